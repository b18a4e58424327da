"""Albums of generated homes: photographs of one visit, as people take them while they walk through all rooms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float, UInt8

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Split
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, split_renderer_cache
from lalaloc_core.learn.data.views import cut_view, tilt_by_hand
from lalaloc_core.learn.synth.furniture.furnish import FurnitureLevel
from lalaloc_core.learn.synth.homes.plans import Home, home_of
from lalaloc_core.learn.synth.rendering.sphere_renderer import Window
from lalaloc_core.learn.synth.scene.shots import CEILING_CLEARANCE_M, POSE_MARGIN_M, Shot
from lalaloc_core.photograph.cameras import Perspective

# Fields of view (degrees) of the cameras, their pictures (pixels), and heights of eyes (m) with that of one hand.
FIELDS_DEG = (55.0, 80.0)
_SIZE = (960, 720)
_HEIGHT_M, _HEIGHT_SD_M, _HAND_SD_M = 1.5, 0.1, 0.03
# Share of photographs that are taken from the spot of the one before, and the turn between them (degrees).
_SAME_SPOT, _TURNS_DEG = 0.4, (25.0, 150.0)
# Median distance (m) of what people photograph, at least, and places and headings that are tried for it.
_AHEAD_M, _TRIES = 1.8, 24
# Shape of the gamma distribution of how many photographs rooms have; and small rooms (m²), and how many are left out.
_EVENNESS, _SMALL_M2, _LEFT_OUT = 4.0, 3.0, 0.5
# Seconds between photographs, and metres walked in one.
_PAUSE_S, _WALK_M_S = 6.0, 0.8
# Part of the sphere that is rendered: room for the widest picture with the largest tilt.
_WINDOW, _WINDOW_SIZE = Window(math.radians(116.0), math.radians(58.0)), (928, 928)
_SPHERE_SIZE = (512, 1024)


class Spot(NamedTuple):
    """Pose of the camera of a photograph; the heading (radians) is that of its centre."""

    position_m: Float[np.ndarray, "2"]
    room_index: int
    heading: float
    taken_s: float


def taken_album(
    split: Split,
    index: int,
    count: int,
    *,
    spheres: bool = False,
    furniture: FurnitureLevel = "full",
    textures: Path | None = None,
) -> tuple[FloorPlan, list[tuple[UInt8[np.ndarray, "h w 3"], Spot]]]:
    """Return an album of one home of a split: photographs, or full spheres, in the order in which they were taken."""
    number = SPLIT_NUMBERS[split]
    home, rng = home_of(number, 0, index)
    renderers = split_renderer_cache(number, 0, textures)
    field_deg = float(rng.uniform(*FIELDS_DEG))
    camera = Perspective.of_hfov(*_SIZE, math.radians(field_deg))
    lowest_m = min(room.ceiling_height_m for room in home.plan.rooms) - CEILING_CLEARANCE_M
    height_m = min(float(rng.normal(_HEIGHT_M, _HEIGHT_SD_M)), lowest_m)
    look = int(rng.integers(1 << 62))
    photographs = []
    for spot in _walk(home, count, rng):
        shot = Shot(
            home=home,
            position_m=spot.position_m,
            room_index=spot.room_index,
            heading=spot.heading % TWO_PI,
            camera_height_m=min(height_m + float(rng.normal(0.0, _HAND_SD_M)), lowest_m),
            furniture=furniture,
            seed=look,
            lighting="raw",
        )
        if spheres:
            pixels = renderers.renderer(*_SPHERE_SIZE, (1, 1)).render([shot])[0].cpu().numpy()
        else:
            (pitch, roll), sphere = tilt_by_hand(rng), renderers.part_of_sphere(shot, _WINDOW, _WINDOW_SIZE)
            pixels = cut_view(sphere, camera, azimuth=0.0, pitch=pitch, roll=roll)
        photographs.append((pixels, spot))
    return home.plan, photographs


def _walk(home: Home, count: int, rng: np.random.Generator) -> list[Spot]:
    """Return places and headings in the order of a walk through the doors of a home; large rooms have more."""
    rooms = home.plan.rooms
    order = _order_of_rooms(home, rng)
    small = [index for index in order if rooms[index].area_m2 < _SMALL_M2 and rng.random() < _LEFT_OUT]
    order = [index for index in order if index not in small] or order
    share = np.array([math.sqrt(rooms[index].area_m2) for index in order]) * rng.gamma(_EVENNESS, size=len(order))
    by_room = _shared(count, share / share.sum())
    spots: list[Spot] = []
    taken_s = 0.0
    for room_index, photographs in zip(order, by_room, strict=True):
        for number in range(photographs):
            last = spots[-1] if spots else None
            if number and last is not None and rng.random() < _SAME_SPOT:
                turn = math.radians(rng.uniform(*_TURNS_DEG)) * (1 if rng.random() < 0.5 else -1)
                place, heading = last.position_m + rng.normal(0.0, 0.05, 2), float(wrap_angle(last.heading + turn))
                if not rooms[room_index].shape.buffer(-0.1).contains(shapely.Point(place)):
                    place = last.position_m
            else:
                place, heading = _framed(home, room_index, rng)
            walked_m = 0.0 if last is None else float(np.linalg.norm(place - last.position_m))
            taken_s += _PAUSE_S * float(rng.gamma(2.0, 0.5)) + walked_m / _WALK_M_S
            spots.append(Spot(place, room_index, heading, taken_s))
    return spots


def _order_of_rooms(home: Home, rng: np.random.Generator) -> list[int]:
    """Return all rooms in the order of a walk that begins anywhere and goes through doors, back where it must."""
    near: dict[int, list[int]] = {index: [] for index in range(len(home.plan.rooms))}
    for opening in home.openings:
        if opening.kind != "window" and opening.neighbour >= 0:
            near[opening.room].append(opening.neighbour)
    left, order = set(near), list[int]()
    stack = [int(rng.integers(len(near)))]
    while left:
        if not stack:
            stack.append(min(left))
        room = stack.pop()
        if room not in left:
            continue
        left.remove(room)
        order.append(room)
        behind = [neighbour for neighbour in dict.fromkeys(near[room]) if neighbour in left]
        stack += [behind[index] for index in rng.permutation(len(behind))]
    return order


def _shared(count: int, share: Float[np.ndarray, "n"]) -> list[int]:
    """Divide a count by shares; the largest remainders are rounded up, and every part has one while there are any."""
    exact = share * count
    whole = np.maximum(np.floor(exact), 1.0)
    while whole.sum() < count:
        whole[int((exact - whole).argmax())] += 1.0
    while whole.sum() > count:
        whole[int((exact - whole).argmin())] -= 1.0
    return [int(value) for value in whole]


def _framed(home: Home, room_index: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "2"], float]:
    """Draw a place in a room and a heading along which there is something to see."""
    room = home.plan.rooms[room_index]
    inner = room.shape.buffer(-POSE_MARGIN_M)
    inner = room.shape.buffer(-0.05) if inner.is_empty else inner
    boundary = room.shape.exterior
    best, best_m = (np.array(room.shape.representative_point().coords[0]), 0.0), -1.0
    x_min, y_min, x_max, y_max = inner.bounds
    for _ in range(_TRIES):
        place = rng.uniform((x_min, y_min), (x_max, y_max))
        if not shapely.contains_xy(inner, *place):
            continue
        heading = float(rng.uniform(0.0, TWO_PI))
        far = place + 50.0 * np.array([math.sin(heading), math.cos(heading)])
        ahead_m = boundary.intersection(shapely.LineString([place, far])).distance(shapely.Point(place))
        if ahead_m > best_m:
            best, best_m = (place, heading), ahead_m
        if ahead_m >= _AHEAD_M:
            break
    return best


def two_views(
    sphere: UInt8[np.ndarray, "h w 3"], field_deg: float, rng: np.random.Generator
) -> list[tuple[UInt8[np.ndarray, "h w 3"], float]]:
    """Return two level views of a sphere and their azimuths (radians): a random one, and half a turn ± 45° on."""
    camera = Perspective.of_hfov(*_SIZE, math.radians(field_deg))
    first = float(rng.uniform(0.0, TWO_PI))
    azimuths = first, first + math.pi * float(rng.uniform(0.75, 1.25))
    return [(cut_view(sphere, camera, azimuth=azimuth, pitch=0.0, roll=0.0), azimuth) for azimuth in azimuths]
