"""How probable places are: the posterior over all grid poses and all ways in which the panorama may be turned.

Each pair of a pose and a hypothesis has the likelihood `exp(-T cost)`, with the temperature T fitted on validation
queries, and a prior uniform over floor area and over the headings that are searched, times that of hints, which costs
contain here. Candidates are the modes of the posterior. The optimiser tells how far down the cost of a mode goes, which
the grid, whose poses are off, cannot: a mode's pairs are shifted by what its candidate gained, all others by what
candidates gain usually. Candidates that end at one place are one mode, and refined modes count as equally wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.poses import Candidate, Query
from lalaloc_core.render.sampling import PoseSet

# An answer is right within this distance, and its heading within this angle (radians).
RIGHT_WITHIN_M = 1.0
HEADING_WITHIN = np.radians(5.0)
# Two poses at one place are of different modes if they are turned against each other by this much (radians).
HEADING_SEPARATION = np.radians(25.0)
# Pairs that are less likely than the best by this factor's logarithm weigh nothing.
NEGLIGIBLE = 12.0


@dataclass(frozen=True, eq=False, kw_only=True)
class GridCosts:
    """What retrieval found for pairs of a grid's pose and a hypothesis.

    Attributes:
        poses: all poses of the grid.
        pose: (m,) which of them each pair is of. Pairs that are missing are improbable.
        hypothesis: (m,) how it is turned.
        cost: (m,) what it costs.
        offset: (m,) the height offset δ that gives it.
        hint_cost: (m,) what hints have against the pose, in units of the cost; None where there are no hints.
        compared: the first so many were compared in full, and are what candidates may be; of the others, which share
            the probability with them, the cost is estimated.
    """

    poses: PoseSet
    pose: Int[np.ndarray, "m"]
    hypothesis: Int[np.ndarray, "m"]
    cost: Float[np.ndarray, "m"]
    offset: Float[np.ndarray, "m"]
    hint_cost: Float[np.ndarray, "m"] | None
    compared: int

    @classmethod
    def of_all(
        cls,
        poses: PoseSet,
        cost: Float[np.ndarray, "k n"],
        offset: Float[np.ndarray, "k n"],
        hint_cost: Float[np.ndarray, "n"] | None = None,
    ) -> GridCosts:
        """Of every pose under every hypothesis."""
        hypothesis, pose = np.indices(cost.shape).reshape(2, -1)
        against = None if hint_cost is None else hint_cost[pose]
        return cls(
            poses=poses,
            pose=pose,
            hypothesis=hypothesis,
            cost=cost.ravel(),
            offset=offset.ravel(),
            hint_cost=against,
            compared=cost.size,
        )

    @cached_property
    def total(self) -> Float[np.ndarray, "m"]:
        """What pairs are ranked by: the cost with that of hints."""
        return self.cost if self.hint_cost is None else self.cost + self.hint_cost


@dataclass(frozen=True, eq=False)
class Support:
    """Where the probability lies once candidates are refined, which moves what stands around them along with them.

    Attributes:
        pose: (m,) the grid pose that each place comes from.
        position_m: (m, 2) where it lies now, which may be outside of its room.
        weight: (m,) its probability; they sum to one.
    """

    pose: Int[np.ndarray, "m"]
    position_m: Float[np.ndarray, "m 2"]
    weight: Float[np.ndarray, "m"]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Probabilities, given that the picture was taken in the plan at all.

    Attributes:
        pose: (n,) probability of every grid pose; they sum to one.
        position: probability of being within 1 m of the first candidate, however turned.
        candidate: probability of being within 1 m of each candidate, turned like it, and at none before it; at most one
            in sum.
        heading: probability that the heading of the first candidate is right within 5°.
        support: the same probability, at the places that refinement found; `probability_map.py` makes a map of it.
    """

    pose: Float[np.ndarray, "n"]
    position: float
    candidate: tuple[float, ...]
    heading: float
    support: Support


def area_shares(poses: PoseSet, areas_m2: Float[np.ndarray, "r"]) -> Float[np.ndarray, "n"]:
    """Log prior of every pose of a grid: its room's area, shared by the room's poses."""
    count = np.bincount(poses.room_index, minlength=len(areas_m2))
    return np.log(areas_m2[poses.room_index] / count[poses.room_index])


def posterior_of(
    grid: GridCosts,
    prior: Float[np.ndarray, "n"],
    query: Query,
    *,
    starts: Sequence[Candidate],
    ends: Sequence[Candidate],
    candidates: Sequence[Candidate],
    temperature: float,
    separation_m: float,
) -> Posterior:
    """The posterior once some modes of the grid are refined.

    Args:
        prior: (n,) log prior of every pose of the grid, up to a constant.
        starts: candidates as the grid has them.
        ends: the same after refinement.
        candidates: what probabilities are wanted of, the answer first.
    """
    lowest = float(grid.total.min())
    gains = [start.total_cost - end.total_cost for start, end in zip(starts, ends, strict=True)]
    usual = float(np.median(gains)) if gains else 0.0
    best = min([lowest - usual, *(end.total_cost for end in ends)])
    pair = np.flatnonzero(temperature * (grid.total - max(gains, default=0.0) - best) < NEGLIGIBLE)
    cost, pose, hypothesis = grid.total[pair].astype(np.float64), grid.pose[pair], grid.hypothesis[pair]
    position = grid.poses.position_m[pose]
    heading = query.roll[hypothesis] + query.frame_heading
    mode = _modes(position, heading, starts, query, separation_m)
    gain = np.full(len(cost), usual)
    for index, (start, end) in enumerate(zip(starts, ends, strict=True)):
        member = mode == index
        gain[member] = gains[index]
        position[member] += end.position_m - start.position_m
        heading[member] += end.frame_heading - start.frame_heading
    log_weight = -temperature * (cost - gain) + prior[pose]
    if ends:
        mode = np.append(_merged(ends, query, separation_m), -1)[mode]
        log_weight += _width_corrections(log_weight, mode, temperature * np.array([end.total_cost for end in ends]))
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    return posterior_from_weights(
        query, candidates, pose=pose, position=position, heading=heading, weight=weight, poses=len(grid.poses)
    )


