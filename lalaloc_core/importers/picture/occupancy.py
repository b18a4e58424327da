"""Occupancy grids, as robots map them, also in coloured pictures, and the rooms that their occupied cells enclose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.importers.common import Budget, ReportBuilder
from lalaloc_core.importers.common.geometry import MapFrame, point_xy, polygons_of
from lalaloc_core.importers.common.sketch import Sketch, SketchedOpening, SketchedRoom
from lalaloc_core.importers.drawing.enclosed_rooms import explained_size
from lalaloc_core.importers.picture.ink import Colours, Gray, Labels, Mask, find_skew, rotate_picture
from lalaloc_core.importers.picture.sketch_picture import sketch_picture
from lalaloc_core.importers.picture.wall_mask import usual_thickness

# Cells are divided until they are this fine (m), because the picture importer expects walls of several pixels.
_FINE_M = 0.0125
# Smallest share of free cells in a room: the inside of a thick wall is unknown.
_FREE_SHARE = 0.5
# Smaller groups of occupied cells (m) are legs of furniture and noise.
_SPECK_M = 0.6
# Longest and shortest side of a piece of furniture (m), pieces that are named, and share of the time after which the
# walls are not read again without furniture.
_LARGEST_PIECE_M, _THINNEST_PIECE_M, _MAX_NAMED, _SHARE_OF_TIME = 2.6, 0.35, 8, 0.3
# Largest turn that aligns the walls with the picture, and the threshold of half a cell.
_MAX_TURN_DEG, _HALF = 45.0, 127
# Share of a room's outline that has a seen wall within so many cells, if unknown cells close the rest; rooms that
# share more with others than the last are these.
_SEEN_SHARE, _BESIDE_CELLS, _OLD = 0.6, 3.0, 0.5
# Share of openings that a map shows: closed doors are walls in it.
_RECALL = 0.7
# A smaller share of the free cells in rooms gives a warning.
_USED_SHARE = 0.8
# Coloured maps: most cells; lengths (m) of the median that removes paths, notches in floors, gaps between floors, depth
# inside a floor, reach of outer walls, longest border between walls that is a door, and growth of lines.
_MOST_CELLS, _PATH_M, _NOTCH_M, _GAP_M, _INSIDE_M = 1e6, 0.08, 0.06, 0.25, 0.3
_OUTER_M, _DOOR_M, _GROWN_M = 0.1, 1.3, 0.036
# Tones: number, least shares of the picture, of its edge (ground) and of a floor; tolerances (of 255) of equal tones,
# of pixels of a tone, and of walls.
_TONES, _LEAST, _GROUND, _EVEN, _SAME, _OF_TONE, _OF_WALL = 24, 0.001, 0.05, 0.6, 10.0, 24.0, 40.0
# Blur of edges and thinnest walls (cells), thickest thin and other walls of maps (m), thickness of paths relative to
# walls, least share of floors, smallest floor and largest zone inside one (m²), and share of its rim without a wall.
_BLURRED, _WALL_CELLS, _THICKEST_M, _THINNER = 2.0, 1.5, (0.065, 0.12), 0.35
_FLOORS, _FLOOR_M2, _ZONE_M2, _OPEN = 0.6, 1.0, 6.0, 0.5


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Grid with its occupied and free cells; all others are unknown."""

    frame: MapFrame
    occupied: Mask
    free: Mask


