"""The worst queries of a run: a list, and statistics of their common features, in FOLDER/worst.json."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from lalaloc_core.errors import BundleError, DatasetError, LaLaLocError, RunError
from lalaloc_core.evaluate.methods.lalaloc import cost_of_pose, encode, read_image
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.runs.evaluation import question_of
from lalaloc_core.evaluate.runs.factories import build_dataset, require_bundle
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.score import ALIGNMENT_LIMIT_M, Outcome, choose_worst, outcomes, position_errors_m
from lalaloc_core.files import atomic_write
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Camera, Scene
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import Query
from lalaloc_core.render.sampling import pose_grid
from lalaloc_core.render.sweep import profiles_at

SUMMARY_FILE = "worst.json"
# Distance to a query's place in its run beyond which the data set has changed.
_SAME_PLACE_M = 1e-3


@dataclass(frozen=True, kw_only=True)
class WorstQuery:
    """One of the worst queries.

    Attributes:
        first_error_m: position error after the first stage.
        symmetric: whether the pose fits the mirrored room; see `is_symmetric`.
        symmetric_by_chance: probability of that for a random wrong position in the room.
        true_cost, found_cost: matching cost of the true and of the found pose; None if the model predicts no wall
            profile. The search missed a true pose with a lower cost; no search finds one with a higher cost.
        distance_bias: median relative error of the predicted distance of walls; negative for too near.
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
    symmetric: bool
    symmetric_by_chance: float
    true_cost: float | None = None
    found_cost: float | None = None
    distance_bias: float | None = None


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
    errors_m = position_errors_m(chosen)
    answered = errors_m[~np.isnan(errors_m)]
    misaligned = [query for query in examined if query.outcome is Outcome.WRONG_ALIGNMENT]
    pairs = [(query.true_cost, query.found_cost) for query in examined]
    costs = [(true, found) for true, found in pairs if true is not None and found is not None]
    biases = [query.distance_bias for query in examined if query.distance_bias is not None]
    kinds = outcomes(chosen)
    first = next((name for prediction in predictions for name in prediction.stages), None)
    started_m = position_errors_m(chosen, first) if first is not None else np.full(len(chosen), np.nan)
    return {
        "queries": len(predictions),
        "chosen": len(chosen),
        "error_m": {"least": float(answered.min()), "most": float(answered.max())} if len(answered) else None,
        "outcomes": {kind.value: kinds.count(kind) for kind in Outcome},
        "mirrored": {
            "among_wrong_alignment": sum(query.symmetric for query in misaligned),
            "expected_by_chance": sum(query.symmetric_by_chance for query in misaligned),
        },
        "lost_after_first_stage": int(((started_m < 1.0) & ~(errors_m < 1.0)).sum()),
        "true_pose_fits": {"compared": len(costs), "better_than_found": sum(true < found for true, found in costs)},
        "median_distance_bias": float(np.median(np.abs(biases))) if biases else None,
        "mean_confidence": {"worst": _mean_confidence(chosen), "all": _mean_confidence(predictions)},
        "facts": _lifts(predictions, chosen),
    }


def _lifts(predictions: Sequence[Prediction], chosen: Sequence[Prediction]) -> dict[str, dict[str, float]]:
    """Return, by fact, its share among the worst and among all queries, and their ratio, largest first."""
    lifts = {}
    for fact in sorted({fact for prediction in predictions for fact in prediction.facts}):
        worst, total = (sum(fact in query.facts for query in part) / len(part) for part in (chosen, predictions))
        lifts[fact] = {"worst": worst, "all": total, "lift": worst / total}
    return dict(sorted(lifts.items(), key=lambda item: -item[1]["lift"]))


def _mean_confidence(predictions: Sequence[Prediction]) -> float | None:
    known = [prediction.confidence for prediction in predictions if prediction.confidence is not None]
    return float(np.mean(known)) if known else None


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
            fit["distance_bias"] = _distance_bias(query, scene, prediction.truth)
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
            symmetric=is_symmetric(scene.plan, prediction),
            symmetric_by_chance=symmetric_by_chance(scene.plan, prediction),
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


def is_symmetric(plan: FloorPlan, prediction: Prediction) -> bool:
    """Return whether a misaligned pose in the right room fits the mirrored room, see `_symmetric_area`."""
    pose = prediction.final_pose
    if pose is None or outcomes([prediction]) != [Outcome.WRONG_ALIGNMENT]:
        return False
    return shapely.Point(pose.x_m, pose.y_m).within(_symmetric_area(plan, prediction))


def symmetric_by_chance(plan: FloorPlan, prediction: Prediction) -> float:
    """Return the share of the wrong positions in the true room for which `is_symmetric` holds."""
    truth = prediction.truth
    room = plan.rooms[truth.room_index].shape
    wrong = room.difference(shapely.Point(truth.x_m, truth.y_m).buffer(ALIGNMENT_LIMIT_M))
    return wrong.intersection(_symmetric_area(plan, prediction)).area / wrong.area if wrong.area > 0.0 else 0.0


def _symmetric_area(plan: FloorPlan, prediction: Prediction) -> shapely.Geometry:
    """Return the surroundings of the true position mirrored along either axis of its room's box, and turned by 180°."""
    truth = prediction.truth
    left, bottom, right, top = plan.rooms[truth.room_index].shape.bounds
    across, along = left + right - truth.x_m, bottom + top - truth.y_m
    places = [(across, truth.y_m), (truth.x_m, along), (across, along)]
    return shapely.union_all(shapely.points(places)).buffer(ALIGNMENT_LIMIT_M)


def _distance_bias(query: Query, scene: Scene, truth: Pose) -> float:
    """Return the median over azimuths of the relative error of the predicted distance."""
    assert query.profile is not None
    log_m = query.profile.log_m[0]
    # In the frame of the query's first hypothesis.
    position_m, room, heading = truth.position_m[None], np.array([truth.room_index]), truth.heading - query.roll[0]
    (true_m,) = profiles_at(scene.plan, position_m, room, np.array([heading]), len(log_m))
    return float(np.expm1(np.median(log_m - np.log(true_m))))
