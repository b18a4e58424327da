"""Tables of the paper: complete, with named sources, and runnable."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lalaloc_core.cli import main
from lalaloc_core.errors import RunError
from lalaloc_core.evaluate.reproduce.ablations import ABLATIONS
from lalaloc_core.evaluate.reproduce.result import Figure, RowResult, TableResult, draw_vogel_samples, markdown
from lalaloc_core.evaluate.reproduce.table import COLUMN_TITLES, PAPER_SETTING, SHIPPED, RowQuery
from lalaloc_core.evaluate.reproduce.tables import TABLES
from lalaloc_core.evaluate.runs.factories import build_method
from lalaloc_core.evaluate.runs.predictions import RunInfo
from lalaloc_core.evaluate.runs.score import Scores, StageScores
from lalaloc_core.floorplan import FloorPlan
from tests.core.questions import question_at
from tests.strategies import plan_document, rectangle


def result(dataset: str = "synthetic scenes (seed 0)", budget: str = "small") -> TableResult:
    return TableResult(
        name="localisation",
        title="Localisation",
        source="tab:localisation",
        dataset=dataset,
        split="test",
        budget=budget,  # type: ignore[arg-type]
        command="lalaloc reproduce",
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
    def test_every_table_of_the_paper_exists(self) -> None:
        names = [table.name for table in TABLES]
        assert len(set(names)) == len(names)
        assert {table.source for table in TABLES} == {
            "tab:localisation",
            "tab:1m_refinement",
            "tab:furniture",
            "tab:refinement",
            "fig:vdr_sample",
            "tab:oracle",
            "tab:1m_oracle",
            "tab:e2e",
            "tab:lalalearning",
            "tab:layoutarch",
            "tab:rgblearning",
            "tab:time",
        }

    @pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
    def test_columns_and_models_exist(self, table) -> None:
        fields = set(Scores.__dataclass_fields__) | set(StageScores.__dataclass_fields__)
        for column in table.columns:
            assert column in COLUMN_TITLES
            assert column in fields or column.startswith("seconds")
        for row in table.rows:
            assert set(row.paper) <= set(table.columns), row.name
        assert set(table.models) <= set(ABLATIONS)

    @pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
    def test_every_row_has_a_valid_method(self, table, tiny_bundle: Path) -> None:
        for row in table.rows:
            ask = row.query
            info = RunInfo(
                label=row.name,
                method=ask.method,
                kind=ask.kind,
                dataset="",
                split=table.split,
                settings=dict(ask.settings),
                bundle=None if ask.model is None else str(tiny_bundle),
            )
            assert build_method(info) is not None

    def test_main_table_has_both_architectures(self) -> None:
        (table,) = (table for table in TABLES if table.name == "localisation")
        queries = {(row.query.method, row.query.kind, row.query.model) for row in table.rows}
        for kind in ("layout", "panorama"):
            assert {("lalaloc", kind, "paper"), ("lalaloc", kind, SHIPPED), ("icp", kind, None)} <= queries
            assert {("explicit", kind, SHIPPED), ("decode", kind, SHIPPED)} <= queries
        assert ("oracle", "layout", None) in queries


class TestPaperSetting:
    def test_all_rows_have_the_paper_setting(self) -> None:
        queries = [row.query for table in TABLES for row in table.rows if row.query.method == "lalaloc"]
        assert len(queries) > 20
        for query in queries:
            assert query.run_settings.items() >= PAPER_SETTING.items()
            assert query.run_settings.items() >= query.settings.items()
        assert RowQuery(method="icp").run_settings == {}

    def test_plan_openings_are_ignored(self, tiny_bundle: Path) -> None:
        bare = plan_document(rectangle(4.0, 3.0), rectangle(4.3, 3.6, at=(4.2, 0.0)))
        door = {"kind": "door", "line": [[4.1, 1.0], [4.1, 2.0]]}
        window = {"kind": "window", "line": [[1.0, 0.0], [2.5, 0.0]]}
        plans = [FloorPlan.from_dict(bare), FloorPlan.from_dict({**bare, "openings": [door, window]})]
        costs = []
        for settings in (RowQuery().run_settings, {}):
            info = RunInfo(
                label="a row",
                method="lalaloc",
                kind="layout",
                dataset="",
                split="test",
                settings=settings,
                bundle=str(tiny_bundle),
            )
            method = build_method(info)
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
        assert main(["reproduce", "--list"]) == 0
        printed = capsys.readouterr().out
        assert all(f"{table.name} " in printed for table in TABLES)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["--table", "roof"], "unknown table 'roof'; --table is one of localisation"),
            ([], "no table is chosen"),
            (["--table", "similarity"], "--data is missing"),
        ],
    )
    def test_invalid_request_has_exit_code_2(
        self, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["reproduce", *arguments]) == 2
        assert message in capsys.readouterr().err

    def test_tables_share_runs(self, tmp_path: Path, tiny_bundle: Path, capsys: pytest.CaptureFixture[str]) -> None:
        data, out = str(tmp_path / "scenes"), tmp_path / "out"
        for split in ("validation", "test"):
            assert main(["synth", "--scenes", "1", "--split", split, "--out", data, "--height", "64"]) == 0
        tables = ["similarity", "vogel-samples"]
        names = [word for name in tables for word in ("--table", name)]
        common = ["--data", data, "--out", str(out), "--bundle", str(tiny_bundle), "--limit", "3", "--workers", "0"]
        assert main(["reproduce", *names, *common]) == 0
        printed = capsys.readouterr().out
        assert "Layout-similarity metric" in printed
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


def test_vogel_figure_needs_its_rows(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not enough values"):
        draw_vogel_samples(result(), tmp_path / "figure.png")
