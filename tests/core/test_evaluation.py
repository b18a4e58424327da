"""Evaluation runs: every query is localised once, also after interruptions; commands `evaluate` and `score`."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from lalaloc_core.cli import main
from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import InvalidInputError, RunError
from lalaloc_core.evaluate.bench.accuracy import azimuth_figures
from lalaloc_core.evaluate.runs.evaluation import run_evaluation
from lalaloc_core.evaluate.runs.factories import build_dataset, choose_appearance
from lalaloc_core.evaluate.runs.predictions import PREDICTIONS_FILE, Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.score import heading_errors_deg, position_errors_m, score
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes, RenderedPhotograph, facts_of
from tests.core.questions import run_info
from tests.core.shipped import encoder
from tests.core.taken import EXAMPLES
from tests.strategies import present


@pytest.fixture
def layout_run(tiny_bundle: Path) -> RunInfo:
    """Return a run of layout queries: three generated homes, two queries each."""
    return run_info(generated={"homes": 3, "shots_per_home": 2}, bundle=str(tiny_bundle))


def without_times(predictions: list[Prediction]) -> list[Prediction]:
    return [dataclasses.replace(prediction, timings_ms={}) for prediction in predictions]


class TestGeneratedScenes:
    def test_scene_is_reproducible_and_splits_differ(self) -> None:
        scenes = GeneratedScenes(homes=3, shots_per_home=2)
        assert list(scenes.scenes("test")) == ["test-00000", "test-00001", "test-00002"]
        first, again = (scenes.load("test-00001") for _ in range(2))
        other = scenes.load("validation-00001")
        for a, b, c in zip(first.cameras, again.cameras, other.cameras, strict=True):
            np.testing.assert_array_equal(a.position_m, b.position_m)
            assert a.heading == b.heading != c.heading
            assert first.plan.room_index_at(a.position_m[None])[0] == a.room_index

    def test_photograph_and_depth_show_the_same_room(self) -> None:
        scene = GeneratedScenes(homes=1, furniture="empty").load("test-00000")
        camera = scene.cameras[0]
        (photograph,) = camera.photographs.values()
        assert photograph.image(32, 64).shape == (32, 64, 3)
        depth = photograph.depth_m()
        # The floor is directly below the camera, the ceiling directly above.
        np.testing.assert_allclose(depth[-1], camera.camera_height_m, rtol=1e-3)
        ceiling = scene.plan.ceiling_heights_m[camera.room_index]
        assert np.median(depth[0]) <= ceiling - camera.camera_height_m + 1e-3

    def test_unknown_scene_is_named(self) -> None:
        with pytest.raises(InvalidInputError, match="scene 'roof-1'"):
            GeneratedScenes(homes=1).load("roof-1")


class TestRunning:
    def test_layout_queries_are_located(self, layout_run: RunInfo, tmp_path: Path) -> None:
        info = dataclasses.replace(layout_run, generated={"homes": 4, "shots_per_home": 3})
        predictions = run_evaluation(RunFolder(tmp_path), info, workers=0)
        assert len(predictions) == 12
        errors = position_errors_m(predictions)
        assert np.mean(errors < 0.05) > 0.6
        assert np.median(errors) < np.median(position_errors_m(predictions, "retrieval"))
        assert heading_errors_deg(predictions).max() < 1e-3
        assert set(predictions[0].timings_ms) == {"encode", "retrieve", "vdr", "lpo"}
        assert present(score(predictions).layout_recall).value > 0.3
        assert [prediction.scene for prediction in predictions[::3]] == list(build_dataset(info).scenes("test"))

    @pytest.mark.slow
    @pytest.mark.parametrize("heading_known", [True, False])
    def test_every_sphere_is_answered(self, layout_run: RunInfo, tmp_path: Path, heading_known: bool) -> None:
        info = dataclasses.replace(layout_run, kind="photograph", furniture="full", heading_known=heading_known)
        predictions = run_evaluation(RunFolder(tmp_path), info, workers=0)
        assert len(predictions) == 6
        assert np.isfinite(position_errors_m(predictions)).all()
        assert (heading_errors_deg(predictions).max() < 1e-3) == heading_known
        assert RunFolder(tmp_path).read_predictions() == predictions
        # Facts come from the generator's shots.
        scenes = build_dataset(info)
        for prediction in predictions:
            camera = next(c for c in scenes.load(prediction.scene).cameras if c.name == prediction.camera)
            (photograph,) = camera.photographs.values()
            assert isinstance(photograph, RenderedPhotograph)
            assert prediction.facts == tuple(sorted(facts_of(photograph.shot)))
        assert any(prediction.facts for prediction in predictions)

    @pytest.mark.slow
    def test_workers_do_not_change_predictions(self, layout_run: RunInfo, tmp_path: Path) -> None:
        here = run_evaluation(RunFolder(tmp_path / "here"), layout_run, workers=0)
        there = run_evaluation(RunFolder(tmp_path / "there"), layout_run, workers=2)
        assert without_times(here) == without_times(there)

    @pytest.mark.slow
    def test_interrupted_run_resumes_to_the_same_file(self, layout_run: RunInfo, tmp_path: Path) -> None:
        expected = run_evaluation(RunFolder(tmp_path / "whole"), layout_run, workers=0)
        broken = RunFolder(tmp_path / "broken")
        broken.write_info(layout_run)
        # Interruption within the second scene.
        broken.append(expected[:3])
        done = run_evaluation(broken, dataclasses.replace(layout_run, command="again"), workers=0)
        assert without_times(done) == without_times(expected)
        assert without_times(broken.read_predictions()) == without_times(expected)
        assert broken.read_info().command == "again"

    @pytest.mark.slow
    def test_larger_limit_continues_the_run(self, layout_run: RunInfo, tmp_path: Path) -> None:
        folder = RunFolder(tmp_path)
        first = run_evaluation(folder, dataclasses.replace(layout_run, limit=3), workers=0)
        assert len(first) == len(folder.read_predictions()) == 3
        more = run_evaluation(folder, dataclasses.replace(layout_run, limit=5), workers=0)
        assert len(more) == len(folder.read_predictions()) == 5
        assert without_times(more[:3]) == without_times(first)
        assert len(run_evaluation(folder, dataclasses.replace(layout_run, limit=2), workers=0)) == 2

    def test_predictions_without_facts_are_read(self, layout_run: RunInfo, tmp_path: Path) -> None:
        (prediction,) = run_evaluation(RunFolder(tmp_path), dataclasses.replace(layout_run, limit=1), workers=0)
        assert prediction.facts == ()
        path = tmp_path / PREDICTIONS_FILE
        line = json.loads(path.read_text(encoding="utf-8"))
        del line["facts"]
        path.write_text(json.dumps(line) + "\n", encoding="utf-8")
        assert RunFolder(tmp_path).read_predictions() == [prediction]

    def test_other_description_is_refused_and_split_without_queries_leaves_no_folder(
        self, layout_run: RunInfo, tmp_path: Path
    ) -> None:
        run_evaluation(RunFolder(tmp_path), dataclasses.replace(layout_run, limit=1), workers=0)
        with pytest.raises(RunError, match=r"grid_step_m 0\.5, not 1\.0"):
            run_evaluation(RunFolder(tmp_path), dataclasses.replace(layout_run, grid_step_m=1.0), workers=0)
        folder, silent = RunFolder(tmp_path / "run"), {"homes": 1, "shots_per_home": 0}
        with pytest.raises(InvalidInputError, match="no queries"):
            run_evaluation(folder, dataclasses.replace(layout_run, generated=silent), workers=0)
        assert not folder.path.exists()

    def test_coarser_grid_is_less_accurate(self, layout_run: RunInfo, tmp_path: Path) -> None:
        medians = []
        for step in (0.5, 2.0):
            info = dataclasses.replace(layout_run, grid_step_m=step, settings={"refine": "none"})
            predictions = run_evaluation(RunFolder(tmp_path / str(step)), info, workers=0)
            assert list(predictions[0].stages) == ["retrieval"]
            medians.append(np.median(position_errors_m(predictions)))
        assert medians[0] < medians[1]

    def test_missing_appearance_is_refused(self) -> None:
        scenes = GeneratedScenes(homes=1)
        assert choose_appearance(scenes, None, None).furniture == "full"
        with pytest.raises(InvalidInputError, match="no photographs 'full/warm'; choose one of: full"):
            choose_appearance(scenes, "full", "warm")


class TestCommandLine:
    def test_score_needs_only_predictions(
        self, tiny_bundle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        arguments = ["--bundle", str(tiny_bundle), "--homes", "1", "--kind", "layout", "--workers", "0"]
        assert main(["lab", "evaluate", *arguments, "--out", str(tmp_path / "run"), "--json"]) == 0
        output = capsys.readouterr().out
        printed = json.loads(output)
        assert printed["n"] == 4
        assert re.search(r"\.\d{5}", output) is None
        assert 0.0 <= printed["final"]["within_1m"]["value"] <= 1.0
        info = RunFolder(tmp_path / "run").read_info()
        RunFolder(tmp_path / "run").write_info(dataclasses.replace(info, bundle="gone", data="gone"))
        assert main(["lab", "score", str(tmp_path / "run"), "--json"]) == 0
        (again,) = json.loads(capsys.readouterr().out).values()
        assert again == printed
        assert main(["lab", "score", str(tmp_path / "run")]) == 0
        table = capsys.readouterr().out
        assert "4 queries" in table
        assert "too few queries for an interval: 4; give at least 20" in table
        (row,) = [line for line in table.splitlines() if line.startswith("answer ")]
        assert f"{printed['final']['median_cm']['value']:.1f}" in row


@pytest.mark.slow
def test_scene_is_solved_as_one_album(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, run = tmp_path / "data" / "flat", tmp_path / "run"
    scene.mkdir(parents=True)
    shutil.copy(EXAMPLES / "flat.json", scene / "plan.json")
    for name in ("kitchen.jpg", "study.jpg", "phone.jpg"):
        shutil.copy(EXAMPLES / name, scene)
    (scene / "broken.jpg").write_bytes(b"\xff\xd8 no picture")
    # The place of the study's photograph is wrong: one correction makes all rooms right.
    (scene / "poses.csv").write_text(
        "photograph,x_m,y_m,heading_deg\nbroken.jpg,2.9,1.5,335\n"
        "kitchen.jpg,7.1,2.2,250\nstudy.jpg,2.6,6.75,340\nphone.jpg,2.9,1.5,335\n"
    )
    command = ["lab", "evaluate", "--albums", "--data", str(scene.parent), "--workers", "0", "--out", str(run)]
    assert main(command) != 0
    assert "scene 'flat', room 'broken.jpg'" in capsys.readouterr().err
    assert main([*command[:-1], str(tmp_path / "skipping"), "--skip-bad", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["n"], report["skipped"], report["clicks_per_album"]) == (3, 1, 1.0)
    for share in ("correct_room", "within_1m_30deg"):
        assert report["final"][share]["value"] == pytest.approx(2 / 3, abs=1e-3)
    # Two rooms are right, and all three are sure.
    assert report["room_calibration_error"] == pytest.approx(1 / 3, abs=0.1)
    phone = RunFolder(tmp_path / "skipping").read_predictions()[2]
    assert (phone.room_rank, phone.clicks, list(phone.stages)) == (1, 1, ["album"])
    assert main(["lab", "score", str(tmp_path / "skipping")]) == 0
    assert "corrections of an album until all rooms are right: 1.0" in capsys.readouterr().out


@pytest.mark.parametrize(
    "options",
    [["--heading", "known"], ["--refine", "vdr"], ["--method", "icp"], ["--view", "70", "--heading-error", "5"]],
)
def test_options_of_single_photographs_are_refused_for_albums(
    options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["lab", "evaluate", "--albums", *options]) != 0
    assert ("--albums" if "--method" in options else options[-2]) in capsys.readouterr().err


def test_figures_cover_every_sphere_and_azimuth() -> None:
    figures = azimuth_figures(encoder(), GeneratedScenes(homes=1, shots_per_home=3))
    assert figures["n"] == 3
    assert figures["median_error"] < 0.2
    recall, confusion = figures["classes"]["recall"], figures["confusion"]
    for kind in OPENING_CLASSES:
        assert confusion[kind][kind] == pytest.approx(recall[kind] or 0.0)
        assert sum(confusion[kind].values()) == pytest.approx(float(recall[kind] is not None))
    known = [share for share in recall.values() if share is not None]
    assert figures["classes"]["balanced_accuracy"] == pytest.approx(np.mean(known))
    assert figures["classes"]["balanced_accuracy"] > 0.4
