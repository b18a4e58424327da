"""Confidence: fitted on answers, honest on fresh ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.bundle import Bundle, write_manifest
from lalaloc_core.calibrate import calibrate, fit_confidence
from lalaloc_core.evaluation.predictions import Pose, Prediction
from lalaloc_core.evaluation.score import expected_calibration_error, position_errors_m
from tests.strategies import seeds


def result(error_m: float, distances: tuple[float, ...]) -> Prediction:
    """A query that was answered that far off; NaN stands for no answer."""
    truth = Pose(x_m=0.0, y_m=0.0, room_index=0, heading_deg=0.0)
    return Prediction(
        scene="a",
        camera="0",
        room="kitchen",
        camera_height_m=1.5,
        truth=truth,
        stages={} if np.isnan(error_m) else {"lpo": dataclasses.replace(truth, x_m=error_m)},
        candidate_distances=distances,
    )


def believable(count: int, seed: int) -> list[Prediction]:
    """Queries whose chance of being right falls with the latent distance and rises with the margin."""
    rng = np.random.default_rng(seed)
    results = []
    for distance, margin in rng.uniform(0.0, 1.0, (count, 2)):
        right = rng.random() < 1.0 / (1.0 + np.exp(-(1.0 - 6.0 * distance + 4.0 * margin)))
        results.append(result(0.2 if right else 3.0, (distance, distance + margin)))
    return results


class TestConfidence:
    def test_a_fit_finds_the_model_that_made_the_data(self) -> None:
        model = fit_confidence(believable(8000, 0))
        assert model.bias == pytest.approx(1.0, abs=0.3)
        assert model.distance == pytest.approx(-6.0, abs=0.6)
        assert model.margin == pytest.approx(4.0, abs=0.6)

    @given(seeds(), st.floats(0.0, 0.8), st.floats(0.0, 0.8), st.floats(0.01, 0.2))
    def test_confidence_falls_with_distance_and_rises_with_the_margin(
        self, seed: int, distance: float, margin: float, more: float
    ) -> None:
        model = fit_confidence(believable(800, seed))
        here = model.probability([distance, distance + margin])
        assert model.probability([distance + more, distance + more + margin]) < here
        assert model.probability([distance, distance + margin + more]) >= here

    def test_its_probabilities_are_frequencies(self) -> None:
        model = fit_confidence(believable(4000, 1))
        fresh = believable(4000, 2)
        confidence = np.array([model.probability(list(r.candidate_distances)) for r in fresh])
        assert expected_calibration_error(confidence, position_errors_m(fresh) < 1.0) < 0.04

    @pytest.mark.parametrize("right", [True, False])
    def test_queries_that_all_went_the_same_way_give_a_finite_model(self, right: bool) -> None:
        model = fit_confidence([result(0.1 if right else 5.0, (0.1 * k, 0.1 * k + 0.3)) for k in range(10)])
        assert all(np.isfinite(value) for value in dataclasses.asdict(model).values())
        assert (model.probability([0.3, 0.6]) > 0.5) == right

    def test_separable_queries_give_a_finite_model(self) -> None:
        results = [result(0.1, (0.1, 0.5)), result(5.0, (0.9, 0.95))] * 20
        model = fit_confidence(results)
        assert model.probability([0.1, 0.5]) > 0.9 > 0.1 > model.probability([0.9, 0.95])

    def test_single_candidates_count_as_clear_ones(self) -> None:
        lonely = [result(0.1, (0.2,)) for _ in range(5)] + [result(5.0, (0.8,)) for _ in range(5)]
        model = fit_confidence(lonely)
        assert model.no_rival_margin == 0.0
        assert model.probability([0.2]) > 0.5 > model.probability([0.8])

    def test_a_query_without_an_answer_counts_as_wrong(self) -> None:
        nan = float("nan")
        model = fit_confidence([result(nan, (0.5, 0.6)) for _ in range(20)])
        assert model.probability([0.5, 0.6]) < 0.5

    def test_calibration_is_stored_without_changing_the_model_s_identity(
        self, tiny_bundle: Path, opened_bundle: Bundle
    ) -> None:
        try:
            calibrated = calibrate(opened_bundle, believable(200, 0), "200 made-up queries")
            again = Bundle.open(tiny_bundle)
            assert again.sha256 == calibrated.sha256 == opened_bundle.sha256
            assert again.manifest.confidence == calibrated.manifest.confidence is not None
            assert again.manifest.metrics["validation"]["n"] == 200
            assert again.manifest.metrics["validation"]["queries"] == "200 made-up queries"
        finally:
            write_manifest(tiny_bundle, opened_bundle.manifest)
