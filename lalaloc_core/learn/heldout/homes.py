"""Homes by seed: plan, openings, materials, and the mesh and camera space of each furniture level."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from jaxtyping import Float, Int
from shapely.geometry.base import BaseGeometry

from lalaloc_core.learn.heldout.furnishing import Furnishing, Level
from lalaloc_core.learn.heldout.geometry import Part
from lalaloc_core.learn.heldout.grown_plans import HeldoutPlan, sample_plan
from lalaloc_core.learn.heldout.palette import room_surfaces, thing_surfaces
from lalaloc_core.learn.heldout.procedural_materials import Materials, Noise
from lalaloc_core.learn.heldout.shell import shell_parts
from lalaloc_core.learn.heldout.tracing import Tracer
from lalaloc_core.learn.heldout.wall_holes import Opening, sample_openings, with_openings

# Separates these seeds from those of other generators.
_FAMILY = 0x0DD
WALL_MARGIN_M = 0.25
_FURNITURE_MARGIN_M = 0.12
_MIN_CAMERA_M, _MAX_CAMERA_M = 1.1, 1.8


@dataclass(frozen=True)
class HomeKey:
    """Key of a home: equal keys give equal homes."""

    split: int
    seed: int
    index: int

    def rng(self, *purpose: int) -> np.random.Generator:
        """Return the random generator of this home for one purpose."""
        return np.random.default_rng([_FAMILY, self.split, self.seed, self.index, *purpose])


@dataclass(frozen=True, eq=False)
class HeldoutHome:
    """A home as built, without furniture."""

    plan: HeldoutPlan
    openings: tuple[Opening, ...]
    shell: tuple[tuple[int, Part], ...]


@dataclass(frozen=True, eq=False)
class TracedHome:
    """A home at one furniture level, ready to be photographed; `number` is the material of each face of the mesh."""

    home: HeldoutHome
    tracer: Tracer
    materials: Materials
    number: Int[np.ndarray, "f"]


@dataclass(frozen=True, eq=False)
class Stand:
    """Pose of a camera."""

    position_m: Float[np.ndarray, "2"]
    room_index: int
    heading: float
    camera_height_m: float


@lru_cache(maxsize=4)
def home_of(key: HomeKey) -> HeldoutHome:
    """Build the home of a key."""
    rng = key.rng(0)
    plan = sample_plan(rng, f"heldout {key.index}")
    openings = sample_openings(plan, rng)
    return HeldoutHome(with_openings(plan, openings), tuple(openings), tuple(shell_parts(plan.plan, openings, rng)))


@lru_cache(maxsize=4)
def _furnishing(key: HomeKey, level: Level) -> Furnishing:
    home = home_of(key)
    return Furnishing(home.plan, home.openings, level, key.rng(1))


@lru_cache(maxsize=4)
def traced_home(key: HomeKey, level: Level) -> TracedHome:
    """Build the home of a key with its furniture."""
    home, rng = home_of(key), key.rng(2)
    tracer = Tracer([*home.shell, *_furnishing(key, level).parts])
    rooms, things = room_surfaces(home.plan.kinds, rng), thing_surfaces(rng)
    surfaces, lookup = [], np.zeros((len(rooms), len(tracer.surfaces)), dtype=np.int64)
    for index, room in enumerate(rooms):
        for k, name in enumerate(tracer.surfaces):
            if name in room:
                lookup[index, k] = len(surfaces)
                surfaces.append(room[name])
    for k, name in enumerate(tracer.surfaces):
        if name in things:
            lookup[:, k] = len(surfaces)
            surfaces.append(things[name])
    return TracedHome(home, tracer, Materials(surfaces, Noise(rng)), lookup[tracer.room, tracer.surface])


def stands_of(key: HomeKey, count: int) -> list[Stand]:
    """Draw cameras uniformly over the floor that is free in the full home, so that they suit every level."""
    home, rng = home_of(key), key.rng(3)
    leaves = [_leaf(opening) for opening in home.openings if opening.kind == "open door"]
    taken = _furnishing(key, "full").taken
    free = [
        room.shape.buffer(-WALL_MARGIN_M).difference(shapely.union_all([floor.buffer(_FURNITURE_MARGIN_M), *leaves]))
        for room, floor in zip(home.plan.plan.rooms, taken, strict=True)
    ]
    areas = np.array([shape.area for shape in free])
    stands = []
    for room in rng.choice(len(free), count, p=areas / areas.sum()):
        ceiling = home.plan.plan.rooms[room].ceiling_height_m
        stands.append(
            Stand(
                position_m=_inside(free[room], rng),
                room_index=int(room),
                heading=float(rng.uniform(0.0, 2 * np.pi)),
                camera_height_m=float(min(rng.uniform(_MIN_CAMERA_M, _MAX_CAMERA_M), ceiling - 0.3)),
            )
        )
    return stands


def _leaf(opening: Opening) -> shapely.Polygon:
    """Return the floor that an open door's leaf covers."""
    wall, width = opening.wall, opening.right_m - opening.left_m
    hinge = wall.point_m(opening.left_m)
    end = hinge + width * (np.cos(opening.swing) * wall.along - np.sin(opening.swing) * wall.outward)
    return shapely.LineString([hinge, end]).buffer(0.2)


def _inside(shape: BaseGeometry, rng: np.random.Generator) -> Float[np.ndarray, "2"]:
    x0, y0, x1, y1 = shape.bounds
    while True:
        drawn = rng.uniform((x0, y0), (x1, y1), (64, 2))
        found = drawn[shapely.contains_xy(shape, drawn[:, 0], drawn[:, 1])]
        if len(found):
            return found[0]
