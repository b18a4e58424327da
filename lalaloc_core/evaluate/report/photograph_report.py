"""Evaluation on annotated photographs of real rooms: walls and openings per azimuth, and galleries of rooms.

FOLDER/photographs.json   all figures, and the figures of every photograph
FOLDER/known, unknown     the runs in galleries, heading known and searched, for `lalaloc lab worst` and `report`
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.report.report_tables import markdown_table, percent
from lalaloc_core.evaluate.runs.evaluation import run_evaluation
from lalaloc_core.evaluate.runs.factories import describe_model
from lalaloc_core.evaluate.runs.galleries import (
    ACCEPTED,
    GalleryAnswer,
    answers_in_galleries,
    describe_answers,
    foreign_confidences,
    foreign_plans,
    score_galleries,
)
from lalaloc_core.evaluate.runs.photograph_reading import ReadPhotograph, ReadViews, read_photographs, read_views
from lalaloc_core.evaluate.runs.predictions import RunFolder, RunInfo, without_infinity
from lalaloc_core.files import atomic_write
from lalaloc_core.learn.data.annotated import AnnotatedPhotographs
from lalaloc_core.learn.metrics import confusion_shares, summarise_azimuths
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder

FIGURES_FILE = "photographs.json"
_HEADINGS = {"known": True, "unknown": False}
# Views of each photograph, at equal angles.
_VIEWS = 8
# Measures of a photograph's walls that are shown for each.
_MEASURES = ("median_error", "error_90", "bias", "scale_ratio")


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PhotographResults:
    """Results of a model on annotated photographs.

    `read` are predictions of walls and openings; `answers` are by heading, "known" or "unknown", and `views` by field
    of view (degrees) and heading. `read_views` are by field of view. `foreign` are confidences in plans of other
    buildings, by heading.
    """

    read: Sequence[ReadPhotograph]
    answers: Mapping[str, Sequence[GalleryAnswer]]
    views: Mapping[str, Mapping[str, Sequence[GalleryAnswer]]] = dataclasses.field(default_factory=dict)
    read_views: Mapping[str, ReadViews] = dataclasses.field(default_factory=dict)
    foreign: Mapping[str, Sequence[float]] = dataclasses.field(default_factory=dict)

    def figures(self) -> dict[str, Any]:
        """Return all figures as plain data."""
        counting = [read.measures for read in self.read if read.photograph.counts]
        scores, *views = (
            {heading: dataclasses.asdict(score_galleries(results)) for heading, results in answers.items()}
            for answers in (self.answers, *self.views.values())
        )
        return without_infinity(
            {
                "azimuths": dataclasses.asdict(summarise_azimuths(counting, OPENING_CLASSES)),
                "read_views": {field_deg: dataclasses.asdict(read) for field_deg, read in self.read_views.items()},
                "galleries": scores,
                "views": dict(zip(self.views, views, strict=True)),
                "read_as": confusion_shares(counting),
                "foreign_plans": {
                    heading: {"n": len(found), "accepted": float(np.mean(np.array(found) > ACCEPTED))}
                    for heading, found in self.foreign.items()
                    if found
                },
                "photographs": [self._figures(read) for read in self.read],
            }
        )

    def _figures(self, read: ReadPhotograph) -> dict[str, Any]:
        name = read.photograph.name
        galleries = {
            heading: [dataclasses.asdict(answer) for answer in results if answer.photograph == name]
            for heading, results in self.answers.items()
        }
        measures = {measure: getattr(read.measures, measure) for measure in ("outline", *_MEASURES)}
        return {"name": name, "quality": read.photograph.quality, **measures, "galleries": galleries}

    def markdown(self) -> str:
        """Return the figures as Markdown tables: all photographs together, the classes read, and each photograph."""
        figures = self.figures()
        totals = {name: figures[name] for name in ("azimuths", "read_views", "galleries", "views", "foreign_plans")}
        tables = [markdown_table(["figure", "measured"], _rows(totals))]
        if figures["read_as"] is not None:
            kinds = [(name, *map(percent, row)) for name, row in zip(OPENING_CLASSES, figures["read_as"], strict=True)]
            tables.append(markdown_table(["annotated, read as", *OPENING_CLASSES], kinds))
        columns = ["photograph", "quality", *_MEASURES, *self.answers]
        return "\n".join([*tables, markdown_table(columns, [self._cells(read) for read in self.read])])

    def _cells(self, read: ReadPhotograph) -> list[str]:
        name = read.photograph.name
        numbers = (_number(getattr(read.measures, measure)) for measure in _MEASURES)
        located = (describe_answers(results, name) for results in self.answers.values())
        return [name, read.photograph.quality, *numbers, *located]


def evaluate_photographs(
    data: Path,
    bundle: Path,
    out: Path,
    *,
    galleries: int,
    workers: int | None,
    views_deg: Sequence[float] = (),
    command: str = "",
) -> PhotographResults:
    """Evaluate a model on annotated photographs and write the results to a folder; existing gallery runs resume.

    `galleries` is the number of galleries of every photograph, for each heading; 0 measures walls and openings only.
    `views_deg` are fields of view in which eight views of each photograph are measured, and localised in its galleries
    as well; `workers` is as in `run_evaluation`, and `command` repeats the evaluation.
    """
    dataset = AnnotatedPhotographs(data)
    if not any(photograph.counts for photograph in dataset.photographs):
        raise InvalidInputError(
            f"all {len(dataset.photographs)} photographs at '{data}' are of quality 'poor'; "
            "at least one must be 'fair' or 'good'"
        )
    opened = Bundle.open(bundle)
    encoders = PhotographEncoder(opened, threads=1)
    read = read_photographs(encoders, dataset.photographs)
    counting = [item for item in read if item.photograph.counts]
    readings = {f"{field_deg:g}": read_views(encoders, counting, field_deg, _VIEWS) for field_deg in views_deg}

    def located(field_deg: float | None, heading: str, known: bool) -> list[GalleryAnswer]:
        name = heading if field_deg is None else f"view-{field_deg:g}-{heading}"
        per_camera = 1 if field_deg is None else _VIEWS
        info = RunInfo(
            label=f"photographs in galleries, {name}",
            dataset=dataset.description,
            split="test",
            data=str(data),
            views=None if field_deg is None else {"field_deg": field_deg, "per_camera": per_camera},
            heading_known=known,
            limit=per_camera * len(dataset.keys(galleries)),
            bundle=str(bundle),
            model=describe_model(bundle),
            command=command,
        )
        predictions = run_evaluation(RunFolder(out / name), info, workers=workers)
        return answers_in_galleries(predictions, dataset.photographs)

    headings = _HEADINGS if galleries else {}
    answers, *views = (
        {heading: located(field_deg, heading, known) for heading, known in headings.items()}
        for field_deg in (None, *views_deg)
    )
    plans = foreign_plans() if galleries else []
    foreign = {
        heading: foreign_confidences(opened, [item.photograph for item in counting], plans, heading_known=known)
        for heading, known in headings.items()
    }
    results = PhotographResults(
        read=read, answers=answers, views=dict(zip(readings, views, strict=True)), read_views=readings, foreign=foreign
    )
    figures = {"command": command, "model": describe_model(bundle), **results.figures()}
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / FIGURES_FILE, json.dumps(figures, indent=2, allow_nan=False) + "\n")
    return results


def _rows(figures: Mapping[str, Any], names: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Yield the names of all figures, from the outermost inwards, and their values."""
    for name, value in figures.items():
        if isinstance(value, Mapping):
            yield from _rows(value, (*names, name))
        else:
            yield ", ".join((*names, name)), f"{value}" if isinstance(value, int) else _number(value)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
