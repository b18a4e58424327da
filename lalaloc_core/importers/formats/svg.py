"""SVG drawings. The words in a layer, id or class give a shape its role, as in the data set CubiCasa5K.

svgelements reads shapes, transforms and styles, after this module has parsed, bounded and stripped the XML.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import shapely
import svgelements

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.floorplan.plan_words import Role, fixture_from_name, role_from_name
from lalaloc_core.importers.common import Budget, ImportOptions, ReportBuilder
from lalaloc_core.importers.common.assemble import ImportedPlan
from lalaloc_core.importers.common.bounded_files import local_name, read_xml
from lalaloc_core.importers.common.geometry import in_range, label_position, polygons_of
from lalaloc_core.importers.common.import_options import to_number
from lalaloc_core.importers.common.sketch import SketchedFixture
from lalaloc_core.importers.drawing.drawing_scale import drawing_scale
from lalaloc_core.importers.drawing.scale_guess import assume_scale
from lalaloc_core.importers.drawing.sketch_drawing import guess_drawing
from lalaloc_core.importers.drawing.storeys import by_storey
from lalaloc_core.importers.drawing.vector_drawing import Area, Drawing, Lettering, Paint, Stroke, Subpath, leaves_of
from lalaloc_core.importers.formats.svg_limits import HREF, check_work

# Attribute of the root element with the scale of exported drawings.
_SCALE_ATTRIBUTE = "data-metres-per-unit"
_SVG = "{http://www.w3.org/2000/svg}"
_GROUPS = (svgelements.Group, svgelements.Use)
# Selectors of styles that the library does not apply, after their declarations.
_COMBINED = re.compile(r"(?:^|,)\s*([^\s@,][^,]*[\s>+~\[:][^\s,][^,]*)")
_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"
# Names that editors generate.
_MADE = re.compile(r"(?:path|rect|polygon|polyline|line|text|tspan|use|svg|g|group|layer|shape|space|_x)[-_\d.]*", re.I)
# A character in an id of Illustrator.
_ESCAPED = re.compile(r"_x([0-9A-F]{2,4})_")
_NONZERO = (None, "nonzero")
_METRES = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254, "pt": 0.0254 / 72.0, "pc": 0.0254 / 6.0}
# Pixels per inch, and usual height of letters.
_PPI, _LETTER_PX = 96.0, 16.0
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
# Attributes of the view of a drawing or symbol.
_OF_VIEW = ("x", "y", "width", "height", "viewBox", "preserveAspectRatio", "transform")
# Elements without a shape, and elements that are drawn only where they are used.
_IGNORED_ELEMENTS = ("image", "script", "foreignObject", "metadata", "pattern", "marker", "mask", "clipPath")
# Export at 1:100: user units per metre, millimetres on paper per metre, and margin.
_UNITS_PER_M, _MM_PER_M, _MARGIN_M = 100.0, 10.0, 0.5
_STYLE = (
    ".Space{fill:#eef3f7;stroke:#222;stroke-width:4}.Column{fill:#888}.Wall{stroke:#222;stroke-width:8}"
    ".Door{stroke:#2a7;stroke-width:6}.Window{stroke:#26c;stroke-width:6}.Passage{stroke:#d80;stroke-width:6}"
    "text{font:24px sans-serif;text-anchor:middle}"
)


@dataclass(frozen=True)
class _Context:
    """Labels of the elements around a shape, innermost last, and the role and layer that follow from them.

    `kind` are words about the use of a room; of a fixture, its kind.
    """

    labels: tuple[str, ...] = ()
    role: Role | None = None
    layer: str = ""
    kind: str | None = None
    is_fixture: bool = False

    def nested(self, element: Any) -> _Context:
        """Return the context of a child element; the innermost label with a role decides."""
        own = element.values.get("attributes") or {}
        texts = [str(own[key])[:200] for key in (_LABEL, "id", "class") if own.get(key)]
        labels = (*self.labels, *texts)[-64:]
        for text in texts[::-1]:
            role = role_from_name(text)
            if role is not None:
                return _Context(labels, role, text, text)
        layer = texts[0] if texts and not self.layer else self.layer
        return _Context(labels, self.role, layer, self.kind)


def read(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read the plan in an SVG drawing."""
    root = read_xml(content, budget)
    if local_name(root) != "svg":
        raise InvalidFloorPlanError(f"the root element is <{local_name(root)[:50]}>; it must be <svg>")
    pictures = sum(local_name(element) in ("image", "img") for element in root.iter())
    hypertexts = (element for element in root.iter() if local_name(element) == "foreignObject")
    texts = sum(any(text.strip() for text in element.itertext()) for element in hypertexts)
    for parent in list(root.iter()):
        parent[:] = [child for child in parent if local_name(child) not in _IGNORED_ELEMENTS]
        if local_name(parent) == "text":
            _join_parts(parent)
    views = {e.get("id"): dict(e.attrib) for e in root.iter() if local_name(e) in ("symbol", "svg") and e is not root}
    _place_views(root, views, _view(root.attrib, (0.0, 0.0))[0])
    check_work(root, budget)
    # The title of a shape is its name, unless it has one; the title of the drawing names nothing.
    for element in root.iter():
        title = next((child.text for child in element if local_name(child) == "title"), None)
        if element is not root and title and title.strip():
            element.attrib.setdefault("data-name", title.strip())
    warnings = []
    if pictures:
        subject = "an embedded picture" if pictures == 1 else f"{pictures} embedded pictures"
        warnings = [f"the SVG has {subject}, not read: if the plan is a picture, send that PNG or JPEG itself"]
        budget.hints += warnings
    if texts:
        warnings.append(
            f"{texts} texts are HTML (foreignObject) and are not read, such as names of rooms: export them as plain "
            "text"
        )
    styles = "".join(element.text or "" for element in root.iter() if local_name(element) == "style")
    if found := _COMBINED.search(re.sub(r"\{[^}]*\}", ",", styles)):
        warnings.append(
            f"styles of '{found[1].strip()[:50]}' are not applied: only those of an element, a class or an id are; "
            "save the styles as attributes"
        )
    return _read_plan(root, warnings, options, budget)