def sketch_map(colours: Colours, metres_per_pixel: float, builder: ReportBuilder, budget: Budget) -> Sketch | None:
    """Return the rooms and passages of a map as apps of robots show it; None if the picture is none.

    Rooms are areas of flat colours that touch or have thin lines between them, below paths, names and symbols.
    """
    factor = min(1.0, metres_per_pixel / _FINE_M, math.sqrt(_MOST_CELLS / colours[..., 0].size))
    rows, columns = (max(1, round(side * factor)) for side in colours.shape[:2])
    frame = MapFrame(metres_per_pixel * colours.shape[0] / rows, (0.0, 0.0, 0.0), (rows, columns))
    cell_m, around = frame.resolution_m, np.ones((3, 3), np.uint8)
    small = cv2.resize(colours, (columns, rows), interpolation=cv2.INTER_AREA)
    plain = cv2.medianBlur(small, 2 * round(0.5 * _PATH_M / cell_m) + 1)
    tones = _frequent_tones(plain)
    label = _distances(plain, tones).argmin(axis=0)
    edge = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
    is_ground = np.array([(edge == k).mean() >= _GROUND for k in range(len(tones))], bool)
    is_floor = ~is_ground & [_is_floor(label == k, cell_m) for k in range(len(tones))]
    if not is_ground.any() or not is_floor.any():
        return None
    tones, first = np.concatenate([tones[is_ground], tones[is_floor]]), int(is_ground.sum())
    far = _distances(plain, tones)
    label = np.where(far.min(axis=0) <= _OF_TONE, far.argmin(axis=0), -1)
    ground = (label >= 0) & (label < first)
    ground &= _near(~_near(~ground, _OUTER_M / cell_m), _OUTER_M / cell_m)
    label = np.where(label >= first, label, 0)
    walls = _without_specks(_lines_at(ground, label > 0, small, tones, cell_m), frame) > 0
    areas, zones_m2 = _areas(label, walls, cell_m, budget)
    free = areas > 0
    between = _closed(free, _GAP_M / cell_m) & ~free
    thick_m = [usual_thickness(mask.astype(np.uint8)) * cell_m for mask in (between, walls)]
    _, found = cv2.connectedComponents(ground.astype(np.uint8))
    within = np.asarray(found)
    outer = np.concatenate([within[0], within[-1], within[:, 0], within[:, -1]])
    inside = ~(ground & np.isin(within, outer))
    # Beside thin outer walls, a wall between two rooms can have a line of each.
    is_thin = thick_m[0] <= _THICKEST_M[0] or 0.0 < thick_m[1] <= _THICKEST_M[0]
    is_map = is_thin and max(thick_m) <= _THICKEST_M[1] and float(free[inside].mean()) >= _FLOORS
    if not is_map or not (walls.any() or len(np.unique(areas)) > 2):
        return None
    if zones_m2:
        builder.unsure.append(
            f"{len(zones_m2)} areas of another colour inside a room, {sum(zones_m2):.1f} m², are taken for zones or "
            "carpets; draw them in the editor if they are rooms"
        )
    # Blurred cells between two floors belong to the nearest.
    rest = (~free).astype(np.uint8)
    far, nearest = cv2.distanceTransformWithLabels(rest, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    numbers = np.asarray(nearest, np.int32)
    owner = np.zeros(int(numbers.max()) + 1, np.int32)
    owner[numbers[free]] = areas[free]
    areas = np.where(~walls & (far <= _BLURRED), owner[numbers], areas)
    free = areas > 0
    lowest, highest = (change(areas.astype(np.float32), around) for change in (cv2.erode, cv2.dilate))
    occupied = _near(walls | (lowest != highest), max(1.0, _GROWN_M / cell_m))
    sketch = sketch_grid(OccupancyGrid(frame, occupied, free & ~occupied), builder, budget)
    if not walls.any():
        builder.warnings.append(
            "rooms are areas of one colour without walls, as in maps of robots, so doors are unknown: add them in the "
            "editor, or send the map as JSON of Valetudo"
        )
        return replace(sketch, openings=[], opening_kinds=())
    builder.notes.append("rooms are areas of one colour between thin walls, as in maps of robots")
    # Floors that meet between the ends of walls meet in a door.
    inner = ((lowest != highest) & (lowest > 0) & ~_near(walls, _BLURRED)).astype(np.uint8)
    count, found = cv2.connectedComponents(inner, connectivity=8)
    for number in range(1, count):
        budget.check_time()
        row, column = np.nonzero(np.asarray(found) == number)
        places = np.column_stack([column + 0.5, rows - row - 0.5]) * cell_m
        along = places[:, np.ptp(places, axis=0).argmax()]
        start, end = places[along.argmin()], places[along.argmax()]
        if 0.0 < (length_m := math.dist(start, end)) <= _DOOR_M:
            beyond = _BLURRED * cell_m / length_m * (end - start)
            sketch.openings.append(SketchedOpening("passage", point_xy(start - beyond), point_xy(end + beyond)))
    return sketch


def _near(mask: Mask, reach: float) -> Mask:
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)) <= reach


def _closed(mask: Mask, reach: float) -> Mask:
    rim = math.ceil(reach) + 1
    return ~_near(~_near(np.pad(mask, rim), reach), reach)[rim:-rim, rim:-rim]


