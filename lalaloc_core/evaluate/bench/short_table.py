"""Short table of a model: walls, openings and types of rooms in pictures by others, in a minute; a line for each run.

FOLDER/<stage>.pt   weights of a run in half precision, which `lalaloc lab train --from` and `lab export` read
FOLDER/runs.csv     a line for each time they were kept: hours and pictures of the run, notes, and the table
"""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.evaluate.runs.photograph_reading import read_photographs, read_views
from lalaloc_core.learn.data import AnnotatedPhotographs
from lalaloc_core.learn.data.posed_spheres import PosedSpheres, annotated
from lalaloc_core.learn.export.run_export import export_into
from lalaloc_core.learn.metrics import AzimuthSummary, summarise_azimuths
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.warm_start import halved, training_totals
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder

RUNS_FILE = "runs.csv"
_ANNOTATED, _HOUSE = "annotated", "rendered_house"
# Fields of view (degrees), and views of each photograph.
_FIELDS_DEG, _FIELD_DEG = (65.0, 80.0, 106.0), (67.0,)
_VIEWS, _FEWER_VIEWS = 8, 4


def short_table(bundle: Bundle, real: Path, rooms: Path) -> dict[str, float]:
    """Return the errors of walls and the balanced accuracy of openings by kind of picture.

    `real` has the folders `annotated` and `rendered_house`, `rooms` path-traced rooms, of which those that validate are
    read.
    """
    encoders, figures = PhotographEncoder(bundle, threads=1), dict[str, float]()
    hand_made = [photograph for photograph in AnnotatedPhotographs(real / _ANNOTATED).photographs if photograph.counts]
    for name, photographs, fields_deg, views in (
        ("annotated", hand_made, _FIELDS_DEG, _VIEWS),
        ("house", annotated(PosedSpheres(real / _HOUSE), "validation"), _FIELD_DEG, _FEWER_VIEWS),
        ("rooms", annotated(PosedSpheres(rooms), "validation"), _FIELD_DEG, _FEWER_VIEWS),
    ):
        read = read_photographs(encoders, photographs)
        figures |= _rows(f"{name} spheres", summarise_azimuths([item.measures for item in read], OPENING_CLASSES))
        for field_deg in fields_deg:
            seen, row = read_views(encoders, read, field_deg, views), f"{name} view {field_deg:g}"
            figures |= _rows(row, seen.by_reader["view"])
            figures |= {f"{row}: {kind}": value for kind, value in seen.types.items()}
    return figures


def _rows(name: str, measured: AzimuthSummary) -> dict[str, float]:
    classes = measured.classes
    return {
        f"{name}: shape": measured.shape_error,
        f"{name}: absolute": measured.median_error,
        f"{name}: openings": float("nan") if classes is None else classes.balanced_accuracy,
    }


def measure_run(run: Path | None, bundle: Path, real: Path, rooms: Path) -> dict[str, float]:
    """Return the short table of a bundle, with the last weights of a run in place of the encoders that it trains."""
    if run is None:
        return short_table(Bundle.open(bundle), real, rooms)
    with tempfile.TemporaryDirectory(prefix="lalaloc-short-") as scratch:
        return short_table(export_into(bundle, run, Path(scratch), version="0", last=True), real, rooms)


def keep_run(run: Path | None, bundle: Path, figures: Mapping[str, float], out: Path, notes: Mapping[str, str]) -> None:
    """Keep the last weights of a run, and add a line to the table of runs; without a run the line is of the bundle."""
    shown = {**notes, **{name: f"{value:.4f}" for name, value in figures.items()}}
    if run is None:
        return _append(out / RUNS_FILE, [{"run": f"bundle {Bundle.open(bundle).manifest.version}", **shown}])
    lines = []
    for path in filter(Path.exists, (run / f"{stage}.pt" for stage in ("image", "view"))):
        checkpoint = Checkpoint.load(path)
        halved(checkpoint).save(out / path.name)
        spent = {
            "hours": round(checkpoint.seconds / 3600.0, 2),
            "steps": checkpoint.step,
            **training_totals(checkpoint),
        }
        lines.append({"run": run.resolve().name, "stage": checkpoint.stage, **spent, **shown})
    return _append(out / RUNS_FILE, lines)


def _append(path: Path, lines: Sequence[Mapping[str, object]]) -> None:
    """Add lines to a table; figures come last."""
    before: list[dict[str, str]] = []
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            before = list(csv.DictReader(file))
    known = dict.fromkeys(("run", "stage", "hours", "steps", *(name for line in (*before, *lines) for name in line)))
    # Figures are named "pictures: measure".
    columns = sorted(known, key=lambda name: ": " in name)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows([*before, *lines])
