"""Report of evaluation runs: one self-contained HTML page without scripts or external addresses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from lalaloc_core.evaluate.report import report_tables
from lalaloc_core.evaluate.report.charts import draw_charts
from lalaloc_core.evaluate.report.figures import Chart
from lalaloc_core.evaluate.report.gallery import Gallery, build_gallery
from lalaloc_core.evaluate.report.reading import Run, open_runs
from lalaloc_core.evaluate.runs.failures import ALIGNMENT_LIMIT_M, Outcome
from lalaloc_core.evaluate.runs.predictions import RunInfo
from lalaloc_core.files import atomic_write

# Limit of all galleries; base64 adds a third, and the page stays below 5 MB.
GALLERY_BYTES = 3_400_000


def write_report(runs: Sequence[Path], out: Path, *, pictures: Path | None = None) -> None:
    """Write the report on some runs.

    `pictures` is a folder for the page's pictures as files, None for none.
    """
    opened = open_runs(runs)
    charts = draw_charts(opened)
    galleries = _build_galleries(opened)
    out.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(out, render_page(opened, charts, galleries))
    if pictures is not None:
        _write_pictures(pictures, charts, galleries)


def _build_galleries(runs: Sequence[Run]) -> dict[int, Gallery]:
    """Return galleries by number of the run, of as many runs as fit on the page."""
    galleries: dict[int, Gallery] = {}
    left = GALLERY_BYTES
    for run in runs:
        if not run.predictions:
            continue
        gallery = build_gallery(run)
        left -= gallery.bytes
        if left < 0:
            break
        galleries[run.number] = gallery
    return galleries


def _write_pictures(folder: Path, charts: Mapping[str, Chart], galleries: Mapping[int, Gallery]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for chart in charts.values():
        atomic_write(folder / f"{chart.name}.svg", chart.svg.encode())
        atomic_write(folder / f"{chart.name}.png", chart.png())
    for number, gallery in galleries.items():
        for group, cards in gallery.groups.items():
            for place, card in enumerate(cards, start=1):
                for picture in card.pictures:
                    name = f"run-{number}-{group.replace(' ', '-')}-{place}-{picture.file_name}"
                    atomic_write(folder / name, picture.content)


_GROUPS = {
    "best": "Best",
    "median": "Median",
    "worst": "Worst",
    "wrong alignment": "Worst alignments in the right room",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """Section of one run.

    `facts` describe the run by name; `gallery` is None if the page would be too large or the run has no predictions.
    """

    run: Run
    facts: dict[str, str]
    gallery: Gallery | None


def render_page(runs: Sequence[Run], charts: Mapping[str, Chart], galleries: Mapping[int, Gallery]) -> str:
    """Return the page; galleries are by number of the run."""
    environment = Environment(
        loader=PackageLoader("lalaloc_core.evaluate.report", "template"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = report_tables.number
    environment.filters["percent"] = report_tables.percent
    environment.filters["distance"] = report_tables.distance
    source, _, _ = PackageLoader("lalaloc_core.evaluate.report", "template").get_source(environment, "style.css")
    return environment.get_template("page.html").render(
        title="Localisation: " + (runs[0].info.label if len(runs) == 1 else f"{len(runs)} runs"),
        style=source,
        parts=[Part(run=run, facts=_facts(run), gallery=galleries.get(run.number)) for run in runs],
        charts=charts,
        tables=report_tables,
        runs=runs,
        several=len(runs) > 1,
        outcomes=[outcome.value for outcome in Outcome],
        alignment_limit_m=ALIGNMENT_LIMIT_M,
        group_names=_GROUPS,
        calibrated=[run for run in runs if run.scores is not None and run.scores.calibration_error is not None],
        curve_points=[
            f"{100.0 * limit_m:g} cm" if limit_m < 1.0 else f"{limit_m:g} m" for limit_m in report_tables.CURVE_POINTS_M
        ],
    )


def _facts(run: Run) -> dict[str, str]:
    """Return the description of a run as text."""
    info = run.info
    facts = {
        "Method": info.method,
        "Settings": ", ".join(f"{name} {value}" for name, value in info.settings.items()) or "defaults",
        "Data": f"{info.dataset}, {info.split} split",
        "Queries": _queries(run),
        "Heading": "known" if info.heading_known else "unknown",
        "Grid": f"{info.grid_step_m:g} m",
        "Model": _model(info),
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


def _model(info: RunInfo) -> str:
    if info.model is None:
        return "none"
    name = " ".join(info.model[key] for key in ("name", "version") if key in info.model)
    return name + (f", SHA-256 {info.model['sha256'][:12]}…" if "sha256" in info.model else "")
