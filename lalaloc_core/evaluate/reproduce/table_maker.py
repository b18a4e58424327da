"""Tables of the paper, made again: train the models, evaluate the rows, set our figures beside the paper's.

Models and runs are stored in one folder and reused. An interrupted run resumes.

    OUT/models/NAME/        trained variants (`ablations.py`), each with its bundle
    OUT/runs/NAME/          evaluation runs (`evaluate/runs/predictions.py`), shared by the tables
    OUT/tables/NAME.json    figures with intervals, n, data set, command (`TableResult`); NAME.md as Markdown
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from lalaloc_core.evaluate.reproduce.ablations import train_ablation
from lalaloc_core.evaluate.reproduce.paper_tables import (
    SHIPPED,
    Budget,
    Column,
    Figure,
    Row,
    RowQuery,
    RowResult,
    Table,
    TableResult,
    draw_vogel_samples,
    markdown,
)
from lalaloc_core.evaluate.runs.evaluation import run_evaluation
from lalaloc_core.evaluate.runs.factories import choose_appearance, describe_model
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.score import Estimate, Scores, score
from lalaloc_core.files import atomic_write
from lalaloc_core.learn.data.dataset_detection import open_dataset

# Queries per row: enough to compare methods at a small budget, and few for times, which run one query at a time.
_SMALL_LIMIT = 75
_TIMED_LIMIT = 20


@dataclass(frozen=True, kw_only=True)
class TableMaker:
    """Maker of tables; `limit` is the number of queries per row, None for the budget's default."""

    data: Path
    out: Path
    budget: Budget
    shipped: Path
    limit: int | None = None
    workers: int | None = None
    skip_bad: bool = False
    command: str = ""

    def make(self, table: Table) -> TableResult:
        """Make one table and write its files."""
        bundles = {name: self._train(name) for name in table.models} | {SHIPPED: self.shipped}
        rows = []
        for row in table.rows:
            info, predictions = self._evaluate(table, row.query, bundles)
            rows.append(_row_result(row, table, info, predictions))
        result = TableResult(
            name=table.name,
            title=table.title,
            source=table.source,
            dataset=open_dataset(self.data).description,
            split=table.split,
            budget=self.budget,
            command=self.command,
            columns=table.columns,
            rows=tuple(rows),
        )
        folder = self.out / "tables"
        folder.mkdir(parents=True, exist_ok=True)
        atomic_write(folder / f"{table.name}.json", result.to_json())
        atomic_write(folder / f"{table.name}.md", markdown(result))
        if table.form == "figure":
            draw_vogel_samples(result, folder / f"{table.name}.png")
        return result

    def _train(self, name: str) -> Path:
        return train_ablation(
            name,
            self.budget,
            open_dataset(self.data),
            self.out / "models",
            device=torch.device("cuda" if torch.cuda.is_available() else "cpu"),
            workers=1 if self.workers is None else self.workers,
        ).folder

    def _evaluate(self, table: Table, query: RowQuery, bundles: Mapping[str, Path]) -> tuple[RunInfo, list[Prediction]]:
        """Return the run of a row, shared by tables with equal queries; timed tables run one query at a time."""
        timed = table.form == "times"
        bundle = None if query.model is None else bundles[query.model]
        dataset = open_dataset(self.data)
        appearance = choose_appearance(dataset, query.furniture, None) if query.kind == "photograph" else None
        limit = self.limit or (_SMALL_LIMIT if self.budget == "small" else None)
        info = RunInfo(
            label=" ".join(filter(None, (query.method, query.model, query.kind, query.furniture))),
            method=query.method,
            kind=query.kind,
            dataset=dataset.description,
            split=table.split,
            settings=query.run_settings,
            data=str(self.data),
            furniture=appearance and appearance.furniture,
            lighting=appearance and appearance.lighting,
            grid_step_m=query.grid_step_m,
            limit=min(limit or _TIMED_LIMIT, _TIMED_LIMIT) if timed else limit,
            bundle=None if bundle is None else str(bundle),
            model=None if bundle is None else describe_model(bundle),
            skip_bad=self.skip_bad,
            command=self.command,
        )
        folder = RunFolder(self.out / "runs" / _folder_name(query, info, timed))
        predictions = run_evaluation(folder, info, workers=0 if timed else self.workers)
        # Read again, because the run records skipped scenes.
        return folder.read_info(), predictions


def _folder_name(query: RowQuery, info: RunInfo, timed: bool) -> str:
    """Return a readable name that is unique to the description of the run."""
    description = {
        key: value
        for key, value in dataclasses.asdict(info).items()
        if key not in ("label", "command", "limit", "skipped", "bundle", "data")
    }
    digest = hashlib.sha256(json.dumps([description, timed], sort_keys=True).encode()).hexdigest()[:8]
    return "-".join(filter(None, (query.method, query.model, query.kind, info.split, digest)))


def _row_result(row: Row, table: Table, info: RunInfo, predictions: list[Prediction]) -> RowResult:
    scores = score(predictions)
    return RowResult(
        group=row.group,
        name=row.name,
        n=scores.n,
        skipped=len(info.skipped),
        model=info.model,
        figures={column: figure for column in table.columns if (figure := _figure(column, scores, row)) is not None},
        paper=dict(row.paper),
    )


def _figure(column: Column, scores: Scores, row: Row) -> Figure | None:
    if column.startswith("seconds"):
        _, _, stage = column.partition(":")
        times = scores.mean_ms if not stage else {stage: scores.mean_ms[stage]} if stage in scores.mean_ms else {}
        return Figure(value=sum(times.values()) / 1e3) if times else None
    if column in ("layout_recall", "pose_recall"):
        return _estimated(getattr(scores, column))
    stage_scores = scores.final if row.stage is None else scores.stages[row.stage]
    return _estimated(getattr(stage_scores, column))


def _estimated(estimate: Estimate | None) -> Figure | None:
    return None if estimate is None else Figure(value=estimate.value, low=estimate.low, high=estimate.high)
