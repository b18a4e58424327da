"""Evaluation, confidence and the command line: failures count, and figures mean what they are called."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.bundle import Bundle, write_manifest
from lalaloc_core.calibrate import calibrate, fit_confidence
from lalaloc_core.cli import main
from lalaloc_core.evaluate import QueryResult, QuerySet, calibration_error, evaluate, summarise
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.optimise import LatentPoseOptimiser
from lalaloc_core.training.stream import TEST, VALIDATION
from tests.strategies import seeds


def result(error_m: float, distances: tuple[float, ...], confidence: float | None = None) -> QueryResult:
    return QueryResult(
        furniture="full",
        error_m=error_m,
        retrieval_error_m=2.0 * error_m,
        heading_error=0.01,
        correct_room=error_m < 2.0,
        candidate_distances=distances,
        confidence=confidence,
        timings_ms={"retrieve": 1.0, "vdr": 2.0},
    )


def believable(count: int, seed: int) -> list[QueryResult]:
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
        assert calibration_error(confidence, np.array([r.error_m < 1.0 for r in fresh])) < 0.04

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


class TestCalibrationError:
    def test_honest_confidence_has_none_and_boasting_all(self) -> None:
        assert calibration_error(np.array([0.0, 0.0, 1.0]), np.array([False, False, True])) == 0.0
        assert calibration_error(np.ones(4), np.zeros(4, dtype=bool)) == 1.0
        assert calibration_error(np.full(4, 0.75), np.array([True, True, True, False])) == 0.0

    def test_bins_are_weighted_by_their_queries(self) -> None:
        confidence = np.array([0.05, 0.95, 0.95, 0.95])
        correct = np.array([True, True, True, True])
        assert calibration_error(confidence, correct) == pytest.approx(0.25 * 0.95 + 0.75 * 0.05)

    @given(st.lists(st.tuples(st.floats(0.0, 1.0), st.booleans()), min_size=1, max_size=40))
    def test_it_is_a_share(self, queries: list[tuple[float, bool]]) -> None:
        confidence, correct = (np.array(column) for column in zip(*queries, strict=True))
        assert 0.0 <= calibration_error(confidence, correct) <= 1.0


class TestSummary:
    def test_an_unanswered_query_is_a_miss(self) -> None:
        summary = summarise([result(0.005, (0.1, 0.2)), result(float("nan"), (0.1, 0.2))])
        assert (summary["n"], summary["within_1cm"], summary["within_1m"]) == (2, 0.5, 0.5)
        assert summary["correct_room"] == 0.5
        assert summary["heading_within_2deg"] == 1.0
        assert summary["median_ms"] == {"retrieve": 1.0, "vdr": 2.0, "lpo": 0.0}
        assert "expected_calibration_error" not in summary

    def test_calibration_is_reported_where_there_is_confidence(self) -> None:
        summary = summarise([result(0.2, (0.1,), confidence=1.0), result(3.0, (0.1,), confidence=1.0)])
        assert summary["expected_calibration_error"] == pytest.approx(0.5)


class TestQueries:
    def test_the_same_query_set_asks_the_same_and_splits_ask_differently(self) -> None:
        first, second = (list(QuerySet(split=TEST, homes=3, shots_per_home=2).shots()) for _ in range(2))
        other = list(QuerySet(split=VALIDATION, homes=3, shots_per_home=2).shots())
        assert [len(shots) for shots in first] == [2, 2, 2]
        for a, b, c in zip(first, second, other, strict=True):
            np.testing.assert_array_equal(a[0].position_m, b[0].position_m)
            assert a[0].heading == b[0].heading
            assert a[0].heading != c[0].heading
            assert {shot.furniture for shot in a} == {"full"}

    @pytest.mark.parametrize("heading_known", [True, False])
    def test_panoramas_are_answered_every_one(
        self, encoders: Encoders, optimiser: LatentPoseOptimiser, heading_known: bool
    ) -> None:
        queries = QuerySet(split=TEST, homes=2, shots_per_home=2, furniture=None)
        answers = evaluate(encoders, queries, kind="panorama", heading_known=heading_known, refiner=optimiser.refine)
        assert len(answers) == 4
        assert all(np.isfinite(answer.error_m) for answer in answers)
        assert all(0.0 <= answer.heading_error <= np.pi for answer in answers)
        assert set(answers[0].timings_ms) == {"retrieve", "vdr", "lpo"}

    def test_layout_queries_are_found_again(self, encoders: Encoders, optimiser: LatentPoseOptimiser) -> None:
        queries = QuerySet(split=TEST, homes=4, shots_per_home=3)
        answers = evaluate(encoders, queries, kind="layout", heading_known=True, refiner=optimiser.refine)
        errors = np.array([answer.error_m for answer in answers])
        assert np.mean(errors < 0.05) > 0.6
        assert np.median(errors) < np.median([answer.retrieval_error_m for answer in answers])
        assert all(answer.heading_error < 1e-6 for answer in answers)


class TestCommandLine:
    def test_evaluate_prints_json(self, tiny_bundle: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["evaluate", "--bundle", str(tiny_bundle), "--homes", "1", "--kind", "layout"]) == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed["n"] == 4
        assert "within_1m" in printed

    def test_the_project_s_own_errors_are_a_message_and_an_exit_code(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["evaluate", "--bundle", str(tmp_path), "--homes", "1"]) == 1
        assert main(["export", "--run", str(tmp_path), "--out", str(tmp_path / "o"), "--version", "1"]) == 1
        errors = capsys.readouterr().err
        assert "error: no model bundle at" in errors
        assert "error: no checkpoint at" in errors

    @pytest.mark.parametrize("arguments", [[], ["fly"], ["train", "roof"], ["evaluate", "--kind", "song"]])
    def test_wrong_arguments_are_exit_code_2(self, arguments: list[str]) -> None:
        with pytest.raises(SystemExit) as caught:
            main(arguments)
        assert caught.value.code == 2
