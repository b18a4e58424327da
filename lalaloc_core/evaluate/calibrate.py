"""Fit what answers are weighed by, and what they say of themselves, on validation queries.

* How much each term of the evidence may count, and how sharp the posterior is: what makes the right ones of the
  candidates the most probable (`fit_matching_weights`).
* What fits a picture by chance (`localise.cohort`), from training homes.
* The probability that a picture fits its plan, with which the posterior makes the probability of "within 1 m", and the
  covariance (`fit_confidence`). Queries are photographs of the plan's home, the same disturbed, since real cameras and
  plans are worse than rendered ones, and some of other homes and of none: what fits nothing must not be trusted.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from lalaloc_core.conventions import heading_from_degrees, wrap_angle
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.runs.predictions import Pose, Prediction
from lalaloc_core.evaluate.runs.score import expected_calibration_error, position_errors_m
from lalaloc_core.files import atomic_write
from lalaloc_core.learn.metrics import Accuracy
from lalaloc_core.localise.bundle import COHORT, Bundle, ConfidenceModel, LogisticModel, MatchingWeights, write_manifest
from lalaloc_core.localise.cohort import Cohort
from lalaloc_core.localise.covariance import marginal_information
from lalaloc_core.localise.posterior import RIGHT_WITHIN_M
from lalaloc_core.localise.ranking import HEADING_SEPARATION

# Of all that is fitted on, photographs of something else than the plan's home weigh so much: with it they are believed
# as seldom as by a fit without disturbed ones, and answers about the home itself look about as sure as they are.
_MISMATCHED_SHARE = 0.25
# A weak pull to zero keeps the fit finite when the queries are perfectly separable.
_RIDGE = 1e-3
# A weak pull of the evidence's weights to what they are by default, in units of a query.
_WEIGHT_RIDGE = 0.5
# What is told of a fit's confidence is asked of fits on the other parts of the homes.
_PARTS = 5
# Photographs of something else are to stay below this confidence.
_UNBELIEVED = 0.1
# Medians of the chi-squared distribution with one and with two degrees of freedom.
_MEDIAN_CHI2 = {1: 0.4549, 2: 1.3863}
# Signals of a picture that fits, or not; which place it is, is the posterior's to say.
_SIGNALS = ("cost", "uncertainty", "latent_distance", "answer_to_chance")
_TERMS = ("walls", "openings", "ceiling", "room_type")


@dataclass(frozen=True, kw_only=True)
class Answers:
    """Answers to fit on.

    Attributes:
        own: to photographs of the plan's home.
        disturbed: to such photographs that are worse, or of rooms whose lengths differ from the plan's.
        mismatched: to photographs of anything else, which no answer is right about.
    """

    own: Sequence[Prediction]
    disturbed: Sequence[Prediction] = ()
    mismatched: Sequence[Prediction] = ()

    def among(self, homes: Collection[str]) -> Answers:
        """Those about some of the homes."""
        own, disturbed, mismatched = (
            [one for one in part if one.scene in homes] for part in (self.own, self.disturbed, self.mismatched)
        )
        return Answers(own=own, disturbed=disturbed, mismatched=mismatched)


def fit_confidence(known: Answers, searched: Answers) -> ConfidenceModel:
    """Fit on answers to queries with known heading, and to queries whose heading was searched.

    Raises:
        InvalidInputError: stored answers of an earlier version lack a signal.
    """
    position, _ = _covariance_factors(known.own)
    position_searched, heading = _covariance_factors(searched.own)
    return ConfidenceModel(
        known_heading=_by_stage(known),
        searched_heading=_by_stage(searched),
        position_factor=position,
        position_factor_searched=position_searched,
        heading_factor=heading,
    )


def fit_matching_weights(answers: Sequence[Prediction]) -> MatchingWeights:
    """Weights of the evidence's terms that make the right ones of all candidates the most probable.

    The likelihood of a choice model over the candidates of each query: where none of them is right, or all are, a query
    says nothing.
    """
    queries = [one for one in (_choice(prediction) for prediction in answers) if one is not None]
    default = MatchingWeights()
    start = default.temperature * np.array([1.0, default.openings, default.ceiling, default.room_type])
    if not queries:
        return default
    # Terms that are the same for all candidates of all queries say nothing of their weights.
    used = np.array([any(np.ptp(terms[:, k]) > 0.0 for terms, _, _ in queries) for k in range(len(_TERMS))])

    def loss(weights: np.ndarray) -> float:
        total = 0.0
        for terms, prior, right in queries:
            score = -(terms @ weights) - prior
            total += np.logaddexp.reduce(score) - np.logaddexp.reduce(score[right])
        return total + _WEIGHT_RIDGE * float(np.square(np.log((weights + 0.05) / (start + 0.05)))[used].sum())

    bounds = [(1.0, 64.0)] + [(0.0, 64.0)] * (len(_TERMS) - 1)
    fitted = optimize.minimize(loss, start, method="L-BFGS-B", bounds=bounds).x
    fitted = np.where(used, fitted, start)
    temperature, openings, ceiling, room_type = (float(round(value, 4)) for value in fitted)
    return MatchingWeights(
        openings=openings / temperature,
        ceiling=ceiling / temperature,
        room_type=room_type / temperature,
        temperature=temperature,
    )


def _choice(prediction: Prediction) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Terms (n, t), penalties in nats (n) and rightness (n) of a query's candidates; None where they teach nothing."""
    candidates = [one for one in prediction.candidates if one.terms]
    right = np.array([_is_right(one.pose, prediction) for one in candidates], dtype=bool)
    if not right.any() or right.all():
        return None
    terms = np.array([[one.terms[name] for name in _TERMS] for one in candidates])
    return terms, np.array([one.terms["height"] for one in candidates]), right


