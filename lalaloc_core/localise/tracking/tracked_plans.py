"""Plans that a tracked camera can be in, as one plan with a pose grid, and the ways through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.errors import InvalidStateError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.tracking.passages import Passages, PlanOnLevel
from lalaloc_core.localise.tracking.track_state import StatePlan, TrackedPose, TrackState
from lalaloc_core.localise.tracking.walk_motion import Odometry, States, WalkGraph, moved
from lalaloc_core.localise.venue.merged_plans import MergedPlans, translated
from lalaloc_core.localise.venue.prototypes import share_searched


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
        plan: the plan.
        grid: its pose grid.
        graph: links of the poses.
        keys: (p,) keys of the plans; they change with the plans.
        first_room: (p,) number of the first room of each plan.
        shift_m: (p, 2) translation (m) of each plan.
        passages: ways between the plans; None for one plan.
        left_out: plans that are not searched; None if there are none.
    """

    plan: FloorPlan
    grid: PoseGrid
    graph: WalkGraph
    keys: tuple[str, ...]
    first_room: Int[np.ndarray, "p"]
    shift_m: Float[np.ndarray, "p 2"]
    passages: Passages | None = None
    left_out: LeftOut | None = None

    @classmethod
    def of_plan(cls, plan: FloorPlan, grid: PoseGrid, graph: WalkGraph | None = None) -> TrackedPlans:
        """Return one plan by itself; its links are made unless they are given."""
        graph = graph or WalkGraph.of(grid.poses, grid.layouts(plan), grid.step_m)
        return cls(plan, grid, graph, ("",), np.zeros(1, int), np.zeros((1, 2)))

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
        """Return several plans.

        Args:
            merged: the plans side by side.
            plans: the same plans with their levels.
            graphs: links of their grids.
            keys: their keys.
            levels: levels of the building; those of further plans count.
            left_out: plans that are not searched.
        """
        passages = Passages.between(plans, levels, merged.grid.poses.room_index)
        graph = WalkGraph.joined(graphs)
        return cls(merged.plan, merged.grid, graph, tuple(keys), merged.first_room, merged.shift_m, passages, left_out)

    def moved(self, states: States, sectors: int, odometry: Odometry | None) -> Float[np.ndarray, "n k"]:
        """Return the belief over all poses and sectors after a motion; see `walk_motion.moved`."""
        if self.passages is None:
            return moved(self.graph, states, sectors, odometry)
        staying, arrived = self.passages.taken(self.graph, states, odometry)
        # People turn on stairs, so all headings are possible after them.
        return moved(self.graph, staying, sectors, odometry) + arrived[:, None] / sectors

    def plan_of_room(self, room_index: int) -> int:
        """Return the number of a room's plan."""
        return int(np.searchsorted(self.first_room, room_index, side="right")) - 1

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
        return replace(translated(pose, self.shift_m[plan], int(self.first_room[plan])), plan=plan)

    def left(self, state: TrackState) -> TrackState:
        """Return a state of these plans with the poses and in the frames of those that it needs."""
        assert state.pose is not None
        used = np.union1d(np.unique(state.plan_of_state), [state.pose.plan])
        plan = state.plan_of_state
        poses = np.array([plan.poses for plan in state.plans])
        begin = np.cumsum([0, *poses[used]])[np.searchsorted(used, plan)]
        belief = replace(state.belief, pose=state.belief.pose - self.graph.first[plan] + begin)
        own = state.pose.plan
        pose = translated(state.pose, -self.shift_m[own], -int(self.first_room[own]))
        pose = replace(pose, plan=int(np.searchsorted(used, own)))
        return replace(state, plans=tuple(state.plans[number] for number in used), belief=belief, pose=pose)
