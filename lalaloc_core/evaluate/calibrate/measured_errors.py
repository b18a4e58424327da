"""Errors of a model's predictions, measured on generated homes for `localise.localisability.predicted_localisability`.

The photographs of a spot are its sphere and three views of 80°. `measure_errors` compares the predictions with the
plan's layout there, and fits the spread of the drawn errors: the one with which the share of photographs that is
predicted to be found is closest to the share that the model finds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.special import ndtri

from lalaloc_core.bundle import Bundle, Manifest, PredictionErrors, write_manifest
from lalaloc_core.bundle.fitted_parameters import LEVELS
from lalaloc_core.conditions import CONDITIONS
from lalaloc_core.conventions import OPENING_CLASSES, wrap_angle
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data import Camera, Split, ViewPhotograph, ViewScenes
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.localise.belief import RIGHT_WITHIN_M
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder, patch_size
from lalaloc_core.localise.local_model import GRID_STEP_M, LocalModel
from lalaloc_core.localise.localisability.predicted_localisability import Errors, Searches, errors_of
from lalaloc_core.localise.match import layouts_at
from lalaloc_core.localise.query import CameraHeight, Query
from lalaloc_core.render.sampling import PoseSet

_FIELD_DEG, _VIEWS = 80.0, 3
# Spreads that are tried, and draws of each photograph: in the fit, and in comparisons.
_SPREADS, _FIT_DRAWS, DRAWS = (0.5, 0.6, 0.7, 0.8, 1.0), 1, 2


class Spot(NamedTuple):
    """Photographs of one spot: its sphere and three views of 80°, all from one camera."""

    plan: FloorPlan
    views: Sequence[Camera]

    @property
    def turns(self) -> list[float]:
        """Angles (radians) from the first view to each."""
        return [float(wrap_angle(view.heading - self.views[0].heading)) for view in self.views]

    @property
    def place(self) -> PoseSet:
        """The spot as a pose of its plan."""
        return PoseSet(self.views[0].position_m[None], np.array([self.views[0].room_index]))


def spots(homes: int, split: Split, textures: Path | None) -> Iterator[Spot]:
    """Yield the spots of furnished generated homes, 4 in each."""
    generated = GeneratedScenes(homes=homes, furniture="full", textures=textures)
    return spots_of(ViewScenes(generated, _FIELD_DEG, _VIEWS), split)


def spots_of(scenes: ViewScenes, split: Split) -> Iterator[Spot]:
    """Yield the spots of a split, each with all of its views."""
    for scene in map(scenes.load, scenes.scenes(split)):
        for first in range(0, len(scene.cameras), scenes.per_camera):
            yield Spot(scene.plan, scene.cameras[first : first + scenes.per_camera])


def queries_of(spot: Spot, encoder: PhotographEncoder) -> dict[str, Query]:
    """Return the queries of a spot by photograph and heading, as `localisability.CONDITIONS` names them."""
    manifest, views = encoder.manifest, spot.views
    height = CameraHeight(views[0].camera_height_m)
    pixels = photograph_of(views[0]).sphere.photograph.image(manifest.image_height, manifest.image_width)
    opened = [photograph_of(view).open(patch_size(manifest)) for view in views]
    others = list(zip(opened[1:], spot.turns[1:], strict=True))
    queries: dict[str, Query] = {}
    for name, heading in (("known_heading", views[0].heading), ("unknown_heading", None)):
        queries[f"sphere_{name}"] = encoder.spheres.query(pixels, heading, height)
        queries[f"phone_{name}"] = encoder.query(opened[0], heading, height)
        queries[f"three_phone_{name}"] = encoder.query(opened[0], heading, height, others=others)
    return queries


class Outcome(NamedTuple):
    """A spot with its predictions, spheres' and views', and the conditions under which the model finds it."""

    spot: Spot
    compared: dict[str, tuple[np.ndarray, ...]]
    found: dict[str, bool]


def outcomes_of(bundle: Bundle, homes: int, split: Split, textures: Path | None) -> list[Outcome]:
    """Localise the photographs of generated homes, 4 spots in each."""
    model, outcomes = LocalModel(bundle), list[Outcome]()
    for spot in spots(homes, split, textures):
        grid = model.grid(spot.plan, spot.views[0].camera_height_m)
        queries, found = queries_of(spot, model.encoder), dict[str, bool]()
        for name, query in queries.items():
            answer = model.localise(spot.plan, grid, query).candidates[0]
            found[name] = bool(np.linalg.norm(answer.position_m - spot.views[0].position_m) < RIGHT_WITHIN_M)
        compared = {name: _compared(spot, queries[f"{name}_known_heading"]) for name in ("sphere", "phone")}
        outcomes.append(Outcome(spot, compared, found))
    return outcomes


def predicted_shares(
    manifest: Manifest, errors: Errors, spots: Sequence[Spot], draws: int = DRAWS
) -> dict[str, Float[np.ndarray, "n"]]:
    """Return the probability of each of n spots, by condition, that a photograph is found, from its plan alone."""
    rng, found = np.random.default_rng(0), {name: list[float]() for name in CONDITIONS}
    for spot in spots:
        search = Searches(spot.plan, manifest, errors, step_m=GRID_STEP_M)
        for name in CONDITIONS:
            (outcomes,) = search.draws(spot.place, name, draws, rng)
            found[name].append(float(np.mean([outcome.found for outcome in outcomes])))
    return {name: np.array(values) for name, values in found.items()}


def calibrate_errors(folder: Path, homes: int) -> Errors:
    """Measure the errors of a bundle's predictions on generated validation homes, and store them in the bundle."""
    bundle = Bundle.open(folder)
    if bundle.manifest.view is None:
        raise InvalidInputError(f"model '{bundle.manifest.name}' has no encoder of views; leave out --errors")
    return errors_of(measure_errors(bundle, outcomes_of(bundle, homes, "validation", None)).manifest)


