"""Report of evaluation runs: one self-contained HTML page without scripts or external addresses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from lalaloc_core.evaluate.report import report_tables
from lalaloc_core.evaluate.report.charts import Chart, draw_charts
from lalaloc_core.evaluate.report.report_tables import Run, open_runs
from lalaloc_core.evaluate.runs.score import ALIGNMENT_LIMIT_M, Outcome
from lalaloc_core.files import atomic_write


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
