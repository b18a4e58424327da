"""Fits on validation queries: weights of the matching cost, and confidence.

* `fit_matching_weights` fits the weight of each term and the temperature of the posterior, so that the right candidates
  are the most probable.
* `with_heading_doubt` adds how well a right heading usually fits, and how much better the best of all headings does.
* `fit_confidence` fits the covariance and the probability that a photograph belongs to its plan, which turns the
  posterior into the probability of "within 1 m". Its queries are photographs of the plan's home, disturbed photographs,
  because real cameras and plans are worse than rendered ones, and photographs of unknown places.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize

from lalaloc_core.bundle import ConfidenceModel, LogisticModel, MatchingWeights
from lalaloc_core.conventions import heading_from_degrees, wrap_angle
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.evaluate.runs.score import expected_calibration_error, position_errors_m
from lalaloc_core.learn.metrics import Accuracy
from lalaloc_core.localise.belief import HEADING_SEPARATION, RIGHT_WITHIN_M
from lalaloc_core.localise.belief.confidence import marginal_information

# Weight of unknown places in the fit, chosen on annotated photographs among 0.25, 0.4, 0.5 and 0.6: the lowest with
# which at most 2 % of them have a confidence above 0.5 in plans of other buildings.
_MISMATCHED_SHARE = 0.5
# Ridge of the logistic fit, which keeps it finite when the queries are separable.
_RIDGE = 1e-3
# Ridge that pulls the weights of the matching cost to their defaults, in units of a query.
_WEIGHT_RIDGE = 0.5
# Largest weight of a term, in nats per unit of its cost; there are as many independent azimuths at most.
_MAX_WEIGHT = 128.0
# Folds of the cross-validation, by home.
_FOLDS = 5
# Confidence above which an unknown place counts as accepted.
_ACCEPTED = 0.1
# Medians of the chi-squared distribution with one and with two degrees of freedom.
_MEDIAN_CHI2 = {1: 0.4549, 2: 1.3863}
# Inputs of the model that a photograph belongs to its plan; the posterior compares places within the plan.
_SIGNALS = ("cost", "uncertainty", "latent_distance", "cost_to_chance", "answer_to_chance")
_TERMS = ("walls", "openings", "ceiling", "room_type")
# Quantiles of costs and of gains that are usual beside right headings.
_USUAL_COST, _USUAL_GAIN = 0.95, 0.995


@dataclass(frozen=True, kw_only=True)
class Answers:
    """Predictions to fit on.

    Attributes:
        disturbed: for photographs of lower quality, of rooms whose lengths differ from the plan's, or in plans without
            openings.
        mismatched: for photographs of unknown places, all of them wrong.
    """

    own: Sequence[Prediction]
    disturbed: Sequence[Prediction] = ()
    mismatched: Sequence[Prediction] = ()

    def among(self, homes: Collection[str]) -> Answers:
        """Return the predictions for some homes."""
        parts = vars(self).items()
        return Answers(**{name: [answer for answer in part if answer.scene in homes] for name, part in parts})


def fit_confidence(known: Answers, searched: Answers) -> ConfidenceModel:
    """Fit the confidence model on queries with a known heading and with a searched heading."""
    position, _ = _covariance_factors(known.own)
    position_searched, heading = _covariance_factors(searched.own)
    return ConfidenceModel(
        known_heading=_by_stage(known),
        searched_heading=_by_stage(searched),
        position_factor=position,
        position_factor_searched=position_searched,
        heading_factor=heading,
    )


def fit_matching_weights(answers: Sequence[Prediction], default: MatchingWeights | None = None) -> MatchingWeights:
    """Return the weights, from `default`, with which a choice model makes right candidates the most probable."""
    queries = [choice for choice in map(_choice, answers) if choice is not None]
    default = default or MatchingWeights()
    start = default.temperature * np.array([1.0, default.openings, default.ceiling, default.room_type])
    if not queries:
        return default
    # The weight of a term that is equal for all candidates of every query cannot be fitted.
    used = np.array([any(np.ptp(terms[:, k]) > 0.0 for terms, _, _ in queries) for k in range(len(_TERMS))])

    def loss(weights: np.ndarray) -> float:
        total = 0.0
        for terms, prior, right in queries:
            score = -(terms @ weights) - prior
            total += np.logaddexp.reduce(score) - np.logaddexp.reduce(score[right])
        return total + _WEIGHT_RIDGE * float(np.square(np.log((weights + 0.05) / (start + 0.05)))[used].sum())

    bounds = [(1.0, _MAX_WEIGHT)] + [(0.0, _MAX_WEIGHT)] * (len(_TERMS) - 1)
    fitted = optimize.minimize(loss, start, method="L-BFGS-B", bounds=bounds).x
    fitted = np.where(used, fitted, start)
    temperature, openings, ceiling, room_type = (float(round(value, 4)) for value in fitted)
    return replace(
        default,
        openings=openings / temperature,
        ceiling=ceiling / temperature,
        room_type=room_type / temperature,
        temperature=temperature,
    )


def _choice(prediction: Prediction) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return terms (n, t), penalties (n, nats) and correctness (n) of the candidates; None if all or none are right."""
    candidates = [candidate for candidate in prediction.candidates if candidate.terms]
    right = np.array([_is_right(candidate.pose, prediction) for candidate in candidates], dtype=bool)
    if not right.any() or right.all():
        return None
    terms = np.array([[candidate.terms[name] for name in _TERMS] for candidate in candidates])
    return terms, np.array([candidate.terms["objects"] + candidate.terms["height"] for candidate in candidates]), right


