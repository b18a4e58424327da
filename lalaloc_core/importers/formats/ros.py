"""Maps of ROS `map_server`: an occupancy grid as a picture (PGM or PNG), and its YAML file, in a zip archive.

The plan frame is the map frame. https://wiki.ros.org/map_server
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from jaxtyping import UInt8

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.importers.common import ImportOptions, ReportBuilder
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble
from lalaloc_core.importers.common.bounded_files import pack
from lalaloc_core.importers.common.geometry import MapFrame
from lalaloc_core.importers.common.import_limits import DEFAULT_IMPORT_LIMITS, Budget
from lalaloc_core.importers.common.import_options import to_number

if TYPE_CHECKING:
    from lalaloc_core.importers.picture.occupancy import OccupancyGrid

YAML_SUFFIXES = (".yaml", ".yml")
_MAX_YAML_BYTES, _MAX_YAML_DEPTH = 65_536, 16
_RESOLUTION_M, _MAX_ORIGIN_M = (0.001, 1.0), 1e6
# Written maps: cell size, margin around the rooms and thickness of outer walls (m), and the usual values of cells.
_CELL_M, _MARGIN_M, _WALL_M = 0.05, 1.0, 0.15
# Cells of larger maps are twice, four times ... as large.
_MAX_CELLS = 4_000_000
_FREE, _UNKNOWN, _OCCUPIED = 254, 205, 0
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196
_YES = ("1", "true", "yes", "on")


def read(source: bytes | Mapping[str, bytes], options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read the plan in a map, as a draft.

    `source` has the files of an archive by name, or is a picture in PGM without its YAML file.
    """
    # Imported late: a map is written without the libraries of pictures.
    from lalaloc_core.importers.picture.occupancy import sketch_grid

    grid = _picture_alone(source, options, budget) if isinstance(source, bytes) else _open(source, budget)
    frame = grid.frame
    scale_source = "the map's resolution" if isinstance(source, Mapping) else "metres_per_pixel"
    builder = ReportBuilder("ros", frame.resolution_m, scale_source, is_draft=True)
    builder.use("occupied cells", "walls", int(grid.occupied.sum()))
    builder.use("free cells", "floor", int(grid.free.sum()))
    sketch = sketch_grid(grid, builder, budget)
    if not sketch.rooms:
        rows, columns = frame.size
        raise InvalidFloorPlanError(
            f"no walls that enclose a room were found in the map, which is {columns * frame.resolution_m:.1f} m by "
            f"{rows * frame.resolution_m:.1f} m at {frame.resolution_m:g} m per cell; check the resolution, and close "
            "the walls in the picture"
        )
    return (assemble(sketch, builder, options, budget.limits.plan),)


def read_frame(source: Mapping[str, bytes]) -> MapFrame:
    """Return the grid of a map from its files."""
    return _open(source, Budget(DEFAULT_IMPORT_LIMITS)).frame


def map_picture(yaml_file: Path) -> Path:
    """Return the path of the picture that the YAML file of a map names."""
    return yaml_file.parent / _text(_settings(yaml_file.read_bytes()), "image")


def map_files(yaml_file: Path) -> dict[str, bytes]:
    """Return the files of a map by name: a YAML file, and the picture that it names."""
    try:
        picture = map_picture(yaml_file)
        return {file.name: file.read_bytes() for file in (yaml_file, picture)}
    except OSError as error:
        raise InvalidFloorPlanError(f"'{error.filename}' cannot be read: {error.strerror}") from error


def write(document: Mapping[str, Any], _anchor: Anchor | None, frame: MapFrame | None = None) -> bytes:
    """Return a map in a zip archive: rooms, doors and passages are free, walls and windows occupied.

    The plan's frame is the map frame. The default grid has cells of 5 cm, or more for large plans, and a margin of 1 m.
    """
    rooms = [shapely.Polygon(room["polygon"], room.get("holes", ())) for room in document["rooms"]]
    frame = frame or _frame_of(rooms)
    picture = _draw(document, rooms, frame)
    x, y, yaw = frame.origin
    settings = (
        f"image: map.pgm\nmode: trinary\nresolution: {frame.resolution_m:.10g}\n"
        f"origin: [{x:.10g}, {y:.10g}, {yaw:.10g}]\nnegate: 0\n"
        f"occupied_thresh: {_OCCUPIED_THRESHOLD}\nfree_thresh: {_FREE_THRESHOLD}\n"
    )
    header = f"P5\n{frame.size[1]} {frame.size[0]}\n255\n".encode()
    return pack({"map.yaml": settings.encode(), "map.pgm": header + picture.tobytes()})