def _frequent_tones(colours: np.ndarray) -> Float[np.ndarray, "n 3"]:
    codes = (colours >> 3).astype(np.int32) @ np.array([1024, 32, 1])
    counts, tones = np.bincount(codes.ravel()), list[np.ndarray]()
    for code in np.argsort(-counts)[: int((counts >= _LEAST * codes.size).sum())]:
        tone = np.median(colours[codes == code], axis=0)
        if len(tones) < _TONES and all(np.abs(tone - known).max() > _SAME for known in tones):
            tones.append(tone)
    return np.array(tones, np.float32)


def _distances(colours: np.ndarray, tones: np.ndarray) -> Float[np.ndarray, "n h w"]:
    return np.array([np.abs(colours.astype(np.float32) - tone).max(axis=2) for tone in tones])


def _is_floor(mask: Mask, cell_m: float) -> bool:
    """Return whether an area is wide nearly everywhere, apart from lines over it; walls are so at corners alone."""
    inside = ~_near(~_closed(mask, _NOTCH_M / cell_m), _INSIDE_M / cell_m)
    return (
        bool(inside.any()) and min(mask[inside].mean(), _near(inside, 2.0 * _INSIDE_M / cell_m)[mask].mean()) >= _EVEN
    )


def _lines_at(ground: Mask, floor: Mask, colours: np.ndarray, tones: Float[np.ndarray, "n 3"], cell_m: float) -> Mask:
    """Return all lines of the tone that most lines between ground and floors have; none if blends are between them."""
    far = _distances(colours, tones).min(axis=0)
    beside = _near(ground, max(1.5, 0.8 * _OUTER_M / cell_m)) & ~ground & _near(floor, 1.5 * _OUTER_M / cell_m)
    line = colours[beside & (far > _OF_TONE)]
    least = max(1.0, _WALL_CELLS * float((_near(ground, 1.5) & beside).sum()))
    if len(line) < least:
        return np.zeros_like(ground)
    codes = (line >> 4).astype(np.int32) @ np.array([256, 16, 1])
    tone = np.median(line[codes == np.bincount(codes).argmax()], axis=0)
    if (np.abs(line - tone).max(axis=1) <= _OF_WALL).sum() < least:
        return np.zeros_like(ground)
    walls = (_distances(colours, tone[None])[0] < np.minimum(far, _OF_WALL)).astype(np.uint8)
    side = max(1, round(_THINNER * usual_thickness(walls & _near(ground, 1.5 * _OUTER_M / cell_m))))
    return cv2.morphologyEx(walls, cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) > 0


