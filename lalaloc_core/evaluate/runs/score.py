"""Scores of predictions, the paper's metrics (section 5) each with a 95 % interval, and kinds of failures.

A query without an answer is a miss in every share and has an infinite error in every median. The bootstrap resamples
scenes, not queries, because queries of one scene are correlated. Intervals of shares are at least as wide as Wilson's.
"""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import binomtest

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.runs.predictions import SCORES_FILE, Prediction, RunFolder, without_infinity
from lalaloc_core.files import atomic_write

_RESAMPLES = 1000
_COVERAGE = 0.95
_BINS = 10
# Fewer queries say too little for an interval to be printed.
MIN_QUERIES = 20


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Value and its 95 % interval; infinite if half of the queries have no answer."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class StageScores:
    """Accuracy of the poses after one stage: shares from 0 to 1, medians over all queries."""

    median_cm: Estimate
    within_1cm: Estimate
    within_5cm: Estimate
    within_10cm: Estimate
    within_50cm: Estimate
    within_1m: Estimate
    within_1m_30deg: Estimate
    correct_room: Estimate
    median_heading_error_deg: Estimate
    heading_within_2deg: Estimate


@dataclass(frozen=True, kw_only=True)
class ReliabilityBin:
    """Queries with a confidence in [low, high): mean confidence, and share within 1 m."""

    low: float
    high: float
    count: int
    confidence: float
    frequency: float