def _place_views(parent: Element, views: Mapping[str | None, Mapping[str, str]], size: tuple[float, float]) -> None:
    """Make groups of nested drawings and symbols, with the transforms of their views, which the library reads wrong.

    `views` are their attributes by id, and `size` is that of the view around. Symbols are drawn where they are used.
    """
    for element in parent:
        name, inside, own = local_name(element), size, element.attrib
        if name == "use" and (target := views.get(own.get("href", own.get(HREF, ""))[1:])) is not None:
            moved = {key: value for key, value in own.items() if key in ("x", "y", "width", "height")}
            _, view = _view({**target, "x": "0", "y": "0", **moved}, size)
            own["transform"] = f"{own.get('transform', '')} {view}"
            for key in moved:
                del own[key]
        elif name in ("svg", "symbol"):
            inside, view = _view(own, size)
            inner = Element(f"{_SVG}g", {key: value for key, value in own.items() if key not in _OF_VIEW})
            inner[:] = list(element)
            element.clear()
            element.tag = f"{_SVG}{'defs' if name == 'symbol' else 'g'}"
            element.set("transform", view)
            element.append(inner)
        _place_views(element, views, inside)


def _view(attributes: Mapping[str, str], around: tuple[float, float]) -> tuple[tuple[float, float], str]:
    """Return the size of the view of a drawing or symbol in its own units, and the transform that places it."""
    box = [0.0, 0.0, *around]
    for place, (key, whole) in enumerate(zip(_OF_VIEW, (*around, *around), strict=False)):
        # Words such as "auto" are no length.
        if _NUMBER.match(text := attributes.get(key, "").strip()):
            length: Any = svgelements.Length(text)
            box[place] = float(length.value(_PPI, whole, _LETTER_PX, 0.5 * _LETTER_PX, f"0 0 {around[0]} {around[1]}"))
    view = _box(attributes) or [0.0, 0.0, *(side or 1.0 for side in box[2:])]
    numbers: list[Any] = [*box, *view, attributes.get("preserveAspectRatio", "xMidYMid")]
    transform = svgelements.Viewbox.viewbox_transform(*numbers)
    return (view[2], view[3]), f"{attributes.get('transform', '')} {transform}"


