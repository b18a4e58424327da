"""Ceilings that are not one plane: beams, soffits, trays and slopes as boxes below the ceiling of the plan.

They hide the edge between wall and ceiling, so that distances must be read from the floor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.furniture.furnish import Prism, wall_frame
from lalaloc_core.learn.synth.furniture.pieces import Finish
from lalaloc_core.learn.synth.homes.openings import Opening

# Boxes end so far above openings and the camera.
_ABOVE_OPENING_M, _ABOVE_CAMERA_M = 0.03, 0.25
# Slopes are stairs of so many steps, because boxes have level undersides.
_STEPS = 6
_MAX_BEAMS = 6
# Share of a box's footprint that must lie in the room: boxes outside would be seen through windows.
_INSIDE = 0.995
_KINDS = ("beams", "soffit", "tray", "slope")


def ceiling_boxes(
    room: Room, openings: Sequence[Opening], camera_height_m: float, rng: np.random.Generator
) -> list[Prism]:
    """Return boxes below a room's ceiling; none where the ceiling is too low for them."""
    top = room.ceiling_height_m
    floor_m = camera_height_m + _ABOVE_CAMERA_M
    kind = _KINDS[int(rng.choice(len(_KINDS), p=(0.35, 0.3, 0.15, 0.2)))]
    wall = int(rng.integers(len(room.walls_m)))
    if kind == "beams":
        return _beams(room, wall, max(floor_m, top - rng.uniform(0.08, 0.35)), rng)
    width = rng.uniform(0.2, 1.0)
    if kind == "slope":
        lowest = max(floor_m, _clear_m(openings, [wall]), top - rng.uniform(0.3, 1.4))
        depth = rng.uniform(0.4, 1.0) * room.area_m2**0.5 / _STEPS
        boxes = [
            _along_wall(room, wall, (step * depth, (step + 1) * depth), lowest + (top - lowest) * step / _STEPS)
            for step in range(_STEPS)
        ]
    else:
        walls = [wall] if kind == "soffit" else list(range(len(room.walls_m)))
        bottom = max(floor_m, _clear_m(openings, walls), top - rng.uniform(0.12, 0.5))
        boxes = [_along_wall(room, number, (0.0, width), bottom) for number in walls]
    return [box for box in boxes if box is not None]


def _clear_m(openings: Sequence[Opening], walls: list[int]) -> float:
    """Return the height above all openings in some walls."""
    return max((opening.head_m + _ABOVE_OPENING_M for opening in openings if opening.wall in walls), default=0.0)


def _along_wall(room: Room, wall: int, reach_m: tuple[float, float], bottom_m: float) -> Prism | None:
    """Return a box along a wall between two distances from it; None if it does not fit."""
    start, along, inwards = wall_frame(room, wall)
    length = float(np.hypot(*(room.walls_m[wall][2:] - room.walls_m[wall][:2])))
    near, far = (start + inwards * reach for reach in reach_m)
    return _box(room, shapely.Polygon([near, near + along * length, far + along * length, far]), along, bottom_m)


def _beams(room: Room, wall: int, bottom_m: float, rng: np.random.Generator) -> list[Prism]:
    """Return parallel beams from wall to wall."""
    _, along, inwards = wall_frame(room, wall)
    middle = np.array(room.shape.centroid.coords[0])
    reach = float(np.hypot(*np.ptp(room.polygon_m, axis=0)))
    half, spacing = rng.uniform(0.04, 0.15), rng.uniform(0.5, 1.8)
    count = min(int(reach / spacing) + 1, _MAX_BEAMS)
    finish: Finish = "wood" if rng.random() < 0.5 else "white"
    beams = []
    for number in range(count):
        centre = middle + inwards * spacing * (number - 0.5 * (count - 1))
        near, far = centre - inwards * half, centre + inwards * half
        strip = shapely.Polygon([near - along * reach, near + along * reach, far + along * reach, far - along * reach])
        parts = shapely.get_parts(strip.intersection(room.shape))
        outlines = [part.minimum_rotated_rectangle for part in parts if part.area]
        beams += [
            _box(room, outline, along, bottom_m, finish) for outline in outlines if isinstance(outline, shapely.Polygon)
        ]
    return [beam for beam in beams if beam is not None]


def _box(
    room: Room, footprint: shapely.Polygon, along: np.ndarray, bottom_m: float, finish: Finish = "paint"
) -> Prism | None:
    """Return a box from a footprint up to the ceiling; None if it is flat or reaches out of the room."""
    if room.ceiling_height_m - bottom_m < 0.03 or footprint.intersection(room.shape).area < _INSIDE * footprint.area:
        return None
    corners = shapely.get_coordinates(footprint)
    across = np.array([-along[1], along[0]])
    low, high = (np.array([function(corners @ along), function(corners @ across)]) for function in (np.min, np.max))
    centre = 0.5 * (low + high)
    middle = along * centre[0] + across * centre[1]
    half_a, half_b = (0.5 * (high - low)).tolist()
    return Prism.upright(middle, along, (half_a, half_b), (bottom_m, room.ceiling_height_m), finish=finish, piece=-1)
