"""Fit the confidence of answers: a logistic model of "within 1 m" on validation queries."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from lalaloc_core.bundle import Bundle, ConfidenceModel, write_manifest
from lalaloc_core.evaluation.predictions import Prediction
from lalaloc_core.evaluation.score import position_errors_m
from lalaloc_core.metrics import Accuracy

# A weak pull to zero keeps the fit finite when the queries are perfectly separable.
_RIDGE = 1e-2
_ITERATIONS = 50


def fit_confidence(predictions: list[Prediction]) -> ConfidenceModel:
    """Maximum-likelihood logistic model of the best latent distance and its margin over the second candidate."""
    candidates = [prediction.candidate_distances for prediction in predictions]
    distance = np.array([distances[0] for distances in candidates])
    margins = [distances[1] - distances[0] for distances in candidates if len(distances) > 1]
    ceiling = float(np.quantile(margins, 0.95)) if margins else 0.0
    margin = np.array(
        [min(distances[1] - distances[0], ceiling) if len(distances) > 1 else ceiling for distances in candidates]
    )
    correct = position_errors_m(predictions) < 1.0
    bias, by_distance, by_margin = _logistic(np.stack([np.ones_like(distance), distance, margin], axis=1), correct)
    return ConfidenceModel(bias=bias, distance=by_distance, margin=by_margin, no_rival_margin=ceiling)


def calibrate(bundle: Bundle, predictions: list[Prediction], description: str) -> Bundle:
    """Store the fitted confidence and the validation figures in the bundle's manifest."""
    errors = position_errors_m(predictions)
    metrics = {**bundle.manifest.metrics, "validation": {"queries": description, **Accuracy.of(errors).to_dict()}}
    manifest = dataclasses.replace(bundle.manifest, confidence=fit_confidence(predictions), metrics=metrics)
    return write_manifest(bundle.folder, manifest)


def _logistic(features: Float[np.ndarray, "n f"], correct: Bool[np.ndarray, "n"]) -> list[float]:
    """Newton's method on the ridge-regularised log likelihood; features are scaled so that one ridge fits all."""
    scale = np.maximum(np.abs(features).max(axis=0), 1e-9)
    scaled = features / scale
    weights = np.zeros(features.shape[1])
    for _ in range(_ITERATIONS):
        probability = 1.0 / (1.0 + np.exp(-np.clip(scaled @ weights, -30.0, 30.0)))
        gradient = scaled.T @ (probability - correct) + _RIDGE * weights
        hessian = (scaled * (probability * (1.0 - probability))[:, None]).T @ scaled + _RIDGE * np.eye(len(weights))
        step = np.linalg.solve(hessian, gradient)
        weights -= step
        if np.abs(step).max() < 1e-9:
            break
    return [float(weight) for weight in weights / scale]
