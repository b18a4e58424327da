"""The worst queries of a run: contact sheets, and statistics of their common features.

FOLDER/worst-01.png ...   spheres with the true, the found and the predicted layout, the worst first
FOLDER/worst.json         common features, and every query
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from lalaloc_core.conventions import TWO_PI, column_azimuths
from lalaloc_core.draw.outline import Stroke, draw_strokes, wall_line
from lalaloc_core.errors import LaLaLocError, RunError
from lalaloc_core.evaluate.methods.lalaloc import cost_of_pose, encode, read_image
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.report.pictures import (
    FOUND_COLOUR,
    PER_SHEET,
    PICTURE_HEIGHT,
    PICTURE_WIDTH,
    PREDICTED_COLOUR,
    TRUE_COLOUR,
    Thumbnail,
    draw_sheet,
    layout_lines,
)
from lalaloc_core.evaluate.report.reopening import ReopenedRun
from lalaloc_core.evaluate.report.report_tables import distance, percent
from lalaloc_core.evaluate.runs.failures import Outcome, is_symmetric, outcomes, symmetric_by_chance
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.score import position_errors_m
from lalaloc_core.files import atomic_write
from lalaloc_core.learn.data.dataset import Scene
from lalaloc_core.localise.query import Query
from lalaloc_core.render.sweep import profiles_at

SUMMARY_FILE = "worst.json"
_KEY = {TRUE_COLOUR: "true layout", FOUND_COLOUR: "found layout", PREDICTED_COLOUR: "predicted walls' floor line"}


@dataclass(frozen=True, kw_only=True)
class WorstQuery:
    """One of the worst queries.

    Attributes:
        first_error_m: position error after the first stage.
        facts: known difficulties of the photograph.
        symmetric: whether the pose fits the mirrored room; see `failures.is_symmetric`.
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

    @property
    def caption(self) -> list[str]:
        """Lines below its picture."""
        place = f"{self.scene}/{self.camera} {self.room}"
        if self.outcome is Outcome.WRONG_ROOM:
            place += f", found in {self.found_room}"
        result = "no answer" if self.error_m is None else f"{distance(self.error_m)} off"
        if self.symmetric:
            result += ", mirrored"
        if self.confidence is not None:
            result += f", confidence {percent(self.confidence)}"
        if self.true_cost is not None and self.found_cost is not None:
            result += f", cost {self.found_cost:.2f} (true {self.true_cost:.2f})"
        if self.distance_bias is not None:
            result += f", walls {100.0 * self.distance_bias:+.0f} %"
        return [place, result, " ".join(self.facts)]


def write_worst(run: Path, out: Path, count: int) -> dict[str, Any]:
    """Draw the worst queries of a run and return `SUMMARY_FILE`'s content without the queries: their common features.

    Queries without an answer come first, then by error.
    """
    folder = RunFolder(run)
    info, predictions = folder.read_info(), folder.read_predictions()
    if not predictions:
        raise RunError(f"the run at '{run}' has no predictions; run `lalaloc lab evaluate` first")
    chosen = choose_worst(predictions, count)
    analyser = _QueryAnalyser(info)
    queries: list[WorstQuery] = []
    thumbnails: list[Thumbnail] = []
    left_out: list[str] = []
    for prediction in chosen:
        try:
            query, picture = analyser.analyse(prediction)
        except (LaLaLocError, OSError) as error:
            left_out.append(str(error))
            continue
        queries.append(query)
        thumbnails.append(Thumbnail(picture, query.caption))
    out.mkdir(parents=True, exist_ok=True)
    pages = []
    for first in range(0, len(thumbnails), PER_SHEET):
        part = thumbnails[first : first + PER_SHEET]
        pages.append(f"worst-{first // PER_SHEET + 1:02d}.png")
        title = f"{info.label}: worst {first + 1} to {first + len(part)} of {len(predictions)}"
        draw_sheet(title, _KEY, part).save(out / pages[-1])
    summary = {"pages": pages, "left_out": left_out, **summarise(predictions, chosen, queries)}
    content = {**summary, "worst": [dataclasses.asdict(query) for query in queries]}
    atomic_write(out / SUMMARY_FILE, json.dumps(content, indent=2, allow_nan=False) + "\n")
    return summary


def choose_worst(predictions: Sequence[Prediction], count: int) -> list[Prediction]:
    """Return up to `count` queries: first those without an answer, then by decreasing error."""
    errors_m = position_errors_m(predictions)
    order = np.argsort(-np.where(np.isnan(errors_m), np.inf, errors_m), kind="stable")
    return [predictions[index] for index in order[:count]]