def _is_right(pose: Pose, prediction: Prediction) -> bool:
    truth = prediction.truth
    difference = wrap_angle(heading_from_degrees(pose.heading_deg - truth.heading_deg))
    near = np.hypot(pose.x_m - truth.x_m, pose.y_m - truth.y_m) < RIGHT_WITHIN_M
    return bool(near and abs(difference) <= HEADING_SEPARATION)


def with_heading_doubt(weights: MatchingWeights, known: Answers, searched: Answers) -> MatchingWeights:
    """Return the weights with `usual_cost` and `usual_gain`: quantiles over photographs answered in both ways."""
    without = {(answer.scene, answer.camera, part): _grid_cost(answer) for answer, part in _own(searched)}
    pairs = [
        (given, best)
        for answer, part in _own(known)
        if (given := _grid_cost(answer)) is not None and (best := without.get((answer.scene, answer.camera, part)))
    ]
    if not pairs:
        return weights
    cost, best = np.array(pairs).T
    return replace(
        weights,
        usual_cost=float(np.quantile(cost, _USUAL_COST)),
        usual_gain=float(np.quantile(np.maximum(1.0 - best / cost, 0.0), _USUAL_GAIN)),
    )


def _own(answers: Answers) -> list[tuple[Prediction, str]]:
    return [(answer, part) for part in ("own", "disturbed") for answer in getattr(answers, part)]


def _grid_cost(answer: Prediction) -> float | None:
    """Return the cost of the best grid pose; None without an answer."""
    return answer.signals["retrieval"]["cost"] if "retrieval" in answer.signals else None


def validation_figures(prefix: str, queries: str, known: Answers, searched: Answers) -> dict[str, Any]:
    """Return the entries of a manifest's `metrics` about predictions for some queries, named after `prefix`."""
    figures: dict[str, Any] = {f"{prefix}_queries": queries}
    for name, answers in ((prefix, known), (f"{prefix}_heading_searched", searched)):
        figures[name] = asdict(Accuracy.from_errors(position_errors_m(answers.own)))
        figures[f"{name}_confidence"] = cross_validate(answers)
    return figures


def cross_validate(answers: Answers) -> dict[str, float]:
    """Measure the confidence after the last stage on homes that it was not fitted on.

    Returns:
        `calibration_error` and `disturbed_calibration_error` for photographs of the homes, and `mismatched_believed`,
        the false-accept rate: the share of unknown places with a confidence above 0.1. Figures without predictions are
        left out.
    """
    homes = sorted({prediction.scene for prediction in (*answers.own, *answers.disturbed, *answers.mismatched)})
    results: dict[str, list[tuple[float, bool]]] = {"own": [], "disturbed": [], "mismatched": []}
    for part in range(_FOLDS):
        tested = set(homes[part::_FOLDS])
        rest = answers.among(set(homes) - tested)
        if not rest.own:
            continue
        stage = list(rest.own[0].signals)[-1]
        model = _fit_stage(stage, rest)
        for name, pairs in results.items():
            part_answers = getattr(answers.among(tested), name)
            pairs += [_confidence(model, stage, answer) for answer in part_answers if stage in answer.signals]
    figures = {}
    for name, figure in (("own", "calibration_error"), ("disturbed", "disturbed_calibration_error")):
        if results[name]:
            confidence, right = zip(*results[name], strict=True)
            figures[figure] = expected_calibration_error(np.array(confidence), np.array(right))
    if results["mismatched"]:
        figures["mismatched_believed"] = float(
            np.mean([confidence > _ACCEPTED for confidence, _ in results["mismatched"]])
        )
    return figures


