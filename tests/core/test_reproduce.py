"""Tables of the paper: complete, with named sources, and runnable."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import get_args

import pytest
import safetensors.torch
import torch

from lalaloc_core.bundle import DECODER_WEIGHTS, IMAGE_ONNX, MANIFEST_NAME, Bundle
from lalaloc_core.cli import main
from lalaloc_core.errors import CheckpointError, ConfigError, RunError
from lalaloc_core.evaluate.reproduce import ablations
from lalaloc_core.evaluate.reproduce.ablations import ABLATIONS, BASE, Budget, train_ablation
from lalaloc_core.evaluate.reproduce.paper_tables import (
    COLUMN_TITLES,
    PAPER_SETTING,
    TABLES,
    Figure,
    RowQuery,
    RowResult,
    TableResult,
    markdown,
)
from lalaloc_core.evaluate.runs.factories import build_method
from lalaloc_core.evaluate.runs.score import Scores, StageScores
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.run import train_stage
from lalaloc_core.learn.training.training_data import TrainingData
from tests.core.questions import question_at, run_info
from tests.strategies import plan_document, rectangle


def result(dataset: str = "synthetic scenes (seed 0)", budget: str = "small") -> TableResult:
    return TableResult(
        name="localisation",
        title="Localisation",
        source="tab:localisation",
        dataset=dataset,
        split="test",
        budget=budget,  # type: ignore[arg-type]
        command="lalaloc lab reproduce",
        columns=("pose_recall", "median_cm"),
        rows=(
            RowResult(
                group="Layout",
                name="LaLaLoc",
                n=100,
                figures={"pose_recall": Figure(value=0.5, low=0.4, high=0.6), "median_cm": Figure(value=None)},
                paper={"pose_recall": 0.874},
            ),
        ),
    )


class TestTables:
    @pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
    def test_columns_and_models_exist(self, table) -> None:
        fields = set(Scores.__dataclass_fields__) | set(StageScores.__dataclass_fields__)
        for column in table.columns:
            assert column in COLUMN_TITLES
            assert column in fields or column.startswith("seconds")
        for row in table.rows:
            assert set(row.paper) <= set(table.columns), row.name
        assert set(table.models) <= set(ABLATIONS)

    def test_every_row_has_a_valid_method(self, tiny_bundle: Path) -> None:
        queries = [row.query for table in TABLES for row in table.rows]
        # Many rows differ in their model alone.
        asked = {(ask.method, ask.kind, repr(ask.settings), ask.model is None): ask for ask in queries}
        for ask in asked.values():
            bundle = None if ask.model is None else str(tiny_bundle)
            info = run_info(method=ask.method, kind=ask.kind, settings=dict(ask.settings), bundle=bundle)
            assert build_method(info) is not None


class TestPaperSetting:
    def test_all_rows_have_the_paper_setting(self) -> None:
        queries = [row.query for table in TABLES for row in table.rows if row.query.method == "lalaloc"]
        assert len(queries) > 20
        for query in queries:
            assert query.run_settings.items() >= PAPER_SETTING.items()
            assert query.run_settings.items() >= query.settings.items()
        assert RowQuery(method="icp").run_settings == {}

    def test_plan_openings_are_ignored(self, tiny_bundle: Path) -> None:
        bare = plan_document(rectangle(4.0, 3.0), rectangle(4.3, 3.6, corner=(4.2, 0.0)))
        door = {"kind": "door", "line": [[4.1, 1.0], [4.1, 2.0]]}
        window = {"kind": "window", "line": [[1.0, 0.0], [2.5, 0.0]]}
        plans = [FloorPlan.from_dict(bare), FloorPlan.from_dict({**bare, "openings": [door, window]})]
        costs = []
        for settings in (RowQuery().run_settings, {}):
            method = build_method(run_info(settings=settings, bundle=str(tiny_bundle)))
            answers = [method.locate(question_at(plan, (1.3, 1.4))) for plan in plans]
            costs.append([[candidate.pose.distance for candidate in answer.candidates] for answer in answers])
        in_the_paper, usual = costs
        assert in_the_paper[0] == in_the_paper[1]
        assert usual[0] != usual[1]


class TestRendering:
    def test_figures_name_their_source(self) -> None:
        text = markdown(result())
        assert "| Layout: LaLaLoc | 50.0 % [40, 60] · *87.4 %* | ∞ | 100 |" in text
        assert "synthetic scenes (seed 0)" in text
        assert "not the same experiment" in text

    @pytest.mark.parametrize(
        ("dataset", "budget", "same"),
        [("Structured3D", "full", True), ("Structured3D", "small", False), ("Structured4D", "full", False)],
    )
    def test_same_experiment_needs_structured3d_and_full_budget(self, dataset: str, budget: str, same: bool) -> None:
        assert ("not the same experiment" not in markdown(result(dataset, budget))) == same

    def test_table_round_trips(self, tmp_path: Path) -> None:
        path = tmp_path / "table.json"
        path.write_text(result().to_json(), encoding="utf-8")
        assert TableResult.read(path) == result()
        path.write_text("{}", encoding="utf-8")
        with pytest.raises(RunError, match="not a table of results"):
            TableResult.read(path)


class TestCommand:
    def test_list_names_every_table(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["lab", "reproduce", "--list"]) == 0
        printed = capsys.readouterr().out
        assert all(f"{table.name} " in printed for table in TABLES)

    @pytest.mark.slow
    def test_tables_share_runs(self, tmp_path: Path, tiny_bundle: Path, capsys: pytest.CaptureFixture[str]) -> None:
        data, out = str(tmp_path / "scenes"), tmp_path / "out"
        for split in ("validation", "test"):
            assert main(["lab", "synth", "--scenes", "1", "--split", split, "--out", data, "--height", "64"]) == 0
        tables = ["similarity", "vogel-samples"]
        names = [word for name in tables for word in ("--table", name)]
        common = ["--data", data, "--out", str(out), "--bundle", str(tiny_bundle), "--limit", "3", "--workers", "0"]
        assert main(["lab", "reproduce", *names, *common]) == 0
        assert "Layout-similarity metric" in capsys.readouterr().out
        similarity = TableResult.read(out / "tables" / "similarity.json")
        pose = similarity.rows[0].figures
        assert pose["pose_recall"].value == 1.0
        assert pose["correct_room"].value == 1.0
        medians = [row.figures["median_cm"].value or 0.0 for row in similarity.rows]
        assert min(medians) == medians[0] > 0.0
        assert (similarity.dataset, similarity.rows[0].n) == ("synthetic scenes (seed 0)", 3)
        assert (out / "tables" / "vogel-samples.png").stat().st_size > 1000
        assert json.loads((out / "tables" / "vogel-samples.json").read_text())["rows"]
        # Four metrics and the nearest pose; six numbers of samples.
        assert len(list((out / "runs").iterdir())) == 11


CPU = torch.device("cpu")
HOMES = GeneratedScenes(homes=3, shots_per_home=2)


def differences(first: dict[str, object], second: dict[str, object], path: str = "") -> set[str]:
    """Return the paths of the settings in which two configurations differ."""
    found: set[str] = set()
    for key, value in first.items():
        other = second[key]
        if isinstance(value, dict) and isinstance(other, dict):
            found |= differences(value, other, f"{path}{key}.")
        elif value != other:
            found.add(path + key)
    return found


class TestTable:
    @pytest.mark.parametrize(
        ("name", "changed"),
        [
            ("layout-log-ratio", {"layout.decode_weight"}),
            ("layout-decode", {"layout.log_ratio_weight"}),
            ("layout-resnet50", {"paper.layout_depth"}),
            ("layout-mlp", {"paper.layout_predictor"}),
            ("image-log-ratio", {"image.l2_weight", "image.log_ratio_weight"}),
            ("image-l2-log-ratio", {"image.log_ratio_weight"}),
            ("image-l2-kd", {"image.kd_weight"}),
            ("end-to-end", set()),
        ],
    )
    def test_small_variant_differs_only_in_its_setting(self, name: str, changed: set[str]) -> None:
        base, config = ABLATIONS[BASE].config["small"], ABLATIONS[name].config["small"]
        assert differences(base.to_dict(), config.to_dict()) == changed | {"name"}

    def test_full_variants_follow_the_paper(self) -> None:
        base = ABLATIONS[BASE].config["full"]
        assert (base.paper.width, base.paper.layout_depth, base.paper.image_depth) == (64, 18, 50)
        assert (base.image.batch, base.image.optimiser.learning_rate) == (64, 0.1)
        # "When trained with a variant of the log-ratio, the training routine follows that of the layout branch."
        for name in ("image-log-ratio", "image-l2-log-ratio", "image-l2-kd", "end-to-end"):
            image, layout = ABLATIONS[name].config["full"].image, ABLATIONS[name].config["full"].layout
            assert (image.batch, image.steps, image.optimiser) == (4, layout.steps, layout.optimiser)

    @pytest.mark.parametrize("budget", get_args(Budget))
    def test_variants_share_networks_of_the_base(self, budget: Budget) -> None:
        for ablation in ABLATIONS.values():
            if ablation.layout_from is not None:
                teacher = ABLATIONS[ablation.layout_from].config[budget]
                assert (teacher.paper, teacher.turns) == (ablation.config[budget].paper, ablation.config[budget].turns)


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shrink every small variant so that it trains in a second."""

    sizes = {"paper.width": 8, "paper.image_depth": 18, "paper.image_height": 64, "paper.image_width": 128}
    sizes |= {"layout.steps": 3, "layout.homes_per_step": 2, "image.steps": 3, "image.batch": 2}
    sizes |= {"layout.triplets.positives": 1, "layout.triplets.negatives": 3}
    small = {
        name: dataclasses.replace(ablation, config={"small": ablation.config["small"].with_settings(sizes)})
        for name, ablation in ABLATIONS.items()
    }
    monkeypatch.setattr(ablations, "ABLATIONS", small)
    monkeypatch.setattr(ablations, "_VALIDATION_SCENES", 1)


