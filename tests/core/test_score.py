"""Scores, their bootstrap intervals, calibration, the run folder, and the worst queries."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.cli import main
from lalaloc_core.errors import InvalidInputError, RunError
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.report.worst import SUMMARY_FILE, summarise, write_worst
from lalaloc_core.evaluate.runs.evaluation import run_evaluation
from lalaloc_core.evaluate.runs.predictions import PREDICTIONS_FILE, SCORES_FILE, Prediction, RunFolder
from lalaloc_core.evaluate.runs.score import (
    Outcome,
    choose_worst,
    expected_calibration_error,
    heading_errors_deg,
    position_errors_m,
    reliability_bins,
    score,
    score_run,
)
from tests.core.questions import prediction_of, run_info
from tests.strategies import present

INFO = run_info()


def prediction(
    *errors_m: float,
    scene: str = "a",
    confidence: float | None = None,
    turned_deg: float = 0.0,
    room: int = 0,
    facts: tuple[str, ...] = (),
) -> Prediction:
    """Return a query with position errors (m) by stage."""
    stages = ("retrieval", "vdr", "lpo")
    return prediction_of(
        Pose(x_m=1.0, y_m=2.0, room_index=0, heading_deg=350.0),
        scene=scene,
        stages={
            stage: Pose(x_m=1.0 + error, y_m=2.0, room_index=room, heading_deg=(350.0 + turned_deg) % 360.0)
            for stage, error in zip(stages, errors_m, strict=False)
        },
        layout_hit=bool(errors_m) and errors_m[0] < 0.3,
        pose_hit=bool(errors_m) and errors_m[0] < 0.2,
        confidence=confidence,
        timings_ms={"retrieve": 1.0, "lpo": 10.0} if errors_m else {},
        facts=facts,
    )


class TestScores:
    def test_final_scores_use_the_final_pose(self) -> None:
        scores = score([prediction(0.25, 0.06, 0.005), prediction(0.1, 0.05, 0.04), prediction(3.0, 3.0, 3.0, room=1)])
        assert (scores.n, scores.unanswered) == (3, 0)
        final = scores.final
        shares = (final.within_1cm, final.within_5cm, final.within_10cm, final.within_1m)
        np.testing.assert_allclose([share.value for share in shares], [1 / 3, 2 / 3, 2 / 3, 2 / 3])
        assert final.median_cm.value == pytest.approx(4.0)
        assert final.correct_room.value == pytest.approx(2 / 3)
        assert scores.stages["vdr"].median_cm.value == pytest.approx(6.0)
        assert list(scores.stages) == ["retrieval", "vdr", "lpo"]
        assert (present(scores.layout_recall).value, present(scores.pose_recall).value) == pytest.approx((2 / 3, 1 / 3))
        assert scores.median_ms == {"retrieve": 1.0, "lpo": 10.0}

    def test_missing_answer_or_stage_is_a_miss_in_every_score(self) -> None:
        scores = score([prediction(0.001), prediction(), prediction()])
        assert scores.unanswered == 2
        assert scores.final.within_1m.value == pytest.approx(1 / 3)
        assert scores.final.correct_room.value == pytest.approx(1 / 3)
        assert scores.final.median_cm.value == np.inf
        assert scores.final.median_heading_error_deg.value == np.inf
        assert present(scores.layout_recall).value == pytest.approx(1 / 3)
        partial = score([prediction(0.1, 0.1, 0.1), prediction(0.1)])
        assert partial.stages["lpo"].within_1m.value == 0.5

    def test_heading_error_wraps_around(self) -> None:
        assert heading_errors_deg([prediction(0.1, turned_deg=15.0)])[0] == pytest.approx(15.0)
        assert heading_errors_deg([prediction(0.1, turned_deg=-200.0)])[0] == pytest.approx(160.0)
        assert np.isnan(heading_errors_deg([prediction()])[0])

    def test_method_without_retrieval_has_no_recall_and_no_predictions_are_refused(self) -> None:
        assert score([prediction_of(TRUTH)]).layout_recall is None
        with pytest.raises(InvalidInputError, match="no predictions"):
            score([])

    def test_slices_are_sorted_worst_first(self) -> None:
        both, query = ("corridor", "mirror"), ("corridor",)
        scores = score(
            [prediction(0.04, facts=both), prediction(facts=both), prediction(0.3, facts=query), prediction(0.02)]
        )
        assert list(scores.slices) == ["mirror", "corridor"]
        mirror, corridor = scores.slices.values()
        assert (mirror.n, corridor.n) == (2, 3)
        assert (mirror.within_1m.value, mirror.median_cm.value) == (0.5, np.inf)
        assert corridor.within_1m.value == pytest.approx(2 / 3)
        assert corridor.within_10cm.value == pytest.approx(1 / 3)
        assert corridor.median_cm.value == pytest.approx(30.0)
        assert score([prediction(0.1)]).slices == {}

    def test_slice_of_all_queries_has_their_scores(self) -> None:
        scores = score([prediction(0.05 * k, scene=str(k % 5), facts=("closet",)) for k in range(30)])
        closet, final = scores.slices["closet"], scores.final
        assert closet.n == scores.n
        for name in ("within_1m", "within_10cm", "median_cm"):
            assert getattr(closet, name) == getattr(final, name)

    def test_interval_of_few_queries_is_wide(self) -> None:
        rare = prediction(2.0, scene="b", facts=("closet",))
        found = score([rare, *(prediction(0.1, scene=str(k)) for k in range(9))]).slices["closet"]
        assert (found.median_cm.low, found.median_cm.high) == pytest.approx((200.0, 200.0))
        # Wilson's interval of one miss.
        assert (found.within_1m.low, found.within_1m.high) == pytest.approx((0.0, 0.793), abs=1e-3)
        both = score([prediction(0.1, scene="a"), prediction(0.2, scene="b")]).final.within_1m
        assert (both.value, both.high) == (1.0, 1.0)
        assert both.low == pytest.approx(0.342, abs=1e-3)

    @given(st.lists(st.floats(0.0, 30.0), min_size=1, max_size=30), st.integers(0, 5))
    def test_interval_contains_value_and_repeats_by_seed(self, errors: list[float], seed: int) -> None:
        predictions = [prediction(error, scene=str(k % 7)) for k, error in enumerate(errors)]
        first, again = (score(predictions, seed) for _ in range(2))
        assert first == again
        for estimate in (first.final.within_1m, first.final.median_cm):
            assert estimate.low <= estimate.high
        assert 0.0 <= first.final.within_1m.low <= first.final.within_1m.value <= first.final.within_1m.high <= 1.0

    def test_interval_shrinks_with_scenes(self) -> None:
        rng = np.random.default_rng(0)
        widths, covered = [], 0
        for count in (20, 320):
            hits = rng.random(count) < 0.7
            found = score([prediction(0.1 if hit else 5.0, scene=str(k)) for k, hit in enumerate(hits)]).final.within_1m
            widths.append(found.high - found.low)
        assert widths[1] < 0.4 * widths[0]
        for _ in range(40):
            hits = rng.random(60) < 0.7
            found = score([prediction(0.1 if hit else 5.0, scene=str(k)) for k, hit in enumerate(hits)]).final.within_1m
            covered += found.low <= 0.7 <= found.high
        assert covered >= 33

    def test_queries_of_one_scene_are_dependent(self) -> None:
        hits = np.arange(80) % 4 > 0
        apart = score([prediction(0.1 if hit else 5.0, scene=str(k)) for k, hit in enumerate(hits)])
        rng = np.random.default_rng(1)
        together = score(
            [prediction(0.1 if hit else 5.0, scene=str(k // 20)) for k, hit in enumerate(np.sort(hits))],
            seed=int(rng.integers(9)),
        )
        wide, narrow = together.final.within_1m, apart.final.within_1m
        assert wide.value == narrow.value
        assert wide.high - wide.low > 2.0 * (narrow.high - narrow.low)


class TestCalibration:
    def test_calibration_error_of_right_and_excessive_confidence(self) -> None:
        assert expected_calibration_error(np.array([0.0, 0.0, 1.0]), np.array([False, False, True])) == 0.0
        assert expected_calibration_error(np.ones(4), np.zeros(4, dtype=bool)) == 1.0
        assert expected_calibration_error(np.full(4, 0.75), np.array([True, True, True, False])) == 0.0
        # Bins are weighted by queries.
        confidence = np.array([0.05, 0.95, 0.95, 0.95])
        correct = np.array([True, True, True, True])
        assert expected_calibration_error(confidence, correct) == pytest.approx(0.25 * 0.95 + 0.75 * 0.05)

    @given(st.lists(st.tuples(st.floats(0.0, 1.0), st.booleans()), min_size=1, max_size=40))
    def test_diagram_has_every_query_once(self, queries: list[tuple[float, bool]]) -> None:
        confidence, correct = (np.array(column) for column in zip(*queries, strict=True))
        bins = reliability_bins(confidence, correct)
        assert sum(part.count for part in bins) == len(queries)
        for part in bins:
            assert part.low <= part.confidence <= part.high
            assert 0.0 <= part.frequency <= 1.0
        assert 0.0 <= expected_calibration_error(confidence, correct) <= 1.0

    def test_calibration_needs_confidence(self) -> None:
        scores = score([prediction(0.2, confidence=1.0), prediction(3.0, confidence=1.0)])
        assert scores.calibration_error == pytest.approx(0.5)
        assert score([prediction(0.2)]).calibration_error is None


def run_of(folder: Path, *predictions: Prediction) -> RunFolder:
    run = RunFolder(folder)
    run.write_info(INFO)
    run.append(predictions)
    return run


class TestRunFolder:
    def test_predictions_round_trip(self, tmp_path: Path) -> None:
        folder = RunFolder(tmp_path / "run")
        assert not folder.exists()
        folder.write_info(INFO)
        predictions = [prediction(0.1, 0.05, scene="ä"), prediction(), prediction(0.3, confidence=0.25)]
        folder.append(predictions[:2])
        folder.append(predictions[2:])
        assert folder.exists()
        assert folder.read_info() == INFO
        assert folder.read_predictions() == predictions

    def test_incomplete_last_line_is_ignored(self, tmp_path: Path) -> None:
        folder = run_of(tmp_path, prediction(0.1), prediction(0.2))
        path = tmp_path / PREDICTIONS_FILE
        path.write_text(path.read_text()[:-30])
        assert folder.read_predictions() == [prediction(0.1)]

    @pytest.mark.parametrize("text", ["not json\n", '{"scene": 3}\n', '{"scene": "a", "unknown": 1}\n', "[]\n"])
    def test_invalid_line_is_named(self, tmp_path: Path, text: str) -> None:
        folder = run_of(tmp_path, prediction(0.1))
        with (tmp_path / PREDICTIONS_FILE).open("a") as file:
            file.write(text)
        with pytest.raises(RunError, match="line 2 is not a prediction"):
            folder.read_predictions()

    def test_folder_without_run_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(RunError, match="no evaluation run at"):
            RunFolder(tmp_path / "nowhere").read_info()
        (tmp_path / "run.json").write_text('{"label": 3}')
        with pytest.raises(RunError, match="does not describe a run"):
            RunFolder(tmp_path).read_info()

    def test_scores_file_has_null_for_infinity(self, tmp_path: Path) -> None:
        folder = run_of(tmp_path, prediction(), prediction(), prediction(0.1))
        report = score_run(folder)
        assert report == json.loads((tmp_path / SCORES_FILE).read_text())
        assert report["final"]["median_cm"]["value"] is None
        assert report["n"] == 3
        assert position_errors_m(folder.read_predictions())[2] == pytest.approx(0.1)


TRUTH = Pose(x_m=1.0, y_m=1.0, room_index=0, heading_deg=0.0)


def found_at(x_m: float | None) -> Prediction:
    """Return a prediction after a right first stage; None: no answer."""
    stages = {} if x_m is None else {"retrieval": TRUTH, "lpo": replace(TRUTH, x_m=x_m)}
    return prediction_of(TRUTH, stages=stages, confidence=0.5)


class TestSummary:
    def test_misses_come_first_then_largest_errors(self) -> None:
        near, far, missed = found_at(1.1), found_at(4.0), found_at(None)
        assert choose_worst([near, far, missed], 2) == [missed, far]
        assert choose_worst([near, far], 5) == [far, near]

    def test_outcomes_are_counted(self) -> None:
        every = [found_at(4.0), found_at(None), found_at(1.1)]
        summary = summarise(every, every[:2], [])
        assert summary["outcomes"] == {"located": 0, "wrong alignment": 1, "wrong room": 0, "no answer": 1}


@pytest.fixture(scope="module")
def layout_run(tiny_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run of layout queries of two generated homes, one of them made wrong."""
    folder = RunFolder(tmp_path_factory.mktemp("worst"))
    generated = {"homes": 2, "shots_per_home": 2, "furniture": "empty"}
    info = run_info(split="validation", settings={"refine": "none"}, generated=generated, bundle=str(tiny_bundle))
    predictions = run_evaluation(folder, info, workers=0)
    folder.replace([replace(predictions[0], stages={}), *predictions[1:]])
    return folder.path


