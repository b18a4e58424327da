"""Scale of drawings: read from the options or the file, never assumed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.options import METRES_PER_UNIT, ImportOptions

_WRITTEN = re.compile(r"(?<![\d.,:])1\s?[:/]\s?(\d{1,4})(?![\d.,:])")
# Common scales of building drawings.
_USUAL = {10, 20, 25, 33, 48, 50, 64, 75, 96, 100, 125, 150, 192, 200, 250, 300, 400, 500, 1000}


def drawing_scale(
    options: ImportOptions,
    subject: str,
    *,
    paper_m_per_unit: float | None = None,
    own: tuple[float, str] | None = None,
    texts: Iterable[str] = (),
    dimensions: Callable[[], tuple[float, str] | None] = lambda: None,
) -> tuple[float, str]:
    """Return metres per unit of a drawing, and the source of that value.

    The options take precedence, then the file's `own` value with its source, then `texts`, which can contain "1:100" if
    a unit has a length on paper, then the `dimensions`. `subject` names the file in the error message.

    Raises:
        InvalidFloorPlanError: neither the options nor the file give a scale.
    """
    if options.known_distance is not None:
        return options.known_distance.metres_per_unit, "option known_distance"
    if options.metres_per_pixel is not None:
        return options.metres_per_pixel, "option metres_per_pixel"
    if options.scale is not None:
        if paper_m_per_unit is None:
            raise InvalidFloorPlanError(
                f"{subject} has no size on paper, so scale=1:{options.scale:g} cannot be used; "
                "set metres_per_pixel or known_distance instead"
            )
        return options.scale * paper_m_per_unit, "option scale"
    if options.units is not None:
        return METRES_PER_UNIT[options.units], "option units"
    if own is not None:
        return own
    written = written_scale(texts)
    if written is not None and paper_m_per_unit is not None:
        return written * paper_m_per_unit, f"1:{written:g}, written in the drawing"
    if (measured := dimensions()) is not None:
        return measured
    hint = f" (1:{written:g} is written in it, but it has no size on paper)" if written is not None else ""
    raise InvalidFloorPlanError(
        f"{subject} gives no scale{hint}: set scale (1:100), metres_per_pixel (metres per unit of the drawing) or "
        "known_distance (x0, y0, x1, y1, metres)"
    )


def written_scale(texts: Iterable[str]) -> int | None:
    """Return the denominator of the only scale written on a drawing, None if there is none or several."""
    found = {int(match) for text in texts for match in _WRITTEN.findall(text)} & _USUAL
    return found.pop() if len(found) == 1 else None