def _width_corrections(
    log_weight: Float[np.ndarray, "m"], mode: Int[np.ndarray, "m"], nll: Float[np.ndarray, "r"]
) -> Float[np.ndarray, "m"]:
    """What makes refined modes as wide as the deepest of them.

    How many poses of a mode fit well is a matter of where the grid's lattice happens to lie: copies of one room would
    differ in it.

    Args:
        nll: (r,) negative log likelihood of each refined mode at its end.
    """
    correction, members = np.zeros(len(log_weight)), [mode == index for index in range(len(nll))]
    width = {
        index: np.logaddexp.reduce(log_weight[member]) + nll[index]
        for index, member in enumerate(members)
        if member.any()
    }
    if width:
        deepest = width[min(width, key=lambda index: nll[index])]
        for index in width:
            correction[members[index]] = deepest - width[index]
    return correction


def _merged(ends: Sequence[Candidate], query: Query, separation_m: float) -> Int[np.ndarray, "r"]:
    """For each refined candidate the best one that ended where it did, and turned alike; itself where it is that."""
    head = np.arange(len(ends))
    position = np.stack([end.position_m for end in ends])
    heading = np.array([query.roll[end.hypothesis] + end.frame_heading for end in ends])
    left = np.ones(len(ends), bool)
    for index in np.argsort([end.total_cost for end in ends], kind="stable"):
        if left[index]:
            here = left & (np.linalg.norm(position - position[index], axis=1) < separation_m)
            here &= _turned_alike(heading, query, ends[index])
            head[here] = index
            left &= ~here
    return head


def _modes(
    position: Float[np.ndarray, "m 2"],
    heading: Float[np.ndarray, "m"],
    starts: Sequence[Candidate],
    query: Query,
    separation_m: float,
) -> Int[np.ndarray, "m"]:
    """The first candidate that is near each pair and turned alike; -1 where there is none."""
    mode = np.full(len(position), -1)
    for index, start in reversed(list(enumerate(starts))):
        near = np.linalg.norm(position - start.position_m, axis=1) < separation_m
        mode[near & _turned_alike(heading, query, start)] = index
    return mode


def _turned_alike(heading: Float[np.ndarray, "m"], query: Query, candidate: Candidate) -> Bool[np.ndarray, "m"]:
    turned = wrap_angle(heading - query.roll[candidate.hypothesis] - candidate.frame_heading)
    return np.abs(turned) <= HEADING_SEPARATION


def posterior_from_weights(
    query: Query,
    candidates: Sequence[Candidate],
    *,
    pose: Int[np.ndarray, "m"],
    position: Float[np.ndarray, "m 2"],
    heading: Float[np.ndarray, "m"],
    weight: Float[np.ndarray, "m"],
    poses: int,
) -> Posterior:
    """What weights of places, which sum to one, say of candidates.

    Args:
        pose: (m,) the grid pose of each weight, of so many poses.
        heading: (m,) of the panorama, radians.
    """
    near = np.linalg.norm(position - candidates[0].position_m, axis=1) < RIGHT_WITHIN_M
    return Posterior(
        pose=np.bincount(pose, weight, minlength=poses),
        position=min(float(weight[near].sum()), 1.0),
        candidate=_shares(position, heading, weight, query, candidates),
        heading=_heading_share(heading, weight, query, candidates),
        support=Support(pose, position, weight),
    )


def _shares(
    position: Float[np.ndarray, "m 2"],
    heading: Float[np.ndarray, "m"],
    weight: Float[np.ndarray, "m"],
    query: Query,
    candidates: Sequence[Candidate],
) -> tuple[float, ...]:
    left, shares = weight.copy(), []
    for candidate in candidates:
        near = np.linalg.norm(position - candidate.position_m, axis=1) < RIGHT_WITHIN_M
        near &= _turned_alike(heading, query, candidate)
        shares.append(float(left[near].sum()))
        left[near] = 0.0
    return tuple(shares)


def _heading_share(
    heading: Float[np.ndarray, "m"], weight: Float[np.ndarray, "m"], query: Query, candidates: Sequence[Candidate]
) -> float:
    answer = query.roll[candidates[0].hypothesis] + candidates[0].frame_heading
    # Hypotheses are sectors: one stands for the headings up to half a sector from it.
    half = 0.5 * query.sector
    return float(weight[np.abs(wrap_angle(heading - answer)) <= HEADING_WITHIN + half].sum())
