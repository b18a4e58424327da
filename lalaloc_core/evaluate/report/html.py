"""Report of evaluation runs: one self-contained HTML page without scripts or external addresses, and its charts."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lalaloc_core.evaluate.report import report_tables
from lalaloc_core.evaluate.report.report_tables import Run, curves, open_runs
from lalaloc_core.evaluate.runs.score import ALIGNMENT_LIMIT_M, Outcome
from lalaloc_core.files import atomic_write

MUTED, PAPER = "#59626d", "#ffffff"
SERIES = ("#0b63b5", "#c2410c", "#0f7b53", "#a3297a", "#8a6d00", "#0e7c86", "#6d4ed1", "#7a4a2a")
_DASHES = ("-", "--", ":", "-.")
_STYLE = Path(__file__).parent / "template/charts.mplstyle"
CURVE_LIMITS_M = (0.001, 20.0)
_TICKS = {0.001: "0.1 cm", 0.01: "1 cm", 0.1: "10 cm", 1.0: "1 m", 10.0: "10 m"}
_WIDTH_INCHES = 5.6
# Names of runs have at most some fifty characters.
_LEGEND_COLUMNS = 2


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


def write_report(folders: Sequence[Path], out: Path, *, pictures: Path | None = None) -> None:
    """Write the report on some runs; `pictures` is a folder for the page's charts as files, None for none."""
    runs = open_runs(folders)
    charts = draw_charts(runs)
    out.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(out, render_page(runs, charts))
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        for chart in charts.values():
            atomic_write(pictures / f"{chart.name}.svg", chart.svg)


def render_page(runs: Sequence[Run], charts: Mapping[str, Chart]) -> str:
    """Return the page."""
    loader = PackageLoader("lalaloc_core.evaluate.report", "template")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    source, _, _ = loader.get_source(environment, "style.css")
    return environment.get_template("page.html").render(
        title="Localisation: " + (runs[0].info.label if len(runs) == 1 else f"{len(runs)} runs"),
        style=source,
        parts=[(run, _facts(run)) for run in runs],
        charts=charts,
        tables=report_tables,
        runs=runs,
        several=len(runs) > 1,
        outcomes=[outcome.value for outcome in Outcome],
        alignment_limit_m=ALIGNMENT_LIMIT_M,
        calibrated=[run for run in runs if run.scores is not None and run.scores.calibration_error is not None],
        curve_points=[
            f"{100.0 * limit_m:g} cm" if limit_m < 1.0 else f"{limit_m:g} m" for limit_m in report_tables.CURVE_POINTS_M
        ],
    )


def _facts(run: Run) -> dict[str, str]:
    info = run.info
    facts = {
        "Method": info.method,
        "Settings": ", ".join(f"{name} {value}" for name, value in info.settings.items()) or "defaults",
        "Data": f"{info.dataset}, {info.split} split",
        "Queries": _queries(run),
        "Heading": "known" if info.heading_known else "unknown",
        "Grid": f"{info.grid_step_m:g} m",
        "Model": "none" if info.model is None else " ".join(info.model.values()),
    }
    if run.scores is not None and run.scores.clicks_per_album is not None:
        facts["Albums"] = (
            f"{run.scores.clicks_per_album:.1f} corrections each until all rooms are right; "
            f"calibration error of the room {run.scores.room_calibration_error:.3f}"
        )
    if info.generated is not None:
        facts["Generator"] = ", ".join(f"{name} {value}" for name, value in info.generated.items() if value is not None)
    return facts


def _queries(run: Run) -> str:
    info = run.info
    look = "/".join(part for part in (info.furniture, info.lighting) if part is not None)
    kind = f"{info.kind} queries" + (f" ({look})" if look else "")
    limit = "" if info.limit is None else f", limited to {info.limit}"
    unanswered = run.scores.unanswered if run.scores is not None else 0
    return f"{len(run.predictions)} {kind}{limit}" + (f", {unanswered} without an answer" if unanswered else "")


def draw_charts(runs: Sequence[Run]) -> dict[str, Chart]:
    """Draw the charts for which the runs have data, by name."""
    answered = [run for run in runs if run.predictions]
    confident = [run for run in answered if run.scores is not None and run.scores.reliability]
    with mpl.rc_context(fname=_STYLE):
        charts = [draw(chosen) for draw, chosen in ((_error_curves, answered), (_calibration, confident)) if chosen]
    return {chart.name: chart for chart in charts}


def _error_curves(runs: Sequence[Run]) -> Chart:
    lines = curves(runs)
    figure = Figure(figsize=(_WIDTH_INCHES, 3.3 + _legend_inches(len(lines))), layout="constrained")
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
    figure = Figure(figsize=(_WIDTH_INCHES, 4.6 + _legend_inches(len(runs))), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color=MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
    for run, style in zip(runs, _line_styles(len(runs)), strict=True):
        bins = run.scores.reliability if run.scores is not None else ()
        points = [100.0 * part.confidence for part in bins], [100.0 * part.frequency for part in bins]
        axes.plot(*points, linewidth=1.2, **style)
        largest = max(part.count for part in bins)
        sizes = [10.0 + 50.0 * part.count / largest for part in bins]
        axes.scatter(*points, s=sizes, color=style["color"], edgecolor=PAPER, zorder=3, clip_on=False)
    axes.set(xlim=(0, 100), ylim=(0, 100), aspect="equal")
    _percent(axes, "x", "confidence")
    _percent(axes, "y", "within 1 m")
    _legend(figure, axes.get_lines()[1:], [run.name for run in runs])
    return _chart(
        figure,
        "calibration",
        "Calibration of the confidence. Share of answers within 1 m against their mean confidence, in ten bins; the "
        "dashed diagonal is perfect calibration, and larger dots have more queries. The table below the chart has the "
        "same figures.",
    )


def _percent(axes: Axes, axis: str, label: str) -> None:
    chosen = axes.xaxis if axis == "x" else axes.yaxis
    chosen.set_ticks(range(0, 101, 20))
    chosen.set_major_formatter(lambda value, _: f"{value:g} %")
    chosen.set_label_text(label)


def _legend(figure: Figure, marks: Sequence[Any], names: Sequence[str]) -> None:
    if len(names) > 1:
        figure.legend(marks, names, loc="outside lower left", ncols=_LEGEND_COLUMNS, fontsize=8.5)


def _legend_inches(names: int) -> float:
    return 0.2 * math.ceil(names / _LEGEND_COLUMNS) if names > 1 else 0.0


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