def _is_right(pose: Pose, prediction: Prediction) -> bool:
    """Whether a pose is within 1 m of the truth and turned alike."""
    truth = prediction.truth
    turned = wrap_angle(heading_from_degrees(pose.heading_deg - truth.heading_deg))
    near = np.hypot(pose.x_m - truth.x_m, pose.y_m - truth.y_m) < RIGHT_WITHIN_M
    return bool(near and abs(turned) <= HEADING_SEPARATION)


def store_cohort(bundle: Bundle, cohort: Cohort) -> Bundle:
    """Store what fits by chance in the bundle."""
    atomic_write(bundle.folder / COHORT, cohort.to_bytes())
    return write_manifest(bundle.folder, bundle.manifest)


def store_matching_weights(bundle: Bundle, evidence: MatchingWeights) -> Bundle:
    """Store fitted weights in the bundle's manifest."""
    return write_manifest(bundle.folder, dataclasses.replace(bundle.manifest, evidence=evidence))


def calibrate(bundle: Bundle, known: Answers, searched: Answers, description: str) -> Bundle:
    """Store the fitted confidence and the validation figures in the bundle's manifest."""
    metrics = {**bundle.manifest.metrics, "validation_queries": description}
    for name, answers in (("validation", known), ("validation_heading_searched", searched)):
        metrics[name] = Accuracy.from_errors(position_errors_m(answers.own)).to_dict()
        metrics[f"{name}_confidence"] = cross_validate(answers)
    manifest = dataclasses.replace(bundle.manifest, confidence=fit_confidence(known, searched), metrics=metrics)
    return write_manifest(bundle.folder, manifest)


