"""Calibration of a model bundle: its matching weights and its confidence, fitted on generated validation homes.

The homes' photographs are localised with the bundle. In this order the bundle gets

1. the cohort (`localise.match.fit_by_chance`): the layouts of unknown places, from training homes;
2. the appearance of openings, and the weights of the matching cost;
3. the confidence and covariance, fitted on predictions made with these weights: for the home's own photographs, for
   disturbed ones, because real cameras and plans are worse than rendered ones, and for photographs of unknown places.

The weights and the confidence of views are fitted separately; views share cohort and appearance with spheres.
"""

from __future__ import annotations

import logging
import tempfile
import zlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from lalaloc_core.bundle import COHORT, Bundle, Manifest, MatchingWeights, write_manifest
from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import BundleError, InvalidInputError
from lalaloc_core.evaluate.calibrate.parameter_fits import (
    Answers,
    fit_confidence,
    fit_matching_weights,
    validation_figures,
    with_heading_doubt,
)
from lalaloc_core.evaluate.runs.evaluation import run_evaluation
from lalaloc_core.evaluate.runs.factories import build_dataset, describe_model
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.files import atomic_write
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Scene
from lalaloc_core.learn.data.synthetic import training_plans
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import Cohort, cohort_of, layouts_at
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.render.sampling import PoseSet

_LOG = logging.getLogger(__name__)
# Views of each camera, at equal angles.
_VIEWS_PER_CAMERA = 2
# Ratio of calibration homes to homes that are also asked for in plans without openings.
_PER_UNOPENED_HOME = 4
# Homes of the cohort.
_COHORT_HOMES = 60


@dataclass(frozen=True, kw_only=True)
class CalibrationConfig:
    """Settings of a calibration.

    Attributes:
        views: calibrate the encoder of views instead of that of spheres.
        keep_evidence: keep the bundle's matching weights and fit the confidence; with a given `tail` or
            `openings_weight`, keep the others, and fit the doubt of headings.
        openings_weight: weight of openings relative to walls; None fits it.
        tail: scale of the errors of walls over the predicted one; None keeps the bundle's.
        out: folder of the predictions, from which an interrupted calibration continues; None keeps none.
    """

    homes: int = 100
    seed: int = 0
    textures: Path | None = None
    views: bool = False
    keep_evidence: bool = False
    openings_weight: float | None = None
    tail: float | None = None
    out: Path | None = None


def calibrate(folder: Path, config: CalibrationConfig) -> Bundle:
    """Calibrate the bundle in a folder and return it."""
    bundle, views = Bundle.open(folder), config.views
    if views and bundle.manifest.view is None:
        raise InvalidInputError(f"model '{bundle.manifest.name}' has no encoder of views; leave out --views")
    if not views:
        plans = training_plans(_COHORT_HOMES, config.seed)
        bundle = store_cohort(bundle, cohort_of(plans, bundle.manifest.profile_columns, config.seed))
    queries = _Queries(folder, config)
    # Weights first: confidence is fitted on predictions made with them.
    weights = bundle.manifest.evidence_for(view=views)
    weights = replace(weights, tail=config.tail or weights.tail)
    if not config.keep_evidence:
        appearance = bundle.manifest.evidence.appearance
        encoders = PhotographEncoder(bundle, threads=1)
        if encoders.spheres.predicts_structure and not views:
            appearance = queries.appearance(encoders)
        bundle = store_matching_weights(bundle, replace(weights, appearance=appearance), views=views)
        unweighed = [query for known in (True, False) for query in queries.localise("unweighed", known)]
        weights = fit_matching_weights(unweighed, MatchingWeights(appearance=appearance, tail=weights.tail))
    if config.openings_weight is not None:
        weights = replace(weights, openings=config.openings_weight)
    bundle = store_matching_weights(bundle, weights, views=views)
    _LOG.info("matching weights: %s", asdict(weights))
    known, searched = queries.answers(known=True), queries.answers(known=False)
    if not (config.keep_evidence and config.openings_weight is None and config.tail is None):
        bundle = store_matching_weights(bundle, with_heading_doubt(weights, known, searched), views=views)
    description = (
        f"{len(known.own)} {'views' if views else 'spheres'} of {config.homes} generated validation homes, all "
        "furniture levels; confidence besides on the same disturbed, and on "
        f"{len(known.mismatched)} photographs of others or of no room"
    )
    return store_confidence(bundle, known, searched, description, views=views)


