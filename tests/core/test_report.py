"""Evaluation report: its figures equal the scores, and the page is self-contained."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lalaloc_core.errors import RunError
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.evaluate.report import write_report
from lalaloc_core.evaluate.report.report_tables import TOTAL, distance, number, stage_times
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder
from lalaloc_core.evaluate.runs.score import ALIGNMENT_LIMIT_M, Outcome, outcomes, position_errors_m, score
from tests.core.questions import prediction_of, run_info
from tests.strategies import present

VOID = {"meta", "link", "img", "br", "hr", "path", "use", "circle", "rect"}
NASTY = "<img src=x onerror=alert(1)> & \"'$x_{$"


class Page(HTMLParser):
    """Parsed page; parsing fails on unbalanced tags."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.words: list[str] = []
        self.tables: dict[str, list[list[str]]] = {}
        self._caption = ""
        self.feed(text)
        self.close()
        assert self.open == []

    @property
    def text(self) -> str:
        """Visible text, with single spaces."""
        return " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.tables[self._caption].append([])
        if tag in ("td", "th"):
            self.tables[self._caption][-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            return
        data = data.replace("\N{NO-BREAK SPACE}", " ")
        self.words.append(data)
        if self.open and self.open[-1] == "caption":
            self._caption = data
            self.tables[data] = []
        elif self.open and self.open[-1] in ("td", "th"):
            self.tables[self._caption][-1][-1] += data.strip()

    def table(self, caption: str) -> list[list[str]]:
        """Return the cells of a table, without the small text below them."""
        return next(rows for name, rows in self.tables.items() if name.startswith(caption))


def prediction(index: int = 0, error_m: float | None = 0.02, **changes: Any) -> Prediction:
    """Return a pose `error_m` to the right of the truth, after a first stage with twice the error; None: no answer."""
    truth = Pose(x_m=1.0, y_m=1.0, room_index=0, heading_deg=10.0)
    found = {} if error_m is None else {"retrieval": 2.0 * error_m, "lpo": error_m}
    values: dict[str, Any] = {
        "truth": truth,
        "scene": f"scene {index // 4}",
        "camera": str(index),
        "stages": {name: replace(truth, x_m=1.0 + off_m, heading_deg=12.0) for name, off_m in found.items()},
        "timings_ms": {"retrieve": 1.0 + index, "lpo": 100.0 + 10.0 * index},
    }
    return prediction_of(**(values | changes))


def in_room(query: Prediction, room_index: int) -> Prediction:
    return replace(query, stages={name: replace(pose, room_index=room_index) for name, pose in query.stages.items()})


def mixed() -> list[Prediction]:
    """Return twelve predictions of all outcomes, with confidences and recalls."""
    errors_m = [0.004, 0.02, 0.03, 0.06, 0.08, 0.3, 0.4, 0.7, 1.5, 3.0, 6.0, None]
    some = [
        prediction(k, error_m, layout_hit=k % 2 == 0, pose_hit=k % 3 == 0, confidence=0.95 - 0.07 * k)
        for k, error_m in enumerate(errors_m)
    ]
    return [in_room(query, 1) if k in (9, 10) else query for k, query in enumerate(some)]


def run_folder(path: Path, predictions: list[Prediction], **changes: Any) -> Path:
    """Write a run; its data set does not exist unless `changes` name one."""
    values: dict[str, Any] = {
        "label": "a run",
        "kind": "photograph",
        "dataset": "Somewhere3D",
        "data": str(path / "gone"),
        "command": "lalaloc lab evaluate --data gone",
    }
    folder = RunFolder(path)
    folder.write_info(run_info(**(values | changes)))
    folder.append(predictions)
    return path


def page_of(*runs: Path, out: Path) -> tuple[Page, str]:
    write_report(runs, out)
    text = out.read_text(encoding="utf-8")
    return Page(text), text


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("report")
    return page_of(run_folder(folder / "run", mixed()), out=folder / "report.html")[1]


@pytest.fixture(scope="module")
def page(text: str) -> Page:
    return Page(text)


class TestFailures:
    def test_outcomes_are_distinguished(self) -> None:
        kinds = {
            Outcome.LOCATED: prediction(error_m=0.1),
            Outcome.WRONG_ALIGNMENT: prediction(error_m=ALIGNMENT_LIMIT_M + 0.01),
            Outcome.WRONG_ROOM: in_room(prediction(error_m=0.1), 1),
            Outcome.NO_ANSWER: prediction(error_m=None),
        }
        assert outcomes(list(kinds.values())) == list(kinds)

    def test_stage_outcome_uses_its_own_pose(self) -> None:
        query = prediction(error_m=0.4 * ALIGNMENT_LIMIT_M + 0.1)
        assert outcomes([query]) == [Outcome.LOCATED]
        assert outcomes([query], "retrieval") == [Outcome.WRONG_ALIGNMENT]
        assert outcomes([query], "vdr") == [Outcome.NO_ANSWER]
        assert [outcomes(mixed()).count(kind) for kind in Outcome] == [7, 2, 2, 1]
        assert outcomes([]) == []


class TestFigures:
    def test_metric_table_has_the_scores(self, page: Page) -> None:
        scores = score(mixed())
        head, retrieval, lpo = page.table("Accuracy")
        assert head[:4] == ["stage", "n", "Layout R@1", "Pose R@1"]
        assert scores.pose_recall is not None
        estimates = (present(scores.layout_recall), present(scores.pose_recall))
        recalls = [f"{100 * estimate.value:.1f} %" for estimate in estimates]
        for row, stage, chosen in ((retrieval, "retrieval", recalls), (lpo, "lpo", ["–", "–"])):
            figures = scores.stages[stage]
            shares = (figures.within_1cm, figures.within_5cm, figures.within_10cm, figures.within_1m)
            assert row[:4] == [stage, "12", *chosen]
            assert math.isclose(float(row[4].removesuffix(" cm")), figures.median_cm.value, rel_tol=0.01)
            assert row[5:9] == [f"{100 * estimate.value:.1f} %" for estimate in shares]
            assert row[9] == f"{100 * figures.correct_room.value:.1f} %"
            assert row[10] == "2.00°"
        interval = scores.final.within_1m
        assert f"{100 * interval.low:.1f}–{100 * interval.high:.1f}" in page.text

    def test_answer_of_other_stage_has_a_row(self, tmp_path: Path) -> None:
        some = [prediction(0), prediction(1, stages={"retrieval": prediction(1).stages["retrieval"]})]
        page, _ = page_of(run_folder(tmp_path / "run", some), out=tmp_path / "report.html")
        assert [row[0] for row in page.table("Accuracy")] == ["stage", "retrieval", "lpo", "answer"]

    def test_curves_and_worst_queries_have_tables(self, page: Page) -> None:
        head, retrieval, lpo = page.table("Queries within")
        errors_m = position_errors_m(mixed(), "lpo")
        assert lpo[0] == "lpo"
        within_1m = 100 * np.mean(np.nan_to_num(errors_m, nan=np.inf) <= 1.0)
        assert lpo[head.index("1 m")] == f"{within_1m:.1f} %"
        assert retrieval[0] == "retrieval"
        head, *rows = page.table("Queries without an answer")
        assert head == ["query", "room", "outcome", "position error", "heading error", "confidence"]
        assert [row[2] for row in rows[:4]] == ["no answer", "wrong room", "wrong room", "wrong alignment"]
        assert [row[3] for row in rows[:4]] == ["–", "6.00 m", "3.00 m", "1.50 m"]

    def test_failures_times_and_calibration_are_shown_and_charts_described(self, page: Page) -> None:
        head, retrieval, answer = page.table("Queries by outcome")
        assert head[1:] == [kind.value for kind in Outcome]
        assert answer == ["answer", "7", "2", "2", "1"]
        assert retrieval[1:] == [str(outcomes(mixed(), "retrieval").count(kind)) for kind in Outcome]
        assert f"more than {ALIGNMENT_LIMIT_M:g} m" in page.text
        rows = {row[0]: row for row in page.table("Milliseconds")}
        assert rows["retrieve"][1:] == ["12", "6.50", "11.4"]
        assert rows[TOTAL][1] == "12"
        assert f"“within 1 m”: {score(mixed()).calibration_error:.3f}" in page.text
        assert len(page.table("Confidence and share")) == 1 + len(score(mixed()).reliability)
        drawings = [attributes for tag, attributes in page.tags if tag == "img"]
        assert len(drawings) == 2
        assert all(drawing["src"].startswith("data:image/svg+xml;base64,") and drawing["alt"] for drawing in drawings)

    def test_slices_have_a_table_worst_first(self, tmp_path: Path, page: Page) -> None:
        known = [
            prediction(k, error_m, facts=facts)
            for k, (error_m, facts) in enumerate([(0.02, ("near_wall",)), (3.0, ("corridor",)), (0.05, ("near_wall",))])
        ]
        rows = page_of(run_folder(tmp_path / "run", known), out=tmp_path / "r.html")[0].table(
            "Accuracy by difficulty of the photograph"
        )
        assert [row[0] for row in rows] == ["fact", "corridor", "near wall", "all queries"]
        assert [row[1].split()[0] for row in rows[1:]] == ["1", "2", "3"]
        assert not any(caption.startswith("Accuracy by difficulty of the photograph") for caption in page.tables)

    def test_run_description_is_shown(self, page: Page) -> None:
        for words in (
            "Somewhere3D, test split",
            "12 photograph queries",
            "1 without an answer",
            "lalaloc lab evaluate --data",
        ):
            assert words in page.text

    def test_numbers_have_three_digits_and_distances_their_unit(self) -> None:
        expected = {0.0: "0.00", 0.004: "< 0.01", 0.006: "0.01", 9.87: "9.87", 98.76: "98.8", 987.6: "988", np.inf: "∞"}
        assert {value: number(value) for value in expected} == expected
        assert (distance(0.0312), distance(1.0), distance(10.38)) == ("3.12 cm", "1.00 m", "10.4 m")

    def test_stage_times_skip_other_queries(self) -> None:
        timings_ms: list[dict[str, float]] = [{"a": 1.0}, {"a": 3.0, "b": 5.0}, {}]
        times = stage_times([prediction(k, timings_ms=query) for k, query in enumerate(timings_ms)])
        assert times["a"][:2] == (2, 2.0)
        assert times["b"] == (1, 5.0, 5.0)
        assert times[TOTAL][1] == np.median([1.0, 8.0])


class TestPage:
    def test_page_is_self_contained(self, page: Page, text: str) -> None:
        assert "script" not in {tag for tag, _ in page.tags}
        for tag, attributes in page.tags:
            for name in ("src", "href"):
                assert attributes.get(name, "#").startswith(("#", "data:")), (tag, attributes)
            assert not [name for name in attributes if name.startswith("on")]
        assert set(re.findall(r"url\((.)", text)) <= {"#"}
        assert "@import" not in text

    def test_every_colour_has_a_dark_mode(self, text: str) -> None:
        day, night = re.findall(r":root \{(.*?)\}", text, re.DOTALL)
        used = set(re.findall(r"var\((--[\w-]+)\)", text))
        assert used
        for colours in (day, night):
            assert used <= set(re.findall(r"(--[\w-]+):", colours))

    def test_text_from_files_is_escaped(self, tmp_path: Path) -> None:
        query = prediction(scene=NASTY, room=NASTY, camera=NASTY, timings_ms={NASTY: 1.0})
        query = replace(query, stages={NASTY: query.stages["lpo"], "lpo": query.stages["lpo"]}, confidence=0.5)
        run = run_folder(
            tmp_path / "run",
            [query],
            label=NASTY,
            dataset=NASTY,
            command=f"lalaloc {NASTY}",
            skipped=(f"scene {NASTY}",),
            furniture=NASTY,
            model={"name": NASTY, "version": NASTY, "sha256": NASTY},
            settings={NASTY: NASTY},
            data=NASTY,
        )
        for runs in ([run], [run, run]):
            page, _ = page_of(*runs, out=tmp_path / "report.html")
            assert all(attributes["src"].startswith("data:") for tag, attributes in page.tags if tag == "img")
            for words in (f"lalaloc {NASTY}", f"scene {NASTY}", f"{NASTY}, test split"):
                assert words in page.text

    def test_page_is_reproducible(self, tmp_path: Path) -> None:
        run = run_folder(tmp_path / "run", mixed())
        assert page_of(run, out=tmp_path / "a.html")[1] == page_of(run, out=tmp_path / "b.html")[1]
        assert list(tmp_path.glob("*.part")) == []

    def test_invalid_run_keeps_the_old_page(self, tmp_path: Path) -> None:
        (tmp_path / "report.html").write_text("before", encoding="utf-8")
        with pytest.raises(RunError, match="no evaluation run at"):
            write_report([tmp_path], tmp_path / "report.html")
        with pytest.raises(RunError, match="at least one run"):
            write_report([], tmp_path / "report.html")
        assert (tmp_path / "report.html").read_text(encoding="utf-8") == "before"


class TestRuns:
    def test_several_runs_share_a_page(self, tmp_path: Path) -> None:
        some = [run_folder(tmp_path / name, mixed()[: 4 * n], label=name) for n, name in ((3, "one"), (2, "two"))]
        page, _ = page_of(*some, out=tmp_path / "report.html")
        rows = page.table("Accuracy")[1:]
        assert [row[0] for row in rows] == ["1. one", "lpo", "2. two", "lpo"]
        assert [row[-10] for row in rows] == ["12", "12", "8", "8"]
        assert [row[0] for row in page.table("Queries within")[1:]] == ["1. one", "2. two"]

    def test_run_without_answers_is_all_misses(self, tmp_path: Path) -> None:
        some = [prediction(k, None, timings_ms={}) for k in range(4)]
        page, _ = page_of(run_folder(tmp_path / "run", some), out=tmp_path / "report.html")
        (_, row) = page.table("Accuracy")
        assert row[:2] == ["answer", "4"]
        assert row[4:] == ["∞ cm", *["0.0 %"] * 5, "∞°"]
        assert page.table("Queries by outcome")[1] == ["answer", "0", "0", "0", "4"]
        assert "No times were recorded" in page.text

    def test_run_without_predictions_has_no_scores(self, tmp_path: Path) -> None:
        empty = run_folder(tmp_path / "empty", [])
        page, _ = page_of(empty, out=tmp_path / "report.html")
        assert "holds no predictions yet" in page.text
        assert page.tables == {}
        page, _ = page_of(empty, run_folder(tmp_path / "run", mixed()), out=tmp_path / "report.html")
        assert [row[0] for row in page.table("Accuracy")[1:]] == ["2. a run", "lpo"]

    def test_calibration_is_absent_without_confidence(self, tmp_path: Path) -> None:
        some = [replace(query, confidence=None) for query in mixed()]
        page, _ = page_of(run_folder(tmp_path / "run", some), out=tmp_path / "report.html")
        assert "nothing to calibrate" in page.text
        assert sum(tag == "img" for tag, _ in page.tags) == 1


class TestWorst:
    def test_charts_are_written_as_files(self, tmp_path: Path) -> None:
        write_report([run_folder(tmp_path / "run", mixed())], tmp_path / "report.html", pictures=tmp_path / "charts")
        drawn = {path.stem: ElementTree.parse(path).getroot().tag for path in (tmp_path / "charts").iterdir()}
        assert drawn == dict.fromkeys(("calibration", "error-curves"), "{http://www.w3.org/2000/svg}svg")
