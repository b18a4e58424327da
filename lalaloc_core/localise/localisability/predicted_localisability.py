"""Probability by place that a photograph taken there is found, from the plan and the model's measured errors alone.

For each of some places the predictions of a model are drawn (`prediction_errors.py`) from the layout that the plan
shows there, and searched for with the matching cost and the coarse pass of real queries. The share of draws whose
answer is within 1 m is the probability. Lines of views tell the directions of walls as often as they are presumed to.
Of openings that the plan draws in part (`FloorPlan.opening_trust`), some are moved: they exist elsewhere. Ceilings and
room types, which weigh little, are left out, and so is pose refinement; `PredictionErrors.spread` is fitted to make up
for both. Poses that fit equally well share the answer.

The pose grids of large plans are coarser, so that the work is bounded. An answer on a grid of step s is then right
within s.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.bundle import Manifest, PredictionErrors
from lalaloc_core.conditions import CONDITIONS, HARDEST, PHOTOGRAPHS, Condition, parts_of
from lalaloc_core.conventions import OPENING_CLASSES, TWO_PI
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import RIGHT_WITHIN_M, GridCosts
from lalaloc_core.localise.match import OTHER_LINES, MatchingConfig, PoseGrid, layouts_at
from lalaloc_core.localise.query import CameraHeight, PredictedOpenings, PredictedProfile, Query, WallDirection, rolled
from lalaloc_core.localise.search.retrieval import grid_costs
from lalaloc_core.render.sampling import PoseSet, grid_size, pose_grid, random_poses

FIELD = math.radians(80.0)
# Grid poses beyond which the grid is coarser; places and draws at each; places of the largest plans.
_MAX_POSES = 40_000
_PLACES, _MIN_PLACES, _DRAWS = 40, 12, 2
# Number of grid poses up to which all places are compared.
_FULL_POSES = 2_500
# Grid step (m); those of larger plans are multiples of 0.1 m.
STEP_M, _STEPS_PER_M = 0.5, 10
# Deviation of the azimuth of walls that lines tell: the median of views of 80° of real rooms.
_LINES_SD = math.radians(1.0)
# Poses whose likelihoods differ by less than this factor fit equally well: copies of a room differ by rounding.
_EQUAL = math.log(1.01)
# Pairs of rooms that are listed, and the smallest share of confused photographs.
_PAIRS, _MIN_CONFUSED = 10, 0.05


class Errors(NamedTuple):
    """Measured errors of the predictions of spheres and of views."""

    sphere: PredictionErrors
    view: PredictionErrors


class ConfusedRooms(NamedTuple):
    """Two rooms, by their numbers, and the share of photographs of either that are answered in the other."""

    rooms: tuple[int, int]
    condition: Condition
    share: float


@dataclass(frozen=True, kw_only=True)
class Localisability:
    """Probabilities that photographs are found within 1 m, or within the spacing if that is more.

    Attributes:
        found: (p,) probability at each place by condition, see `CONDITIONS`.
        rooms: (r,) means of the rooms' places by condition; NaN for rooms without a place.
        plan: mean over the plan's area by condition.
        gains: increase of the plan's mean of `HARDEST` by remedy: "heading", "three_photographs", "sphere",
            "room_hint", and "doors", which is that of the openings that the plan shows; None if it shows none.
    """

    spacing_m: float
    places: PoseSet
    found: dict[Condition, Float[np.ndarray, "p"]]
    rooms: dict[Condition, Float[np.ndarray, "r"]]
    plan: dict[Condition, float]
    confused: tuple[ConfusedRooms, ...]
    gains: dict[str, float | None]


class Draw(NamedTuple):
    """Outcome of a drawn photograph.

    Attributes:
        mistaken: probability of an answer in each of the other rooms.
    """

    found: float
    found_in_room: float
    mistaken: dict[int, float]


# Outcomes of photographs at each place.
_Outcomes = dict[Condition, list[list[Draw]]]


def errors_of(manifest: Manifest) -> Errors:
    """Return the measured errors of a model, or raise InvalidInputError if they were not measured."""
    view = manifest.view
    if manifest.errors is None or view is None or view.errors is None:
        raise InvalidInputError(
            f"model '{manifest.name}' has no measured prediction errors; run `lalaloc lab calibrate --errors`"
        )
    return Errors(manifest.errors, view.errors)


def spacing_m(plan: FloorPlan) -> float:
    """Return the step of a plan's pose grid: wider than usual if it would have too many poses."""
    # Every room has a pose, whatever the step.
    left = max(_MAX_POSES - len(plan.rooms), _MAX_POSES // 2)
    return max(STEP_M, math.ceil(_STEPS_PER_M * math.sqrt(plan.area_m2 / left)) / _STEPS_PER_M)


def localisability(plan: FloorPlan, manifest: Manifest, *, coarse: bool = False) -> Localisability:
    """Return the probabilities at places spread over a plan; the work is bounded for plans of any size.

    A `coarse` prediction has the fewest places with one draw at each, and takes about a fifth of the time.
    """
    errors, step_m = errors_of(manifest), spacing_m(plan)
    rng = np.random.default_rng(0)
    share = 0.0 if coarse else min(1.0, _FULL_POSES / grid_size(plan, step_m))
    places = _spread(plan, max(_MIN_PLACES, round(_PLACES * share)), rng)
    search = Searches(plan, manifest, errors, step_m=step_m)
    draws = max(1, round(_DRAWS * share))
    outcomes: _Outcomes = {name: search.draws(places, name, draws, rng) for name in CONDITIONS}
    undrawn = search.draws(places, HARDEST, draws, rng, openings=False) if search.has_openings else None
    return _summary(plan, step_m, places, outcomes, undrawn)


class Searches:
    """Search of drawn photographs in one plan."""

    def __init__(self, plan: FloorPlan, manifest: Manifest, errors: Errors, *, step_m: float) -> None:
        """Render the pose grid."""
        self._plan, self._manifest, self._errors = plan, manifest, errors
        poses, columns = pose_grid(plan, step_m), manifest.profile_columns
        layouts = layouts_at(plan, poses, np.zeros(len(poses)), columns)
        self._grid = PoseGrid.without_latents(poses, layouts, step_m, plan.camera_height_m)
        self.has_openings = layouts.kind is not None

    def draws(
        self, places: PoseSet, condition: Condition, count: int, rng: np.random.Generator, *, openings: bool = True
    ) -> list[list[Draw]]:
        """Return outcomes of `count` photographs at each place; `openings` compares those of the plan."""
        config = MatchingConfig(use_openings=openings, use_see_through=openings)
        is_view = not condition.startswith("sphere")
        weights = self._manifest.evidence_for(view=is_view)
        outcomes: list[list[Draw]] = [[] for _ in range(len(places))]
        for _ in range(count):
            for number, query in enumerate(self._queries(places, condition, rng)):
                costs = grid_costs(self._plan, self._grid, query, weights, config, best_only=True)
                place = places.position_m[number], int(places.room_index[number])
                outcomes[number].append(self._outcome(costs, *place, _EQUAL / weights.temperature))
        return outcomes

    def _outcome(self, costs: GridCosts, position_m: Float[np.ndarray, "2"], room: int, equal: float) -> Draw:
        """Return the outcome of a photograph from a place; costs that differ by less than `equal` are a tie."""
        poses, pose, cost = costs.poses, costs.pose[: costs.compared], costs.total[: costs.compared]
        reach_m = max(RIGHT_WITHIN_M, self._grid.step_m)

        def best(rows: Int[np.ndarray, "k"]) -> tuple[Int[np.ndarray, "b"], Bool[np.ndarray, "b"]]:
            """Return the tied best poses of some pairs, each once, and which of them are right."""
            tied = np.unique(pose[rows[cost[rows] <= cost[rows].min() + equal]])
            return tied, np.hypot(*(poses.position_m[tied] - position_m).T) < reach_m

        tied, right = best(np.arange(len(pose)))
        others, count = np.unique(poses.room_index[tied[~right]], return_counts=True)
        mistaken = {int(index): n / len(tied) for index, n in zip(others, count, strict=True) if index != room}
        own = np.flatnonzero(poses.room_index[pose] == room)
        return Draw(float(right.mean()), float(best(own)[1].mean()) if len(own) else 0.0, mistaken)

    def _queries(self, places: PoseSet, condition: Condition, rng: np.random.Generator) -> Iterator[Query]:
        """Yield a drawn photograph of each place."""
        name, known = parts_of(condition)
        views, manifest = PHOTOGRAPHS[name], self._manifest
        errors = self._errors.view if views else self._errors.sphere
        columns = manifest.profile_columns
        # A searched heading lies between two hypotheses; a known one is met exactly.
        shifts = np.zeros(1, np.int64)
        if known == "unknown":
            shifts = np.arange(0, columns, 1 if views else columns // manifest.ring_sectors)
        between = rng.uniform(-0.5, 0.5, len(places)) * (TWO_PI / len(shifts) if len(shifts) > 1 else 0.0)
        layouts = layouts_at(self._plan, places, between, columns)
        kind = np.zeros(layouts.log_profile.shape, np.uint8) if layouts.kind is None else layouts.kind
        kind = _as_built(kind, self._plan.opening_trust, rng)
        log_m, log_scale = errors.profile(layouts.log_profile, rng)
        log_probability = errors.openings(kind, rng)
        prior = np.array(manifest.opening_prior if not views or manifest.view is None else manifest.view.opening_prior)
        height = CameraHeight(self._plan.camera_height_m)
        directions = _directions(self._plan, places, between, rng) if views else [()] * len(places)
        for row in range(len(places)):
            unseen = ~_seen(columns, views, int(rng.integers(columns)))
            scale, probability = log_scale[row].astype(np.float32), log_probability[row]
            scale[unseen], probability[unseen] = np.inf, np.log(prior)
            profile = PredictedProfile(log_m[row : row + 1].astype(np.float32), scale[None])
            yield Query(
                np.zeros((len(shifts), 1), np.float32),
                shifts * (TWO_PI / columns),
                0.0,
                known == "known",
                height,
                profile=profile.moved(shifts),
                openings=PredictedOpenings(rolled(probability, shifts), prior),
                wall_directions=directions[row],
                is_view=views > 0,
            )


def _directions(
    plan: FloorPlan, places: PoseSet, heading: Float[np.ndarray, "n"], rng: np.random.Generator
) -> list[tuple[WallDirection, ...]]:
    """Return the direction of walls that lines tell at each place, some of which are of something else."""
    walls = np.radians(plan.wall_directions[places.room_index].argmax(axis=1)) - heading
    walls += rng.normal(0.0, _LINES_SD, len(places))
    is_other = rng.random(len(places)) < OTHER_LINES
    walls[is_other] = rng.uniform(0.0, 0.25 * TWO_PI, is_other.sum())
    return [(WallDirection(float(azimuth), _LINES_SD),) for azimuth in walls]


def _as_built(
    kind: UInt8[np.ndarray, "n w"], opening_trust: Mapping[str, float], rng: np.random.Generator
) -> UInt8[np.ndarray, "n w"]:
    """Return opening codes by place and azimuth as they may be where a plan draws a share of the openings."""
    # With a trust of t, a drawn opening does not exist with a probability of 1 - t, and as many undrawn ones do.
    built = kind.copy()
    for code, name in enumerate(OPENING_CLASSES):
        trust = opening_trust.get(name, 0.0)
        if not 0.0 < trust < 1.0:
            continue
        for row, column in zip(*np.nonzero((kind == code) & (np.roll(kind, 1, axis=1) != code)), strict=True):
            others = np.flatnonzero(np.roll(kind[row], -column) != code)
            width = int(others[0]) if len(others) else kind.shape[1]
            if rng.random() >= trust:
                built[row, (column + np.arange(width)) % kind.shape[1]] = 0
                added = (int(rng.integers(kind.shape[1])) + np.arange(width)) % kind.shape[1]
                built[row, added[built[row, added] == 0]] = code
    return built


def _seen(columns: int, views: int, centre: int) -> Bool[np.ndarray, "w"]:
    """Return the azimuth columns that some views from one spot show, a part of a turn apart; all for spheres."""
    if not views:
        return np.ones(columns, bool)
    half = round(0.5 * FIELD / TWO_PI * columns)
    shown = np.zeros(columns, bool)
    for view in range(views):
        shown[(centre + view * columns // views + np.arange(-half, half)) % columns] = True
    return shown


def _spread(plan: FloorPlan, count: int, rng: np.random.Generator) -> PoseSet:
    """Return places by area, at least one in each room if there are no more rooms than places."""
    rooms = len(plan.rooms)
    try:
        drawn = random_poses(plan, 8 * count, rng)
    except InvalidInputError:
        drawn = PoseSet(np.empty((0, 2)), np.empty(0, int))
    if rooms > count and len(drawn):
        return PoseSet(drawn.position_m[:count], drawn.room_index[:count])
    wanted = np.maximum(1, np.rint(count * plan.areas_m2 / plan.area_m2)).astype(int)
    position, room = [], []
    for index in range(min(rooms, count)):
        own = drawn.position_m[drawn.room_index == index][: wanted[index]]
        position.append(own if len(own) else plan.rooms[index].interior_point()[None])
        room.append(np.full(len(position[-1]), index))
    return PoseSet(np.concatenate(position), np.concatenate(room))


def _summary(
    plan: FloorPlan, step_m: float, places: PoseSet, outcomes: _Outcomes, undrawn: list[list[Draw]] | None
) -> Localisability:
    found: dict[Condition, Float[np.ndarray, "p"]] = {name: _shares(rows, "found") for name, rows in outcomes.items()}
    rooms: dict[Condition, Float[np.ndarray, "r"]] = {
        name: _by_room(plan, places, share) for name, share in found.items()
    }
    means: dict[Condition, float] = {name: _mean(plan, values) for name, values in rooms.items()}

    def mean(rows: list[list[Draw]], field: str) -> float:
        return _mean(plan, _by_room(plan, places, _shares(rows, field)))

    hardest = means[HARDEST]
    gains = {
        "heading": means["phone_known_heading"] - hardest,
        "three_photographs": means["three_phone_unknown_heading"] - hardest,
        "sphere": means["sphere_unknown_heading"] - hardest,
        "room_hint": mean(outcomes[HARDEST], "found_in_room") - hardest,
        "doors": None if undrawn is None else hardest - mean(undrawn, "found"),
    }
    return Localisability(
        spacing_m=step_m,
        places=places,
        found=found,
        rooms=rooms,
        plan=means,
        confused=_confused(places.room_index, outcomes),
        gains=gains,
    )


def _shares(rows: list[list[Draw]], field: str) -> Float[np.ndarray, "p"]:
    return np.array([np.mean([getattr(draw, field) for draw in row]) for row in rows])


def _by_room(plan: FloorPlan, places: PoseSet, share: Float[np.ndarray, "p"]) -> Float[np.ndarray, "r"]:
    count = np.bincount(places.room_index, minlength=len(plan.rooms))
    total = np.bincount(places.room_index, share, minlength=len(plan.rooms))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _mean(plan: FloorPlan, rooms: Float[np.ndarray, "r"]) -> float:
    known = ~np.isnan(rooms)
    return float(np.average(rooms[known], weights=plan.areas_m2[known]))


def _confused(room: Int[np.ndarray, "p"], outcomes: _Outcomes) -> tuple[ConfusedRooms, ...]:
    """Return the pairs of rooms that are confused most, each under the condition that confuses it most."""
    worst: dict[tuple[int, int], ConfusedRooms] = {}
    for condition, rows in outcomes.items():
        taken, wrong = np.bincount(room, [len(row) for row in rows]), dict[tuple[int, int], float]()
        for own, row in zip(room.tolist(), rows, strict=True):
            for draw in row:
                for found_in, probability in draw.mistaken.items():
                    pair = min(own, found_in), max(own, found_in)
                    wrong[pair] = wrong.get(pair, 0.0) + probability
        for pair, count in wrong.items():
            share = count / sum(taken[index] for index in pair if index < len(taken))
            if share >= _MIN_CONFUSED and (pair not in worst or share > worst[pair].share):
                worst[pair] = ConfusedRooms(pair, condition, share)
    return tuple(sorted(worst.values(), key=lambda pair: (-pair.share, pair.rooms))[:_PAIRS])