class _Queries:
    """Photographs of generated homes, localised with the bundle as it is stored at that moment."""

    def __init__(self, bundle: Path, config: CalibrationConfig) -> None:
        self._bundle, self._config = bundle, config
        textures = None if config.textures is None else str(config.textures)
        own = {"homes": config.homes, "seed": config.seed, "furniture": None, "textures": textures}
        # Arguments of the generator by the name of the photographs.
        self._generated: dict[str, dict[str, Any]] = {
            "own": own,
            "unweighed": own,
            "disturbed": own | {"generator": "disturbed"},
            "unopened": own | {"generator": "unopened", "homes": max(config.homes // _PER_UNOPENED_HOME, 1)},
            "mismatched": own | {"generator": "mismatched"},
            "foreign": own | {"generator": "foreign"},
        }

    def localise(self, name: str, known: bool) -> list[Prediction]:
        with tempfile.TemporaryDirectory(prefix="lalaloc-run-") as scratch:
            folder = (self._config.out or Path(scratch)) / f"{name}-{'known' if known else 'searched'}"
            return run_evaluation(RunFolder(folder), self._run_info(name, known))

    def answers(self, *, known: bool) -> Answers:
        """Return the predictions to fit the confidence on."""
        own, disturbed, unopened, mismatched, foreign = (
            self.localise(name, known) for name in ("own", "disturbed", "unopened", "mismatched", "foreign")
        )
        return Answers(own=own, disturbed=[*disturbed, *unopened], mismatched=[*mismatched, *foreign])

    def appearance(self, encoders: PhotographEncoder) -> tuple[tuple[float, ...], ...]:
        datasets = [build_dataset(self._run_info(name, True)) for name in ("own", "disturbed")]
        return fit_appearance(encoders, (data.load(name) for data in datasets for name in data.scenes("validation")))

    def _run_info(self, name: str, known: bool) -> RunInfo:
        return RunInfo(
            label=f"calibration, {name} homes, heading {'known' if known else 'searched'}",
            dataset="generated homes",
            split="validation",
            generated=self._generated[name],
            views={"per_camera": _VIEWS_PER_CAMERA} if self._config.views else None,
            heading_known=known,
            bundle=str(self._bundle),
            model=describe_model(self._bundle),
        )


def store_cohort(bundle: Bundle, cohort: Cohort) -> Bundle:
    """Store the cohort in the bundle."""
    atomic_write(bundle.folder / COHORT, cohort.to_bytes())
    return write_manifest(bundle.folder, bundle.manifest)


def store_matching_weights(bundle: Bundle, weights: MatchingWeights, *, views: bool = False) -> Bundle:
    """Store fitted weights of spheres or of views in the bundle's manifest."""
    return write_manifest(bundle.folder, _with_calibration(bundle.manifest, views, evidence=weights))


def store_confidence(
    bundle: Bundle, known: Answers, searched: Answers, description: str, *, views: bool = False
) -> Bundle:
    """Fit the confidence of spheres or of views, and store it with the validation figures in the manifest."""
    prefix = "view_validation" if views else "validation"
    metrics = {**bundle.manifest.metrics, **validation_figures(prefix, description, known, searched)}
    manifest = _with_calibration(bundle.manifest, views, confidence=fit_confidence(known, searched))
    return write_manifest(bundle.folder, replace(manifest, metrics=metrics))


def _with_calibration(manifest: Manifest, views: bool, **fitted: Any) -> Manifest:
    if not views:
        return replace(manifest, **fitted)
    assert manifest.view is not None
    return replace(manifest, view=replace(manifest.view, **fitted))


# Shares of homes with each convention, the sill of floor-length windows (m), and the width of doorways (m).
_PATIO_DOORS, _DOORWAYS, _GAPS = 0.5, 0.5, 0.25
_MAX_SILL_M, _MAX_DOORWAY_M = 0.1, 1.5
# Prior by rows of `conventions.OPENING_CLASSES`: wall, door, window, passage.
_PRIOR = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.6, 0.2, 0.2], [0.0, 0.1, 0.9, 0.0], [0.15, 0.15, 0.0, 0.7]])
_PRIOR_SHARE = 0.5
_ITERATIONS, _DECIMALS = 200, 3


