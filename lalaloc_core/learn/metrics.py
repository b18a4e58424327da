"""Metrics of localisation and of predictions by azimuth: formulas only, so that training can validate with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from array_api_compat import array_namespace
from jaxtyping import Float, Int

from lalaloc_core.conventions import Array


def chamfer_distance(first: Float[Array, "b n 3"], second: Float[Array, "b m 3"]) -> Float[Array, "b"]:
    """Return the symmetric Chamfer distance (m): the sum of both mean nearest-neighbour distances."""
    xp = array_namespace(first, second)
    square_first = xp.sum(first * first, axis=-1)[:, :, None]
    square_second = xp.sum(second * second, axis=-1)[:, None, :]
    product = xp.matmul(first, xp.matrix_transpose(second))
    squared = square_first + square_second - 2.0 * product
    forward = xp.sqrt(xp.clip(xp.min(squared, axis=2), 0.0))
    backward = xp.sqrt(xp.clip(xp.min(squared, axis=1), 0.0))
    return xp.mean(forward, axis=1) + xp.mean(backward, axis=1)


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """Localisation accuracy over `n` queries; a query without an answer counts as a miss in every share."""

    n: int
    median_cm: float
    within_1cm: float
    within_5cm: float
    within_10cm: float
    within_1m: float

    @classmethod
    def from_errors(cls, error_m: Float[np.ndarray, "n"]) -> Accuracy:
        """Compute the accuracy of position errors (m); NaN marks a query without an answer."""
        error = np.where(np.isnan(error_m), np.inf, error_m)
        return cls(
            n=len(error),
            median_cm=float(np.median(error)) * 100.0,
            within_1cm=float(np.mean(error < 0.01)),
            within_5cm=float(np.mean(error < 0.05)),
            within_10cm=float(np.mean(error < 0.10)),
            within_1m=float(np.mean(error < 1.0)),
        )


# Quantiles of the predicted Laplace distributions at which the share of errors is reported.
QUANTILES = (0.5, 0.8, 0.9, 0.95)


@dataclass(frozen=True, eq=False, kw_only=True)
class AzimuthMeasures:
    """Measures of one photograph, against the annotated outline nearest to the prediction.

    Attributes:
        log_error: (w,) predicted minus true log distance of the wall; infinite where the prediction is NaN.
        log_scale: (w,) predicted log scale of `log_error`, of a Laplace distribution.
        confusion: azimuths by true (row) and predicted class; None if no classes were predicted.
    """

    outline: int
    log_error: Float[np.ndarray, "w"]
    log_scale: Float[np.ndarray, "w"]
    confusion: Int[np.ndarray, "c c"] | None = None

    @property
    def median_error(self) -> float:
        """Median of |Δ log d|."""
        return float(np.median(np.abs(self.log_error)))

    @property
    def error_90(self) -> float:
        """90 % quantile of |Δ log d|."""
        return float(np.quantile(np.abs(self.log_error), 0.9, method="higher"))

    @property
    def bias(self) -> float:
        """Median of Δ log d: positive where walls are predicted too far."""
        return float(np.median(self.log_error))

    @property
    def shape_error(self) -> float:
        """Median of |Δ log d| that remains when the bias is removed: the error of the walls' shape."""
        return float(np.median(np.abs(self.log_error - self.bias)))

    @property
    def scale_ratio(self) -> float:
        """Median ratio of errors to their predicted scale; 1 for a calibrated prediction."""
        return float(np.median(self._normalised) / np.log(2.0))

    @property
    def within(self) -> Float[np.ndarray, "q"]:
        """Share of the errors within each predicted quantile of `QUANTILES`; equal to it if calibrated."""
        limits = -np.log1p(-np.array(QUANTILES))
        return (self._normalised[:, None] <= limits).mean(axis=0)

    @property
    def _normalised(self) -> Float[np.ndarray, "w"]:
        return np.abs(self.log_error) * np.exp(-self.log_scale)


