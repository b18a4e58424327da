"""Cameras of synthetic photographs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import Room
from lalaloc_core.learn.synth.furniture.furnish import FURNITURE_LEVELS, FurnitureLevel, opening_ends_m, wall_frame
from lalaloc_core.learn.synth.homes.openings import Opening
from lalaloc_core.learn.synth.homes.plans import Home
from lalaloc_core.learn.synth.scene.lighting import Mood
from lalaloc_core.render.sampling import random_poses

POSE_MARGIN_M = 0.2
# Cameras stand at least this far below the ceiling.
CEILING_CLEARANCE_M = 0.3
_LEVEL_SHARES = (0.3, 0.2, 0.5)
_STAGED_HEIGHTS_M = (1.2, 1.7)
# Cameras on a threshold stand so far from the plane of the opening, those in it nearer than `POSE_MARGIN_M`.
_IN_OPENING_M, _THRESHOLD_M = 0.03, 0.55
_TRIES = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One photograph: camera, furniture, and the seed of everything random.

    Attributes:
        seed: decides materials, furniture, light and camera settings.
        lighting: colour of all light; None draws one. A shot with lighting is *staged*: shots of one home with the same
            seed show the same materials, whatever their furniture and lighting, and there is no tripod.
        is_night: dark outdoors, and lamps on.
        is_fitted: beams, soffits or slopes below the ceiling, and kitchens and closets fitted as in real homes.
    """

    home: Home
    position_m: Float[np.ndarray, "2"]
    room_index: int
    heading: float
    camera_height_m: float
    furniture: FurnitureLevel
    seed: int
    lighting: Mood | None = None
    is_night: bool = False
    is_fitted: bool = False


def sample_shots(
    home: Home,
    count: int,
    rng: np.random.Generator,
    level: FurnitureLevel | None = None,
    *,
    by_room_share: float = 0.0,
    hard_share: float = 0.0,
    unusual_heights_m: tuple[float, float] = (1.0, 1.9),
    night_share: float = 0.0,
    fitted_share: float = 0.0,
) -> list[Shot]:
    """Draw shots uniformly over a home's floor.

    Without `level` every shot draws its amount of furniture. `by_room_share` is the share of shots whose room is drawn
    uniformly first, which favours closets and corridors; `hard_share` the share from rare places that are hard to
    localise: close to a wall, on the threshold of an open door or in it, in the narrowest rooms. `unusual_heights_m` is
    the range of camera heights of the quarter that is not taken from 1.3 to 1.7 m. Shots at night (`night_share`) have
    black windows; `fitted_share` is the share of `Shot.is_fitted`.
    """
    poses = random_poses(home.plan, count, rng, POSE_MARGIN_M)
    by_room = np.flatnonzero(rng.random(count) < by_room_share)
    for index in by_room:
        room = int(rng.integers(len(home.plan.rooms)))
        poses.position_m[index] = _position_in(home.plan.rooms[room], rng)
        poses.room_index[index] = room
    for index in np.flatnonzero(rng.random(count) < hard_share):
        poses.position_m[index], poses.room_index[index] = _hard_place(home, rng)
    shots = []
    for position, room in zip(poses.position_m, poses.room_index, strict=True):
        usual = rng.random() < 0.75
        height = rng.uniform(1.3, 1.7) if usual else rng.uniform(*unusual_heights_m)
        ceiling = home.plan.rooms[room].ceiling_height_m
        shots.append(
            Shot(
                home=home,
                position_m=position,
                room_index=int(room),
                heading=float(rng.uniform(0.0, TWO_PI)),
                camera_height_m=float(min(height, ceiling - CEILING_CLEARANCE_M)),
                furniture=level or FURNITURE_LEVELS[int(rng.choice(3, p=_LEVEL_SHARES))],
                seed=int(rng.integers(1 << 62)),
                is_night=bool(night_share) and rng.random() < night_share,
                is_fitted=bool(fitted_share) and rng.random() < fitted_share,
            )
        )
    return shots