def measure_errors(bundle: Bundle, outcomes: Sequence[Outcome]) -> Bundle:
    """Measure the errors of predictions of spheres and of views, and store them in the bundle's manifest."""
    manifest = bundle.manifest
    assert manifest.view is not None, "the bundle has no encoder of views"
    sphere, view = (
        measured(*(np.stack(part) for part in zip(*(outcome.compared[name] for outcome in outcomes), strict=True)))
        for name in ("sphere", "phone")
    )
    spots = [outcome.spot for outcome in outcomes]
    shares = {name: float(np.mean([outcome.found[name] for outcome in outcomes])) for name in CONDITIONS}

    def misses(spread: float) -> dict[str, float]:
        errors = Errors(replace(sphere, spread=spread), replace(view, spread=spread))
        predicted = predicted_shares(manifest, errors, spots, _FIT_DRAWS)
        return {name: abs(float(predicted[name].mean()) - shares[name]) for name in CONDITIONS}

    tried = {spread: misses(spread) for spread in _SPREADS}
    return write_manifest(
        bundle.folder,
        replace(
            manifest,
            errors=replace(sphere, spread=_best(tried, spheres=True)),
            view=replace(manifest.view, errors=replace(view, spread=_best(tried, spheres=False))),
        ),
    )


def _best(tried: Mapping[float, Mapping[str, float]], *, spheres: bool) -> float:
    """Return the spread that misses the shares of spheres, or of views, least."""
    names = [name for name in CONDITIONS if name.startswith("sphere") == spheres]
    return min(tried, key=lambda spread: sum(tried[spread][name] for name in names))


def _compared(spot: Spot, query: Query) -> tuple[np.ndarray, ...]:
    assert query.profile is not None
    assert query.openings is not None
    layouts = layouts_at(spot.plan, spot.place, np.array([query.frame_heading]), query.profile.log_m.shape[1])
    kind = np.zeros(layouts.log_profile.shape, np.uint8) if layouts.kind is None else layouts.kind
    return (
        query.profile.log_m[0],
        query.profile.log_scale[0],
        kind[0],
        layouts.log_profile[0],
        query.openings.log_probability[0],
    )


def photograph_of(camera: Camera) -> ViewPhotograph:
    """Return the only photograph of a camera of `ViewScenes`."""
    (photograph,) = camera.photographs.values()
    assert isinstance(photograph, ViewPhotograph)
    return photograph


def measured(
    log_m: Float[np.ndarray, "n w"],
    log_scale: Float[np.ndarray, "n w"],
    kind: Integer[np.ndarray, "n w"],
    truth_log_m: Float[np.ndarray, "n w"],
    log_probability: Float[np.ndarray, "n w c"],
) -> PredictionErrors:
    """Return the statistics of predictions for n photographs; azimuths with an infinite scale are not seen."""
    known = np.isfinite(log_scale)
    scale = np.where(known, log_scale, 0.0)
    error = np.where(known, (log_m - truth_log_m) * np.exp(-scale), 0.0)
    classes = len(OPENING_CLASSES)
    guess = log_probability.argmax(axis=2)
    seen, mean = np.eye(classes), np.tile(0.01 / (classes - 1) + np.eye(classes) * 0.98, (classes, 1, 1))
    for code in range(classes):
        own = known & (kind == code)
        if own.any():
            seen[code] = np.bincount(guess[own], minlength=classes) / own.sum()
        for predicted in range(classes):
            if (both := own & (guess == predicted)).any():
                mean[code, predicted] = np.exp(log_probability[both]).mean(axis=0)
    return PredictionErrors(
        error_quantiles=_rounded(np.quantile(error[known], LEVELS)),
        error_correlation=_correlation(_scores(error, known), known),
        scale_quantiles=_rounded(np.quantile(scale[known], LEVELS)),
        scale_correlation=_correlation(_scores(scale, known), known),
        seen=tuple(map(_rounded, seen)),
        seen_correlation=_correlation((guess != kind).astype(float), known),
        class_probability=tuple(tuple(map(_rounded, rows)) for rows in mean),
    )


def _scores(values: Float[np.ndarray, "n w"], known: Bool[np.ndarray, "n w"]) -> Float[np.ndarray, "n w"]:
    """Return normal scores of the known values by rank; 0 for others."""
    scores = np.zeros(values.shape)
    rank = np.argsort(np.argsort(values[known], kind="stable"), kind="stable")
    scores[known] = ndtri((rank + 0.5) / len(rank))
    return scores


def _correlation(scores: Float[np.ndarray, "n w"], known: Bool[np.ndarray, "n w"]) -> tuple[float, ...]:
    """Return the correlation by difference of azimuth, as far as most photographs show pairs of it."""
    centred = np.where(known, scores - scores[known].mean(), 0.0)
    variance = float(np.square(centred[known]).mean())
    values: list[float] = []
    for lag in range(scores.shape[1] // 2 + 1):
        pairs = int((known & np.roll(known, lag, axis=1)).sum())
        if pairs < 2 * len(scores):
            break
        values.append(float((centred * np.roll(centred, lag, axis=1)).sum() / pairs / max(variance, 1e-9)))
    return _rounded(values)


def _rounded(values: np.ndarray | list[float]) -> tuple[float, ...]:
    return tuple(round(float(value), 4) for value in values)
