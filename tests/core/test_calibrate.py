"""Calibration of confidence, covariance and matching weights, and the cohort that calibrates a fit."""

from __future__ import annotations

import dataclasses
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lalaloc_core.bundle import COHORT, Bundle, ConfidenceModel, LogisticModel, MatchingWeights, write_manifest
from lalaloc_core.errors import BundleError, InvalidInputError
from lalaloc_core.evaluate.calibrate.calibration import (
    fit_appearance,
    mixtures,
    redrawn,
    store_cohort,
    store_confidence,
)
from lalaloc_core.evaluate.calibrate.parameter_fits import (
    Answers,
    cross_validate,
    fit_confidence,
    fit_matching_weights,
    with_heading_doubt,
)
from lalaloc_core.evaluate.methods.method import Pose, PredictedCandidate
from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.evaluate.runs.score import expected_calibration_error, position_errors_m
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic import GeneratedScenes, training_plans
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import Cohort, MatchingConfig, cohort_of, cost_by_chance, log_cost_to_chance
from lalaloc_core.localise.match.fit_by_chance import SIZE
from lalaloc_core.localise.query import Query
from lalaloc_core.localise.refine.latent_refiner import PoseRefiner
from lalaloc_core.localise.search.pipeline import LocaliseConfig, localise
from lalaloc_core.localise.search.retrieval import grid_costs
from tests.core.questions import perfect_query, prediction_of
from tests.core.shipped import encoder
from tests.strategies import crooked_flat, plan_of, present, rectangle, seeds

TRUTH = Pose(x_m=0.0, y_m=0.0, room_index=0, heading_deg=0.0)
# Model that generates the predictions of `believable`.
MAKER = LogisticModel(bias=1.0, log_odds=0.0, cost=-6.0, uncertainty=-0.7, latent_distance=-3.0)


def result(
    error_m: float,
    log_odds: float = 0.0,
    cost: float = 0.1,
    uncertainty: float = -3.0,
    answer_to_chance: float = 0.0,
    latent_distance: float = 0.1,
) -> Prediction:
    """Return a prediction with a position error (m); NaN for no answer."""
    signals = {"log_odds": log_odds, "cost": cost, "uncertainty": uncertainty, "latent_distance": latent_distance}
    signals |= {"cost_to_chance": answer_to_chance + 0.5, "answer_to_chance": answer_to_chance}
    if math.isnan(error_m):
        return prediction_of(TRUTH)
    return prediction_of(TRUTH, stages={"lpo": dataclasses.replace(TRUTH, x_m=error_m)}, signals={"lpo": signals})


def confidence(model: LogisticModel, prediction: Prediction) -> float:
    """Return the posterior times the probability that the photograph belongs to the plan."""
    signals = prediction.signals["lpo"]
    return model.probability(**signals) / (1.0 + math.exp(-signals["log_odds"]))


def believable(count: int, seed: int) -> list[Prediction]:
    """Return queries that are right with the probability that `MAKER` gives their signals."""
    rng = np.random.default_rng(seed)
    results = []
    drawn = rng.uniform([-3.0, 0.0, -4.0, 0.0], [4.0, 1.0, -2.0, 0.5], (count, 4))
    for log_odds, cost, uncertainty, latent in drawn:
        right, wrong = (result(error_m, log_odds, cost, uncertainty, latent_distance=latent) for error_m in (0.2, 3.0))
        results.append(right if rng.random() < confidence(MAKER, right) else wrong)
    return results


def both(known: list[Prediction], searched: list[Prediction]) -> ConfidenceModel:
    return fit_confidence(Answers(own=known), Answers(own=searched))


def fitted(own: list[Prediction], **others: list[Prediction]) -> LogisticModel:
    return fit_confidence(Answers(own=own, **others), Answers(own=[])).known_heading["lpo"]


def bent(offset: np.ndarray, information: np.ndarray, turn_deg: float = 0.0) -> Prediction:
    """Return a prediction with errors `offset` (m) and `turn_deg` and a curvature of its cost."""
    pose = dataclasses.replace(TRUTH, x_m=float(offset[0]), y_m=float(offset[1]), heading_deg=turn_deg)
    return dataclasses.replace(result(0.0), stages={"lpo": pose}, information=tuple(map(tuple, information.tolist())))


