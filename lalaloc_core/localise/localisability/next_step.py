"""The single step that would make an unsure answer surest, by the answer's posterior and the model's measured errors.

Equally probable places with headings stand for the posterior. Stating the heading or the room leaves those that agree
with it. For another photograph, predictions are drawn at some of the places, as in `predicted_localisability.py`, and
compared with what all places would show. The work is bounded for plans of any size.

The expected confidence is the probability that the photograph is of the plan, times the expected share of the
posterior within 1 m of its best place after the step. The answer is the place that fits best, near which the share need
not be the largest. Statements leave that as it is: the share after one is lower by the factor of the answer's share.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from lalaloc_core.bundle import Manifest, PredictionErrors
from lalaloc_core.conventions import DOOR_CODE, PASSAGE_CODE, TWO_PI, wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import CONFIDENT, RIGHT_WITHIN_M, Support
from lalaloc_core.localise.match import Layouts, MatchingConfig, MatchingCost, layouts_at
from lalaloc_core.localise.query import CameraHeight, PredictedOpenings, PredictedProfile, Query
from lalaloc_core.render.sampling import PoseSet

StepKind = Literal["turn", "door", "heading", "rooms"]
# Places that stand for the posterior, drawn photographs of each step, and step of the azimuths that are compared.
_PLACES, _DRAWS, _STRIDE = 128, 24, 2
# Angles (radians) that are tried for another photograph from the spot.
_TURNS = tuple(math.radians(degrees) for degrees in (45, -45, 90, -90, 135, -135, 180))
# Share of another photograph that must be new.
_NEW = 0.5
# Doors that are tried; length of the step behind one (m), and the difference of the distance of the same door (m).
_DOORS, BEHIND_M, _SAME_DOOR_M = 3, 1.0, 0.7
# Error of a stated heading, as of a compass (radians), and the headings that can be stated.
HEADING_ERROR = math.radians(10.0)
_STATED = np.radians(np.arange(0.0, 360.0, 4.0))
# Rooms that are named for a choice, and the smallest probability of one.
_ROOMS, _MIN_ROOM = 5, 0.03
# Smallest increase of the confidence that is worth a step.
_WORTH = 0.02


@dataclass(frozen=True, kw_only=True)
class NextStep:
    """A step, and what it is expected to tell.

    Attributes:
        kind: `turn` (another photograph from the same spot), `door` (another photograph from behind a door), `heading`
            (state it) or `rooms` (choose one).
        turn: of `turn` and `door`: direction (radians) relative to the photograph's centre, clockwise.
        rooms: of `rooms`: numbers of the probable rooms, the most probable first.
    """

    kind: StepKind
    bits: float
    confidence: float
    turn: float = 0.0
    distance_m: float = 0.0
    rooms: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Known:
    """Facts about an answer that steps are computed from.

    Attributes:
        fit: probability that the photograph is of the plan.
        answer: share of the posterior within 1 m of the answer.
        arcs: azimuths (radians, first and last) that were seen, relative to the photograph's centre.
        field: horizontal field of view (radians) of another photograph; 2π for spheres.
    """

    support: Support
    fit: float
    answer: float
    arcs: Sequence[tuple[float, float]]
    field: float
    height_m: float
    is_view: bool
    heading: bool = False
    rooms: bool = False


def next_step(plan: FloorPlan, manifest: Manifest, known: Known, *, step_m: float) -> NextStep | None:
    """Return the step with the highest expected confidence; None where the answer is sure, or no step is worth it."""
    return next(iter(next_steps(plan, manifest, known, step_m=step_m)), None)


def next_steps(plan: FloorPlan, manifest: Manifest, known: Known, *, step_m: float) -> list[NextStep]:
    """Return the steps that are worth it, the one with the highest expected confidence first; none for sure answers.

    `step_m` is the step of the pose grid. Models without measured errors allow no expectation of photographs, so that
    only headings and rooms are asked for.
    """
    if known.fit < CONFIDENT:
        return []
    belief = _Belief.of(plan, known.support)
    now = belief.share
    if known.fit * now >= CONFIDENT:
        return []
    steps = list(_statements(plan, belief, known))
    errors = manifest.errors if not known.is_view else None if manifest.view is None else manifest.view.errors
    if errors is not None and manifest.profile_columns:
        rng = np.random.default_rng(0)
        drawn = _Photographs(plan, manifest, errors.thinned(_STRIDE), known, belief, step_m, rng)
        steps += [*drawn.turns(), *drawn.doors()]
    steps = [step for step in steps if step.confidence >= known.fit * now + _WORTH]
    return sorted(steps, key=lambda step: (-step.confidence, -step.bits))


@dataclass(frozen=True, eq=False)
class _Belief:
    """Places with headings that stand for a posterior, each with its probability.

    Attributes:
        poses: the places, in their rooms.
        heading: (n,) headings of the photograph (radians).
        cell: (n,) number of the grid pose of each.
        weight: (n,) probability; the sum is one.
    """

    poses: PoseSet
    heading: Float[np.ndarray, "n"]
    cell: Int[np.ndarray, "n"]
    weight: Float[np.ndarray, "n"]

    @classmethod
    def of(cls, plan: FloorPlan, support: Support) -> _Belief:
        """Draw places from a posterior, at equal steps of its cumulative probability."""
        order = np.lexsort((support.heading, support.pose))
        total = np.cumsum(support.weight[order])
        chosen = np.searchsorted(total, (np.arange(_PLACES) + 0.5) / _PLACES * total[-1])
        row, count = np.unique(order[np.minimum(chosen, len(order) - 1)], return_counts=True)
        room = plan.room_index_at(support.position_m[row])
        # Refinement can have moved a place out of its room.
        inside = room >= 0
        row, count, room = (row[inside], count[inside], room[inside]) if inside.any() else (row, count, room * 0)
        _, cell = np.unique(support.pose[row], return_inverse=True)
        return cls(PoseSet(support.position_m[row], room), support.heading[row], cell.ravel(), count / count.sum())

    @cached_property
    def share(self) -> float:
        """Share within 1 m of the best place."""
        return float((self.weight @ self._near).max())

    def told(
        self, likelihood: Float[np.ndarray, "k n"], *, near: Float[np.ndarray, "n n"] | None = None, drawn: bool = True
    ) -> tuple[float, float]:
        """Return the mean information and the mean share within 1 m of the best place after some observations.

        `likelihood` is that of each observation at every place; the observations are `drawn`, or all that are possible.
        `near` is 1 for places that are close, if not those of the photograph.
        """
        after = likelihood * self.weight
        total = after.sum(axis=1)
        possible = total > 0.0
        if not possible.any():
            return 0.0, self.share
        after, total = after[possible] / total[possible, None], total[possible]
        cells, before = after @ self._in_cell, self.weight @ self._in_cell
        ratio = np.divide(cells, before, out=np.ones_like(cells), where=cells > 0.0)
        bits = (cells * np.log2(ratio)).sum(axis=1)
        share = (after @ (self._near if near is None else near)).max(axis=1)
        weights = None if drawn else total
        return float(np.average(bits, weights=weights)), float(np.average(share, weights=weights))

    @cached_property
    def _in_cell(self) -> Float[np.ndarray, "n c"]:
        return (self.cell[:, None] == np.arange(self.cell.max() + 1)).astype(float)

    @cached_property
    def _near(self) -> Float[np.ndarray, "n n"]:
        return _near_each_other(self.poses.position_m)


def _near_each_other(position_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n n"]:
    """Return 1 for places within 1 m of each other, else 0."""
    return (np.hypot(*(position_m[:, None] - position_m[None]).T) < RIGHT_WITHIN_M).astype(float)


def _statements(plan: FloorPlan, belief: _Belief, known: Known) -> Iterator[NextStep]:
    """Yield the steps that state the heading or choose a room."""
    fit = known.fit * min(known.answer / belief.share, 1.0)
    if not known.heading:
        agree = np.abs(wrap_angle(_STATED[:, None] - belief.heading)) <= HEADING_ERROR
        bits, share = belief.told(agree / agree.sum(axis=0), drawn=False)
        yield NextStep(kind="heading", bits=bits, confidence=fit * share)
    room = belief.poses.room_index
    mass = np.bincount(room, belief.weight, minlength=len(plan.rooms))
    probable = np.argsort(-mass, kind="stable")[: np.count_nonzero(mass >= _MIN_ROOM)]
    # Rooms of one name cannot be chosen by it.
    _, kinds = np.unique([named.name.casefold() for named in plan.rooms], return_inverse=True)
    if known.rooms or len(np.unique(kinds[probable])) < 2:
        return
    bits, share = belief.told((np.unique(kinds[room])[:, None] == kinds[room]).astype(float), drawn=False)
    rooms = tuple(int(index) for index in probable[:_ROOMS])
    yield NextStep(kind="rooms", bits=bits, confidence=fit * share, rooms=rooms)


class _Door(NamedTuple):
    """A door or passage, by its direction (radians) relative to the photograph's centre, and its distance (m)."""

    turn: float
    distance_m: float


