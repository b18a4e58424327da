"""Unit of a DXF drawing: an option, the header, or the dimensions."""

from __future__ import annotations

import math
from itertools import islice

from ezdxf.document import Drawing as DxfDocument
from ezdxf.entities.dimension import Dimension as DimensionEntity
from ezdxf.lldxf.const import DXFError

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common import Budget, ReportBuilder
from lalaloc_core.importers.common.import_options import METRES_PER_UNIT, ImportOptions
from lalaloc_core.importers.common.plausibility import UNIT_NAMES, likely_unit, unit_hints
from lalaloc_core.importers.drawing.drawing_scale import Dimension, Scale, drawing_scale, scale_by_dimensions
from lalaloc_core.importers.drawing.scale_guess import assume_scale
from lalaloc_core.importers.drawing.sketch_drawing import guess_drawing
from lalaloc_core.importers.drawing.vector_drawing import Drawing

# (metres, value of the option `units`) by $INSUNITS; DXF reference.
_INSUNITS = {
    1: (0.0254, "in"), 2: (0.3048, "ft"), 4: (1e-3, "mm"), 5: (0.01, "cm"), 6: (1.0, "m"), 9: (2.54e-5, "mil"),
    10: (0.9144, "yd"), 13: (1e-6, "µm"), 14: (0.1, "dm"), 15: (10.0, "dam"), 21: (1200 / 3937, "US survey feet"),
    22: (100 / 3937, "US survey inches"), 23: (3600 / 3937, "US survey yards"),
}  # fmt: skip
# Extents (m) of drawings beyond which the unit is doubted, and those of homes.
_EXTENT_M, _USUAL_M = (4.0, 1000.0), (4.0, 120.0)
_MAX_DIMENSIONS, _MAX_WARNINGS = 1000, 3
# A unit is meant within so many standard deviations of the estimated scale, or this share of it.
_NEAR_STDS, _NEAR = 3.0, 0.1


def find_unit(
    document: DxfDocument, drawing: Drawing, options: ImportOptions, builder: ReportBuilder, budget: Budget
) -> Scale:
    """Return the metres per unit and their source: the options, $INSUNITS, the dimensions, or sizes of parts."""
    code = document.header.get("$INSUNITS", 0)
    if not drawing.shapes:
        remedy = "; ".join(builder.warnings[:_MAX_WARNINGS]) or "move the plan from the layout to the model space"
        raise InvalidFloorPlanError(f"the DXF's model space has no lines, areas or hatches; {remedy}")
    extent, unit = drawing.extent, _INSUNITS.get(code)
    own = None if unit is None else (unit[0], f"$INSUNITS is {code} ({unit[1]})")
    own = own or scale_by_dimensions(_dimensions(document), extent)
    if not any((own, options.units, options.known_distance, options.metres_per_pixel)):
        own = _assumed_unit(drawing, options, builder, budget)
        if own is None:
            fitting = likely_unit(extent, _USUAL_M)
            hint = f" and looks like {UNIT_NAMES[fitting]}: units={fitting}" if fitting else ""
            raise InvalidFloorPlanError(
                f"the DXF gives no unit ($INSUNITS is {code}); it is {extent:g} units across{hint}; "
                "set units to mm, cm, m, in or ft"
            )
    factor, source = drawing_scale(options, "the DXF", own=own)
    if not _EXTENT_M[0] <= extent * factor <= _EXTENT_M[1]:
        builder.warnings += (hints := unit_hints("the drawing's longer side", extent * factor, _USUAL_M, factor))
        budget.hints += hints
    return factor, source


def _assumed_unit(drawing: Drawing, options: ImportOptions, builder: ReportBuilder, budget: Budget) -> Scale | None:
    """Return the only unit that is near the scale by the usual sizes of parts, and report it; None without one."""
    guess = guess_drawing(drawing, budget, flip_y=options.y_axis == "down")
    if guess is None:
        return None
    reach = max(_NEAR_STDS * guess.std, _NEAR)
    fitting = [unit for unit, m in METRES_PER_UNIT.items() if abs(math.log(m / guess.metres_per_unit)) <= reach]
    if len(fitting) != 1:
        return assume_scale(guess, builder)
    builder.scale_clues = guess.clues
    builder.warnings.append(
        f"the DXF gives no unit; {UNIT_NAMES[fitting[0]]} are assumed, as a unit is {guess.metres_per_unit:.3g} m, "
        f"{guess.source}; set units if that is wrong"
    )
    return METRES_PER_UNIT[fitting[0]], f"{UNIT_NAMES[fitting[0]]}, {guess.source}"


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
