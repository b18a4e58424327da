"""Import of floor plans from the files of drawing, building and mapping tools, and export to them.

`import_plan` and `import_plans` detect a file's format from its bytes. They return a document in the native format
(docs/reference/plan-format.md) and a report of the layers used and the likely mistakes.

importing.py     table of all formats, detection, import and export
formats/         one module per format: reader and writer (DXF: `formats/dxf.py`)
drawing/         vector drawings of any format: walls, the rooms they enclose, door symbols
picture/         scans and photographs of drawings
common/          code that all importers share: options, limits, the sketch, and its conversion to a plan

Begin with `importing.py`. `lalaloc_core.floorplan` defines a plan.
"""

from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.importers.common.assemble import ImportedPlan
from lalaloc_core.importers.common.import_limits import DEFAULT_IMPORT_LIMITS, ImportLimits, ImportStep, OnStep
from lalaloc_core.importers.common.import_options import ImportOptions, KnownDistance
from lalaloc_core.importers.common.import_report import Trace
from lalaloc_core.importers.common.sketch import Level
from lalaloc_core.importers.importing import (
    EXPORT_FORMATS,
    FORMATS,
    ExportFormat,
    begins_with_plans,
    building_name,
    detect_format,
    detect_media_type,
    export_plan,
    import_if_native,
    import_plan,
    import_plans,
    is_json,
    without_storeys_beside,
)
