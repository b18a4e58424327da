"""Posterior probability of every pose of the grid under every hypothesis of the heading.

A pair of a pose and a hypothesis has the likelihood `exp(-T cost)`, with the temperature T fitted on validation
queries. The prior is uniform over floor area and over the searched headings. Costs include those of hints and fixtures.

Candidates are the modes of the posterior. A grid pose is up to half a step away from the minimum of its mode.
Refinement moves a candidate to the minimum; the decrease of its cost is its *gain*. `weighted_places` applies this to
all pairs:

* Pairs of a refined mode move with its candidate, and their cost is lowered by its gain.
* The cost of all other pairs is lowered by the median gain.
* Modes whose candidates end at the same place and heading are merged.
* Refined modes get equal widths, as the number of pairs near a minimum depends on the position of the grid.

`probability_map` returns the posterior by place, for maps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief.ranking import HEADING_SEPARATION, TIED, ranking
from lalaloc_core.localise.query import Candidate, Query
from lalaloc_core.render.sampling import PoseSet

# An answer is right within this distance, and its heading within this angle (radians).
RIGHT_WITHIN_M = 1.0
HEADING_WITHIN = np.radians(5.0)
# Pairs whose log likelihood is this far below the best are left out.
NEGLIGIBLE = 12.0
# Lattice step (m) on which the places of a probability map are merged.
_MAP_STEP_M = 0.01
# More than the rounding of coordinates.
_ROUNDING_M = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class GridCosts:
    """Costs of m pairs of a grid pose and a hypothesis; pairs left out are improbable.

    Attributes:
        offset: (m,) the height offset δ that gives it.
        place_cost: (m,) cost of hints and fixtures at the pose; None without them.
        compared: number of pairs that were compared in full, which come first; candidates are among these. The cost of
            the other pairs, which share the probability, is estimated.
    """

    poses: PoseSet
    pose: Int[np.ndarray, "m"]
    hypothesis: Int[np.ndarray, "m"]
    cost: Float[np.ndarray, "m"]
    offset: Float[np.ndarray, "m"]
    place_cost: Float[np.ndarray, "m"] | None
    compared: int

    @classmethod
    def of_all(cls, poses: PoseSet, cost: Float[np.ndarray, "k n"]) -> GridCosts:
        """Return the costs of all poses under all hypotheses, compared in full at the stated camera height."""
        hypothesis, pose = np.indices(cost.shape).reshape(2, -1)
        return cls(
            poses=poses,
            pose=pose,
            hypothesis=hypothesis,
            cost=cost.ravel(),
            offset=np.zeros_like(cost).ravel(),
            place_cost=None,
            compared=cost.size,
        )

    @cached_property
    def total(self) -> Float[np.ndarray, "m"]:
        """Cost that pairs are ranked by: the matching cost plus that of the place."""
        return self.cost if self.place_cost is None else self.cost + self.place_cost


@dataclass(frozen=True, eq=False)
class Support:
    """Places with their probability, moved along with the candidates that refinement moved.

    Attributes:
        pose: (m,) number of the grid pose that each place comes from.
        position_m: (m, 2) the place, which refinement can have moved out of its room.
        heading: (m,) heading of the photograph there (radians).
        weight: (m,) probability; the sum is one.
    """

    pose: Int[np.ndarray, "m"]
    position_m: Float[np.ndarray, "m 2"]
    heading: Float[np.ndarray, "m"]
    weight: Float[np.ndarray, "m"]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Probabilities, given that the picture was taken in the plan.

    Attributes:
        pose: (n,) probability of every grid pose; the sum is one.
        position: probability of being within 1 m of the first candidate, at any heading.
        candidate: probability of being within 1 m of each candidate at about its heading, and at no candidate before
            it; at most one in sum.
        heading: probability that the heading of the first candidate is right within 5°.
        support: the same probability at the refined places; see `probability_map`.
    """

    pose: Float[np.ndarray, "n"]
    position: float
    candidate: tuple[float, ...]
    heading: float
    support: Support


def area_shares(poses: PoseSet, areas_m2: Float[np.ndarray, "r"]) -> Float[np.ndarray, "n"]:
    """Return the log prior of every pose of a grid: its room's area, shared by the room's poses."""
    count = np.bincount(poses.room_index, minlength=len(areas_m2))
    return np.log(areas_m2[poses.room_index] / count[poses.room_index])


def or_misread(log_ratio: Float[np.ndarray, "*n"], share: float) -> Float[np.ndarray, "*n"]:
    """Return log likelihoods of places, over the usual one, by a photograph that is misread with a probability.

    A misread photograph fits all places as usual, which bounds what one photograph can say against a place.
    """
    return np.logaddexp(math.log1p(-share) + log_ratio, math.log(share))