class TestWorst:
    def test_list_and_summary_match_the_run(self, layout_run: Path, tmp_path: Path) -> None:
        summary = write_worst(layout_run, tmp_path, 3)
        content = json.loads((tmp_path / SUMMARY_FILE).read_text(encoding="utf-8"))
        predictions = RunFolder(layout_run).read_predictions()
        expected = [(query.scene, query.camera) for query in choose_worst(predictions, 3)]
        worst = content.pop("worst")
        assert content == summary
        assert [(query["scene"], query["camera"]) for query in worst] == expected
        assert worst[0]["outcome"] == Outcome.NO_ANSWER
        assert worst[0]["error_m"] is None
        # Costs of a layout query are zero except at doors, which can be seen through.
        for query in worst:
            assert query["true_cost"] < 0.2
            assert query["found_cost"] is None or query["found_cost"] > query["true_cost"]
        assert summary["true_pose_fits"] == {"compared": 2, "better_than_found": 2}

    def test_command_prints_common_features(
        self, layout_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["lab", "worst", str(layout_run), "--count", "1", "--out", str(tmp_path)]) == 0
        assert json.loads(capsys.readouterr().out)["outcomes"]["no answer"] == 1

    def test_missing_query_is_named(self, layout_run: Path, tmp_path: Path) -> None:
        run = RunFolder(tmp_path / "run")
        run.write_info(RunFolder(layout_run).read_info())
        run.append([replace(query, camera="gone") for query in RunFolder(layout_run).read_predictions()[:1]])
        summary = write_worst(run.path, tmp_path / "out", 1)
        assert "camera 'gone' is missing" in summary["left_out"][0]

    def test_run_without_predictions_is_refused(self, layout_run: Path, tmp_path: Path) -> None:
        RunFolder(tmp_path).write_info(RunFolder(layout_run).read_info())
        with pytest.raises(RunError, match="has no predictions"):
            write_worst(tmp_path, tmp_path / "out", 1)
