"""Prototypes of floor plans: a few poses of each, by which those of a large venue are chosen that are searched in full.

The *prototypes* of a plan are every other pose of its pose grid, as the black squares of a chessboard, with the floor
that each stands for, the wall profile and the openings at 32 azimuths, and the room's ceiling and type. They are
compared with the panorama much as all poses are (`prototype_costs`), and give every plan a probability; the plans that
have most of it are then searched in full.

    mass(plan) = sum over its prototypes and the hypotheses of  floor · exp(-T cost)

`plan_index` finds the prototypes that are worth comparing. What the plans left out would have weighed is estimated
(`share_searched`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, WALL_CODE
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.layouts import layouts_at
from lalaloc_core.localise.poses import PoseGrid
from lalaloc_core.render.sampling import PoseSet

AZIMUTHS = 32
# Neighbouring prototypes are so many grid steps apart.
STEPS = math.sqrt(2.0)
# Opening classes at so many azimuths share a byte, two bits each, the first one lowest.
PER_BYTE = 4
# What is kept of a prototype; as it lies in files and in the database. `claims` has a bit for each opening class that
# the plan shows completely; `cell` is its cell of `prototype_cells`.
ROW = np.dtype(
    [
        ("log_profile", "<f2", (AZIMUTHS,)),
        ("openings", "u1", (AZIMUTHS // PER_BYTE,)),
        ("log_area", "<f4"),
        ("ceiling_m", "<f2"),
        ("cell", "<u2"),
        ("room_type", "u1"),
        ("claims", "u1"),
    ]
)
# A plan that weighs nothing in the posterior counts as this improbable, in logs: posteriors leave out what is less.
_NEGLIGIBLE = -12.0
# Plans whose log masses are nearer than this are alike in all their prototypes.
_ALIKE = 1e-4


@dataclass(frozen=True, eq=False)
class Prototypes:
    """Prototypes of one plan, or of several, one after the other.

    Attributes:
        rows: (n,) of `ROW`.
        step_m: of the grid that they were taken from.
    """

    rows: np.ndarray
    step_m: float

    def __len__(self) -> int:
        return len(self.rows)


def prototypes_of(grid: PoseGrid, plan: FloorPlan) -> Prototypes:
    """Return the prototypes of a plan, in cell 0."""
    place = np.rint(grid.poses.position_m / grid.step_m).astype(np.int64)
    chosen, of_room = place.sum(axis=1) % 2 == 0, grid.poses.room_index
    # Rooms that have none so, which are narrow ones, keep all of theirs.
    chosen |= ~np.isin(of_room, of_room[chosen])
    first = np.flatnonzero(chosen)
    rows, floor_m2 = np.zeros(len(first), ROW), grid.step_m**2 * np.bincount(of_room)
    compared, room = azimuths(grid.profile_m.shape[1]), grid.poses.room_index[first]
    rows["log_profile"] = np.log(grid.profile_m[first][:, compared])
    # Of these poses alone: the others are looked at when they are searched.
    poses, columns = PoseSet(grid.poses.position_m[first], room), grid.profile_m.shape[1]
    kind = layouts_at(plan, poses, np.zeros(len(first)), columns).kind if plan.opening_faces else None
    kind = np.full((len(first), columns), WALL_CODE, np.uint8) if kind is None else kind
    rows["openings"] = packed_openings(kind[:, compared])
    rows["log_area"] = np.log(floor_m2[room] / np.bincount(room)[room])
    rows["ceiling_m"] = plan.ceiling_heights_m[room]
    rows["room_type"] = np.array([ROOM_TYPES.index(one.type) for one in plan.rooms], np.uint8)[room]
    rows["claims"] = sum(1 << OPENING_CLASSES.index(claimed) for claimed in plan.opening_kinds)
    return Prototypes(rows, grid.step_m)


def joined(parts: Sequence[Prototypes]) -> Prototypes:
    """Prototypes of several plans, one after the other."""
    return Prototypes(np.concatenate([part.rows for part in parts]), parts[0].step_m)


def packed_openings(kind: UInt8[np.ndarray, "n a"]) -> UInt8[np.ndarray, "n b"]:
    """Codes of opening classes by azimuth, four to a byte."""
    place = 2 * np.arange(PER_BYTE, dtype=np.uint8)
    return (kind.reshape(len(kind), -1, PER_BYTE) << place).sum(axis=2, dtype=np.uint8)


def unpacked_openings(packed: UInt8[np.ndarray, "n b"]) -> UInt8[np.ndarray, "n a"]:
    """Unpack the codes of `packed_openings`."""
    place = 2 * np.arange(PER_BYTE, dtype=np.uint8)
    return ((packed[:, :, None] >> place) & 3).reshape(len(packed), -1)


def azimuths(columns: int) -> Int[np.ndarray, "a"]:
    """Return the columns of a wall profile that prototypes have; of a profile with fewer, some twice."""
    return np.arange(AZIMUTHS) * columns // AZIMUTHS


def most_probable(
    log_mass: Float[np.ndarray, "p"], poses: Int[np.ndarray, "p"], *, most_plans: int, most_poses: int
) -> Int[np.ndarray, "m"]:
    """Return the plans to search in full, most probable first: at least one, and none without mass.

    Args:
        log_mass: log mass of each plan.
        poses: number of grid poses of each plan.
        most_plans: maximum number of plans.
        most_poses: how many the grids of all of them may have.
    """
    order = np.argsort(-log_mass, kind="stable")[:most_plans]
    order = order[np.isfinite(log_mass[order])]
    within = np.cumsum(poses[order]) <= most_poses
    return order[: max(int(within.sum()), 1)]


def share_searched(
    log_mass: Float[np.ndarray, "p"], searched: Int[np.ndarray, "m"], probability: Float[np.ndarray, "m"]
) -> float:
    """How much of the posterior over all plans those have that were searched.

    A full search changes what a plan weighs. Those left out are taken to change as most of those searched did: by the
    median of their ratios, which is that of wrong plans. But what is left out of equal plans changes as those of them
    do that were searched.

    Args:
        log_mass: log mass of each plan.
        searched: numbers of the plans that were searched.
        probability: of each plan that was searched, given that it is one of them.
    """
    left_out = np.delete(log_mass, searched)
    if not len(left_out):
        return 1.0
    log_probability = np.log(np.maximum(probability, np.exp(_NEGLIGIBLE)))
    change = log_probability - log_mass[searched]
    # The most probable plans are searched, so only the least of them can have equals that are not.
    least = log_mass[searched].min() + _ALIKE
    equals = change[log_mass[searched] <= least]
    expected = left_out + np.where(left_out >= least - 2 * _ALIKE, np.median(equals), np.median(change))
    return float(1.0 / (1.0 + np.exp(np.logaddexp.reduce(expected))))
