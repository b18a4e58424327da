"""Passages: ways from plan to plan, on which a belief changes the level.

Stairs and lifts are rooms of the plans: rooms of the type `stairs`, and rooms whose names have a word for a lift.
Stairs lead to the neighbouring levels, lifts to all levels. If the places of two plans on Earth are known, only stairs
that lie near each other are joined. A plan without stairs or lifts to a neighbouring level leads there from everywhere,
with a low probability.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array

from lalaloc_core.floorplan import FloorPlan, Room
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.tracking.walk_motion import MAX_HOPS, STROLL_M, Odometry, States, WalkGraph

_LIFTS = frozenset({"lift", "lifts", "elevator", "elevators", "aufzug", "ascenseur", "ascensor"})
# Probability of a change of the level between two photographs: beside stairs or lifts, and in a plan without.
_BY_STAIRS, _UNSEEN = 0.1, 0.01
# Largest distance (m) of the middles of two rooms that are parts of the same stairs or lift shaft.
_SAME_SHAFT_M = 6.0
# Distance (m) walked on stairs and beside them, beyond the distance that odometry tells.
_ON_STAIRS_M = 2.0
# Stairs and lifts of all plans; further ones are left out.
_MAX_SHAFTS = 1000


@dataclass(frozen=True)
class PlanOnLevel:
    """Plan with its level and its anchor; None where its place on Earth is unknown."""

    plan: FloorPlan
    level: float
    anchor: Anchor | None = None


@dataclass(frozen=True, eq=False)
class Passages:
    """Ways between p plans with n poses.

    Attributes:
        shafts: (s, n) ones at the poses of each stairs and lift.
        joined: (s, s) whether two of these are parts of the same stairs or lift.
        unseen: (p, p) whether a plan leads to another one from everywhere.
    """

    shafts: csr_array
    joined: Bool[np.ndarray, "s s"]
    unseen: Bool[np.ndarray, "p p"]

    @classmethod
    def between(
        cls, plans: Sequence[PlanOnLevel], levels: Sequence[float], room_index: Int[np.ndarray, "n"]
    ) -> Passages:
        """Find the passages between plans.

        Args:
            plans: the plans.
            levels: levels of the building; those of further plans count.
            room_index: room of each pose, numbered through all plans.
        """
        first = np.cumsum([0, *(len(entry.plan.rooms) for entry in plans)])
        found = [(number, *shaft) for number, entry in enumerate(plans) for shaft in _shafts(entry.plan)]
        plan, room, is_lift = np.array(found[:_MAX_SHAFTS], dtype=int).reshape(-1, 3).T
        order = np.array(sorted({*levels, *(entry.level for entry in plans)}))
        storey = np.searchsorted(order, [entry.level for entry in plans])
        apart = np.abs(storey[:, None] - storey[None, :])
        between, both_lifts = apart[plan][:, plan], (is_lift[:, None] & is_lift[None, :]) == 1
        no_lift = (is_lift[:, None] | is_lift[None, :]) == 0
        joined = (both_lifts & (between > 0)) | (no_lift & (between == 1))
        joined &= ~(_distances_m(plans, plan, room) > _SAME_SHAFT_M)
        # Rooms can be too narrow for a pose.
        has_poses = np.isin(first[plan] + room, room_index)
        joined &= has_poses[:, None] & has_poses[None, :]
        kept = joined.any(axis=1)
        origin, target = np.nonzero(joined)
        by_shaft = np.zeros((len(plans), len(order)), bool)
        by_shaft[plan[origin], storey[plan[target]]] = True
        unseen = (apart == 1) & ~by_shaft[:, storey]
        number = np.full(first[-1], -1)
        number[(first[plan] + room)[kept]] = np.arange(kept.sum())
        shaft = number[room_index]
        pose = np.flatnonzero(shaft >= 0)
        ones = np.ones(len(pose), np.float32)
        shafts = coo_array((ones, (shaft[pose], pose)), shape=(int(kept.sum()), len(room_index))).tocsr()
        return cls(csr_array(shafts), joined[kept][:, kept], unseen)

    def taken(
        self, graph: WalkGraph, states: States, odometry: Odometry | None
    ) -> tuple[States, Float[np.ndarray, "n"]]:
        """Return the states that stay in their plans, and the probability of arriving at each pose of another one."""
        weight, plan = states.weight, graph.plan_of(states.pose)
        length_m = STROLL_M if odometry is None else float(np.hypot(*odometry.displacement_m))
        hops = int(np.clip(np.ceil((length_m + _ON_STAIRS_M) / graph.step_m), 1, MAX_HOPS))
        around = graph.spread(self.shafts, hops)
        near = csr_array(around[:, states.pose])
        beside = near.sum(axis=0)
        by_stairs = np.where(beside > 0.0, _BY_STAIRS, 0.0)
        anywhere = np.where(self.unseen.any(axis=1), _UNSEEN, 0.0)[plan]
        at_shaft = _passed_on(near @ (weight * by_stairs / np.maximum(beside, 1.0)), self.joined)
        in_plan = _passed_on(np.bincount(plan, anywhere * weight, minlength=len(self.unseen)), self.unseen)
        poses = np.diff(graph.first)
        arrived = around.T @ (at_shaft / np.maximum(around.sum(axis=1), 1.0)) + np.repeat(in_plan / poses, poses)
        return States(states.pose, states.sector, weight * (1.0 - by_stairs - anywhere)), arrived


def _passed_on(mass: Float[np.ndarray, "a"], leads_to: Bool[np.ndarray, "a a"]) -> Float[np.ndarray, "a"]:
    """Return the probability at the ends of passages, given that at their begins; equally many take each."""
    return (mass / np.maximum(leads_to.sum(axis=1), 1)) @ leads_to


def _shafts(plan: FloorPlan) -> list[tuple[int, bool]]:
    """Return the number of each room that is stairs or a lift, and whether it is a lift."""
    found = [(number, _is_lift(room)) for number, room in enumerate(plan.rooms)]
    return [(number, lift) for number, lift in found if lift or plan.rooms[number].type == "stairs"]


def _is_lift(room: Room) -> bool:
    return not _LIFTS.isdisjoint(re.findall(r"\w+", room.name.casefold()))


def _distances_m(
    plans: Sequence[PlanOnLevel], plan: Int[np.ndarray, "s"], room: Int[np.ndarray, "s"]
) -> Float[np.ndarray, "s s"]:
    """Return the distances (m) of the middles of rooms, seen from above; NaN where the place on Earth is unknown."""
    middle = np.full((len(plan), 2), np.nan)
    common = next((entry.anchor for entry in plans if entry.anchor is not None), None)
    for number in np.unique(plan):
        entry, own = plans[number], np.flatnonzero(plan == number)
        if common is not None and entry.anchor is not None:
            centre = np.array([entry.plan.rooms[index].shape.centroid.coords[0] for index in room[own]])
            middle[own] = common.to_plan(entry.anchor.to_earth(centre))
    return np.linalg.norm(middle[:, None] - middle[None, :], axis=2)