def cross_validate(answers: Answers) -> dict[str, float]:
    """How honest confidence after the last stage is about homes that it was not fitted on.

    Returns:
        `calibration_error` for photographs of the homes, `disturbed_calibration_error`, and `mismatched_believed`, the
        share of photographs of something else with a confidence above 0.1; each where there are such answers.
    """
    homes = sorted({one.scene for one in (*answers.own, *answers.disturbed, *answers.mismatched)})
    told: dict[str, list[tuple[float, bool]]] = {"own": [], "disturbed": [], "mismatched": []}
    for part in range(_PARTS):
        asked = set(homes[part::_PARTS])
        rest = answers.among(set(homes) - asked)
        if not rest.own:
            continue
        stage = list(rest.own[0].signals)[-1]
        model = _fit_stage(stage, rest)
        for name, pairs in told.items():
            those = getattr(answers.among(asked), name)
            pairs += [_confidence_and_rightness(model, stage, one) for one in those if stage in one.signals]
    figures = {}
    for name, figure in (("own", "calibration_error"), ("disturbed", "disturbed_calibration_error")):
        if told[name]:
            confidence, right = zip(*told[name], strict=True)
            figures[figure] = expected_calibration_error(np.array(confidence), np.array(right))
    if told["mismatched"]:
        figures["mismatched_believed"] = float(np.mean([one > _UNBELIEVED for one, _ in told["mismatched"]]))
    return figures


def _confidence_and_rightness(model: LogisticModel, stage: str, one: Prediction) -> tuple[float, bool]:
    signals = one.signals[stage]
    return model.probability(**signals) / (1.0 + np.exp(-signals["log_odds"])), _is_near(stage, one)


def _is_near(stage: str, one: Prediction) -> bool:
    """Whether the answer after a stage is within 1 m of the truth."""
    pose = one.stages[stage]
    return bool(np.hypot(pose.x_m - one.truth.x_m, pose.y_m - one.truth.y_m) < RIGHT_WITHIN_M)


def _by_stage(answers: Answers) -> dict[str, LogisticModel]:
    stages = dict.fromkeys(stage for prediction in answers.own for stage in prediction.signals)
    return {stage: _fit_stage(stage, answers) for stage in stages}


def _fit_stage(stage: str, answers: Answers) -> LogisticModel:
    """Maximum-likelihood model of a picture fitting its plan, so that times the posterior the answer is right."""
    own = [one for one in (*answers.own, *answers.disturbed) if stage in one.signals]
    mismatched = [one for one in answers.mismatched if stage in one.signals]
    signals = [one.signals[stage] for one in own + mismatched]
    if missing := [name for name in _SIGNALS if any(name not in one for one in signals)]:
        raise InvalidInputError(f"stored answers of an earlier version lack {', '.join(missing)}; ask anew")
    features = np.array([[1.0, *(one[name] for name in _SIGNALS)] for one in signals])
    log_odds = np.array([one["log_odds"] for one in signals])
    posterior = 1.0 / (1.0 + np.exp(-log_odds))
    right = np.append([_is_near(stage, one) for one in own], np.zeros(len(mismatched), bool)).astype(bool)
    weight = np.ones(len(features))
    if mismatched:
        weight[len(own) :] = _MISMATCHED_SHARE / (1.0 - _MISMATCHED_SHARE) * len(own) / len(mismatched)
    # Features are scaled so that one ridge fits all.
    scale = np.maximum(np.abs(features).max(axis=0), 1e-9)

    def loss(weights: np.ndarray) -> float:
        logit = np.clip(features @ (weights / scale), -30.0, 30.0)
        probability = np.clip(posterior / (1.0 + np.exp(-logit)), 1e-9, 1.0 - 1e-9)
        likelihood = np.where(right, np.log(probability), np.log1p(-probability))
        return float(_RIDGE * np.square(weights).sum() - (weight * likelihood).sum())

    # Begins with trust in all: without mismatched photographs there is nothing that teaches otherwise.
    start = np.append(3.0, np.zeros(len(_SIGNALS)))
    bias, *weights = (optimize.minimize(loss, start, method="L-BFGS-B").x / scale).tolist()
    return LogisticModel(bias=bias, log_odds=0.0, **dict(zip(_SIGNALS, weights, strict=True)))


def _covariance_factors(predictions: Sequence[Prediction]) -> tuple[float | None, float | None]:
    """Factors that make half of the right answers' errors fall into the ellipse (interval) that should hold half."""
    position, heading = [], []
    for one in predictions:
        answer = one.final_pose
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
