"""DXF drawings.

Rooms are closed polylines and hatches on layers named after rooms, otherwise the areas that walls enclose. Doors and
windows are recognised by the names of layers and blocks, or by the arcs of door leaves. ezdxf reads the file and
repairs it if it is damaged. Block contents are counted before they are expanded.
"""

from __future__ import annotations

import io
import threading
from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from ezdxf import options as dxf_options  # pyright: ignore[reportPrivateImportUsage]
from ezdxf import path as dxf_path
from ezdxf import recover
from ezdxf.document import Drawing as DxfDocument
from ezdxf.entities.dxfentity import DXFEntity, DXFTagStorage
from ezdxf.entities.dxfgfx import DXFGraphic
from ezdxf.entities.hatch import Hatch
from ezdxf.entities.image import Image
from ezdxf.entities.insert import Insert
from ezdxf.entities.layer import Layer
from ezdxf.entities.lwpolyline import LWPolyline
from ezdxf.entities.mline import MLine
from ezdxf.entities.mpolygon import MPolygon
from ezdxf.entities.mtext import MText
from ezdxf.entities.polyline import Polyface, Polyline, Polymesh
from ezdxf.entities.text import Text
from ezdxf.filemanagement import new as new_dxf
from ezdxf.lldxf.const import DXFError
from ezdxf.lldxf.tagger import binary_tags_loader
from ezdxf.lldxf.tagwriter import TagWriter
from ezdxf.math import Vec3
from jaxtyping import Float

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.floorplan.plan_words import Role, fixture_from_name, role_from_name
from lalaloc_core.importers.common import Budget, ImportedPlan, ImportOptions, ReportBuilder
from lalaloc_core.importers.common.geometry import even_odd_polygons, in_range, label_position, polygons_of
from lalaloc_core.importers.common.sketch import SketchedFixture
from lalaloc_core.importers.drawing.storeys import by_storey
from lalaloc_core.importers.drawing.vector_drawing import Area, Drawing, Lettering, Stroke, joined, leaves_of
from lalaloc_core.importers.formats.dxf_unit import find_unit

_LINES = {"LINE", "LWPOLYLINE", "POLYLINE", "ARC", "CIRCLE", "ELLIPSE", "SPLINE"}
_STRAIGHT = {"LINE", "LWPOLYLINE", "POLYLINE"}
_FILLED = {"HATCH", "MPOLYGON", "SOLID", "TRACE", "3DFACE"}
_TEXTS = {"TEXT", "MTEXT", "ATTRIB"}
_READ = _LINES | _FILLED | _TEXTS | {"INSERT"}
# Alignments of texts that reach from one point to another. Half of the width of a letter and of the distance of lines,
# relative to the height of letters, and letters of a name.
_BETWEEN, _HALF_LETTER, _HALF_LINE, _LETTERS = (3, 5), 0.3, 0.8, 12
# Roles that blocks have by their own names.
_OF_BLOCKS = {"door", "window", "passage", "obstacle", "ignored", "demolished"}
# Entities that draw no part of a building.
_NO_LINES = {"POINT", "DIMENSION", "ARC_DIMENSION", "LARGE_RADIAL_DIMENSION", "LEADER", "MULTILEADER", "TOLERANCE",
             "VIEWPORT", "WIPEOUT", "RAY", "XLINE", "ATTDEF", "LIGHT", "ACAD_TABLE", "OLE2FRAME", "IMAGE"}  # fmt: skip
# Remedies for what is not read; EXPLODE makes lines of other kinds.
_BIND = "bind it (XREF, Bind), or send that drawing"
_DASHED = " is to be demolished or lies above and was left out: draw walls with whole lines"
_UNPLOTTED = " is not plotted, and was left out: plot it, or set layers to those that are read"
_MAKE_PLAIN = "turn such objects into lines (EXPORTTOAUTOCAD), or print a PDF"
_REMEDIES = {"PDFUNDERLAY": "send that PDF, or import it (PDFIMPORT)", "DGNUNDERLAY": "import it (DGNIMPORT)",
             "DWFUNDERLAY": "send the drawing it was made of", "ACAD_PROXY_ENTITY": _MAKE_PLAIN}  # fmt: skip
