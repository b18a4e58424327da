"""The worst queries of a run: a list, and statistics of their common features, in FOLDER/worst.json."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lalaloc_core.errors import BundleError, DatasetError, LaLaLocError, RunError
from lalaloc_core.evaluate.methods.lalaloc import cost_of_pose, encode, read_image
from lalaloc_core.evaluate.runs.evaluation import question_of
from lalaloc_core.evaluate.runs.factories import build_dataset, require_bundle
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.score import Outcome, choose_worst, outcomes, position_errors_m
from lalaloc_core.files import atomic_write
from lalaloc_core.learn.data.dataset import Camera, Scene
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.render.sampling import pose_grid

SUMMARY_FILE = "worst.json"
# Distance to a query's place in its run beyond which the data set has changed.
_SAME_PLACE_M = 1e-3


@dataclass(frozen=True, kw_only=True)
class WorstQuery:
    """One of the worst queries.

    Attributes:
        first_error_m: position error after the first stage.
        true_cost, found_cost: matching cost of the true and of the found pose; None if the model predicts no wall
            profile. The search missed a true pose with a lower cost; no search finds one with a higher cost.
    """

    scene: str
    camera: str
    room: str
    found_room: str | None
    outcome: Outcome
    error_m: float | None
    first_error_m: float | None
    confidence: float | None
    facts: tuple[str, ...]
    true_cost: float | None = None
    found_cost: float | None = None


def write_worst(run: Path, out: Path, count: int) -> dict[str, Any]:
    """List the worst queries of a run in `SUMMARY_FILE`, unanswered ones first, and return their common features."""
    folder = RunFolder(run)
    info, predictions = folder.read_info(), folder.read_predictions()
    if not predictions:
        raise RunError(f"the run at '{run}' has no predictions; run `lalaloc lab evaluate` first")
    chosen, reopened = choose_worst(predictions, count), _ReopenedRun(info)
    queries, left_out = list[WorstQuery](), list[str]()
    for prediction in chosen:
        try:
            queries.append(reopened.analyse(prediction))
        except (LaLaLocError, OSError) as error:
            left_out.append(str(error))
    summary = {"left_out": left_out, **summarise(predictions, chosen, queries)}
    content = {**summary, "worst": [dataclasses.asdict(query) for query in queries]}
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / SUMMARY_FILE, json.dumps(content, indent=2, allow_nan=False) + "\n")
    return summary


def summarise(
    predictions: Sequence[Prediction], chosen: Sequence[Prediction], examined: Sequence[WorstQuery]
) -> dict[str, Any]:
    """Return the common features of the worst queries as plain data."""
    pairs = [(query.true_cost, query.found_cost) for query in examined]
    costs = [(true, found) for true, found in pairs if true is not None and found is not None]
    kinds = outcomes(chosen)
    return {
        "queries": len(predictions),
        "chosen": len(chosen),
        "outcomes": {kind.value: kinds.count(kind) for kind in Outcome},
        "true_pose_fits": {"compared": len(costs), "better_than_found": sum(true < found for true, found in costs)},
    }


class _ReopenedRun:
    """Data set and model of a finished run; changed data is refused."""

    def __init__(self, info: RunInfo) -> None:
        self._info, self._dataset, self._encoders = info, build_dataset(info), None
        if info.bundle is not None:
            bundle = require_bundle(info)
            if info.model is not None and info.model.get("sha256") not in (None, bundle.sha256):
                raise BundleError(
                    f"'{info.bundle}' holds another model than the run used: its SHA-256 is {bundle.sha256}"
                )
            encoders = PhotographEncoder(bundle)
            self._encoders = encoders if encoders.predicts_profile else None

    def analyse(self, prediction: Prediction) -> WorstQuery:
        scene, camera = self._find_camera(prediction)
        found = prediction.final_pose
        fit: dict[str, float | None] = {}
        if self._encoders is not None:
            question = question_of(scene, camera, self._info, pose_grid(scene.plan, self._info.grid_step_m))
            query = encode(self._encoders, question, read_image(self._encoders, question))
            weights = self._encoders.manifest.evidence_for(view=query.is_view)
            fit["true_cost"] = cost_of_pose(query, scene.plan, prediction.truth, weights)
            fit["found_cost"] = None if found is None else cost_of_pose(query, scene.plan, found, weights)
        (error_m,) = position_errors_m([prediction]).tolist()
        (first_m,) = position_errors_m([prediction], next(iter(prediction.stages), None)).tolist()
        (outcome,) = outcomes([prediction])
        return WorstQuery(
            scene=prediction.scene,
            camera=prediction.camera,
            room=prediction.room,
            found_room=None if found is None else scene.plan.rooms[found.room_index].name,
            outcome=outcome,
            error_m=None if found is None else error_m,
            first_error_m=None if found is None else first_m,
            confidence=prediction.confidence,
            facts=prediction.facts,
            **fit,
        )

    def _find_camera(self, prediction: Prediction) -> tuple[Scene, Camera]:
        scene, truth = self._dataset.load(prediction.scene, []), prediction.truth
        camera = next((item for item in scene.cameras if item.name == prediction.camera), None)
        if camera is None:
            raise DatasetError(f"camera '{prediction.camera}' is missing: the data set has changed", scene=scene.name)
        moved_m = float(np.hypot(*(camera.position_m - truth.position_m)))
        if moved_m > _SAME_PLACE_M or camera.room_index != truth.room_index:
            raise DatasetError(
                f"camera '{camera.name}' is {moved_m:.3f} m from its position in the run: the data set has changed",
                scene=scene.name,
            )
        return scene, camera