def train(name: str, out: Path, *, homes: GeneratedScenes = HOMES) -> Bundle:
    return train_ablation(name, "small", homes, out, device=CPU, workers=0)


def written(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.mark.usefixtures("brief")
class TestTraining:
    @pytest.mark.slow
    def test_image_variants_share_stage_one(self, tmp_path: Path) -> None:
        first = train("image-l2-kd", tmp_path)
        assert first.folder == tmp_path / "image-l2-kd" / "bundle"
        assert first.manifest.training["budget"] == "small"
        assert first.manifest.training["image"]["data"]["description"] == HOMES.description
        assert not (tmp_path / "image-l2-kd" / "layout.pt").exists()
        teacher = Checkpoint.load(tmp_path / BASE / "layout.pt", stage="layout")
        bias = safetensors.torch.load(first.read(DECODER_WEIGHTS))["to_depth.bias"]
        torch.testing.assert_close(bias, teacher.inference_weights["decoder"]["to_depth.bias"])
        before = written(tmp_path)
        assert train("image-l2-kd", tmp_path).sha256 == first.sha256
        assert written(tmp_path) == before

    @pytest.mark.slow
    def test_layout_variant_has_no_image_encoder(self, tmp_path: Path) -> None:
        bundle = train("layout-log-ratio", tmp_path)
        assert not {IMAGE_ONNX, DECODER_WEIGHTS} & set(bundle.manifest.files)
        # An interrupted export is repeated without training.
        before = written(tmp_path)["layout-log-ratio/layout.pt"]
        (bundle.folder / MANIFEST_NAME).unlink()
        assert train("layout-log-ratio", tmp_path).sha256 == bundle.sha256
        assert written(tmp_path)["layout-log-ratio/layout.pt"] == before

    @pytest.mark.slow
    def test_variant_resumes_on_its_own_data_set_only(self, tmp_path: Path) -> None:
        config = ablations.ABLATIONS["layout-mlp"].config["small"]
        shorter = config.with_settings({"layout.steps": 2})
        train_stage("layout", shorter, tmp_path / "layout-mlp", device=CPU, data=TrainingData(dataset=HOMES), workers=0)
        with pytest.raises(CheckpointError, match="not on"):
            train("layout-mlp", tmp_path, homes=dataclasses.replace(HOMES, seed=1))
        resumed = train("layout-mlp", tmp_path)
        assert Checkpoint.load(tmp_path / "layout-mlp" / "layout.pt").step == 3
        assert resumed.manifest.training["layout"]["steps"] == 3
        assert resumed.manifest.layout_config["layout_predictor"] == "mlp"

    def test_unknown_variant_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="unknown variant 'layout-resnet34'"):
            train("layout-resnet34", tmp_path)
