"""Floor plans as people have them: read from the files of drawing, building and mapping tools, and written to them.

`import_plan` and `import_plans` take the bytes of a file and find out by its content what it is. Every importer gives a
document in the native format (docs/reference/conventions.md) and a report of what it used and what is likely wrong.

formats/   an importer for each format; `formats/native.py` is the plainest
drawing/   vector drawings, whatever the format: which lines are walls, what they enclose
picture/   scans and photographs of drawings
model/     what importers share: options, limits, the sketch that they fill in, and the plan that becomes of it
exports/   the way back: plans in the formats of other tools

Begin with `importing.py`, which chooses among the formats. What a plan is stands in `lalaloc_core.floorplan`.
"""

from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.importers.exporting import ENDINGS, EXPORT_FORMATS, MEDIA_TYPES, ExportFormat, export_plan
from lalaloc_core.importers.importing import (
    FORMATS,
    detect_format,
    import_if_native,
    import_plan,
    import_plans,
    is_json,
    media_type_of,
)
from lalaloc_core.importers.model.assemble import ImportedPlan
from lalaloc_core.importers.model.limits import DEFAULT_IMPORT_LIMITS, ImportLimits
from lalaloc_core.importers.model.options import ImportOptions, KnownDistance
from lalaloc_core.importers.model.report import ImportReport, LayerUse
from lalaloc_core.importers.model.sketch import Level

__all__ = [
    "DEFAULT_IMPORT_LIMITS",
    "ENDINGS",
    "EXPORT_FORMATS",
    "FORMATS",
    "MEDIA_TYPES",
    "Anchor",
    "ExportFormat",
    "ImportLimits",
    "ImportOptions",
    "ImportReport",
    "ImportedPlan",
    "KnownDistance",
    "LayerUse",
    "Level",
    "detect_format",
    "export_plan",
    "import_if_native",
    "import_plan",
    "import_plans",
    "is_json",
    "media_type_of",
]