class TestConfidence:
    def test_fit_recovers_the_generating_model(self) -> None:
        model = fitted(believable(8000, 0))
        assert model.log_odds == 0.0
        assert model.uncertainty == pytest.approx(MAKER.uncertainty, abs=0.3)
        assert model.cost == pytest.approx(MAKER.cost, abs=0.8)
        assert model.latent_distance == pytest.approx(MAKER.latent_distance, abs=0.8)

    def test_fit_like_unknown_places_has_low_confidence(self) -> None:
        # All photographs of the home have the same cost, so they do not show that a poor fit is bad.
        rng = np.random.default_rng(0)
        odds = rng.uniform(0.0, 5.0, 400)
        own = [result(0.2 if rng.random() < 1.0 / (1.0 + math.exp(-each)) else 3.0, each) for each in odds]
        mismatched = [result(0.2, rng.uniform(0.0, 5.0), cost=0.6) for _ in range(100)]
        plain, fitted_model = fitted(own), fitted(own, mismatched=mismatched)
        assert np.mean([confidence(plain, prediction) for prediction in mismatched]) > 0.5
        assert np.mean([confidence(fitted_model, prediction) for prediction in mismatched]) < 0.1
        # Confidence in the home itself stays calibrated.
        share = np.mean(position_errors_m(own) < 1.0)
        assert np.mean([confidence(fitted_model, prediction) for prediction in own]) == pytest.approx(share, abs=0.03)

    def test_chance_fit_has_low_confidence(self) -> None:
        rng = np.random.default_rng(7)
        own = [result(0.2, 6.0, cost, answer_to_chance=rng.normal(-1.0, 0.3)) for cost in rng.uniform(0.1, 0.8, 200)]
        others = [result(3.0, 6.0, cost, answer_to_chance=rng.normal(0.5, 0.3)) for cost in rng.uniform(0.1, 0.8, 200)]
        model = fitted(own, mismatched=others)
        assert model.answer_to_chance < 0.0
        assert np.mean([confidence(model, prediction) for prediction in own]) > 0.95
        assert np.mean([confidence(model, prediction) for prediction in others]) < 0.1

    def test_fit_like_right_disturbed_photographs_is_confident(self) -> None:
        rng = np.random.default_rng(3)
        own = [result(0.2, 6.0, cost) for cost in rng.uniform(0.1, 0.2, 200)]
        disturbed = [result(0.2, 6.0, cost) for cost in rng.uniform(0.2, 0.55, 200)]
        others = [result(3.0, 6.0, cost) for cost in rng.uniform(0.6, 1.5, 200)]
        between = result(0.2, 6.0, 0.5)
        plain, fitted_model = (fitted(own, disturbed=also, mismatched=others) for also in ([], disturbed))
        assert confidence(plain, between) < 0.6
        assert confidence(fitted_model, between) > 0.8
        assert np.mean([confidence(fitted_model, prediction) for prediction in others]) < 0.1

    def test_disturbed_photographs_do_not_change_covariance(self) -> None:
        offsets = np.random.default_rng(5).normal(0.0, 0.1, (200, 2))
        own = [bent(offset, 100.0 * np.eye(3)) for offset in offsets]
        far = [bent(3.0 * offset, 100.0 * np.eye(3)) for offset in offsets]
        model = fit_confidence(Answers(own=own, disturbed=far), Answers(own=own))
        assert model.position_factor == pytest.approx(
            fit_confidence(Answers(own=own), Answers(own=own)).position_factor
        )

    def test_older_models_use_their_own_signals(self) -> None:
        weights = {"cost": -2.0, "uncertainty": -0.5, "latent_distance": -4.0, "cost_to_chance": -3.0}
        model = LogisticModel(bias=1.0, log_odds=0.0, **weights)
        signals = {"log_odds": 0.0, "cost": 0.3, "uncertainty": -2.0, "latent_distance": 0.1, "cost_to_chance": -0.4}
        logit = 1.0 + sum(weights[name] * signals[name] for name in weights)
        for more in ({}, {"answer_to_chance": -9.0}):
            assert model.probability(**signals, **more) == pytest.approx(1.0 / (1.0 + math.exp(-logit)))

    def test_cross_validation_uses_other_homes(self) -> None:
        # Costs differ in meaning between homes, so a fit on the others is wrong here.
        def of_home(number: int, cost: float, *, right: bool) -> Prediction:
            prediction = result(0.2 if right else 3.0, 6.0, cost)
            return dataclasses.replace(prediction, scene=f"home-{number}")

        alike = [of_home(number, 0.1 + 0.2 * (k % 2), right=k % 2 == 0) for number in range(5) for k in range(40)]
        assert cross_validate(Answers(own=alike))["calibration_error"] < 0.05
        turned = [
            of_home(number, 0.1 + 0.2 * (k % 2), right=(k + number) % 2 == 0) for number in (0, 1) for k in range(40)
        ]
        assert cross_validate(Answers(own=turned))["calibration_error"] > 0.9

    def test_false_accept_rate_is_reported(self) -> None:
        own = [dataclasses.replace(result(0.2, 6.0, 0.1), scene=f"home-{k % 5}") for k in range(100)]
        others = [dataclasses.replace(result(3.0, 6.0, 0.8), scene=f"home-{k % 5}") for k in range(75)]
        # A quarter is indistinguishable from the home's own photographs.
        others += [dataclasses.replace(result(3.0, 6.0, 0.1), scene=f"home-{k % 5}") for k in range(25)]
        figures = cross_validate(Answers(own=own, mismatched=others))
        assert figures["mismatched_believed"] == pytest.approx(0.25)
        assert "disturbed_calibration_error" not in figures
        assert cross_validate(Answers(own=[])) == {}

    @pytest.mark.parametrize("wrong_log_odds", [None, 0.0, 3.0], ids=["none", "like the others", "surer"])
    def test_mismatched_weight_does_not_grow_with_accuracy(self, wrong_log_odds: float | None) -> None:
        rng = np.random.default_rng(0)
        own = [result(0.2, rng.normal() + 5.0, cost=0.1) for _ in range(490)]
        own += [result(3.0, wrong_log_odds, cost=0.1) for _ in range(10) if wrong_log_odds is not None]
        mismatched = [result(0.2, rng.normal() + 3.0, cost=0.6) for _ in range(160)]
        model = fitted(own, mismatched=mismatched)
        assert np.mean([confidence(model, prediction) for prediction in own]) > 0.9
        assert np.mean([confidence(model, prediction) for prediction in mismatched]) < 0.1

    @given(seeds())
    @settings(max_examples=10)
    def test_confidence_follows_odds_cost_and_uncertainty(self, seed: int) -> None:
        model = fitted(believable(800, seed))
        here = confidence(model, result(0.0, 0.0, 0.2, -3.0))
        assert confidence(model, result(0.0, 1.0, 0.2, -3.0)) > here
        assert confidence(model, result(0.0, 0.0, 0.4, -3.0)) < here
        assert confidence(model, result(0.0, 0.0, 0.2, -2.0)) < here

    def test_confidences_are_frequencies(self) -> None:
        model = fitted(believable(4000, 1))
        fresh = believable(4000, 2)
        confidences = np.array([confidence(model, prediction) for prediction in fresh])
        assert expected_calibration_error(confidences, position_errors_m(fresh) < 1.0) < 0.04

    @pytest.mark.parametrize("right", [True, False])
    def test_equal_outcomes_give_a_finite_model(self, right: bool) -> None:
        model = fitted([result(0.1 if right else 5.0, 0.1 * k, 0.1 * k) for k in range(10)])
        assert all(np.isfinite(value) for value in dataclasses.asdict(model).values())
        assert (confidence(model, result(0.0, 0.3, 0.3)) > 0.5) == right

    def test_separable_queries_give_a_finite_model(self) -> None:
        good, bad = result(0.1, 4.0, 0.01), result(5.0, -2.0, 0.9)
        model = fitted([good, bad] * 20)
        assert confidence(model, good) > 0.9 > 0.1 > confidence(model, bad)

    def test_headings_and_stages_have_their_own_models(self) -> None:
        early = [
            dataclasses.replace(
                prediction,
                stages={"retrieval": dataclasses.replace(TRUTH, x_m=5.0), **prediction.stages},
                signals={"retrieval": prediction.signals["lpo"], **prediction.signals},
            )
            for prediction in (result(0.1) for _ in range(20))
        ]
        model = both(early, [result(5.0) for _ in range(20)])
        signals = result(0.0).signals["lpo"]
        probabilities = {
            (stage, known): model.fit_probability(stage, signals, heading_known=known)
            for stage, known in (("lpo", True), ("retrieval", True), ("lpo", False), ("retrieval", False))
        }
        assert (probabilities["lpo", True] or 0.0) > 0.5
        assert (probabilities["retrieval", True] or 1.0) < 0.5
        assert (probabilities["lpo", False] or 1.0) < 0.5
        assert probabilities["retrieval", False] is None

    def test_unanswered_queries_are_ignored_and_lacking_signals_refused(self) -> None:
        some = believable(100, 0)
        assert fitted(some + [result(math.nan)] * 50) == fitted(some)
        stored = result(0.2)
        del stored.signals["lpo"]["answer_to_chance"]
        with pytest.raises(InvalidInputError, match="lack the signals answer_to_chance"):
            fitted([result(0.2), stored])

    def test_calibration_keeps_the_model_identity(self, tiny_bundle: Path, opened_bundle: Bundle) -> None:
        try:
            calibrated = store_confidence(
                opened_bundle, Answers(own=believable(200, 0)), Answers(own=believable(50, 1)), "made-up queries"
            )
            again = Bundle.open(tiny_bundle)
            assert again.sha256 == calibrated.sha256 == opened_bundle.sha256
            assert again.manifest.confidence == calibrated.manifest.confidence is not None
            assert again.manifest.metrics["validation"]["n"] == 200
            assert again.manifest.metrics["validation_heading_searched"]["n"] == 50
            assert again.manifest.metrics["validation_queries"] == "made-up queries"
        finally:
            write_manifest(tiny_bundle, opened_bundle.manifest)


