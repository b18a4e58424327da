"""Contents of a PDF page: paths, text, and the share covered by pictures, in points with y up."""

from __future__ import annotations

import codecs
import ctypes
import io
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pypdfium2
import pypdfium2.raw as pdfium
import shapely
from jaxtyping import Float, UInt8

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.assemble import clean_name
from lalaloc_core.importers.common.geometry import in_range, point_xy, polygons_of
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.drawing.vector_drawing import Area, Drawing, Lettering, Paint, Stroke, Subpath, leaves_of

# Functions that count and return the objects of a page, and those of a form in it.
_OF_PAGE: Any = pdfium.FPDFPage_CountObjects, pdfium.FPDFPage_GetObject
_OF_FORM: Any = pdfium.FPDFFormObj_CountObjects, pdfium.FPDFFormObj_GetObject
_MAX_FORM_DEPTH = 8
# Pages' worth of areas that are painted; each takes some milliseconds.
_MAX_PAINTED = 1000
_MAX_TEXTS, _MAX_LENGTH = 5000, 200
# Smallest packed size of a line or area.
_BYTES_PER_SHAPE = 4
# Pixels of the longer side of a page on which hidden objects are looked for, and bytes of the name of a layer.
_SEEN_PX, _NAME_BYTES = 400, 200
_LAYER, _USER_UNIT = re.compile(rb"/OC(?:G|MD)\b"), re.compile(rb"/UserUnit\s+(\d{1,5}(?:\.\d{1,9})?)")
# Members of layers that are shown depending on others or on their use: on screens or in print.
_CONDITION = re.compile(rb"/(?=(?:VE|OCGs)\s*[\[\d]|Usage\b)[VOU]")
_USES, _MARKS_OF_ORDER = (None, "print"), (codecs.BOM_UTF16_BE, codecs.BOM_UTF16_LE)
_METRES_PER_POINT = 0.0254 / 72.0
Matrix = Float[np.ndarray, "3 3"]


@dataclass
class PageContent:
    """Drawing on a page, the page's size (points), the share of it that pictures cover, and outlines of drawn texts.

    `out_of_range` lines are left out, as their coordinates are out of range. `painted` is the area of all fills and
    pictures, in pages. `crop` is the part of the page that is read (points); None for all of it. `unit_m` is the length
    of a point on paper. `hidden` counts the objects on layers that are switched off, by layer, which are left out.
    """

    page: pypdfium2.PdfPage
    crop: tuple[float, float, float, float] | None = None
    drawing: Drawing = field(default_factory=Drawing)
    size_pt: tuple[float, float] = (0.0, 0.0)
    picture_share: float = 0.0
    letters: list[shapely.Polygon] = field(default_factory=list)
    out_of_range: int = 0
    painted: float = 0.0
    unit_m: float = _METRES_PER_POINT
    hidden: Counter[str] = field(default_factory=Counter)


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


def read_page(page: pypdfium2.PdfPage, number: int, budget: Budget) -> PageContent:
    """Return the paths and texts of a page, counted from 1, and the share that pictures cover.

    Objects on layers that are switched off are made inactive, so that the page is drawn without them, too.
    """
    budget.check_copies(_count_shapes(page.raw, budget), _BYTES_PER_SHAPE)
    spent, found = budget.entities, _read_objects(page, budget)
    unit, hidden = None, Counter[str]()
    # A page that cannot be copied has no layers that are known.
    with suppress(pypdfium2.PdfiumError), pypdfium2.PdfDocument.new() as alone, io.BytesIO() as file:
        # The dictionaries of the file can be compressed; those of a copy of its page are not.
        alone.import_pages(page.pdf, [number - 1])
        alone.save(file)
        unit = _USER_UNIT.search(file.getvalue())
        if _LAYER.search(file.getvalue()):
            with pypdfium2.PdfDocument(_CONDITION.sub(b"/-", file.getvalue())) as copy:
                hidden = _hide(page, copy[0], budget)
    if hidden:
        budget.entities = spent
        found = _read_objects(page, budget)
    # The library takes the unit for a point.
    found.hidden, found.unit_m = hidden, _METRES_PER_POINT * ((unit and float(unit[1])) or 1.0)
    text = page.get_textpage()
    for index in range(min(text.count_rects(), _MAX_TEXTS)):
        left, bottom, right, top = text.get_rect(index)
        words = " ".join(text.get_text_bounded(left, bottom, right, top).split())[:_MAX_LENGTH]
        if words:
            found.drawing.letterings.append(Lettering(words, (0.5 * (left + right), 0.5 * (bottom + top))))
    text.close()
    return found