def _picture_alone(content: bytes, options: ImportOptions, budget: Budget) -> OccupancyGrid:
    """Return the map of a picture in PGM, with its corner at the origin and the usual thresholds."""
    if options.metres_per_pixel is None:
        raise InvalidFloorPlanError(
            "the file is a part of a ROS map; send the YAML file and the picture in one zip archive, or the PGM "
            "picture with metres_per_pixel"
        )
    return _classify(_gray(content, budget), {"resolution": options.metres_per_pixel, "origin": [0.0, 0.0, 0.0]})


def _open(files: Mapping[str, bytes], budget: Budget) -> OccupancyGrid:
    names = [name for name in files if name.casefold().endswith(YAML_SUFFIXES)]
    # Archives can have the parameters of a robot, too.
    names = [name for name in names if b"image:" in files[name]] or names
    if len(names) != 1:
        raise InvalidFloorPlanError(f"the archive has {len(names)} YAML files; a ROS map has one, and a picture")
    settings = _settings(files[names[0]])
    image = _text(settings, "image").replace("\\", "/").rpartition("/")[2]
    for name, content in files.items():
        if name.rpartition("/")[2] == image:
            return _classify(_gray(content, budget), settings)
    raise InvalidFloorPlanError(f"the archive has no picture '{image[:100]}', which the ROS map names; add it")


def _settings(content: bytes) -> Mapping[str, Any]:
    if len(content) > _MAX_YAML_BYTES:
        raise InvalidFloorPlanError(f"the YAML of the ROS map has {len(content)} bytes; the limit is {_MAX_YAML_BYTES}")
    import yaml

    try:
        _check_events(yaml.parse(content, Loader=yaml.BaseLoader), yaml.events)
        # All values are texts.
        settings = yaml.load(content, Loader=yaml.BaseLoader)
    except InvalidFloorPlanError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}, column {mark.column + 1}"
        raise InvalidFloorPlanError(f"the YAML of the ROS map is invalid{where}; save the map again") from error
    if not isinstance(settings, Mapping):
        raise InvalidFloorPlanError("the YAML of the ROS map must have 'image', 'resolution' and 'origin'")
    return settings


def _check_events(events: Iterable[Any], kinds: Any) -> None:
    """Refuse values that are repeated by reference, which a few lines can multiply to billions, and deep nesting."""
    depth = 0
    for event in events:
        if isinstance(event, kinds.AliasEvent) or getattr(event, "value", None) == "<<":
            raise InvalidFloorPlanError(
                f"line {event.start_mark.line + 1} of the YAML of the ROS map repeats values with an alias (*) or a "
                "merge key (<<); write them out"
            )
        depth += isinstance(event, kinds.CollectionStartEvent) - isinstance(event, kinds.CollectionEndEvent)
        if depth > _MAX_YAML_DEPTH:
            raise InvalidFloorPlanError(
                f"the YAML of the ROS map is nested more than {_MAX_YAML_DEPTH} deep; write its values side by side"
            )


def _classify(gray: UInt8[np.ndarray, "h w"], settings: Mapping[str, Any]) -> OccupancyGrid:
    from lalaloc_core.importers.picture.occupancy import OccupancyGrid

    resolution_m = _number(settings, "resolution", None, _RESOLUTION_M)
    origin = settings.get("origin")
    place = [to_number(value) for value in origin] if isinstance(origin, list) else []
    if len(place) < 2 or not all(abs(value) < _MAX_ORIGIN_M for value in place):
        raise InvalidFloorPlanError(
            f"origin of the ROS map is {str(origin)[:50]}; it must be [x, y, yaw], numbers below {_MAX_ORIGIN_M:g}"
        )
    x, y, yaw, *_ = [*place, 0.0]
    occupied_at = _number(settings, "occupied_thresh", _OCCUPIED_THRESHOLD, (0.0, 1.0))
    free_at = _number(settings, "free_thresh", _FREE_THRESHOLD, (0.0, 1.0))
    values = np.arange(256) / 255.0
    occupancy = values if str(settings.get("negate")).casefold() in _YES else 1.0 - values
    if str(settings.get("mode")).casefold() == "raw":
        # Occupancy in percent; others are unknown.
        occupancy = np.where(np.arange(256) <= 100, np.arange(256) / 100.0, 0.5 * (occupied_at + free_at))
    frame = MapFrame(resolution_m, (x, y, yaw), gray.shape)
    return OccupancyGrid(frame, (occupancy > occupied_at)[gray], (occupancy < free_at)[gray])