class TestHeadingDoubt:
    def test_usual_cost_and_gain_are_quantiles_of_paired_answers(self) -> None:
        def answer(name: str, cost: float) -> Prediction:
            prediction = dataclasses.replace(result(0.2), scene=name)
            return dataclasses.replace(prediction, signals={"retrieval": {"cost": cost}})

        given = np.linspace(0.1, 0.5, 201)
        known = [answer(f"home-{k}", cost) for k, cost in enumerate(given)]
        # The search fits better by 0 to 40 %; some photographs were answered in one way only.
        gain = np.linspace(0.0, 0.4, 201)
        searched = [answer(f"home-{k}", cost) for k, cost in enumerate(given * (1.0 - gain))]
        known.append(answer("once", 9.0))
        unanswered = dataclasses.replace(result(math.nan), scene="home-7")
        with_heading = Answers(own=known[:100], disturbed=known[100:])
        without = Answers(own=searched[:100], disturbed=[*searched[100:], unanswered])
        weights = with_heading_doubt(MatchingWeights(openings=0.3), with_heading, without)
        assert weights.usual_cost == pytest.approx(np.quantile(given, 0.95))
        assert weights.usual_gain == pytest.approx(np.quantile(gain, 0.995))
        assert weights.openings == 0.3
        assert with_heading_doubt(weights, Answers(own=[]), Answers(own=[])) == weights


