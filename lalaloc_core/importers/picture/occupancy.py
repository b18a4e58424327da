"""Occupancy grids, as robots map them: their frame, and the rooms that their occupied cells enclose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float, UInt8

from lalaloc_core.importers.common.geometry import MapFrame, point_xy, polygons_from_geometry
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.sketch import Sketch, SketchedOpening, SketchedRoom
from lalaloc_core.importers.picture.ink import find_skew, rotate_picture
from lalaloc_core.importers.picture.sketch_picture import sketch_picture

# Cells are divided until they are this fine (m), because the picture importer expects walls of several pixels.
_FINE_M = 0.0125
# Smallest share of free cells in a room: the inside of a thick wall is unknown.
_FREE_SHARE = 0.5
# Smaller groups of occupied cells (m) are legs of furniture and noise.
_SPECK_M = 0.6
# Largest turn that aligns the walls with the picture, and the threshold of half a cell.
_MAX_TURN_DEG, _HALF = 45.0, 127


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Grid with its occupied and free cells; all others are unknown."""

    frame: MapFrame
    occupied: Bool[np.ndarray, "h w"]
    free: Bool[np.ndarray, "h w"]


def sketch_grid(grid: OccupancyGrid, builder: ReportBuilder, budget: Budget) -> Sketch:
    """Return the rooms and gaps that the picture importer finds, in the map frame."""
    frame = grid.frame
    rows, columns = frame.size
    parts = max(1, math.ceil(frame.resolution_m / _FINE_M - 1e-9))
    if rows * columns * parts**2 > budget.limits.max_plan_pixels:
        parts = max(1, math.isqrt(budget.limits.max_plan_pixels // (rows * columns)))
    cells = 255 * _without_specks(grid)
    if not cells.any():
        return Sketch()
    fine_m = frame.resolution_m / parts
    gray = cv2.resize(cells, (columns * parts, rows * parts), interpolation=cv2.INTER_LINEAR).astype(np.uint8)
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
    sketch = sketch_picture(np.where(walls > 0, 0, 255).astype(np.uint8), fine_m, inner, budget, straighten=False)
    builder.no_room = [shapely.transform(area, to_map) for area in inner.no_room]
    if builder.no_room:
        area_m2 = sum(area.area for area in builder.no_room)
        builder.warnings.append(
            f"{area_m2:.0f} m² inside the walls became no room (no_room); close the walls in the picture"
        )
    rooms = []
    for room in sketch.rooms:
        for part in polygons_from_geometry(room.shape.buffer(grown * fine_m, join_style="mitre")):
            floor = shapely.transform(part, to_grid)
            if _free_share(floor, grid) >= _FREE_SHARE:
                rooms.append(SketchedRoom(shapely.transform(floor, frame.to_map)))
    openings = []
    for opening in sketch.openings:
        start, end = to_map(np.array([opening.start, opening.end]))
        openings.append(SketchedOpening(opening.kind, point_xy(start), point_xy(end)))
    if openings:
        builder.unsure.append(
            f"{len(openings)} gaps in walls are taken for passages or doors; set opening_kinds to the kinds that are "
            "complete"
        )
    return Sketch(rooms=rooms, openings=openings, opening_kinds=())


def _without_specks(grid: OccupancyGrid) -> UInt8[np.ndarray, "h w"]:
    """Return the occupied cells without those that are too few for a wall."""
    _, found, stats, _ = cv2.connectedComponentsWithStats(grid.occupied.astype(np.uint8), connectivity=8)
    longest = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    is_wall = longest * grid.frame.resolution_m >= _SPECK_M
    is_wall[0] = False
    return is_wall.astype(np.uint8)[np.asarray(found, dtype=np.int32)]


def _free_share(room: shapely.Polygon, grid: OccupancyGrid) -> float:
    """Return the share of free cells in a room, whose coordinates are metres along the grid."""
    rows, _ = grid.frame.size
    x0, y0, x1, y1 = (int(value / grid.frame.resolution_m) for value in room.bounds)
    y, x = np.mgrid[max(y0, 0) : y1 + 1, max(x0, 0) : x1 + 1]
    shapely.prepare(room)
    size = grid.frame.resolution_m
    inside = shapely.contains_xy(room, (x + 0.5) * size, (y + 0.5) * size)
    row = np.clip(rows - 1 - y[inside], 0, rows - 1)
    column = np.clip(x[inside], 0, grid.frame.size[1] - 1)
    return float(grid.free[row, column].mean()) if inside.any() else 0.0
