"""Maps of vacuum robots: the JSON of Valetudo, by itself or as a text of its PNG.

Rooms are the named segments, in rows of cells (x, y, number of cells; y down). Robots drive around furniture, so holes
of segments are floor. Neighbours are joined by a passage where no wall cell is between them: doors stand open.
https://valetudo.cloud
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.json_values import is_number, read_json
from lalaloc_core.importers.common import Budget, ImportLimits, ImportOptions, ReportBuilder
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble
from lalaloc_core.importers.common.geometry import check_coordinates, check_overlaps, point_xy, polygons_of
from lalaloc_core.importers.common.sketch import Sketch, SketchedOpening, SketchedRoom

_CELL_CM = (1.0, 20.0)
# Thickest wall between rooms, narrowest passage (m), and cells within which an outline is at a wall.
_THICKEST_M, _NARROWEST_M, _AT_WALL = 0.35, 0.4, 2.0
# Smaller parts of a segment (m²) are noise.
_LEAST_M2 = 0.5
# Compressed text of a PNG, and the place of its length before it.
_CHUNK, _LENGTH_BYTES, _HEAD_BYTES = b"zTXtValetudoMap\0\0", 4, 65536


def map_in_picture(content: bytes, limits: ImportLimits) -> Any:
    """Return the map that a PNG has as a text; None without one."""
    begin = content[:_HEAD_BYTES].find(_CHUNK)
    if begin < _LENGTH_BYTES:
        return None
    end = begin + _LENGTH_BYTES + int.from_bytes(content[begin - _LENGTH_BYTES : begin])
    unpacking = zlib.decompressobj()
    try:
        text = unpacking.decompress(content[begin + len(_CHUNK) : end], limits.max_unpacked_bytes)
    except zlib.error as error:
        raise InvalidFloorPlanError("the map in the PNG is damaged; send the robot's map as JSON") from error
    if not unpacking.eof:
        raise InvalidFloorPlanError(
            f"the map in the PNG is cut off, or larger than {limits.max_unpacked_bytes} bytes (max_unpacked_bytes); "
            "send the robot's map as JSON"
        )
    return read_json(text, limits.max_depth, limits.max_json_values)


def read(document: Mapping[str, Any], options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read the plan of a map."""
    size, (least, most) = document["pixelSize"], _CELL_CM
    if not is_number(size) or not least <= size <= most:
        raise InvalidFloorPlanError(f"pixelSize of the map is {str(size)[:50]}; it must be {least:g} to {most:g} cm")
    cell_m = 0.01 * float(size)
    builder = ReportBuilder("valetudo", cell_m, "the map's pixelSize")
    sketch, walls, outlines = Sketch(opening_kinds=("door", "passage")), [], []
    layers = document["layers"] if isinstance(document["layers"], list) else []
    for number, layer in enumerate(layer for layer in layers if isinstance(layer, Mapping)):
        kind = str(layer.get("type"))[:50]
        shape = _shape(layer, f"layer {number}", cell_m, budget) if kind in ("segment", "wall") else None
        builder.use(kind, {"segment": "room", "wall": "walls"}.get(kind, "ignored"))
        if shape is not None and kind == "wall":
            walls.append(shape)
        elif shape is not None:
            facts = layer.get("metaData")
            name = facts.get("name") if isinstance(facts, Mapping) else None
            parts = [part for part in polygons_of(shape) if part.area >= _LEAST_M2]
            floors = [shapely.Polygon(part.exterior) for part in parts]
            outlines += floors
            simple = [part for floor in floors for part in polygons_of(floor.simplify(cell_m))]
            sketch.rooms += [SketchedRoom(part, str(name)[:200] if name else None) for part in simple]
    if not sketch.rooms:
        raise InvalidFloorPlanError("the map has no segments: let the robot divide it into rooms, and send it again")
    builder.notes.append("rooms are where the robot drives: their outlines leave out furniture that stands at walls")
    if walls:
        sketch.openings += _passages(outlines, shapely.union_all(walls), cell_m, budget)
    else:
        sketch.opening_kinds = ()
        builder.warnings.append("the map has no walls, so passages between rooms are unknown: add them in the editor")
    return (assemble(sketch, builder, options, budget.limits.plan),)


def _shape(layer: Mapping[str, Any], where: str, cell_m: float, budget: Budget) -> BaseGeometry:
    """Return the area (m, y up) of a layer's cells: runs, or single ones in old maps."""
    runs, pixels = layer.get("compressedPixels") or [], layer.get("pixels") or []
    raw, columns = (runs, 3) if runs else (pixels, 2)
    if not isinstance(raw, list) or len(raw) % columns or not all(map(is_number, raw)):
        raise InvalidFloorPlanError(f"the cells of {where} of the map must be groups of {columns} numbers")
    cells = np.array(raw, float).reshape(-1, columns)
    check_coordinates(cells, where)
    if (cells != np.floor(cells)).any() or (cells[:, 2:] < 1.0).any():
        raise InvalidFloorPlanError(f"the cells of {where} of the map must be whole numbers, at least one in a row")
    budget.spend(len(cells))
    x, y = cells[:, 0], -cells[:, 1]
    boxes = shapely.box(x * cell_m, (y - 1.0) * cell_m, (x + (cells[:, 2] if runs else 1.0)) * cell_m, y * cell_m)
    check_overlaps(boxes.tolist(), what="rows of cells")
    return shapely.union_all(boxes)


def _passages(
    outlines: list[shapely.Polygon], walls: BaseGeometry, cell_m: float, budget: Budget
) -> list[SketchedOpening]:
    """Return the passages between rooms: where the outline of one is near another, and not at a wall."""
    reach_m, found = _AT_WALL * cell_m, []
    at_walls = walls.buffer(reach_m, join_style="mitre")
    tree = shapely.STRtree(outlines)
    pairs = tree.query(outlines, predicate="dwithin", distance=_THICKEST_M).T
    for first, second in pairs[pairs[:, 0] < pairs[:, 1]].tolist():
        budget.check_time()
        beside = outlines[second].buffer(_THICKEST_M, join_style="mitre")
        near = shapely.intersection(outlines[first].exterior, beside).difference(at_walls)
        for part in shapely.get_parts(shapely.line_merge(near)):
            start, end = np.array(part.coords[0]), np.array(part.coords[-1])
            length_m = float(np.hypot(*(end - start)))
            if length_m > 0.0 and length_m + 2.0 * reach_m >= _NARROWEST_M:
                longer = reach_m * (end - start) / length_m
                found.append(SketchedOpening("passage", point_xy(start - longer), point_xy(end + longer)))
    return found
