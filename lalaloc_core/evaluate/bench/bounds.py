"""Possible gains of a better encoder: accuracy with the true layout in place of predictions, and causes of what misses.

Walls have independent errors of log distance, openings and ceiling none. Whatever is missed with exact predictions, no
encoder can find: other evidence must.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.evaluate.bench.measured import Setting
from lalaloc_core.evaluate.calibrate.measured_errors import photograph_of
from lalaloc_core.evaluate.methods.lalaloc import cost_of_pose, layouts_of_pose
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data import AnnotatedPhotographs, Scene, ViewScenes
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.localise.belief import RIGHT_WITHIN_M
from lalaloc_core.localise.encode.photograph_encoder import patch_size
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight, PredictedCeiling, PredictedProfile, Query, rolled

# Fields of view (degrees) of views, and number and field of the views of a turn.
_FIELDS_DEG, _TURN = (65.0, 80.0, 106.0), (6, 67.0)
# Fields of view (degrees) of annotated photographs, and views of each.
_ANNOTATED_DEG, _ANNOTATED_VIEWS = (80.0, 106.0), 4
# What is predicted, what is true: errors (log) of walls, None for those of the encoder, and whether openings are true.
_ROWS = {
    "predicted": (None, False),
    "walls_to_8_percent": (0.08, False),
    "openings": (None, True),
    "walls_to_8_percent_and_openings": (0.08, True),
    "all": (0.01, True),
}
# Probability of a true class, and least scale of a true ceiling's log height.
_SURE, _CEILING_SCALE = 0.85, 0.02
# Largest difference of costs of places that fit equally well.
_EQUAL = 0.02


class Asked(NamedTuple):
    """A photograph or a turn with the pose of its first camera."""

    plan: FloorPlan
    pose: Pose
    query: Query


def bench_bounds(setting: Setting) -> dict[str, Any]:
    """Measure spheres, views and turns of furnished test homes, heading unknown, with true walls and openings.

    Each row has the share within 1 m, and of the others the shares by cause: another place fits equally well, the true
    place costs more, or it costs less and the search lost it. Of annotated photographs, also views of each, in the
    first gallery of its photograph.
    """
    model = setting.model
    homes = GeneratedScenes(homes=setting.homes, furniture="full", textures=setting.textures)
    views = {f"view_{field:g}": (1, field) for field in _FIELDS_DEG}
    figures: dict[str, Any] = {}
    for kind, (count, field_deg) in {"sphere": (None, _FIELDS_DEG[0]), **views, "turn": _TURN}.items():
        scenes = ViewScenes(homes, field_deg, count or 1)
        figures[kind] = _shares(model, scenes, scenes.scenes("test"), count)
    if setting.annotated is not None:
        photographs = AnnotatedPhotographs(setting.annotated)
        galleries = [key.scene for key in photographs.keys(galleries=1) if not key.outline]
        for field_deg in _ANNOTATED_DEG:
            scenes = ViewScenes(photographs, field_deg, _ANNOTATED_VIEWS)
            figures[f"annotated_{field_deg:g}"] = _shares(model, scenes, galleries, 1)
    return figures


def _shares(model: LocalModel, scenes: ViewScenes, names: Iterable[str], count: int | None) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    outcomes: dict[str, Counter[str]] = {name: Counter() for name in _ROWS}
    for asked in (asked for name in names for asked in _asked(model, scenes.load(name), count)):
        grid = model.grid(asked.plan, asked.query.camera_height.height_m)
        for name, (noise, opened) in _ROWS.items():
            query = with_truth(asked, noise=noise, openings=opened, rng=rng)
            outcomes[name][_outcome(model, asked, grid, query)] += 1
    return {
        name: {"n": found.total(), **{cause: count / found.total() for cause, count in sorted(found.items())}}
        for name, found in outcomes.items()
    }


def _asked(model: LocalModel, scene: Scene, count: int | None) -> Iterator[Asked]:
    """Yield the queries of a scene's views, so many together; None for the spheres that they are cut from."""
    manifest, encoder = model.bundle.manifest, model.encoder
    for first in range(0, len(scene.cameras), count or 1):
        cameras = scene.cameras[first : first + (count or 1)]
        camera, height = cameras[0], CameraHeight(cameras[0].camera_height_m)
        if count is None:
            sphere = photograph_of(camera).sphere.photograph.image(manifest.image_height, manifest.image_width)
            query = encoder.spheres.query(sphere, None, height)
        else:
            opened = [photograph_of(view).open(patch_size(manifest)) for view in cameras]
            turns = [view.heading - camera.heading for view in cameras]
            query = encoder.query(opened[0], None, height, others=list(zip(opened[1:], turns[1:], strict=True)))
        yield Asked(scene.plan, Pose.at(camera.position_m, camera.room_index, camera.heading), query)


def with_truth(asked: Asked, *, noise: float | None, openings: bool, rng: np.random.Generator) -> Query:
    """Return the query with the layout at its true pose in place of the encoder's predictions.

    `noise` is the standard deviation of independent errors of the walls' log distances; None leaves the predicted
    walls. `openings` replaces openings and ceiling.
    """
    plan, pose, query = asked
    assert query.profile is not None
    columns = query.profile.log_m.shape[1]
    layouts = layouts_of_pose(query, plan, pose)
    shifts = np.round((query.roll - query.roll[0]) / TWO_PI * columns).astype(int)
    seen = query.profile.seen[0]
    if noise is not None:
        log_m = layouts.log_profile[0] + rng.normal(0.0, noise, columns)
        scale = np.where(seen, np.log(noise), np.inf)
        query = replace(query, profile=PredictedProfile(log_m[None], scale[None]).moved(shifts))
    if openings and query.openings is not None and layouts.kind is not None:
        classes = len(query.openings.prior)
        true = np.where(np.arange(classes) == layouts.kind[0][:, None], _SURE, (1.0 - _SURE) / (classes - 1))
        # Azimuths that are not seen keep the frequencies, which cost nothing.
        share = np.where(seen[:, None], true, query.openings.prior)
        query = replace(query, openings=replace(query.openings, log_probability=rolled(np.log(share), shifts)))
        above_m = plan.ceiling_heights_m[pose.room_index] - query.camera_height.height_m
        query = replace(query, ceiling=PredictedCeiling(float(np.log(above_m)), float(np.log(_CEILING_SCALE))))
    return query


def _outcome(model: LocalModel, asked: Asked, grid: PoseGrid, query: Query) -> str:
    found = model.localise(asked.plan, grid, query)
    best = found.candidates[0]
    if np.linalg.norm(best.position_m - asked.pose.position_m) < RIGHT_WITHIN_M:
        return "within_1m"
    weights = model.bundle.manifest.evidence_for(view=query.is_view)
    excess = cost_of_pose(query, asked.plan, asked.pose, weights) - best.cost
    if excess < 0.0:
        return "lost_by_search"
    return "another_fits_equally" if excess < _EQUAL else "truth_costs_more"
