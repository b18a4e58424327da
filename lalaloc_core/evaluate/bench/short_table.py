"""Short table of a model: walls and openings by azimuth on pictures by others, in a minute; a line of it for each run.

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
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.runs.photograph_reading import read_photographs, read_views
from lalaloc_core.learn.data.annotated import AnnotatedPhotographs
from lalaloc_core.learn.data.annotations import AnnotatedPhotograph
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
        figures |= _figures(encoders, name, photographs, fields_deg, views)
    return figures


def _figures(
    encoders: PhotographEncoder,
    name: str,
    photographs: Sequence[AnnotatedPhotograph],
    fields_deg: Sequence[float],
    views: int,
) -> dict[str, float]:
    read = read_photographs(encoders, photographs)
    spheres = summarise_azimuths([item.measures for item in read], OPENING_CLASSES)
    figures = _rows(f"{name} spheres", spheres)
    for field_deg in fields_deg:
        figures |= _rows(f"{name} view {field_deg:g}", read_views(encoders, read, field_deg, views).by_reader["view"])
    return figures


def _rows(name: str, measured: AzimuthSummary) -> dict[str, float]:
    classes = measured.classes
    return {
        f"{name}: shape": measured.shape_error,
        f"{name}: absolute": measured.median_error,
        f"{name}: openings": float("nan") if classes is None else classes.balanced_accuracy,
    }


def keep_run(run: Path, bundle: Path, real: Path, rooms: Path, out: Path, notes: Mapping[str, str]) -> dict[str, float]:
    """Keep the weights of a run's last checkpoints, add a line to the table of runs, and return its figures.

    `bundle` provides the networks that the run does not train.
    """
    checkpoints = [
        Checkpoint.load(run / f"{stage}.pt") for stage in ("image", "view") if (run / f"{stage}.pt").exists()
    ]
    if not checkpoints:
        raise InvalidInputError(f"'{run}' has no checkpoint of stage 'image' or 'view'")
    with tempfile.TemporaryDirectory(prefix="lalaloc-short-") as scratch:
        made = export_into(bundle, run, Path(scratch), version="0", last=True)
        figures = short_table(made, real, rooms)
    lines = []
    for checkpoint in checkpoints:
        halved(checkpoint).save(out / f"{checkpoint.stage}.pt")
        totals = {
            "hours": round(checkpoint.seconds / 3600.0, 2),
            "steps": checkpoint.step,
            **training_totals(checkpoint),
        }
        lines.append({"run": run.resolve().name, "stage": checkpoint.stage, **totals, **notes})
    _append(out / RUNS_FILE, [line | {name: f"{value:.4f}" for name, value in figures.items()} for line in lines])
    return figures


def _append(path: Path, lines: Sequence[Mapping[str, object]]) -> None:
    """Add lines to a table; new columns come last."""
    before: list[dict[str, str]] = []
    if path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            before = list(csv.DictReader(file))
    columns = list(dict.fromkeys(name for line in (*before, *lines) for name in line))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows([*before, *lines])