def _confidence(model: LogisticModel, stage: str, prediction: Prediction) -> tuple[float, bool]:
    """Return the confidence of a pose after a stage, and whether it is within 1 m."""
    signals = prediction.signals[stage]
    return model.probability(**signals) / (1.0 + np.exp(-signals["log_odds"])), _is_near(stage, prediction)


def _is_near(stage: str, prediction: Prediction) -> bool:
    pose, truth = prediction.stages[stage], prediction.truth
    return bool(np.hypot(pose.x_m - truth.x_m, pose.y_m - truth.y_m) < RIGHT_WITHIN_M)


def _by_stage(answers: Answers) -> dict[str, LogisticModel]:
    stages = dict.fromkeys(stage for prediction in answers.own for stage in prediction.signals)
    return {stage: _fit_stage(stage, answers) for stage in stages}


def _fit_stage(stage: str, answers: Answers) -> LogisticModel:
    own = [answer for answer in (*answers.own, *answers.disturbed) if stage in answer.signals]
    mismatched = [answer for answer in answers.mismatched if stage in answer.signals]
    signals = [answer.signals[stage] for answer in own + mismatched]
    if missing := [name for name in _SIGNALS if any(name not in values for values in signals)]:
        raise InvalidInputError(
            f"stored predictions lack the signals {', '.join(missing)}; remove them and calibrate again"
        )
    features = np.array([[1.0, *(values[name] for name in _SIGNALS)] for values in signals])
    log_odds = np.array([values["log_odds"] for values in signals])
    posterior = 1.0 / (1.0 + np.exp(-log_odds))
    right = np.append([_is_near(stage, answer) for answer in own], np.zeros(len(mismatched), bool)).astype(bool)
    weight = np.ones(len(features))
    if mismatched:
        weight[len(own) :] = _MISMATCHED_SHARE / (1.0 - _MISMATCHED_SHARE) * len(own) / len(mismatched)
    # One ridge fits all features when they are scaled.
    scale = np.maximum(np.abs(features).max(axis=0), 1e-9)

    def loss(weights: np.ndarray) -> float:
        logit = np.clip(features @ (weights / scale), -30.0, 30.0)
        probability = np.clip(posterior / (1.0 + np.exp(-logit)), 1e-9, 1.0 - 1e-9)
        likelihood = np.where(right, np.log(probability), np.log1p(-probability))
        return float(_RIDGE * np.square(weights).sum() - (weight * likelihood).sum())

    # Starts with high confidence, the right result without mismatched photographs.
    start = np.append(3.0, np.zeros(len(_SIGNALS)))
    bias, *weights = (optimize.minimize(loss, start, method="L-BFGS-B").x / scale).tolist()
    return LogisticModel(bias=bias, log_odds=0.0, **dict(zip(_SIGNALS, weights, strict=True)))


def _covariance_factors(predictions: Sequence[Prediction]) -> tuple[float | None, float | None]:
    """Return factors for position and heading so that half of the right poses lie in the 50 % ellipse (interval)."""
    position, heading = [], []
    for prediction in predictions:
        pose, truth = prediction.final_pose, prediction.truth
        if pose is None or prediction.information is None:
            continue
        offset = np.array([pose.x_m - truth.x_m, pose.y_m - truth.y_m])
        by_position, by_heading = marginal_information(np.array(prediction.information))
        if np.hypot(*offset) < RIGHT_WITHIN_M:
            position.append(offset @ by_position @ offset)
            if by_heading is not None:
                turn = wrap_angle(heading_from_degrees(pose.heading_deg - truth.heading_deg))
                heading.append(turn**2 * by_heading)
    return (
        float(np.median(position)) / _MEDIAN_CHI2[2] if position else None,
        float(np.median(heading)) / _MEDIAN_CHI2[1] if heading else None,
    )