@dataclass(frozen=True, kw_only=True)
class SliceScores:
    """Accuracy on the `n` queries with one fact; a query counts for each of its facts."""

    n: int
    within_1m: Estimate
    within_10cm: Estimate
    median_cm: Estimate


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores of one run.

    Attributes:
        layout_recall, pose_recall: Layout R@1 and Pose R@1; None for methods without retrieval.
        stages: accuracy by stage, in order.
        calibration_error: expected calibration error of "within 1 m"; None without confidences.
        room_calibration_error: the same of the right room; None outside albums.
        clicks_per_album: mean number of corrections until all rooms are right; None outside albums.
        median_ms, mean_ms: duration by stage, over the queries that reached it.
        slices: accuracy by fact (`Prediction.facts`), the smallest share within 1 m first.
    """

    n: int
    unanswered: int
    layout_recall: Estimate | None
    pose_recall: Estimate | None
    stages: dict[str, StageScores]
    final: StageScores
    calibration_error: float | None = None
    reliability: tuple[ReliabilityBin, ...] = ()
    room_calibration_error: float | None = None
    clicks_per_album: float | None = None
    median_ms: dict[str, float] = field(default_factory=dict)
    mean_ms: dict[str, float] = field(default_factory=dict)
    slices: dict[str, SliceScores] = field(default_factory=dict)


def score(predictions: Sequence[Prediction], seed: int = 0) -> Scores:
    """Score the predictions of one run; `seed` is that of the bootstrap."""
    if not predictions:
        raise InvalidInputError("there are no predictions to score; run `lalaloc lab evaluate` first")
    bootstrap = _Bootstrap([prediction.scene for prediction in predictions], np.random.default_rng(seed))
    names = list(dict.fromkeys(name for prediction in predictions for name in prediction.stages))
    final = position_errors_m(predictions)
    confident = [p for p in predictions if p.confidence is not None]
    reliability, calibration_error = (), None
    if confident:
        confidence = np.array([prediction.confidence for prediction in confident], dtype=float)
        is_correct = position_errors_m(confident) < 1.0
        reliability = reliability_bins(confidence, is_correct)
        calibration_error = expected_calibration_error(confidence, is_correct)
    clicks = {p.scene: p.clicks for p in predictions if p.clicks is not None}
    return Scores(
        n=len(predictions),
        unanswered=int(np.isnan(final).sum()),
        layout_recall=_recall(bootstrap, [p.layout_hit for p in predictions]),
        pose_recall=_recall(bootstrap, [p.pose_hit for p in predictions]),
        stages={name: _stage_scores(bootstrap, predictions, name) for name in names},
        final=_stage_scores(bootstrap, predictions, None),
        calibration_error=calibration_error,
        reliability=reliability,
        room_calibration_error=_room_calibration_error(predictions),
        clicks_per_album=float(np.mean(list(clicks.values()))) if clicks else None,
        median_ms=_timings(predictions, np.median),
        mean_ms=_timings(predictions, np.mean),
        slices=_slices(bootstrap, predictions),
    )


def score_run(folder: RunFolder) -> dict[str, Any]:
    """Score a run, write the scores to its folder, and return them as plain data with null for infinite values."""
    info = folder.read_info()
    scores = without_infinity(dataclasses.asdict(score(folder.read_predictions())))
    report = {"label": info.label, "dataset": info.dataset, "skipped": len(info.skipped), **scores}
    atomic_write(folder.path / SCORES_FILE, json.dumps(report, indent=2, allow_nan=False) + "\n")
    return report


def position_errors_m(predictions: Sequence[Prediction], stage: str | None = None) -> Float[np.ndarray, "n"]:
    """Return the position errors (m) of the poses after a stage (None: the final poses); NaN without a pose."""
    return _errors(predictions, stage, lambda pose, truth: np.hypot(pose.x_m - truth.x_m, pose.y_m - truth.y_m))


def heading_errors_deg(predictions: Sequence[Prediction], stage: str | None = None) -> Float[np.ndarray, "n"]:
    """Return the absolute heading errors (degrees) of the poses after a stage, as `position_errors_m`."""
    return _errors(predictions, stage, lambda pose, truth: abs(np.degrees(wrap_angle(pose.heading - truth.heading))))


def _errors(
    predictions: Sequence[Prediction], stage: str | None, error: Callable[[Pose, Pose], float]
) -> Float[np.ndarray, "n"]:
    poses = [(prediction.pose_after(stage), prediction.truth) for prediction in predictions]
    return np.array([np.nan if pose is None else error(pose, truth) for pose, truth in poses], dtype=float)


def reliability_bins(confidence: Float[np.ndarray, "n"], correct: Bool[np.ndarray, "n"]) -> tuple[ReliabilityBin, ...]:
    """Return the non-empty bins of the reliability diagram, equally wide in confidence."""
    index: Int[np.ndarray, "n"] = np.minimum((confidence * _BINS).astype(int), _BINS - 1)
    return tuple(
        ReliabilityBin(
            low=b / _BINS,
            high=(b + 1) / _BINS,
            count=int((index == b).sum()),
            confidence=float(confidence[index == b].mean()),
            frequency=float(correct[index == b].mean()),
        )
        for b in range(_BINS)
        if (index == b).any()
    )


def expected_calibration_error(confidence: Float[np.ndarray, "n"], correct: Bool[np.ndarray, "n"]) -> float:
    """Return the mean gap between confidence and frequency over the bins, weighted by queries."""
    diagram = reliability_bins(confidence, correct)
    return sum(part.count * abs(part.confidence - part.frequency) for part in diagram) / len(confidence)


class _Bootstrap:
    """Resamples of scenes as weights of queries; all scores of a run use the same resamples."""

    def __init__(self, scenes: Sequence[str], rng: np.random.Generator) -> None:
        names, member = np.unique(np.array(scenes), return_inverse=True)
        shares = np.full(len(names), 1.0 / len(names))
        self._weights: Float[np.ndarray, "r n"] = rng.multinomial(len(names), shares, _RESAMPLES)[:, member].astype(
            float
        )

    def among(self, chosen: Bool[np.ndarray, "n"]) -> _Bootstrap:
        """Restrict the resamples to some queries; resamples without any of them are dropped."""
        part = copy.copy(self)
        weights = self._weights[:, chosen]
        part._weights = weights[weights.any(axis=1)]
        return part

    def share(self, holds: Bool[np.ndarray, "n"]) -> Estimate:
        """Return the share of queries for which something holds.

        Its interval covers those of the bootstrap and of Wilson (Probable Inference, 1927): resampling two hits never
        gives a miss, and Wilson's interval takes queries of one scene for independent.
        """
        total = self._weights.sum(axis=1)
        resampled = (self._weights @ holds.astype(float))[total > 0.0] / total[total > 0.0]
        found = self._estimate(float(holds.mean()), resampled)
        wilson = binomtest(int(holds.sum()), len(holds)).proportion_ci(_COVERAGE, method="wilson")
        return replace(found, low=min(found.low, float(wilson.low)), high=max(found.high, float(wilson.high)))

    def median(self, values: Float[np.ndarray, "n"]) -> Estimate:
        order = np.argsort(values, kind="stable")
        cumulated = np.cumsum(self._weights[:, order], axis=1)
        half = 0.5 * cumulated[:, -1:]
        # The lower and upper median of an even number of queries, which np.median averages.
        lower = values[order][(cumulated >= half).argmax(axis=1)]
        upper = values[order][(cumulated > half).argmax(axis=1)]
        return self._estimate(float(np.median(values)), 0.5 * (lower + upper))

    @staticmethod
    def _estimate(value: float, resampled: Float[np.ndarray, "r"]) -> Estimate:
        tail = 0.5 * (1.0 - _COVERAGE)
        # Interpolation between a number and infinity is undefined.
        low, high = np.quantile(resampled, [tail, 1.0 - tail], method="nearest")
        return Estimate(value=value, low=float(low), high=float(high))


def _stage_scores(bootstrap: _Bootstrap, predictions: Sequence[Prediction], stage: str | None) -> StageScores:
    error = _infinite(position_errors_m(predictions, stage))
    heading = _infinite(heading_errors_deg(predictions, stage))
    return StageScores(
        median_cm=bootstrap.median(100.0 * error),
        within_1cm=bootstrap.share(error < 0.01),
        within_5cm=bootstrap.share(error < 0.05),
        within_10cm=bootstrap.share(error < 0.10),
        within_50cm=bootstrap.share(error < 0.50),
        within_1m=bootstrap.share(error < 1.0),
        within_1m_30deg=bootstrap.share((error < 1.0) & (heading < 30.0)),
        correct_room=bootstrap.share(_right_rooms(predictions, stage)),
        median_heading_error_deg=bootstrap.median(heading),
        heading_within_2deg=bootstrap.share(heading < 2.0),
    )


def _right_rooms(predictions: Sequence[Prediction], stage: str | None = None) -> Bool[np.ndarray, "n"]:
    pairs = [(prediction.pose_after(stage), prediction.truth) for prediction in predictions]
    return np.array([pose is not None and pose.room_index == truth.room_index for pose, truth in pairs])


def _room_calibration_error(predictions: Sequence[Prediction]) -> float | None:
    confidence = [p.room_confidence for p in predictions if p.room_confidence is not None]
    if len(confidence) < len(predictions):
        return None
    return expected_calibration_error(np.array(confidence), _right_rooms(predictions))


def _slices(bootstrap: _Bootstrap, predictions: Sequence[Prediction]) -> dict[str, SliceScores]:
    error = _infinite(position_errors_m(predictions))
    slices = {}
    for fact in sorted({fact for prediction in predictions for fact in prediction.facts}):
        holds = np.array([fact in prediction.facts for prediction in predictions])
        part, error_m = bootstrap.among(holds), error[holds]
        slices[fact] = SliceScores(
            n=len(error_m),
            within_1m=part.share(error_m < 1.0),
            within_10cm=part.share(error_m < 0.10),
            median_cm=part.median(100.0 * error_m),
        )
    return dict(sorted(slices.items(), key=lambda item: item[1].within_1m.value))


def _infinite(errors: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    return np.where(np.isnan(errors), np.inf, errors)


def _recall(bootstrap: _Bootstrap, hits: list[bool | None]) -> Estimate | None:
    if all(hit is None for hit in hits):
        return None
    return bootstrap.share(np.array([bool(hit) for hit in hits]))


def _timings(predictions: Sequence[Prediction], summary: Callable[[list[float]], Any]) -> dict[str, float]:
    stages = list(dict.fromkeys(name for prediction in predictions for name in prediction.timings_ms))
    return {name: float(summary([p.timings_ms[name] for p in predictions if name in p.timings_ms])) for name in stages}


# One step of the paper's grid: a larger error is beyond the grid poses around the true one.
ALIGNMENT_LIMIT_M = 0.5


class Outcome(StrEnum):
    """Outcome of a query; every query has exactly one."""

    LOCATED = "located"
    WRONG_ALIGNMENT = "wrong alignment"
    WRONG_ROOM = "wrong room"
    NO_ANSWER = "no answer"


def outcomes(predictions: Sequence[Prediction], stage: str | None = None) -> list[Outcome]:
    """Return the outcome of each query, for the final pose or the pose after a stage."""
    pairs = zip(predictions, position_errors_m(predictions, stage), strict=True)
    return [_outcome(prediction, stage, float(error_m)) for prediction, error_m in pairs]


def choose_worst(predictions: Sequence[Prediction], count: int) -> list[Prediction]:
    """Return up to `count` queries: first those without an answer, then by decreasing error."""
    errors_m = position_errors_m(predictions)
    order = np.argsort(-_infinite(errors_m), kind="stable")
    return [predictions[index] for index in order[:count]]


def _outcome(prediction: Prediction, stage: str | None, error_m: float) -> Outcome:
    pose = prediction.pose_after(stage)
    if pose is None:
        return Outcome.NO_ANSWER
    if pose.room_index != prediction.truth.room_index:
        return Outcome.WRONG_ROOM
    return Outcome.LOCATED if error_m <= ALIGNMENT_LIMIT_M else Outcome.WRONG_ALIGNMENT
