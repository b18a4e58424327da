"""Code that all importers share, from options to the finished plan.

Begin with `sketch.py`, which every importer fills in, then `assemble.py`, which turns a sketch into a plan.
`opening_placement.py` moves openings onto walls, and `plausibility.py` finds likely mistakes.
"""

from lalaloc_core.importers.common.assemble import ImportedPlan
from lalaloc_core.importers.common.import_limits import Budget, ImportLimits
from lalaloc_core.importers.common.import_options import ImportOptions
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.sketch import Level, Sketch, SketchedRoom