def stage_rooms(home: Home, rng: np.random.Generator) -> list[Shot]:
    """Return one staged shot of every room along +y, all from one height, clear of the walls where there is space."""
    low, high = _STAGED_HEIGHTS_M
    lowest_ceiling = min(room.ceiling_height_m for room in home.plan.rooms)
    height = rng.uniform(low, min(high, lowest_ceiling - CEILING_CLEARANCE_M))
    seed = int(rng.integers(1 << 62))
    return [
        Shot(
            home=home,
            position_m=_staged_position(room, rng),
            room_index=index,
            heading=0.0,
            camera_height_m=float(height),
            furniture="full",
            seed=seed,
            lighting="raw",
        )
        for index, room in enumerate(home.plan.rooms)
    ]


def _staged_position(room: Room, rng: np.random.Generator) -> Float[np.ndarray, "2"]:
    """Draw a position clear of the walls; of a room with no more than a sliver of such, return the middle."""
    if room.shape.buffer(-POSE_MARGIN_M).area > 1e-2:
        return _position_in(room, rng)
    return np.array(shapely.maximum_inscribed_circle(room.shape, 0.01).coords[0])


def _hard_place(home: Home, rng: np.random.Generator) -> tuple[Float[np.ndarray, "2"], int]:
    """Draw a position and its room: on a threshold or in an opening, beside a wall, in a corridor or narrow room."""
    rooms = home.plan.rooms
    kind = rng.random()
    see_through = [opening for opening in home.openings if opening.is_see_through]
    if kind < 0.3 and see_through:
        opening = see_through[int(rng.integers(len(see_through)))]
        place = _on_threshold(rooms[opening.room], opening, rng)
        if place is not None:
            return place, opening.room
    if kind < 0.5:
        index = int(rng.integers(len(rooms)))
        places = np.stack([_position_in(rooms[index], rng) for _ in range(_TRIES)])
        walls = shapely.distance(rooms[index].shape.exterior, shapely.points(places))
        return places[int(walls.argmin())], index
    corridors = [number for number, room in enumerate(rooms) if room.name.startswith("corridor")]
    if kind < 0.75 and corridors:
        index = int(rng.choice(corridors))
        return _position_in(rooms[index], rng), index
    narrowness = np.array([room.shape.length / room.area_m2 for room in rooms]) ** 2
    index = int(rng.choice(len(rooms), p=narrowness / narrowness.sum()))
    return _position_in(rooms[index], rng), index


def _on_threshold(room: Room, opening: Opening, rng: np.random.Generator) -> Float[np.ndarray, "2"] | None:
    """Draw a position in front of an opening or in it, clear of the walls beside it; None if none is found."""
    start, along, inwards = wall_frame(room, opening.wall)
    # Slightly wider than the opening, so that no sliver of it remains.
    walls = room.shape.boundary.difference(shapely.LineString(opening_ends_m(room, opening)).buffer(1e-3))
    low, high = (_IN_OPENING_M, POSE_MARGIN_M) if rng.random() < 0.5 else (POSE_MARGIN_M, _THRESHOLD_M)
    for _ in range(_TRIES):
        position = start + along * rng.uniform(opening.start_m, opening.end_m) + inwards * rng.uniform(low, high)
        if shapely.contains_xy(room.shape, *position) and walls.distance(shapely.Point(position)) >= POSE_MARGIN_M:
            return position
    return None


def _position_in(room: Room, rng: np.random.Generator) -> Float[np.ndarray, "2"]:
    """Draw a position uniformly over a room's floor, `POSE_MARGIN_M` from its walls."""
    inner = room.shape.buffer(-POSE_MARGIN_M)
    x_min, y_min, x_max, y_max = inner.bounds
    while True:
        drawn = rng.uniform((x_min, y_min), (x_max, y_max), (16, 2))
        inside = shapely.contains_xy(inner, drawn[:, 0], drawn[:, 1])
        if inside.any():
            return drawn[inside.argmax()]
