"""Tables of the paper, of `paper_tables.toml`, and as they are measured: rows with figures, as JSON and Markdown."""

from __future__ import annotations

import dataclasses
import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import matplotlib.figure

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError, RunError
from lalaloc_core.evaluate.methods.method import QueryKind
from lalaloc_core.evaluate.runs.predictions import MethodName, without_infinity
from lalaloc_core.learn.data.dataset import Split

Budget = Literal["small", "full"]
# Columns: fields of `evaluate.runs.score.Scores` and its `StageScores`, or seconds per query of a stage
# ("seconds:vdr") or of all stages ("seconds").
Column = str

_PATH = Path(__file__).with_name("paper_tables.toml")
_PAPER: Mapping[str, Any] = tomllib.loads(_PATH.read_text(encoding="utf-8"))
COLUMN_TITLES: Mapping[Column, str] = _PAPER["columns"]
SHARES = frozenset({"layout_recall", "pose_recall", "correct_room", *(c for c in COLUMN_TITLES if c[:6] == "within")})
# Name of the bundle that ships; other models are the variants in `reproduce.ablations`.
SHIPPED = "ring"
PAPER_SETTING: Mapping[str, Any] = _PAPER["setting"]


@dataclass(frozen=True, kw_only=True)
class RowQuery:
    """Query of a row; `model` is `SHIPPED`, the name of a trained variant, or None for methods without a model."""

    method: MethodName = "lalaloc"
    kind: QueryKind = "photograph"
    model: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    grid_step_m: float = 0.5
    furniture: str | None = None

    @property
    def run_settings(self) -> dict[str, Any]:
        """Settings of the run: the paper's, overridden by the row's."""
        return {**(PAPER_SETTING if self.method == "lalaloc" else {}), **self.settings}


@dataclass(frozen=True, kw_only=True)
class Row:
    """Row of a table: the stage whose poses are scored (None: the last), and the paper's figures by column, if any."""

    group: str
    name: str
    query: RowQuery
    stage: str | None = None
    paper: Mapping[Column, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Table:
    """Table of the paper; a "figure" is also drawn, and "times" runs one query at a time."""

    name: str
    title: str
    source: str
    split: Split
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    form: Literal["table", "figure", "times"] = "table"

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the trained variants that the rows need."""
        names = [row.query.model for row in self.rows if row.query.model not in (None, SHIPPED)]
        return tuple(dict.fromkeys(name for name in names if name is not None))


def _table(values: dict[str, Any]) -> Table:
    for row in values["rows"]:
        figures = zip(values["columns"], row.get("paper", ()), strict="paper" in row)
        row["paper"] = {column: figure for column, figure in figures if not math.isnan(figure)}
    return build_config(Table, values, path=_PATH.name)


TABLES = tuple(map(_table, _PAPER["tables"]))


@dataclass(frozen=True, kw_only=True)
class Figure:
    """Measured figure with its 95 % bootstrap interval, if any; None for infinity, after too many misses."""

    value: float | None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, kw_only=True)
class RowResult:
    """Row with n queries, our figures and the paper's by column, and the model."""

    group: str
    name: str
    n: int
    skipped: int = 0
    model: dict[str, str] | None = None
    figures: dict[str, Figure] = field(default_factory=dict)
    paper: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class TableResult:
    """Table; our figures are measured on `dataset`, the paper's on Structured3D."""

    name: str
    title: str
    source: str
    dataset: str
    split: str
    budget: Budget
    command: str
    columns: tuple[str, ...]
    rows: tuple[RowResult, ...]

    def to_json(self) -> str:
        """Return the table as indented JSON."""
        return json.dumps(without_infinity(dataclasses.asdict(self)), indent=1, allow_nan=False) + "\n"

    @classmethod
    def read(cls, path: Path) -> TableResult:
        """Read a table from its file."""
        try:
            return build_config(cls, json.loads(path.read_text(encoding="utf-8")), path=path.name)
        except (OSError, ValueError, ConfigError) as error:
            raise RunError(f"'{path}' is not a table of results: {error}") from error


_PAPER_DATA = "Structured3D"


def markdown(table: TableResult) -> str:
    """Return a table as Markdown, with our figure and, in italics, the paper's in each cell."""
    same = table.dataset == _PAPER_DATA and table.budget == "full"
    lines = [
        f"**{table.title}** (`{table.source}`, `lalaloc lab reproduce --table {table.name}`). Upright: ours, on "
        f"{table.dataset}, {table.split} split, budget {table.budget}, with 95 % intervals. Italic: the paper's, on "
        f"{_PAPER_DATA}{'' if same else '; not the same experiment'}.",
        "",
        "| | " + " | ".join(COLUMN_TITLES[column] for column in table.columns) + " | n |",
        "|---|" + "---|" * (len(table.columns) + 1),
    ]
    for row in table.rows:
        name = f"{row.group}: {row.name}" if row.group else row.name
        cells = [_cell(column, row.figures.get(column), row.paper.get(column)) for column in table.columns]
        count = f"{row.n} ({row.skipped} skipped)" if row.skipped else str(row.n)
        lines.append("| " + " | ".join([name, *cells, count]) + " |")
    return "\n".join(lines) + "\n"


def _cell(column: str, ours: Figure | None, paper: float | None) -> str:
    parts = []
    if ours is not None:
        interval = ""
        if ours.low is not None or ours.high is not None:
            interval = f" [{_bound(column, ours.low)}, {_bound(column, ours.high)}]"
        parts.append(_number(column, ours.value) + interval)
    if paper is not None:
        parts.append(f"*{_number(column, paper)}*")
    return " · ".join(parts) or "–"


def _number(column: str, value: float | None) -> str:
    if value is None:
        return "∞"
    if column in SHARES:
        return f"{100.0 * value:.1f} %"
    if column.startswith("seconds"):
        return f"{value:.2g}" if value < 10.0 else f"{value:.1f}"
    # Errors of layout queries are below a millimetre.
    return f"{value:.1f}" if value >= 1.0 else f"{value:.2f}" if value >= 0.01 else "< 0.01"


def _bound(column: str, value: float | None) -> str:
    if value is not None and column in SHARES:
        return f"{100.0 * value:.0f}"
    return _number(column, value)


def _median_cm(row: RowResult) -> float:
    """Return the median error; infinite, and not drawn, if half of the queries have no answer."""
    value = row.figures["median_cm"].value
    return math.inf if value is None else value


def draw_vogel_samples(table: TableResult, path: Path) -> None:
    """Draw the paper's figure of Vogel disc samples: median error by number of samples, with and without LPO."""
    figure = matplotlib.figure.Figure(figsize=(6.0, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for name, style in (("VDR", "o-"), ("VDR + LPO", "s-")):
        rows = [row for row in table.rows if row.name == name]
        axes.plot([int(row.group.split()[0]) for row in rows], [_median_cm(row) for row in rows], style, label=name)
    for name, style in (("Retrieval", ":"), ("LPO", "--")):
        (row,) = (row for row in table.rows if row.name == name and row.group == "without VDR")
        axes.axhline(_median_cm(row), linestyle=style, color="0.4", label=f"{name}, no VDR")
    axes.set(xlabel="samples of the Vogel disc", ylabel="median error (cm)", ylim=(0.0, None))
    axes.legend(frameon=False, loc="center right")
    figure.savefig(path, dpi=120)
