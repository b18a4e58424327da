"""The report of an evaluation: one HTML page about one or several runs that needs nothing but itself.

No script and no address: pictures are part of the page, and it reads the same offline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lalaloc_core.evaluate.report.charts import draw_charts
from lalaloc_core.evaluate.report.figures import Chart
from lalaloc_core.evaluate.report.gallery import Gallery, build_gallery
from lalaloc_core.evaluate.report.page import render_page
from lalaloc_core.evaluate.report.reading import Run, open_runs
from lalaloc_core.files import atomic_write

# Of all galleries together; as text they take a third more, and the page is to stay below 5 MB.
GALLERY_BYTES = 3_400_000


def write_report(runs: Sequence[Path], out: Path, *, pictures: Path | None = None) -> None:
    """Write the page about some runs.

    Args:
        runs: folders of runs.
        out: the page.
        pictures: a folder that the page's pictures are written to as well, as files.

    Raises:
        RunError: a folder that holds no run.
    """
    opened = open_runs(runs)
    charts = draw_charts(opened)
    galleries = _build_galleries(opened)
    out.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(out, render_page(opened, charts, galleries))
    if pictures is not None:
        _write_pictures(pictures, charts, galleries)


def _build_galleries(runs: Sequence[Run]) -> dict[int, Gallery]:
    """Galleries by number of the run, of the first runs, as far as they fit on the page."""
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