def fit_appearance(encoders: PhotographEncoder, scenes: Iterable[Scene]) -> tuple[tuple[float, ...], ...]:
    """Return `MatchingWeights.appearance`, fitted on the photographs of scenes in their redrawn plans."""
    likelihoods, classes = [], []
    for scene in scenes:
        plan = redrawn(scene.plan, zlib.crc32(scene.name.encode()))
        for camera in scene.cameras:
            for photograph in camera.photographs.values():
                image = photograph.image(encoders.manifest.image_height, encoders.manifest.image_width)
                query = encoders.spheres.query(image, camera.heading, CameraHeight(camera.camera_height_m, 0.0))
                if query.openings is None:
                    raise BundleError(f"model '{encoders.manifest.name}' predicts no openings; use another bundle")
                poses = PoseSet(camera.position_m[None], np.array([camera.room_index]))
                columns = encoders.manifest.profile_columns
                kind = layouts_at(plan, poses, np.array([query.frame_heading]), columns).kind
                likelihoods.append(np.exp(query.openings.log_probability[0]) / query.openings.prior)
                classes.append(np.zeros(columns, np.uint8) if kind is None else kind[0])
    found = mixtures(np.concatenate(likelihoods), np.concatenate(classes))
    rounded = np.round(_PRIOR_SHARE * _PRIOR + (1.0 - _PRIOR_SHARE) * found, _DECIMALS)
    return tuple(map(tuple, (rounded / rounded.sum(axis=1, keepdims=True)).tolist()))


def mixtures(likelihood: Float[np.ndarray, "n c"], drawn: Integer[np.ndarray, "n"]) -> Float[np.ndarray, "c c"]:
    """Return for every class drawn the most likely shares of the classes seen; absent classes look like themselves."""
    classes = len(OPENING_CLASSES)
    shares = np.eye(classes)
    for code in np.unique(drawn):
        own, share = likelihood[drawn == code], np.full(classes, 1.0 / classes)
        for _ in range(_ITERATIONS):
            part = own * share
            share = (part / part.sum(axis=1, keepdims=True)).mean(axis=0)
        shares[code] = share
    return shares


def redrawn(plan: FloorPlan, seed: int) -> FloorPlan:
    """Return a plan with its openings drawn by other conventions, chosen by the seed."""
    patio_doors, doorways, gaps = np.random.default_rng(seed).random(3) < (_PATIO_DOORS, _DOORWAYS, _GAPS)
    document = plan.to_dict()
    for opening in document.get("openings", []):
        kind, width_m = opening["kind"], float(np.hypot(*np.subtract(*opening["line"])))
        if kind == "window" and patio_doors and opening.get("sill_m", np.inf) <= _MAX_SILL_M:
            opening["kind"] = "door"
        elif kind == "door" and gaps:
            opening["kind"] = "passage"
        elif kind == "passage" and doorways and width_m <= _MAX_DOORWAY_M:
            opening["kind"] = "door"
    return FloorPlan.from_dict(document)
