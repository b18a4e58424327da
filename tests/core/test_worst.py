"""Worst queries: choice, summary and pictures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

from lalaloc_core.cli import main
from lalaloc_core.draw.canvas import FOUND, TRUE
from lalaloc_core.errors import RunError
from lalaloc_core.evaluate.report.sheets import PER_SHEET, Thumbnail, draw_sheet
from lalaloc_core.evaluate.report.worst import (
    SUMMARY_FILE,
    choose_worst,
    predicted_profile_m,
    summarise,
    write_worst,
)
from lalaloc_core.evaluate.runs.failures import Outcome, is_symmetric, outcomes, symmetric_by_chance
from lalaloc_core.evaluate.runs.predictions import Pose, Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.run import run_evaluation
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.poses import PredictedProfile, Query
from lalaloc_core.render.profile import wall_profile
from tests.strategies import plan_of, rectangle

# A room from (0, 0) to (6, 4) with its camera in the lower left corner.
PLAN = plan_of(rectangle(6.0, 4.0))
TRUTH = Pose(x_m=1.0, y_m=1.0, room_index=0, heading_deg=0.0)


def found_at(x_m: float | None, y_m: float = 1.0, room: int = 0, facts: tuple[str, ...] = ()) -> Prediction:
    """Return a prediction after a right first stage; None: no answer."""
    stages = {} if x_m is None else {"retrieval": TRUTH, "lpo": replace(TRUTH, x_m=x_m, y_m=y_m, room_index=room)}
    return Prediction(
        scene="s", camera="0", room="r", camera_height_m=1.5, truth=TRUTH, stages=stages, facts=facts, confidence=0.5
    )


class TestFailures:
    @pytest.mark.parametrize(
        ("x_m", "y_m", "symmetric"),
        [(5.0, 1.0, True), (1.0, 3.0, True), (5.2, 2.8, True), (3.0, 2.0, False), (1.1, 1.0, False)],
    )
    def test_mirrored_poses_are_recognised(self, x_m: float, y_m: float, symmetric: bool) -> None:
        assert is_symmetric(PLAN, found_at(x_m, y_m)) == symmetric

    def test_wrong_room_is_not_mirrored(self) -> None:
        assert not is_symmetric(PLAN, found_at(None))
        assert not is_symmetric(PLAN, found_at(5.0, 1.0, room=1))

    def test_chance_is_share_of_mirrored_positions(self) -> None:
        rng = np.random.default_rng(0)
        everywhere = [found_at(x, y) for x, y in rng.uniform((0.0, 0.0), (6.0, 4.0), (2000, 2))]
        wrong = [pose for pose in everywhere if outcomes([pose]) == [Outcome.WRONG_ALIGNMENT]]
        share = np.mean([is_symmetric(PLAN, pose) for pose in wrong])
        assert symmetric_by_chance(PLAN, wrong[0]) == pytest.approx(share, abs=0.02)


class TestSummary:
    def test_misses_come_first_then_largest_errors(self) -> None:
        near, far, missed = found_at(1.1), found_at(4.0), found_at(None)
        assert choose_worst([near, far, missed], 2) == [missed, far]
        assert choose_worst([near, far], 5) == [far, near]

    def test_facts_are_compared_with_all_queries(self) -> None:
        corridor, mirror = ("corridor",), ("mirror",)
        every = [found_at(4.0, facts=corridor), found_at(None, facts=corridor)]
        every += [found_at(1.1, facts=facts) for facts in (corridor, mirror, mirror, mirror, (), ())]
        summary = summarise(every, every[:2], [])
        assert summary["facts"] == {
            "corridor": {"worst": 1.0, "all": 3 / 8, "lift": pytest.approx(8 / 3)},
            "mirror": {"worst": 0.0, "all": 3 / 8, "lift": 0.0},
        }
        assert summary["outcomes"] == {"located": 0, "wrong alignment": 1, "wrong room": 0, "no answer": 1}
        assert summary["error_m"] == {"least": 3.0, "most": 3.0}
        # The answered query had a right first stage.
        assert summary["lost_after_first_stage"] == 1


class TestPredictedWalls:
    @pytest.mark.parametrize("heading", [0.0, 0.7, 4.0])
    def test_predicted_profile_is_in_photograph_frame(self, heading: float) -> None:
        here, walls = np.array([[1.0, 1.0]]), PLAN.walls_m[[0]]
        columns = 512
        turned = np.log(wall_profile(here, np.zeros(1), walls, columns))
        profile = PredictedProfile(turned, np.zeros_like(turned))
        query = Query(np.ones((1, 1)), np.array([heading]), 0.0, True, CameraHeight(1.5), profile)
        expected = wall_profile(here, np.array([heading]), walls, 128)[0]
        np.testing.assert_allclose(predicted_profile_m(query, 128), expected, rtol=0.02)


@pytest.fixture(scope="module")
def layout_run(tiny_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run of layout queries of two generated homes, one of them made wrong."""
    folder = RunFolder(tmp_path_factory.mktemp("worst"))
    info = RunInfo(
        label="two homes",
        method="lalaloc",
        kind="layout",
        dataset="generated homes (seed 0)",
        split="validation",
        settings={"refine": "none"},
        generated={"homes": 2, "shots_per_home": 2, "furniture": "empty"},
        bundle=str(tiny_bundle),
    )
    predictions = run_evaluation(folder, info, workers=0)
    folder.replace([replace(predictions[0], stages={}), *predictions[1:]])
    return folder.path


