"""Scored runs of a report and the rows of its tables: figures as text, in HTML or Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lalaloc_core.errors import RunError
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.score import (
    Estimate,
    Outcome,
    Scores,
    choose_worst,
    heading_errors_deg,
    outcomes,
    position_errors_m,
    score,
)

CURVE_POINTS_M = (0.01, 0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 20.0)
METRICS = ("median", "< 1 cm", "< 5 cm", "< 10 cm", "< 1 m", "right room", "heading")
NOTHING = "–"
_MAX_LABEL = 48
TOTAL = "total"
# Queries that the page lists as the worst of each run.
WORST = 20


@dataclass(frozen=True, eq=False, kw_only=True)
class Run:
    """Run of a report.

    The shortened name begins with the number if there are several runs; `scores` is None without predictions.
    """

    name: str
    info: RunInfo
    predictions: list[Prediction]
    scores: Scores | None

    @property
    def stages(self) -> list[str]:
        """Stages that any query passed, in order."""
        return list(self.scores.stages) if self.scores is not None else []


def open_runs(folders: Sequence[Path]) -> list[Run]:
    """Read and score runs."""
    if not folders:
        raise RunError("a report needs at least one run")
    runs = []
    for number, folder in enumerate(map(RunFolder, folders), start=1):
        info, predictions = folder.read_info(), folder.read_predictions()
        name = info.label if len(info.label) <= _MAX_LABEL else info.label[: _MAX_LABEL - 1] + "…"
        name = f"{number}. {name}" if len(folders) > 1 else name
        scores = score(predictions) if predictions else None
        runs.append(Run(name=name, info=info, predictions=predictions, scores=scores))
    return runs


def stage_times(predictions: Sequence[Prediction]) -> dict[str, tuple[int, float, float]]:
    """Return, by stage and of whole queries (`TOTAL`), how many have times, and their median and 95th percentile."""
    timed = [prediction.timings_ms for prediction in predictions if prediction.timings_ms]
    names = dict.fromkeys(name for timings in timed for name in timings)
    times_ms = {name: [timings[name] for timings in timed if name in timings] for name in names}
    if timed:
        times_ms[TOTAL] = [sum(timings.values()) for timings in timed]
    return {
        name: (len(ms), float(np.percentile(ms, 50.0)), float(np.percentile(ms, 95.0))) for name, ms in times_ms.items()
    }


def curves(runs: Sequence[Run]) -> dict[str, Float[np.ndarray, "n"]]:
    """Return position errors (m; NaN without an answer) by curve: stages of a single run, or final poses of each."""
    if len(runs) == 1 and len(runs[0].stages) > 1:
        return {stage: position_errors_m(runs[0].predictions, stage) for stage in runs[0].stages}
    return {run.name: position_errors_m(run.predictions) for run in runs}


class Cell(NamedTuple):
    """Figure, with its interval or share in small type below."""

    text: str
    below: str = ""


class Row(NamedTuple):
    """Row of a table: the name of its part, and figures; `strong` for the most important one."""

    part: str
    cells: Sequence[Cell]
    strong: bool = False


def by_run(runs: Sequence[Run], rows: Callable[[Run], Iterable[Row]]) -> list[tuple[str, list[Row]]]:
    """Return the names of the runs that have rows of a table, with these rows."""
    return [(run.name, found) for run in runs if (found := list(rows(run)))]


def metric_rows(run: Run) -> Iterator[Row]:
    """Yield one row per stage of a run, and one for the final pose where it differs from the last stage."""
    if (scores := run.scores) is None:
        return
    parts = dict(scores.stages)
    if scores.final not in parts.values():
        parts["answer"] = scores.final
    for place, (stage, figures) in enumerate(parts.items()):
        # Recall belongs to the first stage, retrieval.
        recalls = (scores.layout_recall, scores.pose_recall) if place == 0 else (None, None)
        shares = (figures.within_1cm, figures.within_5cm, figures.within_10cm, figures.within_1m, figures.correct_room)
        cells = (
            Cell(str(scores.n)),
            *map(_share, recalls),
            _median(figures.median_cm, " cm"),
            *map(_share, shares),
            _median(figures.median_heading_error_deg, "°"),
        )
        yield Row(stage, cells, place == len(parts) - 1)


def curve_rows(runs: Sequence[Run]) -> list[Row]:
    """Return the share of queries within each of `CURVE_POINTS_M`, per curve of the chart."""
    return [
        Row(name, [Cell(percent(float(np.mean(errors_m <= limit_m)))) for limit_m in CURVE_POINTS_M])
        for name, errors_m in curves([run for run in runs if run.predictions]).items()
    ]


def outcome_rows(run: Run) -> Iterator[Row]:
    """Yield the number of queries by outcome, for the first of several stages and for the final pose."""
    first = run.stages[:1] if len(run.stages) > 1 else []
    for stage in [*first, None] if run.predictions else []:
        found = outcomes(run.predictions, stage)
        counts = [found.count(kind) for kind in Outcome]
        cells = [Cell(str(count), percent(count / len(found))) for count in counts]
        yield Row(stage or "answer", cells, stage is None)


def slice_rows(run: Run) -> Iterator[Row]:
    """Yield one row per fact, the worst first, and one for all queries, if the run has facts."""
    if (scores := run.scores) is None or not scores.slices:
        return
    counted = {name: (part.n, part) for name, part in scores.slices.items()}
    for name, (count, figures) in {**counted, "all queries": (scores.n, scores.final)}.items():
        shares = (figures.within_1m, figures.within_10cm)
        cells = (Cell(str(count), percent(count / scores.n)), *map(_share, shares), _median(figures.median_cm, " cm"))
        yield Row(name.replace("_", " "), cells, figures is scores.final)


def reliability_rows(run: Run) -> Iterator[Row]:
    """Yield the bins of the reliability diagram."""
    for part in run.scores.reliability if run.scores is not None else ():
        cells = (Cell(str(part.count)), Cell(percent(part.confidence)), Cell(percent(part.frequency)))
        yield Row(f"{100 * part.low:.0f}–{100 * part.high:.0f} %", cells)


def time_rows(run: Run) -> Iterator[Row]:
    """Yield median and 95th percentile of each stage and of whole queries."""
    for name, (count, median_ms, p95_ms) in stage_times(run.predictions).items():
        yield Row(name, (Cell(str(count)), Cell(number(median_ms)), Cell(number(p95_ms))), name == TOTAL)


def worst_rows(run: Run) -> Iterator[Row]:
    """Yield the queries without an answer and then those with the largest errors, up to `WORST`."""
    chosen = choose_worst(run.predictions, WORST)
    errors = zip(outcomes(chosen), position_errors_m(chosen), heading_errors_deg(chosen), strict=True)
    for query, (kind, error_m, heading_deg) in zip(chosen, errors, strict=True):
        found = (NOTHING,) * 2 if kind is Outcome.NO_ANSWER else (distance(error_m), f"{number(heading_deg)}°")
        confidence = NOTHING if query.confidence is None else percent(query.confidence)
        cells = [Cell(text) for text in (query.room, kind.value, *found, confidence)]
        yield Row(f"{query.scene}/{query.camera}", cells)


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (columns, ["---"] * len(columns), *rows))


def percent(share: float) -> str:
    """Format a share in percent, with a no-break space."""
    return f"{100.0 * share:.1f}\N{NO-BREAK SPACE}%"


def number(value: float) -> str:
    """Format a number with three digits, at most two of them after the point; ∞ for infinity."""
    return "< 0.01" if 0.0 < value < 0.005 else _rounded(value)


def _rounded(value: float) -> str:
    if math.isinf(value):
        return "∞"
    return f"{value:.2f}" if value < 10.0 else f"{value:.1f}" if value < 100.0 else f"{value:.0f}"


def distance(distance_m: float) -> str:
    """Format a distance in metres, or in centimetres below 1 m."""
    return f"{number(distance_m)} m" if distance_m >= 1.0 else f"{number(100.0 * distance_m)} cm"


def _share(estimate: Estimate | None) -> Cell:
    if estimate is None:
        return Cell(NOTHING)
    return Cell(percent(estimate.value), f"{100.0 * estimate.low:.1f}–{100.0 * estimate.high:.1f}")


def _median(estimate: Estimate, unit: str) -> Cell:
    return Cell(number(estimate.value) + unit, f"{_rounded(estimate.low)}–{_rounded(estimate.high)}")