def _box(attributes: Mapping[str, str]) -> list[float] | None:
    """Return the `viewBox`, None without a usable one."""
    box = [float(number) for number in _NUMBER.findall(attributes.get("viewBox", ""))]
    return box if len(box) == 4 and min(box[2:]) > 0.0 else None


def _join_parts(text: Element) -> None:
    """Join the parts of each line of a text, which programs divide at changes of style and for the distance of letters.

    A part with another y than the one before, or moved down by `dy`, begins a line.
    """
    line = text
    for part in list(text):
        words = "".join(part.itertext())
        part[:] = []
        if part.get("y", line.get("y")) != line.get("y") or part.get("dy", "").strip(".0"):
            line, part.text = part, words
        else:
            line.text = f"{line.text or ''}{words}"
            text.remove(part)
        line.text = f"{line.text}{part.tail or ''}"


def _read_plan(root: Element, warnings: list[str], options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read the plan; `warnings` are about what is left out."""
    (unit_m, paper_m), own = _size_on_paper(root), _own_scale(root)
    builder = ReportBuilder("svg", warnings=warnings)
    drawing = _read_drawing(root, options, builder, budget)
    if options.crop is not None:
        drawing = drawing.cropped(options.crop)
    builder.metres_per_unit, builder.scale_source = drawing_scale(
        options,
        "the SVG",
        [drawing],
        budget.check_time,
        paper_m_per_unit=unit_m,
        paper_m=paper_m,
        own=own,
        guess=lambda written: assume_scale(
            guess_drawing(drawing, budget, flip_y=options.y_axis != "up"), builder, written
        ),
    )
    if options.y_axis != "up":
        builder.notes.append("y points down in SVG and was flipped")
    return by_storey({0.0: drawing}, builder, options, budget, flip_y=options.y_axis != "up")


def write(document: Mapping[str, Any], anchor: Anchor | None) -> bytes:
    """Return an SVG drawing at 1:100 with the classes of CubiCasa5K. It has no place for heights and the anchor."""
    corners = np.concatenate([np.asarray(room["polygon"], dtype=float) for room in document["rooms"]])
    low, high = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
    width, height = (float(size) for size in high - low)

    def points(points_m: Sequence[Sequence[float]]) -> str:
        return " ".join(f"{_UNITS_PER_M * x:.4f},{-_UNITS_PER_M * y:.4f}" for x, y in points_m)

    view_box = (_UNITS_PER_M * low[0], -_UNITS_PER_M * high[1], _UNITS_PER_M * width, _UNITS_PER_M * height)
    root = ElementTree.Element(
        "svg",
        {
            "xmlns": "http://www.w3.org/2000/svg",
            "width": f"{_MM_PER_M * width:.3f}mm",
            "height": f"{_MM_PER_M * height:.3f}mm",
            "viewBox": " ".join(f"{value:.4f}" for value in view_box),
            _SCALE_ATTRIBUTE: repr(1.0 / _UNITS_PER_M),
        },
    )
    ElementTree.SubElement(root, "style").text = _STYLE
    for room in document["rooms"]:
        group = ElementTree.SubElement(root, "g", {"class": f"Space {str(room.get('type', '')).capitalize()}".strip()})
        outline = {"points": points(room["polygon"])}
        if room.get("name"):
            outline["data-name"] = room["name"]
        ElementTree.SubElement(group, "polygon", outline)
        for hole in room.get("holes", ()):
            ElementTree.SubElement(root, "polygon", {"class": "Column", "points": points(hole)})
        for wall in room.get("walls", ()):
            ElementTree.SubElement(root, "polyline", {"class": "Wall", "fill": "none", "points": points(wall)})
        x, y = label_position(shapely.Polygon(room["polygon"], room.get("holes")))
        position = {"x": f"{_UNITS_PER_M * x:.2f}", "y": f"{-_UNITS_PER_M * y:.2f}"}
        ElementTree.SubElement(root, "text", position).text = room.get("name", "")
    for opening in document.get("openings", ()):
        attributes = {"class": opening["kind"].capitalize(), "fill": "none", "points": points(opening["line"])}
        ElementTree.SubElement(root, "polyline", attributes)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _size_on_paper(root: Element) -> tuple[float | None, float | None]:
    """Return the lengths (m) on paper of a user unit and the longer side, None if the width has no unit or pixels."""
    sides: list[Any] = [svgelements.Length(root.get(key, "")) for key in ("width", "height")]
    sizes_m = [float(side.amount) * _METRES.get(side.units, 0.0) for side in sides]
    units = (_box(root.attrib) or [size * _PPI / _METRES["in"] for size in (0.0, 0.0, *sizes_m)])[2:]
    scales = [size / unit for size, unit in zip(sizes_m, units, strict=True) if size > 0.0]
    # A drawing is not stretched by default, and leaves a margin on a sheet of other proportions.
    return (min(scales), max(sizes_m)) if scales else (None, None)


def _own_scale(root: Element) -> tuple[float, str] | None:
    value = to_number(root.get(_SCALE_ATTRIBUTE))
    return (value, _SCALE_ATTRIBUTE) if 1e-6 <= value <= 1e3 else None


def _read_drawing(root: Element, options: ImportOptions, builder: ReportBuilder, budget: Budget) -> Drawing:
    """Return all visible shapes and texts in user units."""
    for key in ("width", "height", "viewBox", "preserveAspectRatio", "transform"):
        root.attrib.pop(key, None)
    try:
        tree = svgelements.SVG.parse(io.BytesIO(ElementTree.tostring(root)), reify=True, ppi=_PPI)
    except (ValueError, TypeError, AttributeError, IndexError, KeyError, ZeroDivisionError, OverflowError) as error:
        raise InvalidFloorPlanError("the SVG has values that cannot be read; save it as plain SVG") from error
    drawing = Drawing()
    for element, context in _walk(tree, _Context()):
        budget.spend()
        if _is_hidden(element):
            continue
        if context.is_fixture and options.includes_layer(*context.labels):
            _add_fixture(element, context, drawing, builder, budget)
        elif context.role in ("ignored", "demolished") or not options.includes_layer(*context.labels):
            builder.leave_out(context.layer, context.role)
        elif isinstance(element, svgelements.Text):
            _add_text(element, context, drawing)
        elif isinstance(element, svgelements.Shape):
            _add_shape(element, context, drawing, builder, budget)
    return drawing


def _walk(group: svgelements.Group | svgelements.Use, context: _Context) -> Iterator[tuple[Any, _Context]]:
    for element in group:
        nested = context.nested(element)
        # Words such as "furniture" or "sanitary" tell a bath from a bathroom.
        fixture = fixture_from_name(*nested.labels[len(context.labels) :]) if nested.role == "ignored" else None
        if fixture is not None:
            yield element, _Context(nested.labels, nested.role, nested.layer, fixture, is_fixture=True)
        elif isinstance(element, _GROUPS):
            yield from _walk(element, nested)
        else:
            yield element, nested


def _add_fixture(fixture: Any, context: _Context, drawing: Drawing, builder: ReportBuilder, budget: Budget) -> None:
    """Add the smallest rectangle around a shape or the shapes of a group."""
    parts = fixture.select() if isinstance(fixture, _GROUPS) else [fixture]
    points = []
    for part in parts:
        budget.spend()
        if isinstance(part, svgelements.Shape) and not _is_hidden(part):
            points += [outline for outline, _, _ in _outlines(part, budget) if len(outline)]
    box = shapely.minimum_rotated_rectangle(shapely.MultiPoint(np.concatenate(points))) if points else None
    if context.kind is not None and isinstance(box, shapely.Polygon):
        builder.use(context.layer, f"fixtures: {context.kind}")
        drawing.fixtures.append(SketchedFixture(context.kind, box, context.layer))
    else:
        builder.use(context.layer, "ignored")


def _is_hidden(element: Any) -> bool:
    values = element.values
    # As "0", "0.0" or "0%".
    is_transparent = not str(values.get("opacity", 1)).strip("0.%")
    is_invisible = str(values.get("visibility")).startswith(("hidden", "collapse"))
    return is_transparent or is_invisible or str(values.get("display")).startswith("none")


def _add_text(element: Any, context: _Context, drawing: Drawing) -> None:
    text = " ".join((element.text or "").split())[:200]
    point = element.transform.point_in_matrix_space((element.x, element.y))
    if text and in_range(np.array([point.x, point.y], dtype=float)):
        drawing.letterings.append(Lettering(text, (float(point.x), float(point.y)), context.layer))


def _add_shape(element: Any, context: _Context, drawing: Drawing, builder: ReportBuilder, budget: Budget) -> None:
    role, layer, fill, pen = context.role, context.layer, _paint(element.fill), _paint(element.stroke)
    is_filled, width = fill is not None and fill.is_visible, float((pen and element.stroke_width) or 0.0)
    shells: list[shapely.Polygon] = []
    for points, closed, curves in _outlines(element, budget):
        if leaves := leaves_of(curves, layer) if role in (None, "door") else []:
            drawing.swings += leaves
            builder.use(layer, "door swings", len(leaves))
        elif pen is not None and not pen.is_visible and not closed and role is None:
            builder.use(layer, "ignored (invisible)")
        elif len(points) >= 4 and (closed or (role in ("room", "wall", "obstacle") and is_filled)):
            shells += polygons_of(shapely.Polygon(points))
        elif len(points) >= 2 and (line := shapely.LineString(points)).length > 0.0:
            is_white = pen is not None and pen.is_white
            drawing.strokes.append(Stroke(line, layer, role, width, drawing.next_order, is_white))
            builder.use(layer, f"lines: {role or 'possible walls'}")
        elif not len(points):
            builder.use(layer, "ignored (coordinates out of range)")
    if shells:
        is_wall = fill is not None and is_filled and fill.is_dark
        is_nonzero = element.values.get("fill-rule") in _NONZERO
        like = Area(shells[0], layer, role, _name_of(element, context), context.kind, is_wall, width)
        count = drawing.add_areas(shells, like, fill, is_nonzero=is_filled and is_nonzero, has_line=True)
        builder.use(layer, f"areas: {role or 'possible rooms'}", count)


def _paint(colour: Any) -> Paint | None:
    if colour is None or colour.value is None:
        return None
    return Paint(float(colour.red), float(colour.green), float(colour.blue), float(colour.alpha))


def _outlines(shape: svgelements.Shape, budget: Budget) -> Iterator[tuple[np.ndarray, bool, list[np.ndarray]]]:
    """Yield the points of every subpath, whether it is closed, and its curves (runs of curved segments).

    A subpath whose coordinates are out of range has no points.
    """
    # Rectangles and ellipses still have the transform that turns them.
    for segments in abs(svgelements.Path(shape)).as_subpaths():
        path = Subpath()
        for segment in svgelements.Path(segments):
            path.is_closed |= isinstance(segment, svgelements.Close)
            if isinstance(segment, svgelements.Move) or segment.start is None or segment.end is None:
                continue
            is_curved = not isinstance(segment, svgelements.Line | svgelements.Close)
            steps = Subpath.STEPS if is_curved else 1
            budget.spend(steps)
            path.add([(*segment.point(k / steps),) for k in range(steps + 1)], is_curved=is_curved)
        points = np.array(path.points, dtype=float).reshape(-1, 2)
        if not in_range(points):
            yield np.empty((0, 2)), False, []
        elif len(points):
            points = points[np.concatenate([[True], np.any(np.diff(points, axis=0) != 0.0, axis=1)])]
            returns = len(points) > 3 and bool(np.all(points[0] == points[-1]))
            yield points, path.is_closed or returns, [np.array(curve) for curve in path.curves]


def _name_of(element: Any, context: _Context) -> str | None:
    """Return the label or id of a room's shape, else the words of its class besides "room"."""
    own = element.values.get("attributes") or {}
    for key in (_LABEL, "data-name", "id"):
        text = _ESCAPED.sub(lambda found: chr(int(found[1], 16)), str(own.get(key) or "")).strip()
        if text and not _MADE.fullmatch(text) and (key != "id" or role_from_name(text) is None):
            return text.replace("_", " ")
    if context.role != "room" or context.kind is None:
        return None
    words = [word for word in re.findall(r"[^\W\d_]+", context.kind) if word.casefold() not in ("space", "room")]
    return " ".join(words) or None