class TestAppearance:
    def test_mixtures_are_recovered(self) -> None:
        rng = np.random.default_rng(0)
        true = rng.dirichlet(np.ones(4), 4)
        drawn = np.repeat(np.arange(4), 2000)
        # What is seen is recognised in nine of ten cases.
        recognised = 0.9 * np.eye(4) + 0.025
        seen = [rng.choice(4, p=true[code] @ recognised) for code in drawn]
        likelihood = recognised[:, seen].T
        np.testing.assert_allclose(mixtures(likelihood, drawn), true, atol=0.05)
        np.testing.assert_array_equal(mixtures(likelihood[:2000], drawn[:2000])[1:], np.eye(4)[1:])

    def test_plans_are_redrawn_by_conventions(self) -> None:
        document = plan_of(rectangle(6.0, 4.0)).to_dict()
        document["openings"] = [
            {"kind": "window", "line": [[0.5, 0.0], [1.5, 0.0]], "sill_m": 0.0, "head_m": 2.1},
            {"kind": "window", "line": [[2.0, 0.0], [3.0, 0.0]], "sill_m": 0.9, "head_m": 2.1},
            {"kind": "passage", "line": [[3.5, 0.0], [4.5, 0.0]]},
            {"kind": "passage", "line": [[1.0, 4.0], [4.0, 4.0]]},
            {"kind": "door", "line": [[5.0, 0.0], [5.9, 0.0]]},
        ]
        plan = FloorPlan.from_dict(document)
        kinds = [[opening.kind for opening in redrawn(plan, seed).openings] for seed in range(40)]
        by_opening = [set(drawn) for drawn in zip(*kinds, strict=True)]
        # Windows above a sill and wide passages have one convention.
        assert by_opening == [{"window", "door"}, {"window"}, {"passage", "door"}, {"passage"}, {"door", "passage"}]
        assert redrawn(plan, 3).to_dict() == redrawn(plan, 3).to_dict()

    def test_fit_needs_predicted_openings_and_gives_probabilities(self, encoders: PhotographEncoder) -> None:
        scenes = [GeneratedScenes(homes=1, shots_per_home=1).load("validation-00000")]
        with pytest.raises(BundleError, match="predicts no openings"):
            fit_appearance(encoders, scenes)
        rows = np.array(fit_appearance(encoder(), scenes))
        assert MatchingWeights(appearance=tuple(map(tuple, rows.tolist()))).appearance is not None
        # Half of the result is the prior, in which walls look like walls.
        assert rows[0, 0] > 0.49