class _Photographs:
    """Expectation of further photographs."""

    def __init__(
        self,
        plan: FloorPlan,
        manifest: Manifest,
        errors: PredictionErrors,
        known: Known,
        belief: _Belief,
        step_m: float,
        rng: np.random.Generator,
    ) -> None:
        """Render the layouts of all places."""
        self._plan, self._errors, self._known, self._belief, self._rng = plan, errors, known, belief, rng
        self._weights = manifest.evidence_for(view=known.is_view)
        self._columns, self._config = manifest.profile_columns // _STRIDE, MatchingConfig()
        self._reach_m = self._config.grid_reach * step_m
        view = manifest.view
        self._prior = np.array(manifest.opening_prior if not known.is_view or view is None else view.opening_prior)
        self._layouts = layouts_at(plan, belief.poses, belief.heading, self._columns)
        self._azimuth = ((np.arange(self._columns) + 0.5) / self._columns - 0.5) * TWO_PI

    def turns(self) -> Iterator[NextStep]:
        """Yield the steps to another photograph from the same spot."""
        seen = np.zeros(self._columns, bool)
        for begin, end in self._known.arcs:
            seen |= self._within(0.5 * (begin + end), end - begin)
        shown = {turn: self._within(turn, self._known.field) & ~seen for turn in _TURNS}
        wanted = _NEW * self._known.field / TWO_PI * self._columns
        turns = [turn for turn in _TURNS if shown[turn].sum() >= wanted]
        if not turns:
            return
        masks = np.stack([shown[turn] for turn in turns])
        rows = self._drawn(self._belief.weight)
        likelihood = self._likelihoods(self._layouts, rows, masks)
        for number, turn in enumerate(turns):
            bits, share = self._belief.told(likelihood[:, number])
            yield NextStep(kind="turn", bits=bits, confidence=self._known.fit * share, turn=turn)

    def doors(self) -> Iterator[NextStep]:
        """Yield the steps through a door to a photograph from behind it."""
        for door in self._doors():
            told = self._through(door)
            if told is not None:
                bits, share = told
                yield NextStep(kind="door", bits=bits, confidence=self._known.fit * share, **door._asdict())

    def _through(self, door: _Door) -> tuple[float, float] | None:
        """Return the expectation of a photograph from behind a door; None if few places have that door."""
        belief, layouts = self._belief, self._layouts
        assert layouts.kind is not None
        column = int((door.turn / TWO_PI + 0.5) * self._columns) % self._columns
        has_door = _is_way(layouts.kind[:, column]) & (
            np.abs(np.exp(layouts.log_profile[:, column].astype(float)) - door.distance_m) < _SAME_DOOR_M
        )
        heading = belief.heading + door.turn
        way_m = (door.distance_m + BEHIND_M) * np.stack([np.sin(heading), np.cos(heading)], axis=1)
        position_m = belief.poses.position_m + way_m
        room = self._plan.room_index_at(position_m)
        has_door &= (room >= 0) & (room != belief.poses.room_index)
        reached = np.flatnonzero(has_door)
        if belief.weight[reached].sum() < CONFIDENT:
            return None
        behind = layouts_at(self._plan, PoseSet(position_m[reached], room[reached]), heading[reached], self._columns)
        shown = self._within(0.0, self._known.field)[None]
        drawn = self._drawn(belief.weight)
        # Where there is no such door, finding none tells that.
        likelihood = np.repeat((~has_door).astype(float)[None], len(drawn), axis=0)
        passed = np.flatnonzero(has_door[drawn])
        likelihood[passed] = 0.0
        rows = np.searchsorted(reached, drawn[passed])
        likelihood[np.ix_(passed, reached)] = self._likelihoods(behind, rows, shown)[:, 0]
        return belief.told(likelihood, near=_near_each_other(position_m))

    def _doors(self) -> list[_Door]:
        """Return the nearest doors of the most probable place."""
        layouts = self._layouts
        if layouts.kind is None:
            return []
        best = int(self._belief.weight.argmax())
        way = _is_way(layouts.kind[best])
        # Begin at a wall, so that no door is cut in two.
        first = int((~way).argmax())
        order = (np.arange(self._columns) + first) % self._columns
        change = np.flatnonzero(np.diff(way[order].astype(int), prepend=0, append=0))
        doors = []
        for begin, end in zip(change[::2], change[1::2], strict=True):
            column = order[(begin + end - 1) // 2]
            distance_m = float(np.exp(layouts.log_profile[best, column].astype(float)))
            doors.append(_Door(float(self._azimuth[column]), distance_m))
        return sorted(doors, key=lambda door: door.distance_m)[:_DOORS]

    def _drawn(self, weight: Float[np.ndarray, "n"]) -> Int[np.ndarray, "d"]:
        """Draw places at equal steps of their cumulative probability."""
        levels = (np.arange(_DRAWS) + self._rng.uniform()) / _DRAWS
        return np.minimum(np.searchsorted(np.cumsum(weight), levels), len(weight) - 1)

    def _likelihoods(
        self, layouts: Layouts, rows: Int[np.ndarray, "d"], shown: Bool[np.ndarray, "k w"]
    ) -> Float[np.ndarray, "d k n"]:
        """Return the likelihood at every place of photographs drawn at some, each showing the azimuths of k masks."""
        kind = np.zeros(layouts.log_profile.shape, np.uint8) if layouts.kind is None else layouts.kind
        log_m, log_scale = self._errors.profile(layouts.log_profile[rows].astype(float), self._rng)
        openings = PredictedOpenings(self._errors.openings(kind[rows], self._rng), self._prior)
        query = Query(
            np.zeros((len(rows), 1), np.float32),
            np.zeros(len(rows)),
            0.0,
            True,
            CameraHeight(self._known.height_m, 0.0),
            profile=PredictedProfile(log_m.astype(np.float32), log_scale.astype(np.float32)),
            openings=openings,
            is_view=self._known.is_view,
        )
        cost = MatchingCost(self._plan, query, self._reach_m, self._weights, self._config).by_azimuth(layouts)
        # The other azimuths cost nothing.
        logs = -self._weights.temperature / self._columns * (cost @ shown.T.astype(np.float32)).transpose(0, 2, 1)
        return np.exp(logs - logs.max(axis=2, keepdims=True))

    def _within(self, centre: float, width: float) -> Bool[np.ndarray, "w"]:
        """Return the columns within an arc (radians)."""
        return np.abs(wrap_angle(self._azimuth - centre)) <= 0.5 * width


def _is_way(kind: Integer[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
    """Return whether classes of openings are ways."""
    return (kind == DOOR_CODE) | (kind == PASSAGE_CODE)
