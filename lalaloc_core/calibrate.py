"""Fit what answers say of themselves on validation queries: the probability of "within 1 m", and the covariance.

Queries are photographs of the plan's home, and some of other homes and of none: what fits nothing must not be trusted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lalaloc_core.bundle import Bundle, ConfidenceModel, LogisticModel, write_manifest
from lalaloc_core.conventions import heading_from_degrees, wrap_angle
from lalaloc_core.evaluation.predictions import Prediction
from lalaloc_core.evaluation.score import position_errors_m
from lalaloc_core.localise.confidence import RIGHT_WITHIN_M
from lalaloc_core.localise.covariance import marginal_information
from lalaloc_core.metrics import Accuracy

# Of all that is fitted on, photographs of something else than the plan's home weigh so much: enough to tell them, too
# little to make answers about the home itself look less sure than they are.
_MISMATCHED_SHARE = 0.1
# A weak pull to zero keeps the fit finite when the queries are perfectly separable.
_RIDGE = 1e-2
# How strongly offset and slope are held where they are: when hardly an answer is wrong, nothing tells how sure answers
# may look, and mismatched photographs must not gain by that.
_RESCALE_RIDGE = np.array([1.0, 16.0])
_ITERATIONS, _CONVERGED = 50, 1e-9
# Medians of the chi-squared distribution with one and with two degrees of freedom.
_MEDIAN_CHI2 = {1: 0.4549, 2: 1.3863}
_SIGNALS = ("log_odds", "cost", "uncertainty", "latent_distance")


@dataclass(frozen=True, kw_only=True)
class Answers:
    """Answers to fit on.

    Attributes:
        own: to photographs of the plan's home.
        mismatched: to photographs of anything else, which no answer is right about.
    """

    own: Sequence[Prediction]
    mismatched: Sequence[Prediction] = ()


def fit_confidence(known: Answers, searched: Answers) -> ConfidenceModel:
    """Fit on answers to queries with known heading, and to queries whose heading was searched."""
    position, _ = _covariance_factors(known.own)
    position_searched, heading = _covariance_factors(searched.own)
    return ConfidenceModel(
        known_heading=_by_stage(known),
        searched_heading=_by_stage(searched),
        position_factor=position,
        position_factor_searched=position_searched,
        heading_factor=heading,
    )


def calibrate(bundle: Bundle, known: Answers, searched: Answers, description: str) -> Bundle:
    """Store the fitted confidence and the validation figures in the bundle's manifest."""
    metrics = {**bundle.manifest.metrics, "validation_queries": description}
    for name, answers in (("validation", known), ("validation_heading_searched", searched)):
        metrics[name] = Accuracy.of(position_errors_m(answers.own)).to_dict()
    manifest = dataclasses.replace(bundle.manifest, confidence=fit_confidence(known, searched), metrics=metrics)
    return write_manifest(bundle.folder, manifest)


def _by_stage(answers: Answers) -> dict[str, LogisticModel]:
    stages = dict.fromkeys(stage for prediction in answers.own for stage in prediction.signals)
    return {stage: _fit_stage(stage, answers) for stage in stages}


def _fit_stage(stage: str, answers: Answers) -> LogisticModel:
    """Maximum-likelihood logistic model of a stage's pose being within 1 m of the truth.

    Mismatched photographs decide, with the rest, in which direction of the signals trust grows. How fast, and from
    where, is then fitted on the home's own queries alone, whose probabilities are those that must be right.
    """
    own = [one for one in answers.own if stage in one.signals]
    mismatched = [one for one in answers.mismatched if stage in one.signals]
    features = np.array([[1.0, *(one.signals[stage][name] for name in _SIGNALS)] for one in own + mismatched])
    distance = [np.hypot(one.stages[stage].x_m - one.truth.x_m, one.stages[stage].y_m - one.truth.y_m) for one in own]
    right = np.append(np.array(distance) < RIGHT_WITHIN_M, np.zeros(len(mismatched), bool))
    weight = np.ones(len(features))
    if mismatched:
        weight[len(own) :] = _MISMATCHED_SHARE / (1.0 - _MISMATCHED_SHARE) * len(own) / len(mismatched)
    # Features are scaled so that one ridge fits all.
    scale = np.maximum(np.abs(features).max(axis=0), 1e-9)
    direction = _logistic(features, right, weight, ridge=_RIDGE * scale**2)
    if mismatched:
        logit = (features @ direction)[: len(own)]
        about = np.stack([np.ones(len(own)), logit], axis=-1)
        offset, slope = _logistic(about, right[: len(own)], weight[: len(own)], ridge=_RESCALE_RIDGE, base=logit)
        direction = (1.0 + slope) * direction
        direction[0] += offset
    bias, *weights = direction.tolist()
    return LogisticModel(bias=bias, **dict(zip(_SIGNALS, weights, strict=True)))


def _covariance_factors(predictions: Sequence[Prediction]) -> tuple[float | None, float | None]:
    """Factors that make half of the right answers' errors fall into the ellipse (interval) that should hold half."""
    position, heading = [], []
    for one in predictions:
        answer = one.answer
        if answer is None or one.information is None:
            continue
        offset = np.array([answer.x_m - one.truth.x_m, answer.y_m - one.truth.y_m])
        by_position, by_heading = marginal_information(np.array(one.information))
        if np.hypot(*offset) < RIGHT_WITHIN_M:
            position.append(offset @ by_position @ offset)
            if by_heading is not None:
                turn = wrap_angle(heading_from_degrees(answer.heading_deg - one.truth.heading_deg))
                heading.append(turn**2 * by_heading)
    return (
        float(np.median(position)) / _MEDIAN_CHI2[2] if position else None,
        float(np.median(heading)) / _MEDIAN_CHI2[1] if heading else None,
    )


def _logistic(
    features: Float[np.ndarray, "n f"],
    correct: Bool[np.ndarray, "n"],
    weight: Float[np.ndarray, "n"],
    *,
    ridge: Float[np.ndarray, "f"],
    base: Float[np.ndarray, "n"] | float = 0.0,
) -> Float[np.ndarray, "f"]:
    """Weights of features that are added to the log odds `base`, by Newton's method on the penalised log likelihood.

    Args:
        ridge: how strongly each weight is pulled to zero.
    """
    weights = np.zeros(features.shape[1])
    for _ in range(_ITERATIONS):
        probability = 1.0 / (1.0 + np.exp(-np.clip(base + features @ weights, -30.0, 30.0)))
        gradient = features.T @ (weight * (probability - correct)) + ridge * weights
        hessian = (features * (weight * probability * (1.0 - probability))[:, None]).T @ features + np.diag(ridge)
        step = np.linalg.solve(hessian, gradient)
        weights -= step
        if (np.abs(step) * np.sqrt(ridge)).max() < _CONVERGED:
            break
    return weights