class TestPages:
    def test_sheets_and_summary_match_the_run(self, layout_run: Path, tmp_path: Path) -> None:
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
            assert abs(query["distance_bias"]) < 1e-3
            assert query["found_cost"] is None or query["found_cost"] > query["true_cost"]
        assert summary["true_pose_fits"] == {"compared": 2, "better_than_found": 2}
        assert summary["pages"] == ["worst-01.png"]
        with Image.open(tmp_path / "worst-01.png") as page:
            pixels = np.asarray(page.convert("RGB"), dtype=float).reshape(-1, 3)
        # Lines are smoothed, so a pixel rarely has exactly the colour of a layout.
        for colour in (ImageColor.getrgb(TRUE), ImageColor.getrgb(FOUND)):
            assert np.abs(pixels - colour).max(axis=1).min() < 48.0

    def test_command_prints_common_features(
        self, layout_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["worst", str(layout_run), "--count", "1", "--out", str(tmp_path)]) == 0
        assert json.loads(capsys.readouterr().out)["outcomes"]["no answer"] == 1

    def test_missing_query_is_named(self, layout_run: Path, tmp_path: Path) -> None:
        run = RunFolder(tmp_path / "run")
        run.write_info(RunFolder(layout_run).read_info())
        run.append([replace(query, camera="gone") for query in RunFolder(layout_run).read_predictions()[:1]])
        summary = write_worst(run.path, tmp_path / "out", 1)
        assert "camera 'gone' is missing" in summary["left_out"][0]
        assert summary["pages"] == []

    def test_run_without_predictions_is_refused(self, layout_run: Path, tmp_path: Path) -> None:
        run = RunFolder(tmp_path)
        run.write_info(RunFolder(layout_run).read_info())
        with pytest.raises(RunError, match="has no predictions"):
            write_worst(tmp_path, tmp_path / "out", 1)

    def test_sheet_grows_by_rows(self) -> None:
        thumbnail = Thumbnail(Image.new("RGB", (384, 192)), ["a word " * 40])
        heights = [draw_sheet("t", {"#ff0000": "red"}, [thumbnail] * count).height for count in (1, 4, 5, PER_SHEET)]
        assert heights[0] == heights[1] < heights[2] < heights[3]