@dataclass(frozen=True, kw_only=True)
class ClassScores:
    """Scores of predicted classes.

    Attributes:
        balanced_accuracy: mean recall of the classes that occur.
        recall: by class; None if the class never occurs.
        precision: by class; None if the class is never predicted.
    """

    balanced_accuracy: float
    recall: Mapping[str, float | None]
    precision: Mapping[str, float | None]


@dataclass(frozen=True, kw_only=True)
class AzimuthSummary:
    """Medians over several photographs; over all azimuths, the shares within predicted quantiles, and class scores."""

    n: int
    median_error: float
    shape_error: float
    error_90: float
    scale_ratio: float
    within: Mapping[str, float]
    classes: ClassScores | None = None


def confusion_shares(measures: Sequence[AzimuthMeasures]) -> list[list[float]] | None:
    """Return by true class (rows) the shares of azimuths by the class that is predicted; None without predictions."""
    confusions = [measure.confusion for measure in measures if measure.confusion is not None]
    counts = np.sum(confusions, axis=0)
    return (counts / counts.sum(axis=1, keepdims=True).clip(1)).tolist() if confusions else None


def measure_azimuths(
    profiles_m: Sequence[Float[np.ndarray, "w"]],
    log_profile: Float[np.ndarray, "w"],
    log_scale: Float[np.ndarray, "w"],
    true_classes: Int[np.ndarray, "w"] | None = None,
    class_scores: Float[np.ndarray, "w c"] | None = None,
) -> AzimuthMeasures:
    """Compare a prediction with the true wall profiles, one per annotated outline, and with the true classes."""
    errors = [np.nan_to_num(log_profile - np.log(profile), nan=np.inf) for profile in profiles_m]
    outline = int(np.argmin([np.median(np.abs(error)) for error in errors]))
    confusion = None
    if class_scores is not None:
        assert true_classes is not None
        confusion = count_classes(true_classes, class_scores.argmax(axis=1), class_scores.shape[1])
    return AzimuthMeasures(outline=outline, log_error=errors[outline], log_scale=log_scale, confusion=confusion)


def summarise_azimuths(measures: Sequence[AzimuthMeasures], classes: Sequence[str]) -> AzimuthSummary:
    """Summarise one or more photographs with equal weight; `classes` are names by code."""
    within = np.mean([measure.within for measure in measures], axis=0)
    confusions = [measure.confusion for measure in measures if measure.confusion is not None]
    return AzimuthSummary(
        n=len(measures),
        median_error=float(np.median([measure.median_error for measure in measures])),
        shape_error=float(np.median([measure.shape_error for measure in measures])),
        error_90=float(np.median([measure.error_90 for measure in measures])),
        scale_ratio=float(np.median([measure.scale_ratio for measure in measures])),
        within={f"{quantile:g}": float(share) for quantile, share in zip(QUANTILES, within, strict=True)},
        classes=score_classes(np.sum(confusions, axis=0), classes) if confusions else None,
    )


def count_classes(
    true: Int[np.ndarray, "*n"], predicted: Int[np.ndarray, "*n"], classes: int
) -> Int[np.ndarray, "c c"]:
    """Count azimuths by true (row) and predicted class; negative true classes are unknown and left out."""
    confusion, known = np.zeros((classes, classes), dtype=int), true >= 0
    np.add.at(confusion, (true[known], predicted[known]), 1)
    return confusion


def score_classes(confusion: Int[np.ndarray, "c c"], classes: Sequence[str]) -> ClassScores:
    """Compute the scores of a table of counts by true (row) and predicted class."""
    correct, occurring, predicted = (
        counts.tolist() for counts in (np.diag(confusion), confusion.sum(axis=1), confusion.sum(axis=0))
    )
    recall = {name: _share(correct[k], occurring[k]) for k, name in enumerate(classes)}
    known = [share for share in recall.values() if share is not None]
    return ClassScores(
        balanced_accuracy=float(np.mean(known)) if known else float("nan"),
        recall=recall,
        precision={name: _share(correct[k], predicted[k]) for k, name in enumerate(classes)},
    )


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
