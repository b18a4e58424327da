"""Plans that a tracked camera can be in, as one plan with a pose grid, and the ways through them.

Stairs and lifts lead from plan to plan. They are rooms of the type `stairs`, and rooms whose names have a word for a
lift. Stairs lead to the neighbouring levels, lifts to all levels. If the places of two plans on Earth are known, only
stairs that lie near each other are joined. A plan without stairs or lifts to a neighbouring level leads there from
everywhere, with a low probability.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array

from lalaloc_core.errors import InvalidStateError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.tracking.track_state import StatePlan, TrackedPose, TrackState
from lalaloc_core.localise.tracking.walk_motion import MAX_HOPS, STROLL_M, Odometry, States, WalkGraph, moved
from lalaloc_core.localise.venue.merged_plans import MergedPlans, translated
from lalaloc_core.localise.venue.prototypes import share_searched

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
        """Find the passages between plans, given the room of each pose, numbered through all plans.

        `levels` are those of the building; those of further plans count.
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
    lifts = [not _LIFTS.isdisjoint(re.findall(r"\w+", room.name.casefold())) for room in plan.rooms]
    return [(number, lift) for number, lift in enumerate(lifts) if lift or "stairs" in plan.rooms[number].types]


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


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Plans of a venue that are not searched for one photograph.

    Attributes:
        area_share: share of the venue's floor area that is searched.
        log_mass: (v,) log masses of all plans of the venue, see `venue.plan_index`.
        searched: (p,) numbers of the searched plans among these.
    """

    area_share: float
    log_mass: Float[np.ndarray, "v"]
    searched: Int[np.ndarray, "p"]


@dataclass(frozen=True, eq=False)
class TrackedPlans:
    """One plan, or p plans of a venue laid side by side.

    Attributes:
        merged: the plans, side by side.
        graph: links of the poses.
        keys: (p,) keys of the plans; they change with the plans.
        passages: ways between the plans; None for one plan.
        left_out: plans that are not searched; None if there are none.
    """

    merged: MergedPlans
    graph: WalkGraph
    keys: tuple[str, ...]
    passages: Passages | None = None
    left_out: LeftOut | None = None

    @classmethod
    def of_plan(cls, plan: FloorPlan, grid: PoseGrid, graph: WalkGraph | None = None) -> TrackedPlans:
        """Return one plan by itself; its links are made unless they are given."""
        graph = graph or WalkGraph.of(grid.poses, grid.layouts(plan), grid.step_m)
        return cls(MergedPlans.of_plan(plan, grid), graph, ("",))

    @classmethod
    def of_levels(
        cls,
        merged: MergedPlans,
        plans: Sequence[PlanOnLevel],
        graphs: Sequence[WalkGraph],
        keys: Sequence[str],
        levels: Sequence[float],
        left_out: LeftOut | None = None,
    ) -> TrackedPlans:
        """Return several plans, side by side and with their levels; `levels` are as in `Passages.between`."""
        passages = Passages.between(plans, levels, merged.grid.poses.room_index)
        return cls(merged, WalkGraph.joined(graphs), tuple(keys), passages, left_out)

    @property
    def plan(self) -> FloorPlan:
        """The plan, or all side by side."""
        return self.merged.plan

    @property
    def grid(self) -> PoseGrid:
        """The pose grid of `plan`."""
        return self.merged.grid

    def moved(self, states: States, sectors: int, odometry: Odometry | None) -> Float[np.ndarray, "n k"]:
        """Return the belief over all poses and sectors after a motion; see `walk_motion.moved`."""
        if self.passages is None:
            return moved(self.graph, states, sectors, odometry)
        staying, arrived = self.passages.taken(self.graph, states, odometry)
        # People turn on stairs, so all headings are possible after them.
        return moved(self.graph, staying, sectors, odometry) + arrived[:, None] / sectors

    def share(self, evidence: Float[np.ndarray, "n"]) -> float:
        """Return the probability that the camera is in these plans, given the evidence of a photograph at each pose."""
        if self.left_out is None:
            return 1.0
        by_plan = np.add.reduceat(evidence, self.graph.first[:-1])
        log_mass, searched = self.left_out.log_mass.copy(), self.left_out.searched
        # Plans that are searched only because the camera was there before tell nothing about those left out.
        best = log_mass[searched] >= np.delete(log_mass, searched).max(initial=-np.inf)
        if best.any():
            log_mass[searched[~best]] = -np.inf
        else:
            best[:] = True
        return share_searched(log_mass, searched[best], (by_plan / by_plan.sum())[best])

    def entered(self, state: TrackState) -> TrackState:
        """Return a state with the poses and in the frame of these plans, without those that are left out."""
        poses = np.diff(self.graph.first)
        number = np.array([self.keys.index(plan.key) if plan.key in self.keys else -1 for plan in state.plans], int)
        for plan, own in zip(state.plans, number, strict=True):
            if own >= 0 and plan.poses != poses[own]:
                raise InvalidStateError(
                    f"the session has {plan.poses} poses, the grid {poses[own]}: the plan or the model has changed; "
                    "begin a new session"
                )
        plans = tuple(StatePlan(key, int(count)) for key, count in zip(self.keys, poses, strict=True))
        if not state.plans:
            return replace(state, plans=plans)
        own = number[state.plan_of_state]
        kept = own >= 0
        begin = np.cumsum([0, *(plan.poses for plan in state.plans)])[state.plan_of_state]
        pose = (state.belief.pose - begin + self.graph.first[own])[kept]
        belief = States(pose, state.belief.sector[kept], state.belief.weight[kept])
        return replace(state, plans=plans, belief=belief, pose=self._entered(state.pose, number))

    def _entered(self, pose: TrackedPose | None, number: Int[np.ndarray, "_"]) -> TrackedPose | None:
        if pose is None or number[pose.plan] < 0:
            return None
        plan = int(number[pose.plan])
        return replace(translated(pose, self.merged.shift_m[plan], int(self.merged.first_room[plan])), plan=plan)

    def left(self, state: TrackState) -> TrackState:
        """Return a state of these plans with the poses and in the frames of those that it needs."""
        assert state.pose is not None
        used = np.union1d(np.unique(state.plan_of_state), [state.pose.plan])
        plan = state.plan_of_state
        poses = np.array([plan.poses for plan in state.plans])
        begin = np.cumsum([0, *poses[used]])[np.searchsorted(used, plan)]
        belief = replace(state.belief, pose=state.belief.pose - self.graph.first[plan] + begin)
        own = state.pose.plan
        pose = translated(state.pose, -self.merged.shift_m[own], -int(self.merged.first_room[own]))
        pose = replace(pose, plan=int(np.searchsorted(used, own)))
        return replace(state, plans=tuple(state.plans[number] for number in used), belief=belief, pose=pose)