class _SortedPlaces:
    """Places sorted by x, as a venue has tens of thousands, few of which are near a candidate."""

    def __init__(self, position: Float[np.ndarray, "m 2"], heading: Float[np.ndarray, "m"], query: Query) -> None:
        self._order = np.argsort(position[:, 0])
        self._x_m, self._y_m = np.ascontiguousarray(position[self._order].T)
        self._heading, self._query = heading, query

    def within(self, centre: Float[np.ndarray, "2"], distance_m: float) -> Int[np.ndarray, "n"]:
        """Return the numbers, rising, of the places near a point."""
        reach_m = distance_m + _ROUNDING_M
        begin, end = np.searchsorted(self._x_m, (centre[0] - reach_m, centre[0] + reach_m))
        x_m, y_m = self._x_m[begin:end] - centre[0], self._y_m[begin:end] - centre[1]
        return np.sort(self._order[begin:end][x_m * x_m + y_m * y_m < distance_m * distance_m])

    def near(self, candidate: Candidate, distance_m: float) -> Int[np.ndarray, "n"]:
        """Return the numbers, rising, of the places near a candidate and at about its heading."""
        near = self.within(candidate.position_m, distance_m)
        turned = wrap_angle(self._heading[near] - self._query.roll[candidate.hypothesis] - candidate.frame_heading)
        return near[np.abs(turned) <= HEADING_SEPARATION]


@dataclass(frozen=True, eq=False)
class WeightedPlaces:
    """Probable places of a query.

    Attributes:
        poses: number of grid poses.
        counted: the same places as candidates count them; None for the same.
    """

    query: Query
    support: Support
    poses: int
    counted: _SortedPlaces | None = None

    def posterior(self, candidates: Sequence[Candidate]) -> Posterior:
        """Return the posterior with the probabilities of candidates, the answer first."""
        support, answer, shares = self.support, candidates[0], []
        weight, left = support.weight, support.weight.copy()
        places = self.counted or _SortedPlaces(support.position_m, support.heading, self.query)
        for candidate in candidates:
            near = places.near(candidate, RIGHT_WITHIN_M)
            shares.append(float(left[near].sum()))
            left[near] = 0.0
        turned = wrap_angle(support.heading - (self.query.roll[answer.hypothesis] + answer.frame_heading))
        # A hypothesis stands for the headings up to half a sector from it.
        is_right = np.abs(turned) <= HEADING_WITHIN + 0.5 * self.query.sector
        return Posterior(
            pose=np.bincount(support.pose, weight, minlength=self.poses),
            position=min(float(weight[places.within(answer.position_m, RIGHT_WITHIN_M)].sum()), 1.0),
            candidate=tuple(shares),
            heading=float(weight[is_right].sum()),
            support=support,
        )


def weighted_places(
    grid: GridCosts,
    prior: Float[np.ndarray, "n"],
    query: Query,
    *,
    starts: Sequence[Candidate],
    ends: Sequence[Candidate],
    temperature: float,
    separation_m: float,
) -> WeightedPlaces:
    """Return the probable places after some modes of the grid were refined.

    `prior` is the log prior of every pose of the grid, up to a constant. `starts` are the modes that were refined, as
    the grid has them, and `ends` the same after refinement, in the same order. `temperature` is T, and `separation_m`
    the radius of a mode.
    """
    lowest = float(grid.total.min())
    moves = list(zip(starts, ends, strict=True))
    gains = [start.total_cost - end.total_cost for start, end in moves]
    usual = float(np.median(gains)) if gains else 0.0
    best = min([lowest - usual, *(end.total_cost for end in ends)])
    pair = np.flatnonzero(temperature * (grid.total - max(gains, default=0.0) - best) < NEGLIGIBLE)
    cost, pose, hypothesis = grid.total[pair].astype(np.float64), grid.pose[pair], grid.hypothesis[pair]
    position = grid.poses.position_m[pose]
    heading = query.roll[hypothesis] + query.frame_heading
    # The first candidate near each pair and at about its heading; -1 for none.
    mode, places = np.full(len(pair), -1), _SortedPlaces(position, heading, query)
    for index, start in reversed(list(enumerate(starts))):
        mode[places.near(start, separation_m)] = index
    # The last row is for pairs of no mode.
    gain = np.array([*gains, usual])[mode]
    shifts = [(*(end.position_m - start.position_m), end.frame_heading - start.frame_heading) for start, end in moves]
    shift = np.array([*shifts, (0.0, 0.0, 0.0)])[mode]
    position, heading = position + shift[:, :2], heading + shift[:, 2]
    log_weight = -temperature * (cost - gain) + prior[pose]
    counted = position, heading
    if ends:
        mode = np.append(_merged(ends, query, separation_m), -1)[mode]
        depth = np.array([end.total_cost for end in ends])
        log_weight += _width_corrections(log_weight, mode, depth, temperature)
        counted = _ties_at_their_ends(position, heading, mode, ends, query)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    support = Support(pose, position, heading, weight)
    return WeightedPlaces(query, support, len(grid.poses), _SortedPlaces(*counted, query))


