"""How long a unit of a drawing is: never assumed, always read or asked for."""

from __future__ import annotations

import re
from collections.abc import Iterable

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.model.options import METRES_PER_UNIT, ImportOptions

_WRITTEN = re.compile(r"(?<![\d.,:])1\s?[:/]\s?(\d{1,4})(?![\d.,:])")
# Scales that buildings are drawn in.
_USUAL = {10, 20, 25, 33, 48, 50, 64, 75, 96, 100, 125, 150, 192, 200, 250, 300, 400, 500, 1000}


def drawing_scale(
    options: ImportOptions,
    what: str,
    *,
    paper_m_per_unit: float | None = None,
    said: tuple[float, str] | None = None,
    texts: Iterable[str] = (),
) -> tuple[float, str]:
    """(metres per unit of a drawing, where that was read).

    Args:
        options: what was asked for goes before everything else.
        what: the file, for the refusal.
        paper_m_per_unit: length of a unit on paper, where the drawing has a size.
        said: metres per unit that the file itself gives, and how.
        texts: lettering, which may hold "1:100".

    Raises:
        InvalidFloorPlanError: nothing says how long a unit is.
    """
    if options.known_distance is not None:
        return options.known_distance.metres_per_unit, "option known_distance"
    if options.metres_per_pixel is not None:
        return options.metres_per_pixel, "option metres_per_pixel"
    if options.scale is not None:
        if paper_m_per_unit is None:
            raise InvalidFloorPlanError(
                f"{what} has no size on paper that a scale of 1:{options.scale:g} could refer to; "
                "give metres_per_pixel or known_distance instead"
            )
        return options.scale * paper_m_per_unit, "option scale"
    if options.units is not None:
        return METRES_PER_UNIT[options.units], "option units"
    if said is not None:
        return said
    written = written_scale(texts)
    if written is not None and paper_m_per_unit is not None:
        return written * paper_m_per_unit, f"1:{written:g}, as is written in the drawing"
    hint = f"; it says 1:{written:g}, but has no size on paper" if written is not None else ""
    raise InvalidFloorPlanError(
        f"{what} does not say how long anything is{hint}: give scale (1:100), metres_per_pixel (metres per unit of the "
        "drawing) or known_distance (x0, y0, x1, y1, metres)"
    )


def written_scale(texts: Iterable[str]) -> int | None:
    """The denominator of the one scale that is written on a drawing; None where there is none, or several."""
    found = {int(match) for text in texts for match in _WRITTEN.findall(text)} & _USUAL
    return found.pop() if len(found) == 1 else None
