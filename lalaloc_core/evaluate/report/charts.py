"""Charts of a report, drawn once by matplotlib: error curves and calibration."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lalaloc_core.evaluate.report.scored_runs import Run
from lalaloc_core.evaluate.runs.score import position_errors_m

INK, MUTED, RULE, PAPER = "#1c2128", "#59626d", "#d5dbe1", "#ffffff"
SERIES = ("#0b63b5", "#c2410c", "#0f7b53", "#a3297a", "#8a6d00", "#0e7c86", "#6d4ed1", "#7a4a2a")
_DASHES = ("-", "--", ":", "-.")
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "lalaloc",
    # Names of runs can contain dollar signs.
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": RULE,
    "grid.linewidth": 0.7,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "savefig.facecolor": "auto",
    "legend.frameon": False,
}
CURVE_LIMITS_M = (0.001, 20.0)
CONFIDENCE_BINS = 20
_TICKS = {0.001: "0.1 cm", 0.01: "1 cm", 0.1: "10 cm", 1.0: "1 m", 10.0: "10 m"}
_WIDTH_INCHES = 5.6
_LEGEND_CHARACTERS = 84


@dataclass(frozen=True, eq=False, kw_only=True)
class Chart:
    """Drawn chart, on white; `name` is that of its files, and `alt` describes it to screen readers."""

    name: str
    alt: str
    svg: bytes

    @property
    def data_uri(self) -> str:
        """The drawing as a data URI."""
        return f"data:image/svg+xml;base64,{base64.b64encode(self.svg).decode()}"


def draw_charts(runs: Sequence[Run]) -> dict[str, Chart]:
    """Draw the charts for which the runs have data, by name."""
    answered = [run for run in runs if run.predictions]
    confident = [run for run in answered if run.scores is not None and run.scores.reliability]
    with mpl.rc_context(_STYLE):
        charts = [draw(chosen) for draw, chosen in ((_error_curves, answered), (_calibration, confident)) if chosen]
    return {chart.name: chart for chart in charts}


def curves(runs: Sequence[Run]) -> dict[str, Float[np.ndarray, "n"]]:
    """Return position errors (m; NaN without an answer) by curve: stages of a single run, or final poses of each."""
    if len(runs) == 1 and len(runs[0].stages) > 1:
        return {stage: position_errors_m(runs[0].predictions, stage) for stage in runs[0].stages}
    return {run.name: position_errors_m(run.predictions) for run in runs}


def _error_curves(runs: Sequence[Run]) -> Chart:
    lines = curves(runs)
    figure = Figure(figsize=(_WIDTH_INCHES, 3.3 + _legend_inches(list(lines))), layout="constrained")
    axes = figure.subplots()
    low, high = CURVE_LIMITS_M
    for errors_m, style in zip(lines.values(), _line_styles(len(lines)), strict=True):
        reached = np.sort(errors_m[errors_m <= high])
        share = np.arange(1, len(reached) + 1) / len(errors_m)
        x = np.concatenate([[low], np.maximum(reached, low), [high]])
        y = np.concatenate([[0.0], share, share[-1:] if len(share) else [0.0]])
        axes.plot(x, 100.0 * y, drawstyle="steps-post", linewidth=1.8, **style)
    axes.set(xscale="log", xlim=CURVE_LIMITS_M, ylim=(0.0, 100.0))
    axes.set_xticks(list(_TICKS), list(_TICKS.values()))
    axes.set_xlabel("position error")
    _percent(axes, "y", "queries within")
    _legend(figure, axes.get_lines(), list(lines))
    poses = "after each stage" if len(runs) == 1 else "with the final pose of each run"
    return _chart(
        figure,
        "error-curves",
        f"Cumulative position error. Share of all queries {poses} by position error, from 0.1 cm to 20 m on a "
        "logarithmic axis. The table below the chart has the same figures.",
    )


def _calibration(runs: Sequence[Run]) -> Chart:
    figure = Figure(figsize=(_WIDTH_INCHES, 2.6 + _legend_inches([run.name for run in runs])), layout="constrained")
    diagram, histogram = figure.subplots(1, 2)
    diagram.plot([0, 100], [0, 100], color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
    for run, style in zip(runs, _line_styles(len(runs)), strict=True):
        assert run.scores is not None
        bins = run.scores.reliability
        points = [100.0 * part.confidence for part in bins], [100.0 * part.frequency for part in bins]
        diagram.plot(*points, linewidth=1.2, **style)
        largest = max(part.count for part in bins)
        diagram.scatter(
            *points,
            s=[10.0 + 50.0 * part.count / largest for part in bins],
            color=style["color"],
            edgecolor=PAPER,
            zorder=3,
            clip_on=False,
        )
        edges = np.linspace(0.0, 100.0, CONFIDENCE_BINS + 1)
        confidences = (prediction.confidence for prediction in run.predictions)
        confidence = [100.0 * confidence for confidence in confidences if confidence is not None]
        count, _ = np.histogram(confidence, edges)
        histogram.stairs(100.0 * count / len(confidence), edges, fill=len(runs) == 1, linewidth=1.5, **style)
    diagram.set(xlim=(0, 100), ylim=(0, 100), aspect="equal")
    histogram.set_xlim(0, 100)
    histogram.set_box_aspect(1)
    _percent(diagram, "x", "confidence", step=50)
    _percent(diagram, "y", "within 1 m", step=50)
    _percent(histogram, "x", "confidence", step=50)
    _percent(histogram, "y", "queries", step=None)
    _legend(figure, diagram.get_lines()[1:], [run.name for run in runs])
    return _chart(
        figure,
        "calibration",
        "Calibration of the confidence. Left: share of answers within 1 m against their mean confidence, in ten bins; "
        "the dashed diagonal is perfect calibration, and larger dots have more queries. Right: distribution of the "
        "confidence. The table below the chart has the same figures.",
    )


def _percent(axes: Axes, axis: str, label: str, step: int | None = 20) -> None:
    chosen = axes.xaxis if axis == "x" else axes.yaxis
    if step is not None:
        chosen.set_ticks(range(0, 101, step))
    chosen.set_major_formatter(lambda value, _: f"{value:g} %")
    chosen.set_label_text(label)


def _legend(figure: Figure, marks: Sequence[Any], names: Sequence[str]) -> None:
    if len(names) > 1:
        columns = _legend_columns(names)
        figure.legend(marks, names, loc="outside lower left", ncols=columns, fontsize=8.5, columnspacing=1.4)


def _legend_columns(names: Sequence[str]) -> int:
    return max(1, min(4, len(names), _LEGEND_CHARACTERS // (max(map(len, names)) + 6)))


def _legend_inches(names: Sequence[str]) -> float:
    return 0.2 * math.ceil(len(names) / _legend_columns(names)) if len(names) > 1 else 0.0


def _chart(figure: Figure, name: str, alt: str) -> Chart:
    svg = io.BytesIO()
    # Without a date, equal runs give equal reports.
    figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    return Chart(name=name, alt=alt, svg=svg.getvalue())


def _line_styles(count: int) -> list[dict[str, Any]]:
    """Return colour and dash of each line; the first 32 differ."""
    return [
        {"color": SERIES[index % len(SERIES)], "linestyle": _DASHES[index // len(SERIES) % len(_DASHES)]}
        for index in range(count)
    ]
