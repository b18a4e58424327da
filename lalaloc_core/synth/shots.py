"""Where the camera of a synthetic photograph stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import Room
from lalaloc_core.sampling import random_poses
from lalaloc_core.synth.furniture import FURNITURE_LEVELS, FurnitureLevel
from lalaloc_core.synth.plans import Home

POSE_MARGIN_M = 0.2
_LEVEL_SHARES = (0.2, 0.25, 0.55)
_CEILING_CLEARANCE_M = 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One photograph: where and how it is taken, and the seed of all that is random about it.

    Attributes:
        home: the home.
        position_m: camera position (2,) in the plan frame.
        room_index: the room it stands in.
        heading: azimuth of the centre column, radians.
        camera_height_m: over the floor.
        furniture: how full the rooms are.
        seed: decides materials, furniture, light and camera settings.
    """

    home: Home
    position_m: Float[np.ndarray, "2"]
    room_index: int
    heading: float
    camera_height_m: float
    furniture: FurnitureLevel
    seed: int


def sample_shots(
    home: Home,
    count: int,
    rng: np.random.Generator,
    level: FurnitureLevel | None = None,
    *,
    by_room_share: float = 0.0,
) -> list[Shot]:
    """Draw shots uniform over a home's floor.

    Args:
        home: the home.
        count: how many.
        rng: source of randomness.
        level: how full the rooms are; None draws it for every shot.
        by_room_share: share of shots whose room is drawn first, all rooms alike: more of closets and corridors.
    """
    poses = random_poses(home.plan, count, rng, POSE_MARGIN_M)
    by_room = np.flatnonzero(rng.random(count) < by_room_share)
    for index in by_room:
        room = int(rng.integers(len(home.plan.rooms)))
        poses.position_m[index] = _position_in(home.plan.rooms[room], rng)
        poses.room_index[index] = room
    shots = []
    for position, room in zip(poses.position_m, poses.room_index, strict=True):
        usual = rng.random() < 0.75
        height = rng.uniform(1.3, 1.7) if usual else rng.uniform(1.0, 1.9)
        ceiling = home.plan.rooms[room].ceiling_height_m
        shots.append(
            Shot(
                home=home,
                position_m=position,
                room_index=int(room),
                heading=float(rng.uniform(0.0, TWO_PI)),
                camera_height_m=float(min(height, ceiling - _CEILING_CLEARANCE_M)),
                furniture=level or FURNITURE_LEVELS[int(rng.choice(3, p=_LEVEL_SHARES))],
                seed=int(rng.integers(1 << 62)),
            )
        )
    return shots


def _position_in(room: Room, rng: np.random.Generator) -> Float[np.ndarray, "2"]:
    """A position uniform over a room's floor, `POSE_MARGIN_M` from its walls."""
    inner = room.shape.buffer(-POSE_MARGIN_M)
    x_min, y_min, x_max, y_max = inner.bounds
    while True:
        drawn = rng.uniform((x_min, y_min), (x_max, y_max), (16, 2))
        inside = shapely.contains_xy(inner, drawn[:, 0], drawn[:, 1])
        if inside.any():
            return drawn[inside.argmax()]
