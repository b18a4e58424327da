"""Tables of a report: figures as text, in HTML or Markdown."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from lalaloc_core.evaluate.report.charts import curves
from lalaloc_core.evaluate.report.scored_runs import Run, stage_times
from lalaloc_core.evaluate.runs.score import (
    Estimate,
    Outcome,
    SliceScores,
    StageScores,
    choose_worst,
    count_outcomes,
    heading_errors_deg,
    outcomes,
    position_errors_m,
)

CURVE_POINTS_M = (0.01, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 20.0)
METRICS = ("median", "< 1 cm", "< 5 cm", "< 10 cm", "< 1 m", "right room", "heading")
NOTHING = "–"


@dataclass(frozen=True)
class Cell:
    """Figure, with its interval or share in small type below."""

    text: str
    below: str = ""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Row of a table; `strong` for the most important one."""

    run: str
    part: str
    cells: tuple[Cell, ...]
    strong: bool = False


def metric_rows(runs: Sequence[Run]) -> list[Row]:
    """Return one row per stage of each run, and one for the final pose where it differs from the last stage."""
    rows = []
    for run in runs:
        scores = run.scores
        if scores is None:
            continue
        recalls = tuple(_share(recall) for recall in (scores.layout_recall, scores.pose_recall))
        none = (Cell(NOTHING), Cell(NOTHING))
        parts = dict(scores.stages)
        if scores.final not in parts.values():
            parts["answer"] = scores.final
        for place, (stage, figures) in enumerate(parts.items()):
            # Recall belongs to the first stage, retrieval.
            cells = (Cell(str(scores.n)), *(recalls if place == 0 else none), *_metrics(figures))
            rows.append(Row(run=run.name, part=stage, cells=cells, strong=place == len(parts) - 1))
    return rows


def curve_rows(runs: Sequence[Run]) -> list[Row]:
    """Return the share of queries within each of `CURVE_POINTS_M`, per curve of the chart."""
    rows = []
    for name, errors_m in curves([run for run in runs if run.predictions]).items():
        shares = [float(np.mean(errors_m <= limit_m)) for limit_m in CURVE_POINTS_M]
        rows.append(Row(run=name, part="", cells=tuple(Cell(percent(share)) for share in shares)))
    return rows


def outcome_rows(runs: Sequence[Run]) -> list[Row]:
    """Return the number of queries by outcome, for the first of several stages and for the final pose."""
    rows = []
    for run in runs:
        parts: list[tuple[str, str | None]] = [(run.stages[0], run.stages[0])] if len(run.stages) > 1 else []
        for part, stage in [*parts, ("answer", None)] if run.predictions else []:
            counts = count_outcomes(run.predictions, stage)
            cells = tuple(Cell(str(counts[kind]), percent(counts[kind] / len(run.predictions))) for kind in Outcome)
            rows.append(Row(run=run.name, part=part, cells=cells, strong=stage is None))
    return rows


def slice_rows(runs: Sequence[Run]) -> list[Row]:
    """Return one row per fact, the worst first, and one for all queries, for each run with facts."""
    rows = []
    for run in runs:
        if run.scores is None or not run.scores.slices:
            continue
        parts: dict[str, SliceScores | StageScores] = {**run.scores.slices, "all queries": run.scores.final}
        for name, figures in parts.items():
            count = figures.n if isinstance(figures, SliceScores) else run.scores.n
            cells = (
                Cell(str(count), percent(count / run.scores.n)),
                _share(figures.within_1m),
                _share(figures.within_10cm),
                _median(figures.median_cm, " cm"),
            )
            strong = isinstance(figures, StageScores)
            rows.append(Row(run=run.name, part=name.replace("_", " "), cells=cells, strong=strong))
    return rows


def reliability_rows(runs: Sequence[Run]) -> list[Row]:
    """Return the bins of the reliability diagrams."""
    return [
        Row(
            run=run.name,
            part=f"{100 * part.low:.0f}–{100 * part.high:.0f} %",
            cells=(Cell(str(part.count)), Cell(percent(part.confidence)), Cell(percent(part.frequency))),
        )
        for run in runs
        if run.scores is not None
        for part in run.scores.reliability
    ]


def time_rows(runs: Sequence[Run]) -> list[Row]:
    """Return median and 95th percentile of each stage and of whole queries."""
    return [
        Row(
            run=run.name,
            part=name,
            cells=(Cell(str(time.count)), Cell(number(time.median_ms)), Cell(number(time.p95_ms))),
            strong=name == "total",
        )
        for run in runs
        for name, time in stage_times(run.predictions).items()
    ]


def worst_rows(runs: Sequence[Run], count: int) -> list[Row]:
    """Return the queries without an answer and then those with the largest errors, up to `count` of each run."""
    rows = []
    for run in runs:
        chosen = choose_worst(run.predictions, count)
        errors_m, headings_deg = position_errors_m(chosen), heading_errors_deg(chosen)
        for query, kind, error_m, heading_deg in zip(chosen, outcomes(chosen), errors_m, headings_deg, strict=True):
            answered = kind is not Outcome.NO_ANSWER
            cells = (
                Cell(query.room),
                Cell(kind.value),
                Cell(distance(error_m) if answered else NOTHING),
                Cell(f"{number(heading_deg)}°" if answered else NOTHING),
                Cell(NOTHING if query.confidence is None else percent(query.confidence)),
            )
            rows.append(Row(run=run.name, part=f"{query.scene}/{query.camera}", cells=cells))
    return rows


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (columns, ["---"] * len(columns), *rows))


def percent(share: float) -> str:
    """Format a share in percent, with a no-break space."""
    return f"{100.0 * share:.1f}\N{NO-BREAK SPACE}%"


def number(value: float) -> str:
    """Format a number with three digits, at most two of them after the point; ∞ for infinity."""
    return "< 0.01" if 0.0 < value < 0.005 else _rounded(value)


def distance(distance_m: float) -> str:
    """Format a distance in metres, or in centimetres below 1 m."""
    return f"{number(distance_m)} m" if distance_m >= 1.0 else f"{number(100.0 * distance_m)} cm"


def _rounded(value: float) -> str:
    if math.isinf(value):
        return "∞"
    return f"{value:.2f}" if value < 10.0 else f"{value:.1f}" if value < 100.0 else f"{value:.0f}"


def _metrics(figures: StageScores) -> tuple[Cell, ...]:
    shares = (figures.within_1cm, figures.within_5cm, figures.within_10cm, figures.within_1m, figures.correct_room)
    median, heading = figures.median_cm, figures.median_heading_error_deg
    return (_median(median, " cm"), *(_share(share) for share in shares), _median(heading, "°"))


def _share(estimate: Estimate | None) -> Cell:
    if estimate is None:
        return Cell(NOTHING)
    return Cell(percent(estimate.value), f"{100.0 * estimate.low:.1f}–{100.0 * estimate.high:.1f}")


def _median(estimate: Estimate, unit: str) -> Cell:
    return Cell(number(estimate.value) + unit, f"{_rounded(estimate.low)}–{_rounded(estimate.high)}")
