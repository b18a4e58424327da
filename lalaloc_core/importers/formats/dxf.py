"""DXF: rooms from closed polylines and hatches on layers named so, else from walls; doors and windows by the names of
layers and blocks, or by the arcs of leaves.

ezdxf reads the file, broken ones as well; what blocks stand for is counted before any is drawn.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import shapely
from ezdxf import path as dxf_path
from ezdxf import recover
from ezdxf.document import Drawing as DxfDocument
from ezdxf.entities.dxfentity import DXFEntity
from ezdxf.entities.dxfgfx import DXFGraphic
from ezdxf.entities.insert import Insert
from ezdxf.lldxf.const import DXFError
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.drawing.scale import drawing_scale
from lalaloc_core.importers.drawing.shapes import Area, Drawing, Lettering, Stroke, swing_of
from lalaloc_core.importers.drawing.understand import understand
from lalaloc_core.importers.model.assemble import ImportedPlan, assemble
from lalaloc_core.importers.model.checks import likely_unit
from lalaloc_core.importers.model.geometry import polygons_of
from lalaloc_core.importers.model.limits import Budget
from lalaloc_core.importers.model.options import ImportOptions
from lalaloc_core.importers.model.report import ReportBuilder
from lalaloc_core.importers.model.words import Role, role_of

FORMAT = "dxf"
# $INSUNITS of the format's reference.
_INSUNITS = {1: (0.0254, "in"), 2: (0.3048, "ft"), 4: (1e-3, "mm"), 5: (0.01, "cm"), 6: (1.0, "m"), 14: (0.1, "dm")}
_LINES = {"LINE", "LWPOLYLINE", "POLYLINE", "ARC", "CIRCLE", "ELLIPSE", "SPLINE"}
_FILLED = {"HATCH", "MPOLYGON", "SOLID", "TRACE"}
_TEXTS = {"TEXT", "MTEXT", "ATTRIB"}
_MAX_NAMED_LAYERS = 20
_MAX_BLOCK_DEPTH = 16
# Curves are followed to this share of the drawing's size.
_SAG = 2e-5
_USUAL_EXTENT_M = (4.0, 120.0)


@dataclass(frozen=True)
class _Place:
    """Where an entity stands: the layer that counts for it, and what layer or block name say it is."""

    layer: str
    role: Role | None


def import_dxf(content: bytes, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """The plan in the model space of a DXF drawing.

    Raises:
        InvalidFloorPlanError: what is wrong with the file, or that it does not say its unit.
    """
    document = _open(content)
    _check_blocks(document, budget)
    builder = ReportBuilder()
    drawing = _read(document, options, builder, budget)
    factor, source = _unit(document, drawing, options, builder)
    if options.y_axis is None and document.header.get("$UCSYDIR", (0.0, 1.0, 0.0))[1] < -0.5:
        builder.warnings.append(
            "the file's own axes say that y points down ($UCSYDIR); say y_axis=down if it is mirrored"
        )
    drawing = drawing.scaled(factor, turn_over=options.y_axis == "down")
    sketch = understand(drawing, builder, budget)
    return (assemble(sketch, builder, options, format=FORMAT, metres_per_unit=factor, scale_source=source),)


def _open(content: bytes) -> DxfDocument:
    try:
        if content.startswith(b"AutoCAD Binary DXF"):
            from ezdxf.lldxf.tagger import binary_tags_loader

            return _from_tags(binary_tags_loader(content))
        document, _ = recover.read(io.BytesIO(content))
    except (DXFError, OSError, ValueError, KeyError, IndexError, TypeError, AttributeError,
            UnicodeError) as error:  # fmt: skip
        raise InvalidFloorPlanError(f"the DXF cannot be read: {error}") from error
    return document


def _from_tags(tags: object) -> DxfDocument:
    from ezdxf.lldxf.tagwriter import TagWriter

    text = io.StringIO()
    writer = TagWriter(text, dxfversion="AC1032")
    for tag in tags:  # type: ignore[attr-defined]
        writer.write_tag(tag)
    document, _ = recover.read(io.BytesIO(text.getvalue().encode()))
    return document


def _check_blocks(document: DxfDocument, budget: Budget) -> None:
    """Count what inserts stand for: blocks of blocks, in rows and columns, grow without end."""
    sizes: dict[str, int] = {}

    def size(name: str, depth: int) -> int:
        if depth > _MAX_BLOCK_DEPTH:
            raise InvalidFloorPlanError(f"blocks lie more than {_MAX_BLOCK_DEPTH} deep in each other, or in themselves")
        if name not in sizes:
            block = document.blocks.get(name)
            sizes[name] = 0 if block is None else total(block, depth + 1)
        return sizes[name]

    def total(entities: object, depth: int) -> int:
        count = 0
        for entity in entities:  # type: ignore[attr-defined]
            count += _weight(entity)
            if isinstance(entity, Insert):
                rows, columns = max(entity.dxf.row_count, 1), max(entity.dxf.column_count, 1)
                count += rows * columns * size(entity.dxf.name, depth)
            if count > budget.limits.max_entities:
                break
        return count

    budget.spend(total(document.modelspace(), 0))


def _weight(entity: DXFEntity) -> int:
    """How much there is to an entity: its vertices."""
    kind = entity.dxftype()
    if kind in ("LWPOLYLINE", "POLYLINE"):
        return 1 + len(entity) // 2  # type: ignore[arg-type]
    if kind == "SPLINE":
        return 1 + entity.control_point_count()  # type: ignore[attr-defined]
    return 1


def _read(document: DxfDocument, options: ImportOptions, builder: ReportBuilder, budget: Budget) -> Drawing:
    drawing = Drawing()
    hidden = {layer.dxf.name.casefold() for layer in document.layers if layer.is_off() or layer.is_frozen()}
    sag = _sag(document)
    for entity, place in _walk(document.modelspace(), None, 0):
        budget.check_time()
        if place.layer.casefold() in hidden:
            builder.use(place.layer, "ignored (layer is off)")
        elif place.role == "ignored" or not options.wants_layer(place.layer):
            builder.use(place.layer, "ignored")
        else:
            _add(entity, place, drawing, builder, sag)
    if options.layers and not drawing.areas and not drawing.strokes:
        there = sorted({layer for layer, _ in builder.uses})[:_MAX_NAMED_LAYERS]
        raise InvalidFloorPlanError(
            f"nothing lies on the layers {', '.join(options.layers)[:200]}; "
            f"the drawing has {', '.join(repr(layer) for layer in there) or 'nothing on any layer'}"
        )
    return drawing


def _walk(entities: object, around: _Place | None, depth: int) -> Iterator[tuple[DXFGraphic, _Place]]:
    """Entities with their places; blocks are opened, but for those that are doors and windows themselves."""
    for entity in entities:  # type: ignore[attr-defined]
        if not isinstance(entity, DXFGraphic) or depth > _MAX_BLOCK_DEPTH:
            continue
        layer = entity.dxf.get("layer", "0")
        # Layer 0 in a block means the layer that the block was put on.
        on = around.layer if around is not None and layer == "0" else layer
        role = role_of(on)
        if around is not None and around.role is not None and role in (None, "text"):
            role = around.role
        if isinstance(entity, Insert):
            named = role_of(entity.dxf.name)
            role = named if named in ("door", "window", "passage", "obstacle", "ignored") else role
            for attribute in entity.attribs:
                yield attribute, _Place(on, "text")
            for copy in entity.multi_insert() if entity.mcount > 1 else (entity,):
                place = _Place(on, role)
                if role in ("window", "passage", "obstacle"):
                    yield copy, place
                else:
                    yield from _walk(copy.virtual_entities(), place, depth + 1)
        else:
            yield entity, _Place(on, role)


def _add(entity: DXFGraphic, place: _Place, drawing: Drawing, builder: ReportBuilder, sag: float) -> None:
    kind, role = entity.dxftype(), place.role
    if kind in _TEXTS:
        text = entity.plain_text() if hasattr(entity, "plain_text") else entity.dxf.get("text", "")  # type: ignore[attr-defined]
        at = entity.dxf.get("insert")
        if at is not None and text.strip():
            where = (float(at[0]), float(at[1]))
            drawing.letterings += [Lettering(line[:200], where, place.layer) for line in text.splitlines()[:20]]
            builder.use(place.layer, "texts")
        return
    if role == "text":
        builder.use(place.layer, "ignored")
        return
    if isinstance(entity, Insert):
        _add_block(entity, place, drawing, builder, sag)
    elif kind in _FILLED:
        shapes = _filled(entity, sag)
        is_solid = kind != "HATCH" or entity.dxf.get("solid_fill", 0) == 1
        drawing.areas += [Area(shape, place.layer, role, is_dark=is_solid) for shape in shapes]
        builder.use(place.layer, f"hatches: {role or 'perhaps walls'}", max(len(shapes), 1))
    elif kind in _LINES:
        _add_line(entity, place, drawing, builder, sag)
    else:
        builder.use(place.layer, f"ignored ({kind})")


def _add_block(entity: Insert, place: _Place, drawing: Drawing, builder: ReportBuilder, sag: float) -> None:
    """A window (column, passage) that is a block: the box around what it draws, along its longer side."""
    inner = Drawing()
    for part, _ in _walk(entity.virtual_entities(), place, 1):
        if part.dxftype() in _LINES | _FILLED:
            _add(part, place, inner, ReportBuilder(), sag)
    shapes = [*(area.shape for area in inner.areas), *(stroke.line for stroke in inner.strokes)]
    if not shapes:
        return
    box = shapely.minimum_rotated_rectangle(shapely.GeometryCollection(shapes))
    builder.use(place.layer, f"blocks: {place.role}")
    if isinstance(box, shapely.Polygon):
        drawing.areas.append(Area(box, place.layer, place.role))
    elif isinstance(box, shapely.LineString):
        drawing.strokes.append(Stroke(box, place.layer, place.role))


def _add_line(entity: DXFGraphic, place: _Place, drawing: Drawing, builder: ReportBuilder, sag: float) -> None:
    points = _points(entity, sag)
    if len(points) < 2:
        return
    role = place.role
    if entity.dxftype() == "ARC" and role in (None, "door"):
        swing = swing_of(points, place.layer)
        if swing is not None:
            drawing.swings.append(swing)
            builder.use(place.layer, "swings of doors")
            return
    closed = bool(getattr(entity, "is_closed", False)) or (len(points) > 3 and bool(np.allclose(points[0], points[-1])))
    if closed and len(points) >= 3:
        shapes = polygons_of(shapely.Polygon(points))
        drawing.areas += [Area(shape, place.layer, role) for shape in shapes]
        builder.use(place.layer, f"closed lines: {role or 'perhaps walls or rooms'}", max(len(shapes), 1))
    elif shapely.LineString(points).length > 0.0:
        drawing.strokes.append(Stroke(shapely.LineString(points), place.layer, role))
        builder.use(place.layer, f"lines: {role or 'perhaps walls'}")


def _points(entity: DXFGraphic, sag: float) -> np.ndarray:
    """Points along a line in world coordinates, seen from above."""
    try:
        way = dxf_path.make_path(entity)
        points = np.array([(vertex.x, vertex.y) for vertex in way.flattening(sag, segments=8)])
    except (TypeError, ValueError, ZeroDivisionError, DXFError):
        return np.empty((0, 2))
    if not len(points) or not np.isfinite(points).all():
        return np.empty((0, 2))
    return points[np.concatenate([[True], np.any(np.diff(points, axis=0) != 0.0, axis=1)])]


def _filled(entity: DXFGraphic, sag: float) -> list[shapely.Polygon]:
    """What a hatch fills: between its outlines."""
    try:
        is_hatch = entity.dxftype() in ("HATCH", "MPOLYGON")
        ways = list(dxf_path.from_hatch(entity)) if is_hatch else [dxf_path.make_path(entity)]  # type: ignore[arg-type]
        rings = [np.array([(v.x, v.y) for v in way.flattening(sag, segments=8)]) for way in ways]
    except (TypeError, ValueError, ZeroDivisionError, DXFError):
        return []
    shape: BaseGeometry = shapely.Polygon()
    for ring in rings:
        if len(ring) >= 4 and np.isfinite(ring).all():
            for part in polygons_of(shapely.Polygon(ring)):
                shape = shapely.symmetric_difference(shape, part)
    return polygons_of(shape)


def _sag(document: DxfDocument) -> float:
    low, high = document.header.get("$EXTMIN", (0, 0, 0)), document.header.get("$EXTMAX", (0, 0, 0))
    size = max(abs(high[0] - low[0]), abs(high[1] - low[1]))
    return _SAG * size if 0.0 < size < 1e9 else 0.01


def _unit(document: DxfDocument, drawing: Drawing, options: ImportOptions, builder: ReportBuilder) -> tuple[float, str]:
    """(metres per unit, where that was read): options, $INSUNITS, or a refusal that names the likely unit."""
    code = document.header.get("$INSUNITS", 0)
    said = _INSUNITS.get(code)
    extent = _extent(drawing)
    if options.units is None and options.known_distance is None and options.metres_per_pixel is None and said is None:
        fitting = likely_unit(extent, _USUAL_EXTENT_M)
        hint = (
            f"; {extent:g} units across, it looks like {fitting}: units={fitting}"
            if fitting
            else f" ({extent:g} units)"
        )
        raise InvalidFloorPlanError(
            f"the DXF does not say its unit ($INSUNITS is {code}){hint}; say units=mm, cm, m, in or ft"
        )
    factor, source = drawing_scale(
        options, "the DXF", said=None if said is None else (said[0], f"$INSUNITS is {code} ({said[1]})")
    )
    if not _USUAL_EXTENT_M[0] <= extent * factor <= 1000.0:
        fitting = likely_unit(extent, _USUAL_EXTENT_M)
        hint = f"; it looks like {fitting}: units={fitting}" if fitting and said and fitting != said[1] else ""
        builder.warnings.append(f"the drawing is {extent * factor:.4g} m across{hint}")
    return factor, source


def _extent(drawing: Drawing) -> float:
    shapes = [*(area.shape for area in drawing.areas), *(stroke.line for stroke in drawing.strokes)]
    if not shapes:
        raise InvalidFloorPlanError("the DXF's model space holds no lines, areas or hatches that could be a plan")
    x0, y0, x1, y1 = shapely.total_bounds(shapes)
    return float(max(x1 - x0, y1 - y0))