def _areas(label: np.ndarray, walls: Mask, cell_m: float, budget: Budget) -> tuple[Labels, list[float]]:
    """Return the number of each cell's room, 0 without, and the sizes (m²) of zones and carpets inside rooms."""
    areas, zones_m2 = np.zeros(label.shape, np.int32), list[float]()
    for tone in np.unique(label[label > 0]):
        part = _closed(label == tone, _NOTCH_M / cell_m) & ~walls & ((label == tone) | (label == 0))
        _, found, stats, _ = cv2.connectedComponentsWithStats(part.astype(np.uint8), connectivity=4)
        is_room = stats[:, cv2.CC_STAT_AREA] * cell_m**2 >= _FLOOR_M2
        is_room[0] = False
        areas = np.maximum(areas, np.where(is_room, areas.max() + np.cumsum(is_room), 0)[np.asarray(found)])
    for number in range(1, int(areas.max()) + 1):
        budget.check_time()
        room = (areas == number).astype(np.uint8)
        outlines, _ = cv2.findContours(room, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        inside = cv2.drawContours(np.zeros_like(room), outlines, -1, 1, cv2.FILLED) & ~room
        count, found, stats, _ = cv2.connectedComponentsWithStats(inside, connectivity=4)
        for hole in range(1, count):
            budget.check_time()
            part, area_m2 = np.asarray(found) == hole, float(stats[hole, cv2.CC_STAT_AREA]) * cell_m**2
            if area_m2 < _ZONE_M2 and walls[part & _near(~part, _BLURRED)].mean() < _OPEN:
                zones_m2 += [area_m2] if areas[part].any() else []
                areas[part & ~walls] = number
    return areas, zones_m2


def sketch_grid(grid: OccupancyGrid, builder: ReportBuilder, budget: Budget) -> Sketch:
    """Return the rooms and gaps that the picture importer finds, in the map frame.

    Unknown cells beside free ones close a room if most of its walls were seen: scanners do not see glass.
    """
    cells = _without_specks(grid.occupied, grid.frame)
    if not cells.any():
        return Sketch()
    sketch, report = _read_walls(cells, grid, budget)
    furniture, places = _furniture(cells, grid.frame)
    if places and budget.elapsed_s < _SHARE_OF_TIME * budget.limits.max_import_s:
        cleared, cleared_report = _read_walls(cells & ~furniture, grid, budget)
        # A piece of a wall between two doors can look like furniture.
        if explained_size([r.shape for r in cleared.rooms]) >= explained_size([r.shape for r in sketch.rooms]):
            cells, sketch, report = cells & ~furniture, cleared, cleared_report
            area_m2 = float(furniture.sum()) * grid.frame.resolution_m**2
            named = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in places[:_MAX_NAMED])
            builder.unsure.append(
                f"{len(places)} occupied areas that touch no wall, {area_m2:.1f} m² of cells, are taken for furniture: "
                f"{named}; draw them as holes of their rooms if they are columns"
            )
    beside_free = cv2.dilate(grid.free.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    unseen = _without_specks(beside_free & ~grid.free & ~grid.occupied, grid.frame)
    if unseen.any():
        guess, guess_report = _read_walls(cells | unseen, grid, budget)
        known = shapely.union_all([room.shape for room in sketch.rooms])
        shared_m2 = [shapely.intersection(room.shape, known).area for room in guess.rooms]
        is_old = [area > _OLD * room.shape.area for room, area in zip(guess.rooms, shared_m2, strict=True)]
        shares = _seen_shares(guess.rooms, grid, cells > 0)
        judged = list(zip(guess.rooms, is_old, shares, strict=True))
        kept = [room for room, old, share in judged if old or share >= _SEEN_SHARE]
        if len(kept) > sum(is_old) >= len(sketch.rooms):
            sketch, report = replace(guess, rooms=kept), guess_report
            for room, old, share in judged:
                if room in kept and not old:
                    place = room.shape.representative_point()
                    builder.unsure.append(
                        f"{(1.0 - share) * room.shape.exterior.length:.1f} m of the walls around ({place.x:.1f}, "
                        f"{place.y:.1f}) were never seen (unknown cells, as behind glass) and are a guess"
                    )
    builder.no_room = report.no_room
    if builder.no_room:
        area_m2 = sum(area.area for area in builder.no_room)
        builder.warnings.append(f"{area_m2:.0f} m² inside walls became no room (no_room); close them in the picture")
    _report_free_cells(sketch, grid, builder)
    if sketch.openings:
        builder.unsure.append(f"{len(sketch.openings)} gaps in walls are taken for passages or doors")
    return sketch


def _read_walls(cells: Gray, grid: OccupancyGrid, budget: Budget) -> tuple[Sketch, ReportBuilder]:
    """Return what the picture importer finds between walls (1), in the map frame."""
    frame = grid.frame
    rows, columns = frame.size
    parts = max(1, math.ceil(frame.resolution_m / _FINE_M - 1e-9))
    if rows * columns * parts**2 > budget.limits.max_plan_pixels:
        parts = max(1, math.isqrt(budget.limits.max_plan_pixels // (rows * columns)))
    fine_m = frame.resolution_m / parts
    size = columns * parts, rows * parts
    gray = cv2.resize(255 * cells, size, interpolation=cv2.INTER_LINEAR).astype(np.uint8)
    skew_deg = find_skew(gray > _HALF, _MAX_TURN_DEG)
    if skew_deg:
        gray = rotate_picture(gray, skew_deg, fill=0.0)
    # Walls of scanned maps are one cell thick, too thin for a drawing; they are grown here and the rooms below.
    grown = round(0.5 * parts)
    walls = cv2.dilate((gray > _HALF).astype(np.uint8), np.ones((2 * grown + 1, 2 * grown + 1), np.uint8))
    centre_m = 0.5 * fine_m * np.array(gray.shape[::-1])
    grid_centre_m = 0.5 * frame.resolution_m * np.array([columns, rows])
    c, s = math.cos(math.radians(skew_deg)), math.sin(math.radians(skew_deg))

    def to_grid(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return (points - centre_m) @ np.array([[c, -s], [s, c]]) + grid_centre_m

    def to_map(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return frame.to_map(to_grid(points))

    # Its report gives places in the picture.
    inner = ReportBuilder()
    sketch = sketch_picture(
        np.where(walls > 0, 0, 255).astype(np.uint8), fine_m, inner, budget, straighten=False, has_symbols=False
    )
    inner.no_room = [shapely.transform(area, to_map) for area in inner.no_room]
    rooms = []
    for room in sketch.rooms:
        for part in polygons_of(room.shape.buffer(grown * fine_m, join_style="mitre")):
            floor = shapely.transform(part, to_grid)
            if _free_share(floor, grid) >= _FREE_SHARE:
                rooms.append(SketchedRoom(shapely.transform(floor, frame.to_map)))
    ends = [to_map(np.array([opening.start, opening.end])) for opening in sketch.openings]
    placed = zip(sketch.openings, ends, strict=True)
    openings = [SketchedOpening(old.kind, point_xy(start), point_xy(end)) for old, (start, end) in placed]
    return Sketch(rooms=rooms, openings=openings, recall=_RECALL, kinds=("door", "passage")), inner


def _furniture(cells: Gray, frame: MapFrame) -> tuple[Gray, list[tuple[float, float]]]:
    """Return the groups of cells (1) of the size of furniture that touch no wall, and their middles in the map frame.

    Thinner ones are free-standing walls.
    """
    count, labels, stats, centres = cv2.connectedComponentsWithStats(cells, connectivity=8)
    found, places = np.zeros_like(cells), []
    for index in range(1, count):
        left, top, width, height = stats[index, : cv2.CC_STAT_AREA]
        if max(width, height) * frame.resolution_m > _LARGEST_PIECE_M:
            continue
        part = labels[top : top + height, left : left + width] == index
        _, size, _ = cv2.minAreaRect(np.argwhere(part).astype(np.float32))
        if (min(size) + 1.0) * frame.resolution_m >= _THINNEST_PIECE_M:
            found[top : top + height, left : left + width][part] = 1
            x, row = centres[index]
            middle = np.array([[x + 0.5, frame.size[0] - row - 0.5]]) * frame.resolution_m
            places.append(point_xy(frame.to_map(middle)[0]))
    return found, places


def _seen_shares(rooms: Sequence[SketchedRoom], grid: OccupancyGrid, seen: Mask) -> list[float]:
    """Return the share of each room's outline (map frame) that has a wall beside it that was seen."""
    near, lines = _near(seen, _BESIDE_CELLS), [room.shape.exterior for room in rooms]
    steps = [np.linspace(0.0, 1.0, max(8, math.ceil(line.length / grid.frame.resolution_m))) for line in lines]
    points = [line.interpolate(step, normalized=True) for line, step in zip(lines, steps, strict=True)]
    return [float(near[grid.frame.cells_at(shapely.get_coordinates(each))].mean()) for each in points]


def _report_free_cells(sketch: Sketch, grid: OccupancyGrid, builder: ReportBuilder) -> None:
    """Warn about floor that the robot saw and that is in no room."""
    free_m2 = float(grid.free.sum()) * grid.frame.resolution_m**2
    used_m2 = sum(room.shape.area for room in sketch.rooms)
    if sketch.rooms and free_m2 > 0.0 and used_m2 < _USED_SHARE * free_m2:
        builder.warnings.append(
            f"{free_m2 - used_m2:.0f} m² of free cells ({1.0 - used_m2 / free_m2:.0%} of all) are in no room; close "
            "the walls around them in the picture if they are rooms"
        )


def _without_specks(cells: Mask, frame: MapFrame) -> Gray:
    """Return cells, as 1, without those that are too few for a wall."""
    _, found, stats, _ = cv2.connectedComponentsWithStats(cells.astype(np.uint8), connectivity=8)
    longest = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    is_wall = longest * frame.resolution_m >= _SPECK_M
    is_wall[0] = False
    return is_wall.astype(np.uint8)[np.asarray(found, dtype=np.int32)]


def _free_share(room: shapely.Polygon, grid: OccupancyGrid) -> float:
    """Return the share of free cells in a room, whose coordinates are metres along the grid."""
    flip, inside = np.array([1.0, -1.0]) / grid.frame.resolution_m, np.zeros(grid.frame.size, np.uint8)
    rings = [shapely.get_coordinates(ring) * flip for ring in (room.exterior, *room.interiors)]
    cv2.fillPoly(inside, [np.round(np.add(ring, [-0.5, len(inside) - 0.5])).astype(np.int32) for ring in rings], 1)
    return float(grid.free[inside > 0].mean()) if inside.any() else 0.0
