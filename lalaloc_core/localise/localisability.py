"""Probability by place that a photograph taken there is found, from the plan and the model's measured errors alone.

For each of some places the predictions of a model are drawn (`prediction_errors.py`) from the layout that the plan
shows there, and searched for with the matching cost and the coarse pass of real queries. The share of draws whose
answer is within 1 m is the probability. Ceilings and room types, which weigh little, are left out, and so is pose
refinement; `PredictionErrors.spread` is fitted to make up for both.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import Manifest
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.layouts import layouts_at
from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.poses import PoseGrid, PredictedOpenings, PredictedProfile, Query, rolled
from lalaloc_core.localise.posterior import RIGHT_WITHIN_M
from lalaloc_core.localise.prediction_errors import PredictionErrors
from lalaloc_core.localise.retrieval import grid_costs
from lalaloc_core.render.sampling import PoseSet, grid_size, pose_grid, random_poses

# Photographs, with the number of views of 80° that each consists of; 0 for spheres.
PHOTOGRAPHS = {"sphere": 0, "phone": 1, "three_phone": 3}
CONDITIONS = tuple(f"{name}_{heading}_heading" for heading in ("known", "unknown") for name in PHOTOGRAPHS)
# The condition that needs help most, which remedies are measured on.
HARDEST = "phone_unknown_heading"
FIELD = math.radians(80.0)
# Grid poses beyond which plans are refused; places and draws at each; places of the largest plans.
MAX_POSES = 40_000
_PLACES, _MIN_PLACES, _DRAWS = 40, 12, 2
# Number of grid poses up to which all places are compared.
_FULL_POSES = 2_500
_STEP_M = 0.5
# Pairs of rooms that are listed, and the smallest share of confused photographs.
_PAIRS, _MIN_CONFUSED = 10, 0.05


class Errors(NamedTuple):
    """Measured errors of the predictions of spheres and of views."""

    sphere: PredictionErrors
    view: PredictionErrors


class ConfusedRooms(NamedTuple):
    """Two rooms, by their numbers, and the share of photographs of either that are answered in the other."""

    rooms: tuple[int, int]
    condition: str
    share: float


@dataclass(frozen=True, kw_only=True)
class Localisability:
    """Probabilities that photographs are found within 1 m.

    Attributes:
        places: the places.
        found: (p,) probability at each place by condition, see `CONDITIONS`.
        rooms: (r,) means of the rooms' places by condition; NaN for rooms without a place.
        plan: mean over the plan's area by condition.
        confused: pairs of rooms that are confused, the most confused first.
        gains: increase of the plan's mean of `HARDEST` by remedy: "heading", "three_photographs", "sphere",
            "room_hint", and "doors", which is that of the openings that the plan shows; None if it shows none.
    """

    places: PoseSet
    found: dict[str, Float[np.ndarray, "p"]]
    rooms: dict[str, Float[np.ndarray, "r"]]
    plan: dict[str, float]
    confused: tuple[ConfusedRooms, ...]
    gains: dict[str, float | None]


class Draw(NamedTuple):
    """Outcome of a drawn photograph: whether it was found, also with a hint of its room, and the room of its answer."""

    found: bool
    found_in_room: bool
    room: int


def errors_of(manifest: Manifest) -> Errors:
    """Return the measured errors of a model.

    Raises:
        InvalidInputError: they were not measured.
    """
    view = manifest.view
    if manifest.errors is None or view is None or view.errors is None:
        raise InvalidInputError(
            f"model '{manifest.name}' has no measured prediction errors; run `lalaloc calibrate --errors`"
        )
    return Errors(manifest.errors, view.errors)


def localisability(plan: FloorPlan, manifest: Manifest, *, seed: int = 0) -> Localisability:
    """Return the probabilities at places spread over a plan; the work is bounded for plans of any size.

    Raises:
        InvalidInputError: the plan has too many grid poses, or the model no measured errors.
    """
    errors = errors_of(manifest)
    if (poses := grid_size(plan, _STEP_M)) > MAX_POSES:
        raise InvalidInputError(
            f"the plan has about {poses} grid poses, {_STEP_M:g} m apart; the limit is {MAX_POSES}: split the plan"
        )
    rng = np.random.default_rng(seed)
    share = min(1.0, _FULL_POSES / poses)
    places = _spread(plan, max(_MIN_PLACES, round(_PLACES * share)), rng)
    search = Searches(plan, manifest, errors, step_m=_STEP_M)
    draws = max(1, round(_DRAWS * share))
    outcomes = {name: search.draws(places, name, draws, rng) for name in CONDITIONS}
    undrawn = search.draws(places, HARDEST, draws, rng, openings=False) if search.has_openings else None
    return _summary(plan, places, outcomes, undrawn)


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
        self, places: PoseSet, condition: str, count: int, rng: np.random.Generator, *, openings: bool = True
    ) -> list[list[Draw]]:
        """Return outcomes of `count` photographs at each place; `openings` compares those of the plan."""
        config = MatchingConfig(use_openings=openings, use_see_through=openings)
        is_view = not condition.startswith("sphere")
        weights = self._manifest.evidence_for(view=is_view)
        outcomes: list[list[Draw]] = [[] for _ in range(len(places))]
        for _ in range(count):
            for number, query in enumerate(self._queries(places, condition, rng)):
                costs = grid_costs(self._plan, self._grid, query, weights, config)
                pose, cost = costs.pose[: costs.compared], costs.total[: costs.compared]
                near = np.hypot(*(costs.poses.position_m[pose] - places.position_m[number]).T) < RIGHT_WITHIN_M
                room = costs.poses.room_index[pose]
                best = int(cost.argmin())
                own = np.flatnonzero(room == places.room_index[number])
                in_room = bool(len(own) and near[own[cost[own].argmin()]])
                outcomes[number].append(Draw(bool(near[best]), in_room, int(room[best])))
        return outcomes

    def _queries(self, places: PoseSet, condition: str, rng: np.random.Generator) -> Iterator[Query]:
        """Yield a drawn photograph of each place."""
        name, known = condition.removesuffix("_heading").rsplit("_", 1)
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
        log_m, log_scale = errors.profile(layouts.log_profile, rng)
        log_probability = errors.openings(kind, rng)
        prior = np.array(manifest.opening_prior if not views or manifest.view is None else manifest.view.opening_prior)
        height = CameraHeight(self._plan.camera_height_m)
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
                is_view=views > 0,
            )


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
    plan: FloorPlan, places: PoseSet, outcomes: dict[str, list[list[Draw]]], undrawn: list[list[Draw]] | None
) -> Localisability:
    found = {name: _shares(rows, "found") for name, rows in outcomes.items()}
    rooms = {name: _by_room(plan, places, share) for name, share in found.items()}
    means = {name: _mean(plan, values) for name, values in rooms.items()}

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


def _confused(room: Int[np.ndarray, "p"], outcomes: dict[str, list[list[Draw]]]) -> tuple[ConfusedRooms, ...]:
    """Return the pairs of rooms that are confused most, each under the condition that confuses it most."""
    worst: dict[tuple[int, int], ConfusedRooms] = {}
    for condition, rows in outcomes.items():
        taken, wrong = np.bincount(room, [len(row) for row in rows]), dict[tuple[int, int], int]()
        for own, row in zip(room.tolist(), rows, strict=True):
            for draw in row:
                if not draw.found and draw.room != own:
                    pair = min(own, draw.room), max(own, draw.room)
                    wrong[pair] = wrong.get(pair, 0) + 1
        for pair, count in wrong.items():
            share = count / sum(taken[index] for index in pair if index < len(taken))
            if share >= _MIN_CONFUSED and (pair not in worst or share > worst[pair].share):
                worst[pair] = ConfusedRooms(pair, condition, share)
    return tuple(sorted(worst.values(), key=lambda pair: (-pair.share, pair.rooms))[:_PAIRS])