_MAX_NAMED_LAYERS = 20
_MAX_BLOCK_DEPTH = 16
_BYTES_PER_SHAPE = 10
# Maximum distance of a curve from its polyline, as a share of the drawing's size.
_SAG = 2e-5
# Members with a point of an entity, and heights that are told apart.
_PLACES, _MOST_HEIGHTS = ("start", "center", "insert", "elevation", "vtx0", "location"), 1000
# Largest relation of the widths of a polyline that are one.
_SAME_WIDTH = 1.05
# A polyline is closed if its ends are nearer than this share of its length. The distance to the origin must not matter,
# because surveyed coordinates are large.
_CLOSED = 1e-5
# Layers of exported drawings, with their colours.
_LAYERS = {"ROOM": 7, "COLUMN": 8, "WALL": 1, "DOOR": 3, "WINDOW": 5, "PASSAGE": 30, "ROOM-TEXT": 2}
_INSUNITS_METRES = 6
# Held while the options of ezdxf, which all threads share, are changed.
_OPTIONS = threading.Lock()


@dataclass(frozen=True)
class _Context:
    """Effective layer of an entity, its role by the name of its layer or block, and the fixture that a block shows."""

    layer: str
    role: Role | None
    fixture: str | None = None


def read(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read the plan in the model space of a DXF drawing."""
    document = _open(content)
    _check_blocks(document, budget)
    builder = ReportBuilder("dxf")
    drawings: Mapping[float, Drawing] = _read_drawings(document, options, builder, budget)
    if options.crop is not None:
        drawings = {height: drawing.cropped(options.crop) for height, drawing in drawings.items()}
    whole = joined(drawings.values())
    builder.metres_per_unit, builder.scale_source = find_unit(document, whole, options, builder, budget)
    if options.y_axis is None and document.header.get("$UCSYDIR", (0.0, 1.0, 0.0))[1] < -0.5:
        builder.warnings.append(
            "y points down in the file's coordinate system ($UCSYDIR); set y_axis=down if the plan is mirrored"
        )
    return by_storey(drawings, builder, options, budget, flip_y=options.y_axis == "down")


@contextmanager
def _fixed_metadata() -> Iterator[None]:
    """Let ezdxf write fixed times and ids, so that a plan always gives the same file."""
    with _OPTIONS:
        before = dxf_options.write_fixed_meta_data_for_testing
        dxf_options.write_fixed_meta_data_for_testing = True
        try:
            yield
        finally:
            dxf_options.write_fixed_meta_data_for_testing = before


@_fixed_metadata()
def write(document: Mapping[str, Any], anchor: Anchor | None) -> bytes:
    """Return a plan as a DXF drawing in metres; heights, ids and the anchor are lost."""
    drawing = new_dxf("R2010")
    drawing.header["$INSUNITS"] = _INSUNITS_METRES
    for layer, colour in _LAYERS.items():
        drawing.layers.add(layer, color=colour)
    space = drawing.modelspace()
    for room in document["rooms"]:
        space.add_lwpolyline(room["polygon"], close=True, dxfattribs={"layer": "ROOM"})
        for hole in room.get("holes", ()):
            space.add_lwpolyline(hole, close=True, dxfattribs={"layer": "COLUMN"})
        for start, end in room.get("walls", ()):
            space.add_line(start, end, dxfattribs={"layer": "WALL"})
        if room.get("name"):
            position = label_position(shapely.Polygon(room["polygon"], room.get("holes")))
            space.add_text(room["name"], height=0.2, dxfattribs={"layer": "ROOM-TEXT"}).set_placement(position)
    for opening in document.get("openings", ()):
        start, end = opening["line"]
        space.add_line(start, end, dxfattribs={"layer": opening["kind"].upper()})
    # ezdxf would add the classes in the order of a set, which differs between processes.
    for kind in sorted(drawing.entitydb.dxf_types_in_use()):
        drawing.classes.add_class(kind)
    text = io.StringIO()
    drawing.write(text)
    return text.getvalue().encode()


def _open(content: bytes) -> DxfDocument:
    try:
        if content.startswith(b"AutoCAD Binary DXF"):
            text = io.StringIO()
            writer = TagWriter(text, dxfversion="AC1032")
            for tag in binary_tags_loader(content):
                writer.write_tag(tag)
            content = text.getvalue().encode()
        document, _ = recover.read(io.BytesIO(content))
    except (DXFError, OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InvalidFloorPlanError("the DXF is damaged and cannot be read; save it as DXF R2010 or later") from error
    return document


def _check_blocks(document: DxfDocument, budget: Budget) -> None:
    """Check the number of entities after expansion; nested arrays of blocks can multiply to billions."""
    sizes: dict[str, int] = {}

    def size(name: str, depth: int) -> int:
        if depth > _MAX_BLOCK_DEPTH:
            raise InvalidFloorPlanError(
                f"blocks are nested more than {_MAX_BLOCK_DEPTH} deep or contain themselves; explode them"
            )
        if name not in sizes:
            block = document.blocks.get(name)
            sizes[name] = 0 if block is None else total(block, depth + 1)
        return sizes[name]

    def total(entities: Iterable[DXFEntity], depth: int) -> int:
        count = 0
        for entity in entities:
            if isinstance(entity, Insert):
                # Every copy counts, also of an empty block, with its attributes.
                copies = max(entity.dxf.row_count, 1) * max(entity.dxf.column_count, 1)
                count += len(entity.attribs) + copies * (1 + size(entity.dxf.name, depth))
            else:
                count += _weight(entity)
            if count > budget.limits.max_entities:
                break
        return count

    shapes = total(document.modelspace(), 0)
    budget.spend(shapes)
    budget.check_copies(shapes, _BYTES_PER_SHAPE)


def _weight(entity: DXFEntity) -> int:
    """Return the weight of an entity in the budget, which grows with its vertices."""
    kind = entity.dxftype()
    if kind in ("LWPOLYLINE", "POLYLINE"):
        return 1 + len(entity) // 2  # type: ignore[arg-type]
    if kind == "SPLINE":
        return 1 + entity.control_point_count()  # type: ignore[attr-defined]
    if isinstance(entity, MLine):
        return 1 + len(entity.vertices) * max((len(vertex.line_params) for vertex in entity.vertices), default=1)
    return 1


def _read_drawings(
    document: DxfDocument, options: ImportOptions, builder: ReportBuilder, budget: Budget
) -> dict[float, Drawing]:
    """Return what is drawn at each height."""
    drawings: defaultdict[float, Drawing] = defaultdict(Drawing)
    states = (Layer.is_off, Layer.is_frozen, lambda layer: not layer.dxf.plot)
    off, frozen, unplotted = (frozenset(x.dxf.name.casefold() for x in document.layers if state(x)) for state in states)
    low, high = document.header.get("$EXTMIN", (0, 0, 0)), document.header.get("$EXTMAX", (0, 0, 0))
    size = max(abs(high[0] - low[0]), abs(high[1] - low[1]))
    # The maximum distance of a curve from its polyline, in drawing units.
    sag = _SAG * size if 0.0 < size < 1e9 else 0.01
    missing = _count_missing(document, builder)
    for entity, context in _walk(document.modelspace(), None, 0, budget, frozen):
        layer, height = context.layer.casefold(), _height(entity)
        drawing = drawings[height if height in drawings or len(drawings) < _MOST_HEIGHTS else 0.0]
        if layer in off | frozen or entity.dxf.get("invisible", 0):
            builder.use(context.layer, f"ignored ({'layer is off' if layer in off | frozen else 'invisible'})")
        elif layer in unplotted and context.role is None and not options.layers:
            builder.use(context.layer, "ignored (layer is not plotted)")
            missing[f"layer '{context.layer[:50]}'", _UNPLOTTED] += 1
        elif isinstance(entity, Insert) and context.fixture is not None and options.includes_layer(context.layer):
            _add_block(entity, context, drawing, builder, sag, budget)
        elif context.role in ("ignored", "demolished") or not options.includes_layer(context.layer):
            builder.leave_out(context.layer, context.role)
        elif (kind := entity.dxftype()) in _READ:
            if kind in _STRAIGHT and context.role in (None, "wall") and _is_dashed(entity, context, document):
                builder.use(context.layer, "ignored (dashed)")
                missing[f"a dashed line on layer '{context.layer[:50]}'", _DASHED] += 1
            else:
                _add(entity, context, drawing, builder, sag, budget)
        else:
            builder.use(context.layer, f"ignored ({kind})")
            if kind not in _NO_LINES and context.role != "text":
                subject = f"{kind} on layer '{context.layer[:50]}'"
                missing[subject, f" is not read: {_REMEDIES.get(kind, 'explode it (EXPLODE)')}"] += 1
    for (subject, remedy), count in missing.items():
        builder.warnings.append(f"{subject}{f' ({count} times)' if count > 1 else ''}{remedy}")
    if options.layers and not any(drawing.shapes for drawing in drawings.values()):
        available = sorted({layer for layer, _ in builder.uses})[:_MAX_NAMED_LAYERS]
        raise InvalidFloorPlanError(
            f"layers is {', '.join(options.layers)[:200]}, but these layers are empty; "
            f"layers of the drawing: {', '.join(repr(layer) for layer in available) or 'none'}"
        )
    return drawings


def _height(entity: DXFGraphic) -> float:
    """Return the height of a point of an entity, in the file's unit."""
    source = (
        entity.vertices[0] if isinstance(entity, Polyline) and entity.is_3d_polyline and entity.vertices else entity
    )
    stated = next((source.dxf.get(key) for key in _PLACES if source.dxf.hasattr(key)), 0.0)
    height = float(stated if isinstance(stated, float | int) else stated[2])
    return round(height, 6) if in_range(np.array(height)) else 0.0


def _is_dashed(entity: DXFGraphic, context: _Context, document: DxfDocument) -> bool:
    """Return whether the line type of an entity, or of its layer, has gaps."""
    name = entity.dxf.get("linetype", "BYLAYER")
    if name.upper() == "BYLAYER":
        name = document.layers.get(context.layer).dxf.linetype if document.layers.has_entry(context.layer) else ""
    pattern = document.linetypes.get(name).pattern_tags.tags if document.linetypes.has_entry(name) else []
    # Code 49 has the lengths of dashes and, negative, of gaps.
    return any(code == 49 and length < 0.0 for code, length in pattern)


def _count_missing(document: DxfDocument, builder: ReportBuilder) -> Counter[tuple[str, str]]:
    """Count, by subject and remedy, what the file only refers to, and objects of other programs; also in its blocks."""
    found: Counter[tuple[str, str]] = Counter()
    layouts: list[Iterable[DXFEntity]] = [document.modelspace()]
    seen: set[str] = set()
    for entity in (entity for layout in layouts for entity in layout):
        if isinstance(entity, Insert):
            block = document.blocks.get(entity.dxf.name)
            if block is not None and len(block):
                if block.name not in seen:
                    layouts.append(block)
                seen.add(block.name)
            elif block is not None and block.block is not None and (path := block.block.dxf.get("xref_path")):
                found[f"the drawing attaches '{path[:100]}'", f", which is not in the file: {_BIND}"] += 1
            else:
                found[f"the block '{entity.dxf.name[:50]}' is empty", f"; if it is another drawing, {_BIND}"] += 1
        elif isinstance(entity, Image):
            name = "" if entity.image_def is None else entity.image_def.dxf.get("filename", "")
            found[f"the drawing attaches the picture '{name[:100]}'", ", which is not read: send the picture"] += 1
        elif isinstance(entity, DXFTagStorage):
            layer = str(entity.graphic_properties().get("layer", "0"))
            builder.use(layer, f"ignored ({entity.dxftype()})")
            found[f"{entity.dxftype()} on layer '{layer[:50]}'", f" is not read: {_MAKE_PLAIN}"] += 1
    return found


def _walk(
    entities: Iterable[Any], block: _Context | None, depth: int, budget: Budget, frozen: Container[str] = ()
) -> Iterator[tuple[DXFGraphic, _Context]]:
    """Yield entities with their contexts. Blocks are expanded, except for windows, passages, obstacles and fixtures.

    `block` is the context of the block that contains the entities, None for the model space. All of a block that is
    invisible, or on a `frozen` layer, is hidden, and it is not expanded.
    """
    for entity in entities:
        if not isinstance(entity, DXFGraphic) or depth > _MAX_BLOCK_DEPTH:
            continue
        layer = entity.dxf.get("layer", "0")
        # Layer 0 in a block means the layer of the insert.
        if block is not None and layer == "0":
            layer = block.layer
        role = role_from_name(layer)
        if block is not None and block.role is not None and role in (None, "text"):
            role = block.role
        if isinstance(entity, Insert) and (layer.casefold() in frozen or entity.dxf.get("invisible", 0)):
            yield entity, _Context(layer, role)
        elif isinstance(entity, Insert):
            block_role = role_from_name(entity.dxf.name)
            role = block_role if block_role in _OF_BLOCKS else role
            for attribute in entity.attribs:
                yield attribute, _Context(layer, "text")
            context = _Context(layer, role, fixture_from_name(entity.dxf.name) if role in (None, "ignored") else None)
            for copy in entity.multi_insert() if entity.mcount > 1 else (entity,):
                budget.check_time()
                if context.fixture is not None or role in ("window", "passage", "obstacle"):
                    yield copy, context
                else:
                    yield from _walk(copy.virtual_entities(), context, depth + 1, budget, frozen)
        elif isinstance(entity, MLine | Polyface | Polymesh):
            for part in entity.virtual_entities():
                budget.check_time()
                yield part, _Context(layer, role)
        else:
            yield entity, _Context(layer, role)


def _add(
    entity: DXFGraphic, context: _Context, drawing: Drawing, builder: ReportBuilder, sag: float, budget: Budget
) -> None:
    kind, role = entity.dxftype(), context.role
    if kind in _TEXTS:
        text = entity.plain_text() if hasattr(entity, "plain_text") else entity.dxf.get("text", "")  # type: ignore[attr-defined]
        text, position = text.replace("\\~", " "), _anchor(entity)
        if position is not None and text.strip() and in_range(np.array(position)):
            drawing.letterings += [Lettering(line[:200], position, context.layer) for line in text.splitlines()[:20]]
            builder.use(context.layer, "texts")
        return
    if role == "text":
        builder.use(context.layer, "ignored")
        return
    if isinstance(entity, Insert):
        _add_block(entity, context, drawing, builder, sag, budget)
    elif kind in _FILLED:
        shapes, is_face = _filled_areas(entity, sag), kind == "3DFACE"
        is_solid = None if is_face else kind != "HATCH" or entity.dxf.get("solid_fill", 0) == 1
        drawing.areas += [Area(shape, context.layer, role, is_dark=is_solid) for shape in shapes]
        used_as = f"{'faces' if is_face else 'hatches'}: {role or 'possible walls'}"
        builder.use(context.layer, used_as if shapes or not is_face else "ignored", max(len(shapes), 1))
    elif kind in _LINES:
        parts: Iterable[DXFGraphic] = (entity,)
        if isinstance(entity, LWPolyline) and entity.has_arc and not entity.closed and role in (None, "wall", "door"):
            # A leaf and its arc can be one polyline.
            parts = entity.virtual_entities()
        for part in parts:
            _add_line(part, context, drawing, builder, sag)


def _anchor(entity: DXFGraphic) -> tuple[float, float] | None:
    """Return the middle of a text's first letters, in world coordinates: where it begins can be another room."""
    point = entity.dxf.get("insert")
    if point is None or not isinstance(entity, Text | MText):
        return None
    lines = str(entity.plain_text()).splitlines()
    half = _HALF_LETTER * min(max(map(len, lines), default=0), _LETTERS)
    if isinstance(entity, MText):
        down, across = divmod(entity.dxf.attachment_point - 1, 3)
        middle = Vec3((1 - across) * half, (down - 1) * _HALF_LINE * len(lines)) * entity.dxf.char_height
        point = entity.ucs().to_wcs(middle)
    else:
        halign, other = entity.dxf.get("halign", 0), entity.dxf.get("align_point")
        if other is not None and (halign or entity.dxf.get("valign", 0)):
            point = 0.5 * (Vec3(point) + Vec3(other)) if halign in _BETWEEN else Vec3(other)
        # Texts begin at their anchor, or end at it.
        side = {0: half, 2: -half}.get(halign, 0.0) * entity.dxf.height
        point = entity.ocs().to_wcs(Vec3(point) + side * Vec3.from_deg_angle(entity.dxf.rotation))
    return float(point[0]), float(point[1])


def _add_block(
    entity: Insert, context: _Context, drawing: Drawing, builder: ReportBuilder, sag: float, budget: Budget
) -> None:
    """Add a window, passage, obstacle or fixture drawn as a block: the smallest rectangle around its entities."""
    layer, role, fixture = context.layer, context.role, context.fixture
    # Lines of furniture count whatever the role of their layer.
    inside = _Context(layer, role if fixture is None else "obstacle")
    inner = Drawing()
    for part, _ in _walk(entity.virtual_entities(), inside, 1, budget):
        if part.dxftype() in _LINES | _FILLED:
            _add(part, inside, inner, ReportBuilder(), sag, budget)
    box = shapely.minimum_rotated_rectangle(shapely.GeometryCollection(inner.shapes))
    if fixture is not None and isinstance(box, shapely.Polygon) and not box.is_empty:
        drawing.fixtures.append(SketchedFixture(fixture, box, layer))
        builder.use(layer, f"fixtures: {fixture}")
    elif fixture is not None:
        builder.use(layer, "ignored (block without area)")
    elif not box.is_empty:
        if isinstance(box, shapely.Polygon):
            drawing.areas.append(Area(box, layer, role))
        elif isinstance(box, shapely.LineString):
            drawing.strokes.append(Stroke(box, layer, role))
        builder.use(layer, f"blocks: {role}")


def _add_line(entity: DXFGraphic, context: _Context, drawing: Drawing, builder: ReportBuilder, sag: float) -> None:
    points = next(iter(_rings(entity, sag)), np.empty((0, 2)))
    points = points[np.concatenate([[True], np.any(np.diff(points, axis=0) != 0.0, axis=1)])[: len(points)]]
    if len(points) < 2:
        builder.use(context.layer, "ignored (no length, or coordinates out of range)")
        return
    role, widths = context.role, _widths(entity)
    width = float(np.mean(widths))
    if len(widths) > 1 and len(points) == len(widths) + 1:
        parts = zip(pairwise(points), widths, strict=True)
        drawing.strokes += [Stroke(shapely.LineString(part), context.layer, role, pen) for part, pen in parts]
        builder.use(context.layer, f"lines: {role or 'possible walls'}")
    elif entity.dxftype() == "ARC" and role in (None, "door") and (leaves := leaves_of([points], context.layer)):
        drawing.swings += leaves
        builder.use(context.layer, "door swings")
    elif len(points) >= 3 and (bool(getattr(entity, "is_closed", False)) or _ends_meet(points)):
        shapes = polygons_of(shapely.Polygon(points))
        drawing.areas += [Area(shape, context.layer, role, width=width) for shape in shapes]
        builder.use(context.layer, f"closed lines: {role or 'possible walls or rooms'}", max(len(shapes), 1))
    elif shapely.LineString(points).length > 0.0:
        drawing.strokes.append(Stroke(shapely.LineString(points), context.layer, role, width))
        builder.use(context.layer, f"lines: {role or 'possible walls'}")


def _widths(entity: DXFGraphic) -> list[float]:
    """Return the width of a polyline, or of each of its parts if they differ; 0 for other lines."""
    if isinstance(entity, LWPolyline):
        usual, ends = entity.dxf.get("const_width", 0.0), list(entity.get_points("se"))
    elif isinstance(entity, Polyline) and entity.is_2d_polyline:
        usual, keys = entity.dxf.get("default_start_width", 0.0), ("start_width", "end_width")
        ends = [tuple(vertex.dxf.get(key, 0.0) for key in keys) for vertex in entity.vertices]
    else:
        return [0.0]
    # The last vertex of an open line begins no part.
    widths = [float(np.mean(pair)) for pair in ends[: None if entity.is_closed else -1]]
    if usual or not any(widths):
        return [usual]
    return [max(widths)] if max(widths) <= _SAME_WIDTH * min(widths) else widths


def _ends_meet(points: np.ndarray) -> bool:
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    return len(points) > 3 and float(np.linalg.norm(points[0] - points[-1])) <= _CLOSED * length


def _rings(entity: DXFGraphic, sag: float) -> list[Float[np.ndarray, "_ 2"]]:
    """Return the points along a line or each outline of an area, in world coordinates seen from above, if in range."""
    try:
        paths = dxf_path.from_hatch(entity) if isinstance(entity, Hatch | MPolygon) else [dxf_path.make_path(entity)]
        return [ring for path in paths if len(ring := _flatten(path, sag)) and in_range(ring)]
    except (TypeError, ValueError, ZeroDivisionError, DXFError):
        return []


def _flatten(path: dxf_path.Path, sag: float) -> Float[np.ndarray, "n 2"]:
    """Return the points along a path; a curve larger than the drawing's stated size has no more than others."""
    corners = np.array([(vertex.x, vertex.y) for vertex in path.control_vertices()])
    size = float(np.ptp(corners, axis=0).max(initial=0.0)) if len(corners) else 0.0
    if not in_range(corners):
        raise ValueError("the path has coordinates that are out of range")
    return np.array([(vertex.x, vertex.y) for vertex in path.flattening(max(sag, _SAG * size), segments=8)])


def _filled_areas(entity: DXFGraphic, sag: float) -> list[shapely.Polygon]:
    """Return the filled area of a hatch, between its outlines, or of a face."""
    rings = (shapely.Polygon(ring) for ring in _rings(entity, sag) if len(ring) >= 4)
    return even_odd_polygons(part for ring in rings for part in polygons_of(ring))
