"""Floor plans that grow: each room is placed against a wall of a standing one, at any angle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float
from shapely import affinity

from lalaloc_core.floorplan import FloorPlan, room_type_from_label
from lalaloc_core.learn.heldout.outlines import RoomKind, sample_outline

MIN_ROOMS, MAX_ROOMS = 3, 9
MIN_AREA_M2, MAX_AREA_M2 = 40.0, 160.0
# Minimum shared wall (m), so that a door fits.
MIN_CONTACT_M = 1.15
_PLACEMENTS = 40
_KINDS: tuple[RoomKind, ...] = ("bedroom", "kitchen", "bathroom", "corridor", "closet", "study")
_KIND_SHARES = (0.32, 0.12, 0.18, 0.14, 0.12, 0.12)


@dataclass(frozen=True, eq=False)
class HeldoutPlan:
    """A floor plan with the use of each room.

    No two rooms overlap, and each has a wall in common with another. `kinds` are per room; `wall_m` is the thickness of
    the inner walls.
    """

    plan: FloorPlan
    kinds: tuple[RoomKind, ...]
    wall_m: float


def sample_plan(rng: np.random.Generator, name: str) -> HeldoutPlan:
    """Draw a plan of 3 to 9 rooms and 40 to 160 m²."""
    while True:
        kinds: list[RoomKind] = ["living", "kitchen", "bathroom"]
        wanted = int(rng.integers(MIN_ROOMS, MAX_ROOMS + 1))
        while len(kinds) < wanted:
            kinds.append(_KINDS[rng.choice(len(_KINDS), p=_KIND_SHARES)])
        kinds[1:] = [kinds[k] for k in 1 + rng.permutation(wanted - 1)]
        wall_m = float(rng.uniform(0.08, 0.24))
        shapes = _grow(kinds, wall_m, rng)
        if shapes is not None and MIN_AREA_M2 <= sum(shape.area for shape in shapes) <= MAX_AREA_M2:
            break
    height_m = float(rng.uniform(2.35, 3.2))
    turn = rng.uniform(0.0, 360.0) if rng.random() < 0.5 else 0.0
    shapes = [affinity.rotate(shape, turn, origin=(0, 0)) for shape in shapes]
    rooms = [
        {
            "name": f"{kind} {index + 1}",
            "type": room_type_from_label(kind),
            "polygon": [list(corner) for corner in shape.exterior.coords[:-1]],
            "ceiling_height_m": height_m - (float(rng.uniform(0.1, 0.2)) if rng.random() < 0.2 else 0.0),
        }
        for index, (kind, shape) in enumerate(zip(kinds, shapes, strict=True))
    ]
    return HeldoutPlan(FloorPlan.from_dict({"name": name, "rooms": rooms}), tuple(kinds), wall_m)


def _grow(kinds: list[RoomKind], wall_m: float, rng: np.random.Generator) -> list[shapely.Polygon] | None:
    """Return the rooms in the order of `kinds`; None if one found no place."""
    shapes = [sample_outline(kinds[0], rng)]
    for kind in kinds[1:]:
        standing = shapely.union_all(shapes)
        best, best_size = None, math.inf
        for _ in range(_PLACEMENTS):
            placed = _against(shapes[rng.integers(len(shapes))], sample_outline(kind, rng), wall_m, rng)
            if placed is None or placed.distance(standing) < wall_m - 1e-6:
                continue
            # Choose the most compact of several places.
            size = shapely.union(standing, placed).convex_hull.length / math.sqrt(standing.area + placed.area)
            if size < best_size:
                best, best_size = placed, size
        if best is None:
            return None
        shapes.append(best)
    return shapes


def _against(
    host: shapely.Polygon, guest: shapely.Polygon, wall_m: float, rng: np.random.Generator
) -> shapely.Polygon | None:
    """Return `guest` with one wall along a wall of `host`, a wall thickness away."""
    start, along, length = _random_wall(host, rng)
    guest_start, guest_along, guest_length = _random_wall(guest, rng)
    if min(length, guest_length) < MIN_CONTACT_M:
        return None
    # The guest's wall runs the other way round, as both outlines are counter-clockwise.
    turn = math.atan2(-along[1], -along[0]) - math.atan2(guest_along[1], guest_along[0])
    # Its start is between the positions that barely touch; ends are often flush.
    slide = rng.choice([length, guest_length, rng.uniform(MIN_CONTACT_M, length + guest_length - MIN_CONTACT_M)])
    target = start + along * slide + wall_m * np.array([along[1], -along[0]])
    turned = affinity.rotate(guest, turn, origin=tuple(guest_start), use_radians=True)
    return affinity.translate(turned, *(target - guest_start))


def _random_wall(
    shape: shapely.Polygon, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], float]:
    """Return start, unit direction and length of a random wall."""
    corners = np.array(shape.exterior.coords)
    index = rng.integers(len(corners) - 1)
    edge = corners[index + 1] - corners[index]
    length = float(np.linalg.norm(edge))
    return corners[index], edge / length, length
