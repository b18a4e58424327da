"""Prototypes of floor plans: a subset of each plan's poses, used to select the plans of a large venue to search.

The *prototypes* of a plan are every other pose of its pose grid, like the black squares of a chessboard. Each has the
floor area that it represents, the wall profile and openings at 32 azimuths, and the room's ceiling and type. Their cost
is a coarser matching cost (`prototype_costs`), for the best ones at the best pose nearby, and
gives every plan a mass, its unnormalised probability:

    mass(plan) = sum over its prototypes and the hypotheses of  area · exp(-T cost)

`plan_index` finds the prototypes with relevant terms of this sum. The most probable plans are searched in full
(`most_probable`); `share_searched` estimates the probability of the plans that were left out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, WALL_CODE
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match import PoseGrid, layouts_at
from lalaloc_core.render.sampling import PoseSet

AZIMUTHS = 32
# Number of opening classes packed into a byte, two bits each, the first azimuth lowest.
PER_BYTE = 4
# Record of a prototype, in memory, files and the database. `log_profile` is in log metres, `log_area` in log square
# metres. `claims` has two bits for each opening class, see `claims_of_trust`; `cell` is
# that of `prototype_cells`.
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
# Trusts in openings by the first and the second bit of `claims`; earlier databases have only first bits.
_TRUST_LEVELS = ((0.0, 0.35), (1.0, 0.75))
# Minimum log probability of a searched plan: posteriors leave out pairs below it (`posterior.NEGLIGIBLE`).
_NEGLIGIBLE = -12.0
# Plans whose log masses differ by less than this count as copies of each other.
_COPY_TOLERANCE = 1e-4


def prototypes_of(grid: PoseGrid, plan: FloorPlan) -> np.ndarray:
    """Return the prototypes of a plan: records of type `ROW`, not yet assigned to cells (all in cell 0)."""
    square = np.rint(grid.poses.position_m / grid.step_m).astype(np.int64)
    is_chosen, pose_room = square.sum(axis=1) % 2 == 0, grid.poses.room_index
    # Narrow rooms can have no pose on a black square; they keep all of their poses.
    is_chosen |= ~np.isin(pose_room, pose_room[is_chosen])
    chosen = np.flatnonzero(is_chosen)
    rows, floor_m2 = np.zeros(len(chosen), ROW), grid.step_m**2 * np.bincount(pose_room)
    columns, room = azimuths(grid.profile_m.shape[1]), pose_room[chosen]
    rows["log_profile"] = np.log(grid.profile_m[chosen][:, columns])
    width, kind = grid.profile_m.shape[1], None
    if plan.opening_faces and grid.is_rendered:
        known = grid.layouts(plan).kind
        kind = None if known is None else known[chosen]
    elif plan.opening_faces:
        # Openings are rendered for the prototypes alone; for all other poses when the plan is searched.
        kind = layouts_at(plan, PoseSet(grid.poses.position_m[chosen], room), np.zeros(len(chosen)), width).kind
    kind = np.full((len(chosen), width), WALL_CODE, np.uint8) if kind is None else kind
    rows["openings"] = packed_openings(kind[:, columns])
    rows["log_area"] = np.log(floor_m2[room] / np.bincount(room)[room])
    rows["ceiling_m"] = plan.ceiling_heights_m[room]
    # Rooms with several types count as unknown: the index only chooses the plans to search.
    kinds = [each.type if len(each.types) == 1 else ROOM_TYPES[0] for each in plan.rooms]
    rows["room_type"] = np.array([ROOM_TYPES.index(kind) for kind in kinds], np.uint8)[room]
    rows["claims"] = claims_of_trust(plan.opening_trust)
    return rows


def claims_of_trust(opening_trust: Mapping[str, float]) -> int:
    """Return the `claims` of a plan: the nearest levels of its trusts."""
    claims = 0
    for kind, trust in opening_trust.items():
        bits = min(np.ndindex(2, 2), key=lambda bits: abs(_TRUST_LEVELS[bits[0]][bits[1]] - trust))
        claims |= (bits[0] | bits[1] << len(OPENING_CLASSES)) << OPENING_CLASSES.index(kind)
    return claims


def trust_of_claims(claims: int) -> list[float]:
    """Return the trust in each opening class, see `claims_of_trust`."""
    classes = len(OPENING_CLASSES)
    return [_TRUST_LEVELS[claims >> code & 1][claims >> classes + code & 1] for code in range(classes)]


def packed_openings(kind: UInt8[np.ndarray, "n a"]) -> UInt8[np.ndarray, "n b"]:
    """Pack opening classes by azimuth, four to a byte."""
    shift = 2 * np.arange(PER_BYTE, dtype=np.uint8)
    return (kind.reshape(len(kind), -1, PER_BYTE) << shift).sum(axis=2, dtype=np.uint8)


def unpacked_openings(packed: UInt8[np.ndarray, "n b"]) -> UInt8[np.ndarray, "n a"]:
    """Unpack the opening classes of `packed_openings`."""
    shift = 2 * np.arange(PER_BYTE, dtype=np.uint8)
    return ((packed[:, :, None] >> shift) & 3).reshape(len(packed), -1)


def azimuths(columns: int) -> Int[np.ndarray, "a"]:
    """Return the columns of a wall profile at the prototypes' azimuths; narrower profiles repeat columns."""
    return np.arange(AZIMUTHS) * columns // AZIMUTHS


def most_probable(
    log_mass: Float[np.ndarray, "p"], poses: Int[np.ndarray, "p"], *, max_plans: int, max_poses: int
) -> Int[np.ndarray, "m"]:
    """Return the plans to search in full, most probable first: at least one, and none without mass.

    `poses` is the number of grid poses of each plan, and `max_poses` limits their sum. Copies of a plan keep their
    order: their masses differ by rounding, depending on how the index was put together.
    """
    order = np.argsort(-np.round(log_mass / _COPY_TOLERANCE), kind="stable")[:max_plans]
    order = order[np.isfinite(log_mass[order])]
    fits = np.cumsum(poses[order]) <= max_poses
    return order[: max(int(fits.sum()), 1)]


def share_searched(
    log_mass: Float[np.ndarray, "p"], searched: Int[np.ndarray, "m"], probability: Float[np.ndarray, "m"]
) -> float:
    """Estimate the probability, among all plans, that the right one was searched.

    A full search replaces a plan's mass by a posterior probability. For plans that were left out, the ratio of the two
    is estimated by the median ratio of the searched plans, most of which are wrong ones as well. If some copies of a
    plan were searched and others left out, these get the median ratio of the searched copies. `probability` is that of
    each searched plan, given that the right one was searched.
    """
    left_out = np.delete(log_mass, searched)
    if not len(left_out):
        return 1.0
    log_probability = np.log(np.maximum(probability, np.exp(_NEGLIGIBLE)))
    log_ratio = log_probability - log_mass[searched]
    # The most probable plans are searched, so only the least probable of these can have copies that were left out.
    highest = log_mass[searched].min() + _COPY_TOLERANCE
    copies = log_ratio[log_mass[searched] <= highest]
    expected = left_out + np.where(left_out >= highest - 2 * _COPY_TOLERANCE, np.median(copies), np.median(log_ratio))
    return float(1.0 / (1.0 + np.exp(np.logaddexp.reduce(expected))))