def summarise(
    predictions: Sequence[Prediction], chosen: Sequence[Prediction], examined: Sequence[WorstQuery]
) -> dict[str, Any]:
    """Return the common features of the worst queries as plain data."""
    errors_m = position_errors_m(chosen)
    answered = errors_m[~np.isnan(errors_m)]
    misaligned = [query for query in examined if query.outcome is Outcome.WRONG_ALIGNMENT]
    costs = [
        (query.true_cost, query.found_cost)
        for query in examined
        if query.true_cost is not None and query.found_cost is not None
    ]
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


def predicted_profile_m(query: Query, columns: int) -> Float[np.ndarray, "{columns}"]:
    """Return the predicted wall profile (m) in the frame of the photograph, without the query's first roll."""
    assert query.profile is not None
    known = column_azimuths(query.profile.log_m.shape[1])
    return np.exp(np.interp(column_azimuths(columns) + query.roll[0], known, query.profile.log_m[0], period=TWO_PI))


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


class _QueryAnalyser:
    """Data set and model of a run, reopened to analyse its queries."""

    def __init__(self, info: RunInfo) -> None:
        self._run = ReopenedRun(info)
        encoders = None if info.bundle is None else self._run.open_model()
        self._encoders = encoders if encoders is not None and encoders.predicts_profile else None

    def analyse(self, prediction: Prediction) -> tuple[WorstQuery, Image.Image]:
        """Return the analysis of a query, and its picture."""
        scene, camera = self._run.find_camera(prediction)
        image = self._run.photograph(scene, camera).image(PICTURE_HEIGHT, PICTURE_WIDTH)
        found, height = prediction.final_pose, camera.camera_height_m
        strokes = [_layout(scene, prediction.truth, height, TRUE_COLOUR, 3.0)]
        if found is not None:
            strokes.append(_layout(scene, found, height, FOUND_COLOUR, 1.5))
        fit: dict[str, float | None] = {}
        if self._encoders is not None:
            question = self._run.question(scene, camera)
            query = encode(self._encoders, question, read_image(self._encoders, question))
            floor = wall_line(predicted_profile_m(query, PICTURE_WIDTH), -height, PICTURE_HEIGHT)
            strokes.append(Stroke([floor], PREDICTED_COLOUR, 1.5, 2.0))
            weights = self._encoders.manifest.evidence_for(view=query.is_view)
            fit["true_cost"] = cost_of_pose(query, scene.plan, prediction.truth, weights)
            fit["found_cost"] = None if found is None else cost_of_pose(query, scene.plan, found, weights)
            fit["distance_bias"] = _distance_bias(query, scene, prediction.truth)
        errors_m = position_errors_m([prediction])
        first_m = position_errors_m([prediction], next(iter(prediction.stages), None))
        (outcome,) = outcomes([prediction])
        worst = WorstQuery(
            scene=prediction.scene,
            camera=prediction.camera,
            room=prediction.room,
            found_room=None if found is None else scene.plan.rooms[found.room_index].name,
            outcome=outcome,
            error_m=None if found is None else float(errors_m[0]),
            first_error_m=None if found is None else float(first_m[0]),
            confidence=prediction.confidence,
            facts=prediction.facts,
            symmetric=is_symmetric(scene.plan, prediction),
            symmetric_by_chance=symmetric_by_chance(scene.plan, prediction),
            **fit,
        )
        return worst, draw_strokes(image, strokes)


def _layout(scene: Scene, pose: Pose, camera_height_m: float, colour: str, width: float) -> Stroke:
    lines = layout_lines(scene.plan, pose, camera_height_m, PICTURE_HEIGHT, PICTURE_WIDTH)
    return Stroke(lines, colour, width, width + 1.0)


def _distance_bias(query: Query, scene: Scene, truth: Pose) -> float:
    """Return the median over azimuths of the relative error of the predicted distance."""
    assert query.profile is not None
    log_m = query.profile.log_m[0]
    # In the frame of the query's first hypothesis.
    position_m, room, heading = truth.position_m[None], np.array([truth.room_index]), truth.heading - query.roll[0]
    (true_m,) = profiles_at(scene.plan, position_m, room, np.array([heading]), len(log_m))
    return float(np.expm1(np.median(log_m - np.log(true_m))))
