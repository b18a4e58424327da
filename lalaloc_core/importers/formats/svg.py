"""SVG: closed shapes by the words of their layer, id and class; the classes of CubiCasa5K are such words.

svgelements reads shapes, transforms and styles; the document is parsed, bounded and stripped before it sees it.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import shapely
import svgelements
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.drawing.scale import drawing_scale
from lalaloc_core.importers.drawing.shapes import (
    CURVE_STEPS,
    DARK,
    Area,
    Drawing,
    Lettering,
    Stroke,
    luminance,
    swing_of,
)
from lalaloc_core.importers.drawing.understand import understand
from lalaloc_core.importers.formats.xml_text import read_xml
from lalaloc_core.importers.model.assemble import ImportedPlan, assemble
from lalaloc_core.importers.model.geometry import polygons_of
from lalaloc_core.importers.model.limits import Budget
from lalaloc_core.importers.model.options import ImportOptions
from lalaloc_core.importers.model.report import ReportBuilder
from lalaloc_core.importers.model.words import Role, role_of

FORMAT = "svg"
# What the exporter writes, and the importer believes.
SCALE_ATTRIBUTE = "data-metres-per-unit"
_HREF = "{http://www.w3.org/1999/xlink}href"
_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"
# Names that editors give by themselves.
_AUTOMATIC = re.compile(
    r"(?:path|rect|polygon|polyline|line|text|tspan|use|svg|g|group|layer|shape|space|_x)[-_\d.]*", re.I
)
_METRES = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254, "pt": 0.0254 / 72.0, "pc": 0.0254 / 6.0, "px": 0.0254 / 96.0}
_LENGTH = re.compile(r"\s*([0-9.eE+-]+)\s*(mm|cm|in|pt|pc|px|)\s*")
_BYTES_PER_ENTITY = 12


@dataclass(frozen=True)
class _Place:
    """The words around an element, nearest last, and what follows from them."""

    labels: tuple[str, ...] = ()
    role: Role | None = None
    layer: str = ""
    kind: str | None = None

    def inside(self, element: Any) -> _Place:
        """The place of an element in this one; the nearest words that say what something is win."""
        own = element.values.get("attributes") or {}
        texts = [str(own[key])[:200] for key in (_LABEL, "id", "class") if own.get(key)]
        labels = (*self.labels, *texts)[-64:]
        for text in (*texts[::-1],):
            role = role_of(text)
            if role is not None:
                return _Place(labels, role, text, text)
        layer = texts[0] if texts and not self.layer else self.layer
        return _Place(labels, self.role, layer, self.kind)


def import_svg(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """The plan in a SVG drawing.

    Raises:
        InvalidFloorPlanError: what is wrong with the file, or that it does not say its scale.
    """
    root = read_xml(content, budget)
    if root.tag.rpartition("}")[2] != "svg":
        raise InvalidFloorPlanError(f"the root element is <{root.tag.rpartition('}')[2][:50]}>, not <svg>")
    _check_uses(root, budget)
    paper_m, said = _size_on_paper(root), _own_scale(root)
    builder = ReportBuilder()
    drawing = _read(root, options, builder, budget)
    texts = [lettering.text for lettering in drawing.letterings]
    factor, source = drawing_scale(options, "the SVG", paper_m_per_unit=paper_m, said=said, texts=texts)
    if options.y_axis != "up":
        builder.notes.append("y points down in SVG and was turned over")
    drawing = drawing.scaled(factor, turn_over=options.y_axis != "up")
    sketch = understand(drawing, builder, budget)
    plan = assemble(sketch, builder, options, format=FORMAT, metres_per_unit=factor, scale_source=source)
    return (plan,)


def _check_uses(root: Element, budget: Budget) -> None:
    """Count what `<use>` draws again: a few elements that use each other can stand for billions."""
    by_id = {element.get("id"): element for element in root.iter() if element.get("id")}
    sizes: dict[Element, int] = {}
    open_elements: set[Element] = set()

    def size(element: Element) -> int:
        if element in sizes:
            return sizes[element]
        if element in open_elements:
            raise InvalidFloorPlanError("a <use> element draws itself")
        open_elements.add(element)
        total = 1 + len(element.get("d", "")) // _BYTES_PER_ENTITY + len(element.get("points", "")) // _BYTES_PER_ENTITY
        total += sum(size(child) for child in element)
        if element.tag.rpartition("}")[2] == "use":
            target = by_id.get((element.get("href") or element.get(_HREF) or "").removeprefix("#"))
            total += size(target) if target is not None else 0
        open_elements.discard(element)
        sizes[element] = total
        return total

    budget.spend(size(root))


def _size_on_paper(root: Element) -> float | None:
    """Length of a user unit on paper (m), where the drawing has a width with a unit; pixels are none."""
    match = _LENGTH.fullmatch(root.get("width", ""))
    if match is None or match[2] in ("", "px"):
        return None
    try:
        width_m = float(match[1]) * _METRES[match[2]]
        numbers = [float(part) for part in re.split(r"[,\s]+", root.get("viewBox", "").strip()) if part]
    except ValueError:
        return None
    units = numbers[2] if len(numbers) == 4 else width_m / _METRES["px"]
    return width_m / units if width_m > 0.0 and units > 0.0 else None


def _own_scale(root: Element) -> tuple[float, str] | None:
    try:
        value = float(root.get(SCALE_ATTRIBUTE, ""))
    except ValueError:
        return None
    return (value, SCALE_ATTRIBUTE) if 1e-6 <= value <= 1e3 else None


def _read(root: Element, options: ImportOptions, builder: ReportBuilder, budget: Budget) -> Drawing:
    """Everything that is drawn, in user units."""
    for key in ("width", "height", "viewBox", "preserveAspectRatio", "transform"):
        root.attrib.pop(key, None)
    for parent in list(root.iter()):
        for child in list(parent):
            # Pictures are not looked at, and what stands for nothing by itself is drawn where it is used.
            if str(child.tag).rpartition("}")[2] in (
                "image",
                "script",
                "foreignObject",
                "metadata",
                "pattern",
                "marker",
            ):
                parent.remove(child)
    try:
        tree = svgelements.SVG.parse(io.BytesIO(ElementTree.tostring(root)), reify=True, ppi=96.0)
    except (ValueError, TypeError, AttributeError, IndexError, KeyError, ZeroDivisionError, OverflowError) as error:
        raise InvalidFloorPlanError(f"the SVG cannot be read: {error}") from error
    drawing = Drawing()
    for element, place in _walk(tree, _Place()):
        budget.spend()
        if _is_hidden(element):
            continue
        if place.role == "ignored" or not options.wants_layer(*place.labels):
            builder.use(place.layer, "ignored")
        elif isinstance(element, svgelements.Text):
            _add_text(element, place, drawing)
        elif isinstance(element, svgelements.Shape):
            _add_shape(element, place, drawing, builder, budget)
    return drawing


def _walk(group: svgelements.Group, place: _Place) -> Iterator[tuple[Any, _Place]]:
    for element in group:
        here = place.inside(element)
        if isinstance(element, svgelements.Group):
            yield from _walk(element, here)
        else:
            yield element, here


def _is_hidden(element: Any) -> bool:
    values = element.values
    return str(values.get("display")) == "none" or str(values.get("visibility")) == "hidden"


def _add_text(element: Any, place: _Place, drawing: Drawing) -> None:
    text = " ".join((element.text or "").split())[:200]
    at = element.transform.point_in_matrix_space((element.x, element.y))
    if text and np.isfinite([at.x, at.y]).all():
        drawing.letterings.append(Lettering(text, (float(at.x), float(at.y)), place.layer))


def _add_shape(element: Any, place: _Place, drawing: Drawing, builder: ReportBuilder, budget: Budget) -> None:
    name = _name_of(element, place)
    fill: Any = element.fill
    is_filled = fill is not None and fill.value is not None and fill.opacity > 0.2
    is_dark = is_filled and _luminance_of(fill) < DARK
    width = element.stroke_width if element.stroke is not None and element.stroke.value is not None else 0.0
    shells: list[shapely.Polygon] = []
    for points, closed, curves in _outlines(svgelements.Path(element), budget):
        swings = [swing_of(curve, place.layer) for curve in curves] if place.role in (None, "door") else []
        leaves = [swing for swing in swings if swing is not None] if len(swings) <= 2 else []
        if leaves:
            drawing.swings += leaves
            builder.use(place.layer, "swings of doors", len(leaves))
        elif len(points) >= 4 and (closed or (place.role in ("room", "wall", "obstacle") and is_filled)):
            shells += polygons_of(shapely.Polygon(points))
        elif len(points) >= 2 and shapely.LineString(points).length > 0.0:
            drawing.strokes.append(Stroke(shapely.LineString(points), place.layer, place.role, float(width or 0.0)))
            builder.use(place.layer, f"lines: {place.role or 'perhaps walls'}")
    for shape in _with_holes(shells):
        drawing.areas.append(Area(shape, place.layer, place.role, name, place.kind, is_dark))
        builder.use(place.layer, f"areas: {place.role or 'perhaps rooms'}")


def _luminance_of(colour: Any) -> float:
    return luminance(float(colour.red), float(colour.green), float(colour.blue))


def _outlines(path: svgelements.Path, budget: Budget) -> Iterator[tuple[np.ndarray, bool, list[np.ndarray]]]:
    """(points, whether closed, its curves: successive curved segments as one) of every subpath."""
    for subpath in path.as_subpaths():
        segments = [s for s in svgelements.Path(subpath) if not isinstance(s, svgelements.Move)]
        closed = any(isinstance(segment, svgelements.Close) for segment in segments)
        points: list[complex] = []
        curves: list[list[complex]] = []
        was_curved = False
        for segment in segments:
            if segment.start is None or segment.end is None:
                continue
            is_curved = not isinstance(segment, svgelements.Line | svgelements.Close)
            steps = CURVE_STEPS if is_curved else 1
            budget.spend(steps)
            piece = [complex(*segment.point(k / steps)) for k in range(steps + 1)]
            points += piece if not points else piece[1:]
            if is_curved and was_curved:
                curves[-1] += piece[1:]
            elif is_curved:
                curves.append(piece)
            was_curved = is_curved
        array = _array(points)
        if len(array) and np.isfinite(array).all():
            distinct = array[np.concatenate([[True], np.any(np.diff(array, axis=0) != 0.0, axis=1)])]
            back = len(distinct) > 3 and bool(np.all(distinct[0] == distinct[-1]))
            yield distinct, closed or back, [_array(curve) for curve in curves]


def _array(points: list[complex]) -> np.ndarray:
    return np.array([[point.real, point.imag] for point in points]).reshape(-1, 2)


def _with_holes(shells: list[shapely.Polygon]) -> list[shapely.Polygon]:
    """A path of several outlines is filled between them."""
    if len(shells) < 2:
        return shells
    shape: BaseGeometry = shapely.Polygon()
    for shell in shells:
        shape = shapely.symmetric_difference(shape, shell)
    return polygons_of(shape)


def _name_of(element: Any, place: _Place) -> str | None:
    """The label or id of a room's shape; else what its class says beside "room"."""
    own = element.values.get("attributes") or {}
    for key in (_LABEL, "data-name", "id"):
        text = str(own.get(key) or "").strip()
        if text and not _AUTOMATIC.fullmatch(text) and (key != "id" or role_of(text) is None):
            return text.replace("_", " ")
    if place.role != "room" or place.kind is None:
        return None
    words = [word for word in re.findall(r"[^\W\d_]+", place.kind) if word.casefold() not in ("space", "room")]
    return " ".join(words) or None
