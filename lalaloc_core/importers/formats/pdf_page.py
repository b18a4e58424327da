"""Contents of a PDF page: paths, text, and the share covered by pictures, in points with y up."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pypdfium2
import pypdfium2.raw as pdfium
import shapely
from jaxtyping import Float

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.geometry import even_odd_polygons, in_range, polygons_from_geometry
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.drawing.vector_drawing import (
    CURVE_STEPS,
    Area,
    Drawing,
    Lettering,
    Patch,
    Stroke,
    fit_swing,
    is_bluish,
    is_dark,
)

# Functions that count and return the objects of a page, and those of a form in it.
_OF_PAGE: Any = pdfium.FPDFPage_CountObjects, pdfium.FPDFPage_GetObject
_OF_FORM: Any = pdfium.FPDFFormObj_CountObjects, pdfium.FPDFFormObj_GetObject
_MAX_FORM_DEPTH = 8
# Pages' worth of areas that are painted; each takes some milliseconds.
_MAX_PAINTED = 1000
# Opacity (of 255) of fills that can be walls, and of fills that hide what is below them.
_OPAQUE, _HIDING = 60, 230
_MAX_TEXTS, _MAX_LENGTH = 5000, 200
# Smallest packed size of a line or area.
_BYTES_PER_SHAPE = 4
Matrix = Float[np.ndarray, "3 3"]


@dataclass
class PageContent:
    """Drawing on a page, the page's size (points), the share of it that pictures cover, and outlines of drawn texts.

    `out_of_range` lines are left out, as their coordinates are out of range. `painted` is the area of all fills and
    pictures, in pages. `crop` is the part of the page that is read (points); None for all of it. `unit_m` is the length
    of a point on paper.
    """

    page: pypdfium2.PdfPage
    crop: tuple[float, float, float, float] | None = None
    drawing: Drawing = field(default_factory=Drawing)
    size_pt: tuple[float, float] = (0.0, 0.0)
    picture_share: float = 0.0
    letters: list[shapely.Polygon] = field(default_factory=list)
    out_of_range: int = 0
    painted: float = 0.0
    unit_m: float = 0.0


@dataclass
class _Subpath:
    points: list[tuple[float, float]] = field(default_factory=list)
    curves: list[list[tuple[float, float]]] = field(default_factory=list)
    was_curved: bool = False
    is_closed: bool = False


def open_page(content: bytes, number: int) -> tuple[pypdfium2.PdfDocument, pypdfium2.PdfPage]:
    """Open a document and one of its pages, counted from 1. The caller closes the document."""
    try:
        document = pypdfium2.PdfDocument(content)
        pages = len(document)
    except pypdfium2.PdfiumError as error:
        raise InvalidFloorPlanError(
            "the PDF cannot be read: it is damaged or encrypted; save it again without a password"
        ) from error
    if number > pages:
        document.close()
        raise InvalidFloorPlanError(f"page is {number}; the PDF has {pages} pages, set page to one of them")
    try:
        return document, document[number - 1]
    except pypdfium2.PdfiumError as error:
        document.close()
        raise InvalidFloorPlanError(
            f"page {number} of the PDF is damaged and cannot be read; save it again or set page"
        ) from error


def read_page(page: pypdfium2.PdfPage, budget: Budget) -> PageContent:
    """Return the paths and texts of a page, and the share that pictures cover."""
    width, height = page.get_size()
    budget.check_copies(_count_shapes(page.raw, budget), _BYTES_PER_SHAPE)
    found = PageContent(page, size_pt=(float(width), float(height)))
    for item, matrix in _objects(page.raw, np.eye(3), budget):
        kind = pdfium.FPDFPageObj_GetType(item)
        if kind == pdfium.FPDF_PAGEOBJ_PATH:
            found.out_of_range += _add_path(item, matrix, found, budget)
        elif kind == pdfium.FPDF_PAGEOBJ_IMAGE:
            corners = _apply(matrix, [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
            area = shapely.Polygon(corners).area if in_range(corners) else 0.0
            share = min(area / max(width * height, 1.0), 1.0)
            found.picture_share += share
            found.painted += share
        # Rendering the page cannot be stopped.
        if found.painted > _MAX_PAINTED:
            raise InvalidFloorPlanError(
                f"the areas and pictures of the page cover it more than {_MAX_PAINTED} times, the limit; remove areas "
                "that lie over one another"
            )
    text = page.get_textpage()
    for index in range(min(text.count_rects(), _MAX_TEXTS)):
        left, bottom, right, top = text.get_rect(index)
        words = " ".join(text.get_text_bounded(left, bottom, right, top).split())[:_MAX_LENGTH]
        if words:
            found.drawing.letterings.append(Lettering(words, (0.5 * (left + right), 0.5 * (bottom + top))))
    text.close()
    return found


def _count_shapes(holder: Any, budget: Budget, depth: int = 0) -> int:
    """Return the number of objects after forms are expanded, or one more than may be expanded at all."""
    count, get = _OF_FORM if depth else _OF_PAGE
    shapes = max(count(holder), 0)
    for index in range(shapes if depth < _MAX_FORM_DEPTH and shapes <= budget.limits.max_entities else 0):
        if shapes > budget.limits.max_entities:
            break
        item = get(holder, index)
        if item and pdfium.FPDFPageObj_GetType(item) == pdfium.FPDF_PAGEOBJ_FORM:
            shapes += _count_shapes(item, budget, depth + 1)
    return shapes


def _objects(holder: Any, matrix: Matrix, budget: Budget, depth: int = 0) -> Iterator[tuple[Any, Matrix]]:
    """Yield objects with the matrix to page coordinates; forms are expanded."""
    count, get = _OF_FORM if depth else _OF_PAGE
    for index in range(count(holder)):
        budget.spend()
        item = get(holder, index)
        own = pdfium.FS_MATRIX()
        if not item or not pdfium.FPDFPageObj_GetMatrix(item, own):
            continue
        total = matrix @ np.array([[own.a, own.c, own.e], [own.b, own.d, own.f], [0.0, 0.0, 1.0]])
        if pdfium.FPDFPageObj_GetType(item) != pdfium.FPDF_PAGEOBJ_FORM:
            yield item, total
        elif depth < _MAX_FORM_DEPTH:
            yield from _objects(item, total, budget, depth + 1)


def _add_path(item: Any, matrix: Matrix, found: PageContent, budget: Budget) -> int:
    """Add the outlines and lines of a path; return the number of those out of range, which are left out."""
    drawing, (page_width, page_height) = found.drawing, found.size_pt
    fill, stroke = ctypes.c_int(), ctypes.c_int()
    if not pdfium.FPDFPath_GetDrawMode(item, fill, stroke):
        return 0
    is_filled, is_stroked = fill.value != pdfium.FPDF_FILLMODE_NONE, bool(stroke.value)
    fill_colour = _fill(item) if is_filled else None
    is_wall = fill_colour is not None and is_dark(*fill_colour[:3])
    width = ctypes.c_float()
    pdfium.FPDFPageObj_GetStrokeWidth(item, width)
    pen = float(width.value) * float(np.sqrt(abs(np.linalg.det(matrix[:2, :2])))) if is_stroked else 0.0
    shells: list[shapely.Polygon] = []
    out_of_range = 0
    for subpath in _subpaths(item, budget):
        points = _apply(matrix, subpath.points)
        if not in_range(points):
            out_of_range += 1
            continue
        if is_filled:
            width_pt, height_pt = np.ptp(points, axis=0)
            share = min(width_pt / max(page_width, 1.0), 1.0) * min(height_pt / max(page_height, 1.0), 1.0)
            found.painted += float(share)
        swings = [fit_swing(_apply(matrix, curve), "") for curve in subpath.curves] if len(subpath.curves) <= 2 else []
        leaves = [swing for swing in swings if swing is not None]
        if leaves and not is_filled:
            drawing.swings += leaves
        elif len(points) >= 3 and (subpath.is_closed or is_filled):
            shells += polygons_from_geometry(shapely.Polygon(points))
        elif len(points) >= 2 and is_stroked and (line := shapely.LineString(points)).length > 0.0:
            drawing.strokes.append(Stroke(line, "", None, pen, drawing.next_order))
    if not shells:
        return out_of_range
    parts, order = even_odd_polygons(shells), drawing.next_order
    if fill_colour is not None and not is_wall and fill_colour[3] >= _HIDING:
        drawing.patches += [Patch(part, order, is_bluish(*fill_colour[:3])) for part in parts]
    # A coloured floor or a white background has no drawn outline.
    if is_wall or is_stroked:
        drawing.areas += [Area(part, "", None, is_dark=is_wall, width=pen, order=order) for part in parts]
    return out_of_range


def _subpaths(item: Any, budget: Budget) -> list[_Subpath]:
    count = pdfium.FPDFPath_CountSegments(item)
    budget.spend(max(count, 0))
    paths: list[_Subpath] = []
    bezier: list[tuple[float, float]] = []
    x, y = ctypes.c_float(), ctypes.c_float()
    for index in range(count):
        segment = pdfium.FPDFPath_GetPathSegment(item, index)
        if not pdfium.FPDFPathSegment_GetPoint(segment, x, y):
            continue
        point = (float(x.value), float(y.value))
        kind = pdfium.FPDFPathSegment_GetType(segment)
        if kind == pdfium.FPDF_SEGMENT_MOVETO or not paths:
            paths.append(_Subpath([point]))
            bezier = []
        elif kind == pdfium.FPDF_SEGMENT_BEZIERTO:
            bezier.append(point)
            if len(bezier) == 3:
                _add_curve(paths[-1], bezier)
                bezier = []
        else:
            paths[-1].points.append(point)
            paths[-1].was_curved = False
        paths[-1].is_closed |= bool(pdfium.FPDFPathSegment_GetClose(segment))
    return [path for path in paths if len(path.points) > 1]


def _add_curve(path: _Subpath, control: list[tuple[float, float]]) -> None:
    start, (a, b, end) = np.array(path.points[-1]), (np.array(point) for point in control)
    t = np.linspace(0.0, 1.0, CURVE_STEPS + 1)[1:, None]
    points = (1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * end
    piece = [(float(px), float(py)) for px, py in points]
    if path.was_curved:
        path.curves[-1] += piece
    else:
        path.curves.append([path.points[-1], *piece])
    path.points += piece
    path.was_curved = True


def _apply(matrix: Matrix, points: list[tuple[float, float]]) -> Float[np.ndarray, "n 2"]:
    array = np.array(points, dtype=float).reshape(-1, 2)
    return array @ matrix[:2, :2].T + matrix[:2, 2]


def _fill(item: Any) -> tuple[float, float, float, float] | None:
    """Return the channels and the opacity of a fill, 0 to 255; None for one that shows most of what is below it."""
    red, green, blue, alpha = (ctypes.c_uint() for _ in range(4))
    is_opaque = pdfium.FPDFPageObj_GetFillColor(item, red, green, blue, alpha) and alpha.value >= _OPAQUE
    if not is_opaque:
        return None
    return float(red.value), float(green.value), float(blue.value), float(alpha.value)
