"""Tables with our figures beside the paper's: as JSON, Markdown and drawing."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib.figure

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError, RunError
from lalaloc_core.evaluate.reproduce.table import COLUMN_TITLES, SHARES, Budget
from lalaloc_core.evaluate.runs.predictions import without_infinity


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
        """Read a table from its file.

        Raises:
            RunError: the file is missing or not a table.
        """
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
    """Format an end of an interval."""
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