def _read_objects(page: pypdfium2.PdfPage, budget: Budget) -> PageContent:
    """Return the paths of a page, and the share that pictures cover."""
    width, height = page.get_size()
    found = PageContent(page, size_pt=(float(width), float(height)))
    for item, matrix, _ in _objects(page.raw, np.eye(3)):
        budget.spend()
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
    return found


def _hide(page: pypdfium2.PdfPage, copy: pypdfium2.PdfPage, budget: Budget) -> Counter[str]:
    """Make objects on layers that are switched off inactive, and count them by layer.

    The library states no layer's state, but draws accordingly: hidden is what is drawn on the copy alone, which is of a
    document without states and conditions.
    """
    layers: defaultdict[tuple[str, ...], list[tuple[Any, Any]]] = defaultdict(list)
    drawn, same = (list(_objects(part.raw, np.eye(3))) for part in (page, copy))
    for (item, _, names), (copied, _, _) in zip(drawn, same, strict=False):
        layers[names].append((item, copied))
    pairs = [pair for group in layers.values() for pair in group]
    _activate(pairs, is_active=False)

    def hidden_of(group: Sequence[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
        budget.check_time()
        _activate(group, is_active=True)
        seen, all_seen = _pixels(page), _pixels(copy)
        _activate(group, is_active=False)
        if not seen.any() or len(group) == 1 or np.array_equal(seen, all_seen):
            return list(group) if all_seen.any() and not seen.any() else []
        half = len(group) // 2
        return [*hidden_of(group[:half]), *hidden_of(group[half:])]

    hidden = {names: hidden_of(group) for names, group in layers.items()}
    _activate(pairs, is_active=True)
    _activate([pair for group in hidden.values() for pair in group], is_active=False)
    shown = {name for names, group in layers.items() if len(group) > len(hidden[names]) for name in names}
    return +Counter({", ".join(n for n in names if n not in shown): len(group) for names, group in hidden.items()})


def _activate(pairs: Sequence[tuple[Any, Any]], *, is_active: bool) -> None:
    for item in (item for pair in pairs for item in pair):
        pdfium.FPDFPageObj_SetIsActive(item, is_active)


def _pixels(page: pypdfium2.PdfPage) -> UInt8[np.ndarray, "h w c"]:
    """Return the pixels of the active objects of a page, transparent where there are none on a screen or in print."""
    look: Any = {"scale": _SEEN_PX / max(*page.get_size(), 1.0), "fill_color": (0, 0, 0, 0), "draw_annots": False}
    drawn = [page.render(**look, may_draw_forms=False, optimize_mode=use).to_numpy() for use in _USES]
    return np.minimum(*drawn)


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


def _objects(
    holder: Any, matrix: Matrix, depth: int = 0, layers: tuple[str, ...] = ()
) -> Iterator[tuple[Any, Matrix, tuple[str, ...]]]:
    """Yield active objects with the matrix to page coordinates, and the names of their layers; forms are expanded."""
    count, get = _OF_FORM if depth else _OF_PAGE
    for index in range(count(holder)):
        item = get(holder, index)
        own, active = pdfium.FS_MATRIX(), ctypes.c_int()
        if not item or not pdfium.FPDFPageObj_GetMatrix(item, own):
            continue
        if pdfium.FPDFPageObj_GetIsActive(item, active) and not active.value:
            continue
        total = matrix @ np.array([[own.a, own.c, own.e], [own.b, own.d, own.f], [0.0, 0.0, 1.0]])
        names = (*layers, *_layers_of(item))
        if pdfium.FPDFPageObj_GetType(item) != pdfium.FPDF_PAGEOBJ_FORM:
            yield item, total, names
        elif depth < _MAX_FORM_DEPTH:
            yield from _objects(item, total, depth + 1, names)


def _layers_of(item: Any) -> Iterator[str]:
    """Yield the names of the layers of an object; of marks of other kinds only those with a name count."""
    name, size = (ctypes.c_ubyte * _NAME_BYTES)(), ctypes.c_ulong()
    for index in range(pdfium.FPDFPageObj_CountMarks(item)):
        mark = pdfium.FPDFPageObj_GetMark(item, index)
        if pdfium.FPDFPageObjMark_GetParamBlobValue(mark, b"Name", name, _NAME_BYTES, size):
            raw = bytes(name)[: size.value]
            yield clean_name(raw.decode("utf-16" if raw[:2] in _MARKS_OF_ORDER else "latin-1", "replace")) or ""


def _add_path(item: Any, matrix: Matrix, found: PageContent, budget: Budget) -> int:
    """Add the outlines and lines of a path; return the number of those out of range, which are left out."""
    drawing = found.drawing
    fill, stroke = ctypes.c_int(), ctypes.c_int()
    if not pdfium.FPDFPath_GetDrawMode(item, fill, stroke):
        return 0
    is_filled = fill.value != pdfium.FPDF_FILLMODE_NONE
    paint = _paint(item, pdfium.FPDFPageObj_GetFillColor) if is_filled else None
    pen = _paint(item, pdfium.FPDFPageObj_GetStrokeColor) if stroke.value else None
    width = ctypes.c_float()
    pdfium.FPDFPageObj_GetStrokeWidth(item, width)
    width_pt = float(width.value) * float(np.sqrt(abs(np.linalg.det(matrix[:2, :2])))) if pen is not None else 0.0
    shells: list[shapely.Polygon] = []
    out_of_range = 0
    for subpath in _subpaths(item, budget):
        points = _apply(matrix, subpath.points)
        if not in_range(points):
            out_of_range += 1
            continue
        if is_filled:
            found.painted += float(np.minimum(np.ptp(points, axis=0) / np.maximum(found.size_pt, 1.0), 1.0).prod())
        leaves = [] if pen is None or is_filled else leaves_of([_apply(matrix, curve) for curve in subpath.curves])
        if leaves:
            drawing.swings += leaves
        elif len(points) >= 3 and (is_filled or (subpath.is_closed and pen is not None)):
            shells += polygons_of(shapely.Polygon(points))
        elif len(points) >= 2 and pen is not None and (line := shapely.LineString(points)).length > 0.0:
            drawing.strokes.append(Stroke(line, "", None, width_pt, drawing.next_order, pen.is_white))
    if shells:
        like = Area(shells[0], "", is_dark=paint is not None and paint.is_dark, width=width_pt)
        is_nonzero = fill.value == pdfium.FPDF_FILLMODE_WINDING
        drawing.add_areas(shells, like, paint, is_nonzero=is_nonzero, has_line=pen is not None)
    return out_of_range


def _subpaths(item: Any, budget: Budget) -> list[Subpath]:
    count = pdfium.FPDFPath_CountSegments(item)
    budget.spend(max(count, 0))
    paths: list[Subpath] = []
    bezier: list[tuple[float, float]] = []
    x, y = ctypes.c_float(), ctypes.c_float()
    for index in range(count):
        segment = pdfium.FPDFPath_GetPathSegment(item, index)
        if not pdfium.FPDFPathSegment_GetPoint(segment, x, y):
            continue
        point = (float(x.value), float(y.value))
        kind = pdfium.FPDFPathSegment_GetType(segment)
        if kind == pdfium.FPDF_SEGMENT_MOVETO or not paths:
            paths.append(Subpath([point]))
            bezier = []
        elif kind == pdfium.FPDF_SEGMENT_BEZIERTO:
            bezier.append(point)
            if len(bezier) == 3:
                paths[-1].add(_curve(paths[-1].points[-1], *bezier), is_curved=True)
                bezier = []
        else:
            paths[-1].add([paths[-1].points[-1], point], is_curved=False)
        paths[-1].is_closed |= bool(pdfium.FPDFPathSegment_GetClose(segment))
    return [path for path in paths if len(path.points) > 1]


def _curve(*control: tuple[float, float]) -> list[tuple[float, float]]:
    """Return the points of a Bézier curve."""
    start, a, b, end = map(np.array, control)
    t = np.linspace(0.0, 1.0, Subpath.STEPS + 1)[:, None]
    return list(map(point_xy, (1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * end))


def _apply(matrix: Matrix, points: list[tuple[float, float]]) -> Float[np.ndarray, "n 2"]:
    array = np.array(points, dtype=float).reshape(-1, 2)
    return array @ matrix[:2, :2].T + matrix[:2, 2]


def _paint(item: Any, get: Any) -> Paint | None:
    channels = [ctypes.c_uint() for _ in range(4)]
    paint = Paint(*(float(channel.value) for channel in channels)) if get(item, *channels) else None
    return paint if paint is not None and paint.is_visible else None