def _gray(content: bytes, budget: Budget) -> UInt8[np.ndarray, "h w"]:
    from PIL import Image

    from lalaloc_core.importers.formats.picture import in_bytes, open_picture

    with open_picture(content, ["PPM", "PNG"], "the picture of the ROS map", "save it again", budget) as picture:
        # Transparent cells are unknown.
        flat = Image.new("RGBA", picture.size, (_UNKNOWN, _UNKNOWN, _UNKNOWN, 255))
        flat.alpha_composite(in_bytes(picture).convert("RGBA"))
        return np.asarray(flat.convert("L"))


def _frame_of(rooms: list[shapely.Polygon]) -> MapFrame:
    x0, y0, x1, y1 = shapely.total_bounds(rooms)
    cell_m = _CELL_M
    while (x1 - x0 + 2.0 * _MARGIN_M) * (y1 - y0 + 2.0 * _MARGIN_M) > _MAX_CELLS * cell_m**2:
        cell_m *= 2.0
    left, bottom = (math.floor((value - _MARGIN_M) / cell_m) for value in (x0, y0))
    right, top = (math.ceil((value + _MARGIN_M) / cell_m) for value in (x1, y1))
    return MapFrame(cell_m, (left * cell_m, bottom * cell_m, 0.0), (top - bottom, right - left))


def _draw(document: Mapping[str, Any], rooms: list[shapely.Polygon], frame: MapFrame) -> UInt8[np.ndarray, "h w"]:
    half_m = 0.5 * frame.resolution_m
    # Gaps between rooms up to twice a wall's thickness are walls.
    around = shapely.union_all(rooms).buffer(2.0 * _WALL_M, join_style="mitre")
    walls = around.buffer(-_WALL_M, join_style="mitre")
    doors = [opening["line"] for opening in document.get("openings", ()) if opening["kind"] != "window"]
    ways = [shapely.LineString(line).buffer(2.0 * _WALL_M, cap_style="flat") for line in doors]
    inner = [shapely.LineString(line) for room in document["rooms"] for line in room.get("walls", ())]
    layers = (
        (walls, _OCCUPIED),
        (shapely.union_all(rooms), _FREE),
        (shapely.union_all([*inner, *_shared_edges(rooms, half_m)]).buffer(1.5 * half_m), _OCCUPIED),
        (shapely.union_all(ways).intersection(walls), _FREE),
    )
    for shape, _ in layers:
        shapely.prepare(shape)
    picture = np.full(frame.size, _UNKNOWN, np.uint8)
    for row in range(frame.size[0]):
        x, y = frame.cells(row).T
        for shape, value in layers:
            picture[row, shapely.contains_xy(shape, x, y)] = value
    return picture


def _shared_edges(rooms: list[shapely.Polygon], reach_m: float) -> list[shapely.Geometry]:
    """Return the edges of rooms that touch: no cell lies between them."""
    tree = shapely.STRtree(rooms)
    pairs = tree.query(rooms, predicate="dwithin", distance=reach_m).T
    return [rooms[a].boundary.intersection(rooms[b].buffer(reach_m)) for a, b in pairs if a < b]


def _text(settings: Mapping[str, Any], key: str) -> str:
    value = settings.get(key)
    if not isinstance(value, str) or not value.strip():
        raise InvalidFloorPlanError(f"the YAML of the ROS map has no '{key}'; add the name of its picture")
    return value.strip()


def _number(settings: Mapping[str, Any], key: str, default: float | None, limits: tuple[float, float]) -> float:
    raw, (low, high) = settings.get(key, default), limits
    value = to_number(raw)
    if not low <= value <= high:
        raise InvalidFloorPlanError(f"{key} of the ROS map is {str(raw)[:50]}; it must be {low:g} to {high:g}")
    return value
