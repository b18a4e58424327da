"""Unit of a DXF drawing: an option, the header, or the dimensions."""

from __future__ import annotations

from itertools import islice

import numpy as np
from ezdxf.document import Drawing as DxfDocument
from ezdxf.entities.dimension import Dimension as DimensionEntity
from ezdxf.lldxf.const import DXFError

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.geometry import side_lengths
from lalaloc_core.importers.common.import_options import ImportOptions
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.plausibility import UNIT_NAMES, unit_by_parts
from lalaloc_core.importers.drawing.drawing_scale import Dimension, drawing_scale, scale_by_dimensions
from lalaloc_core.importers.drawing.vector_drawing import Drawing

# (metres, value of the option `units`) by $INSUNITS; DXF reference.
_INSUNITS = {1: (0.0254, "in"), 2: (0.3048, "ft"), 4: (1e-3, "mm"), 5: (0.01, "cm"), 6: (1.0, "m"), 14: (0.1, "dm")}
_USUAL_EXTENT_M = (4.0, 120.0)
_MAX_DIMENSIONS = 1000


def find_unit(
    document: DxfDocument, drawing: Drawing, options: ImportOptions, builder: ReportBuilder
) -> tuple[float, str]:
    """Return the metres per unit and their source, the options, $INSUNITS or the dimensions.

    Raises:
        InvalidFloorPlanError: none gives a unit; the message names the likely one.
    """
    code = document.header.get("$INSUNITS", 0)
    own_unit = _INSUNITS.get(code)
    if not drawing.shapes:
        raise InvalidFloorPlanError(
            "the DXF's model space has no lines, areas or hatches; move the plan from the layout to the model space"
        )
    extent = drawing.extent
    measured = None if own_unit is not None else scale_by_dimensions(_dimensions(document), extent)
    sides = [float(np.sqrt(area.shape.area)) for area in drawing.areas if area.role == "room"]
    doors = [side_lengths(area.shape)[1] for area in drawing.areas if area.role == "door"]
    fitting = unit_by_parts([*doors, *(swing.radius for swing in drawing.swings)], extent, sides)
    given = (options.units, options.known_distance, options.metres_per_pixel, own_unit, measured)
    if all(scale is None for scale in given):
        hint = f" and looks like {UNIT_NAMES[fitting]}: units={fitting}" if fitting else ""
        raise InvalidFloorPlanError(
            f"the DXF gives no unit ($INSUNITS is {code}); it is {extent:g} units across{hint}; "
            "set units to mm, cm, m, in or ft"
        )
    own = measured if own_unit is None else (own_unit[0], f"$INSUNITS is {code} ({own_unit[1]})")
    factor, source = drawing_scale(options, "the DXF", own=own)
    if not _USUAL_EXTENT_M[0] <= extent * factor <= 1000.0:
        hint = "check units"
        if fitting is not None and own_unit and fitting != own_unit[1]:
            hint = f"it looks like {UNIT_NAMES[fitting]}: set units={fitting}"
        builder.warnings.append(f"the drawing is {extent * factor:.4g} m across; {hint}")
    return factor, source


def _dimensions(document: DxfDocument) -> list[Dimension]:
    """Return the texts of the linear dimensions in the model space, with the lengths that they measure."""
    found: list[Dimension] = []
    for entity in islice(document.modelspace().query("DIMENSION"), _MAX_DIMENSIONS):
        try:
            length = entity.get_measurement() if isinstance(entity, DimensionEntity) else None
            # Angles and ordinates measure no length.
            if not isinstance(entity, DimensionEntity) or entity.dimtype not in (0, 1) or not isinstance(length, float):
                continue
            style = entity.override()
            shown = f"{round(length * style.get('dimlfac', 1.0), style.get('dimdec', 2)):g}"
        except (DXFError, AttributeError, TypeError, ValueError, ArithmeticError):
            continue
        text = entity.dxf.get("text", "")
        found.append((shown if text in ("", "<>") else text.replace("<>", shown), [length]))
    return found