def _merged(ends: Sequence[Candidate], query: Query, separation_m: float) -> Int[np.ndarray, "r"]:
    """Return for each refined candidate the best one that ended at its place and heading, which can be itself."""
    head = np.arange(len(ends))
    position = np.stack([end.position_m for end in ends])
    heading = np.array([query.roll[end.hypothesis] + end.frame_heading for end in ends])
    left, places = np.ones(len(ends), bool), _SortedPlaces(position, heading, query)
    for index in ranking(np.array([end.total_cost for end in ends]), position, heading):
        if left[index]:
            same = places.near(ends[index], separation_m)
            same = same[left[same]]
            head[same] = index
            left[same] = False
    return head


def _width_corrections(
    log_weight: Float[np.ndarray, "m"], mode: Int[np.ndarray, "m"], depth: Float[np.ndarray, "r"], temperature: float
) -> Float[np.ndarray, "m"]:
    """Return log factors that give all refined modes the width of the deepest; of tied modes, of the widest.

    The number of grid poses that fit a mode depends on where the lattice lies, and differs between copies of one room.
    `mode` is the refined candidate of each pair, -1 for none, and `depth` the cost of each refined candidate.
    """
    correction, order = np.zeros(len(log_weight)), np.argsort(mode, kind="stable")
    bounds = np.searchsorted(mode[order], np.arange(len(depth) + 1))
    members = [order[begin:end] for begin, end in pairwise(bounds)]
    width = {
        index: np.logaddexp.reduce(log_weight[member]) + temperature * depth[index]
        for index, member in enumerate(members)
        if len(member)
    }
    if width:
        deepest = min(depth[index] for index in width)
        target = max(width[index] for index in width if depth[index] < deepest + TIED)
        for index in width:
            correction[members[index]] = target - width[index]
    return correction


def _ties_at_their_ends(
    position: Float[np.ndarray, "m 2"],
    heading: Float[np.ndarray, "m"],
    mode: Int[np.ndarray, "m"],
    ends: Sequence[Candidate],
    query: Query,
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m"]]:
    """Return positions and headings, those of modes that tie for the best replaced by those of the mode's end.

    Modes are as wide as the grid's steps, and those of a small square room overlap: the probability within 1 m of the
    answer would include parts of the others, and depend on which of the equals is first.
    """
    found = np.unique(mode[mode >= 0])
    cost = np.array([ends[index].total_cost for index in found])
    tied = found[cost < cost.min(initial=np.inf) + TIED]
    if len(tied) < 2:
        return position, heading
    position, heading = position.copy(), heading.copy()
    for index in tied:
        position[mode == index] = ends[index].position_m
        heading[mode == index] = query.roll[ends[index].hypothesis] + ends[index].frame_heading
    return position, heading


@dataclass(frozen=True, eq=False)
class ProbabilityMap:
    """Places with their probabilities.

    Places are the refined ones. Candidates can begin up to a metre from the place where they end, so a map of the
    grid's poses would show the probability beside the answer.
    """

    position_m: Float[np.ndarray, "k 2"]
    room_index: Int[np.ndarray, "k"]
    probability: Float[np.ndarray, "k"]


def probability_map(plan: FloorPlan, poses: PoseSet, posterior: Posterior) -> ProbabilityMap:
    """Return the places of a posterior over the grid `poses` of a plan.

    Places that refinement moved out of their rooms are left out, unless all were.
    """
    support = posterior.support
    key = np.concatenate([support.pose[:, None], np.rint(support.position_m / _MAP_STEP_M).astype(np.int64)], axis=1)
    _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
    weight = np.bincount(which.ravel(), support.weight, minlength=len(first))
    position_m, room = support.position_m[first], poses.room_index[support.pose[first]]
    inside = plan.room_index_at(position_m) == room
    if not weight[inside].sum() > 0.0:
        position_m, inside = poses.position_m[support.pose[first]], np.ones(len(first), bool)
    left = weight[inside]
    return ProbabilityMap(position_m[inside], room[inside], left / left.sum())
