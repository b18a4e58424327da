"""Picture of what an import read from a drawing."""

from __future__ import annotations

import numpy as np
import shapely

from lalaloc_core.draw.canvas import INK, document, path, words
from lalaloc_core.importers.common.import_report import Trace, TracePart

_SIZE, _MARGIN, _LEGEND, _LINE = 1600.0, 20.0, 190.0, 22.0
# Colour of lines, fill, width (pixels) and meaning by part, in the order of drawing; Okabe and Ito's palette.
_STYLES: dict[TracePart, tuple[str, str, float, str]] = {
    "room": ("none", "#cfe8d5", 0.0, "room"),
    "no room": ("#cc79a7", "#f3d9e7", 1.0, "inside, but no room"),
    "wall": ("none", "#b9bfc7", 0.0, "wall"),
    "gap": ("none", "#f0e442", 0.0, "gap that was closed"),
    "other": ("#c3c8cf", "none", 0.8, "ignored"),
    "line": ("#8c939c", "none", 1.2, "line of no known kind"),
    "wall line": (INK, "none", 1.2, "line of a wall"),
    "door": ("#b5651d", "none", 1.6, "door"),
    "window": ("#2b7fc9", "none", 1.6, "window"),
    "passage": ("#009e73", "none", 1.6, "passage"),
}


def trace_svg(trace: Trace, title: str) -> str:
    """Draw a trace with a legend of the parts that occur."""
    if not trace.shapes:
        return document(_SIZE, 100, title, [words(_MARGIN, 50, "Nothing was read from a drawing.", 18)])
    x0, y0, x1, y1 = shapely.total_bounds([shape for _, shape in trace.shapes])
    scale = (_SIZE - 2.0 * _MARGIN - _LEGEND) / max(x1 - x0, y1 - y0, 1e-3)
    height = max(scale * (y1 - y0), _LINE * len(_STYLES)) + 2.0 * _MARGIN
    origin = np.array([_MARGIN + _LEGEND - scale * x0, _MARGIN + scale * y1])
    parts, row = [], 0
    for part, (stroke, fill, width, meaning) in _STYLES.items():
        shapes = [shape for kind, shape in trace.shapes if kind == part]
        if not shapes:
            continue
        rings = [ring for shape in shapes for ring in _rings(shape)]
        d = path((ring * np.array([scale, -scale]) + origin for ring in rings), digits=1)
        style = f'stroke="{stroke}" fill="{fill}" stroke-width="{width:g}" fill-rule="evenodd"'
        parts.append(f'<path d="{d}" {style}/>')
        y = _MARGIN + _LINE * row
        parts.append(f'<rect x="{_MARGIN:g}" y="{y:g}" width="16" height="14" {style}/>')
        parts.append(words(_MARGIN + 24, y + 12, meaning, 13))
        row += 1
    return document(_SIZE, height, title, parts)


def _rings(shape: shapely.Geometry) -> list[np.ndarray]:
    """Return the lines of a geometry, and the outlines of its areas."""
    found = []
    for part in shapely.get_parts(shape):
        if isinstance(part, shapely.Polygon):
            found += [np.asarray(ring.coords) for ring in (part.exterior, *part.interiors)]
        elif isinstance(part, shapely.LineString):
            found.append(np.asarray(part.coords))
        elif isinstance(part, shapely.MultiPolygon | shapely.MultiLineString | shapely.GeometryCollection):
            found += _rings(part)
    return found