class TestMatchingWeights:
    def choice(self, rng: np.random.Generator, weights: np.ndarray) -> Prediction:
        """Return a query of ten candidates, the right one drawn with the probability of these weights."""
        terms = rng.uniform(0.0, 0.5, (10, 4))
        score = -(terms @ weights)
        right = rng.choice(10, p=np.exp(score) / np.exp(score).sum())
        rivals = [
            PredictedCandidate(
                pose=dataclasses.replace(TRUTH, x_m=0.2 if k == right else 3.0 + k),
                terms=dict(zip(("walls", "openings", "ceiling", "room_type"), map(float, row), strict=True))
                | {"objects": 0.0, "height": 0.0},
                probability=0.1,
            )
            for k, row in enumerate(terms)
        ]
        return dataclasses.replace(result(0.2), candidates=tuple(rivals))

    def test_fit_recovers_generating_weights(self) -> None:
        rng = np.random.default_rng(0)
        made = np.array([12.0, 9.0, 1.0, 3.0])
        model = fit_matching_weights([self.choice(rng, made) for _ in range(1500)])
        found = model.temperature * np.array([1.0, model.openings, model.ceiling, model.room_type])
        np.testing.assert_allclose(found, made, atol=1.5)

    def test_uninformative_queries_keep_default_weights(self) -> None:
        assert fit_matching_weights([result(0.2)]) == fit_matching_weights([]) == MatchingWeights()

    def test_constant_terms_keep_their_weights(self) -> None:
        rng = np.random.default_rng(1)
        queries = []
        for _ in range(50):
            prediction = self.choice(rng, np.array([12.0, 0.0, 0.0, 0.0]))
            rivals = tuple(dataclasses.replace(r, terms={**r.terms, "openings": 0.0}) for r in prediction.candidates)
            queries.append(dataclasses.replace(prediction, candidates=rivals))
        model = fit_matching_weights(queries)
        default = MatchingWeights()
        assert model.openings * model.temperature == pytest.approx(default.openings * default.temperature, rel=1e-3)


class TestCovariance:
    @pytest.mark.slow
    @given(seed=seeds(), factor=st.floats(1e-3, 1e3))
    @settings(max_examples=10)
    def test_fit_recovers_generating_factors(self, seed: int, factor: float) -> None:
        rng = np.random.default_rng(seed)
        known, searched = [], []
        for _ in range(600):
            rows = rng.normal(size=(5, 3))
            information = 1e4 * factor * (rows.T @ rows + np.eye(3))
            error = rng.multivariate_normal(np.zeros(3), factor * np.linalg.inv(information))
            searched.append(bent(error[:2], information, math.degrees(error[2])))
            error = rng.multivariate_normal(np.zeros(2), 2.0 * factor * np.linalg.inv(information[:2, :2]))
            known.append(bent(error, information[:2, :2]))
        model = both(known, searched)
        assert model.position_factor == pytest.approx(2.0 * factor, rel=0.25)
        assert model.position_factor_searched == pytest.approx(factor, rel=0.25)
        assert model.heading_factor == pytest.approx(factor, rel=0.35)

    def test_wrong_poses_and_missing_curvature_are_ignored(self) -> None:
        right = [bent(np.array([0.01 * k, 0.0]), 100.0 * np.eye(2)) for k in range(1, 6)]
        wrong = [bent(np.array([2.0, 0.0]), 100.0 * np.eye(2))] * 20
        plain = [result(0.1)] * 20
        expected = present(both(right, []).position_factor)
        assert both(right + wrong + plain, []).position_factor == expected
        assert both(plain, []).position_factor is None
        assert both(right, []).heading_factor is None


CAMERA_M = 1.5
PLANS = training_plans(4, 0)


@pytest.fixture(scope="module")
def cohort(encoders: PhotographEncoder) -> Cohort:
    return cohort_of(PLANS, encoders.manifest.profile_columns, 0)


def log_cost_to_cohort(encoders: PhotographEncoder, cohort: Cohort | None, plan: FloorPlan, query: Query) -> float:
    weights, config = MatchingWeights(), MatchingConfig()
    grid = build_grid(plan, encoders.layouts, step_m=0.5, camera_height_m=CAMERA_M)
    cost = float(grid_costs(plan, grid, query, weights, config).cost.min())
    expected = cost_by_chance(cohort, plan, query, config.grid_reach * 0.5, weights, config)
    return log_cost_to_chance(cost, expected)


@pytest.mark.parametrize("log_scale", [-3.5, -2.0], ids=["clear", "dim"])
def test_only_the_own_home_fits_better_than_the_cohort(
    encoders: PhotographEncoder, cohort: Cohort, log_scale: float
) -> None:
    home, hall = crooked_flat(), plan_of(rectangle(14.0, 11.0))
    query = perfect_query(encoders, home, (5.1, 1.3), log_scale=log_scale)
    assert log_cost_to_cohort(encoders, cohort, home, query) < -0.5
    assert log_cost_to_cohort(encoders, cohort, hall, query) > 0.5


def test_signal_is_zero_without_cohort_or_profile(encoders: PhotographEncoder, cohort: Cohort) -> None:
    home = crooked_flat()
    query = perfect_query(encoders, home, (5.1, 1.3), log_scale=-3.5)
    assert log_cost_to_cohort(encoders, None, home, query) == 0.0
    assert log_cost_to_cohort(encoders, cohort, home, replace(query, profile=None)) == 0.0


def test_cohort_has_a_fixed_size_and_is_reproducible(cohort: Cohort, encoders: PhotographEncoder) -> None:
    columns = encoders.manifest.profile_columns
    assert cohort.log_profile.shape == cohort.kind.shape == (min(SIZE, len(cohort.kind)), columns)
    assert len(cohort.kind) > 500
    assert set(np.unique(cohort.kind)) > {0, 1}
    np.testing.assert_array_equal(cohort_of(PLANS, columns, 0).log_profile, cohort.log_profile)


class TestBundles:
    @pytest.fixture
    def with_cohort(self, opened_bundle: Bundle, cohort: Cohort, tmp_path: Path) -> Bundle:
        folder = tmp_path / "bundle"
        shutil.copytree(opened_bundle.folder, folder)
        return store_cohort(Bundle.open(folder), cohort)

    def test_cohort_is_stored_and_gives_signals(
        self, with_cohort: Bundle, cohort: Cohort, optimiser: PoseRefiner
    ) -> None:
        found = present(Cohort.of_bundle(Bundle.open(with_cohort.folder)))
        np.testing.assert_array_equal(found.kind, cohort.kind)
        encoders, home = PhotographEncoder(with_cohort, threads=1), crooked_flat()
        query = perfect_query(encoders, home, (5.1, 1.3), log_scale=-3.5)
        grid = build_grid(home, encoders.layouts, step_m=0.5, camera_height_m=CAMERA_M)
        config = LocaliseConfig(every_stage=True)
        signals = localise(home, grid, encoders.layouts, query, refiner=optimiser.refine, config=config).signals
        expected = log_cost_to_cohort(encoders, cohort, home, query)
        assert len(signals) == 3
        for signal in signals.values():
            assert signal.cost_to_chance == pytest.approx(expected, abs=0.05)
        # The position lies between grid poses, so only refinement reaches the minimum.
        assert signals["retrieval"].answer_to_chance == pytest.approx(expected, abs=0.05)
        assert signals["lpo"].answer_to_chance < expected - 0.5

    def test_older_bundle_has_no_cohort(self, opened_bundle: Bundle) -> None:
        assert Cohort.of_bundle(opened_bundle) is None

    @pytest.mark.parametrize("damage", ["no arrays", "other columns"])
    def test_damaged_cohort_is_named(self, with_cohort: Bundle, cohort: Cohort, damage: str) -> None:
        narrow = Cohort(cohort.log_profile[:, :-1], cohort.kind[:, :-1]).to_bytes()
        (with_cohort.folder / COHORT).write_bytes(b"nothing" if damage == "no arrays" else narrow)
        changed = write_manifest(with_cohort.folder, with_cohort.manifest)
        with pytest.raises(BundleError, match=r"cohort\.npz"):
            Cohort.of_bundle(changed)
