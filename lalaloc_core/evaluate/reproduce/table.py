"""Structure of the paper's tables: rows with the query of a method and the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from lalaloc_core.evaluate.methods.method import QueryKind
from lalaloc_core.evaluate.runs.predictions import MethodName
from lalaloc_core.learn.data.dataset import Split

Budget = Literal["small", "full"]
# Columns: fields of `evaluate.runs.score.Scores` and its `StageScores`, or seconds per query of a stage
# ("seconds:vdr") or of all stages ("seconds").
Column = str

COLUMN_TITLES: Mapping[Column, str] = {
    "layout_recall": "Layout R@1",
    "pose_recall": "Pose R@1",
    "median_cm": "Median (cm)",
    "within_1cm": "< 1 cm",
    "within_5cm": "< 5 cm",
    "within_10cm": "< 10 cm",
    "within_1m": "< 1 m",
    "correct_room": "Correct room",
    "seconds:retrieve": "Retrieval (s)",
    "seconds:vdr": "VDR (s)",
    "seconds:lpo": "LPO (s)",
    "seconds": "Total (s)",
}
SHARES = frozenset({"layout_recall", "pose_recall", "correct_room", *(c for c in COLUMN_TITLES if c[:6] == "within")})

# Name of the bundle that ships; other models are the variants in `reproduce.ablations`.
SHIPPED = "ring"


# The paper's plans have walls only and exact camera heights and headings. Structured3D's annotation also has openings
# and room types, which our search would use.
PAPER_SETTING: Mapping[str, Any] = {
    "openings": False,
    "see_through": False,
    "ceiling": False,
    "room_type": False,
    "heading_doubt": 0.0,
    "camera_height_std_m": 0.0,
}


@dataclass(frozen=True, kw_only=True)
class RowQuery:
    """Query of a row.

    Attributes:
        model: `SHIPPED` or the name of a trained variant; None for methods without a model.
        furniture: furniture of the photographs; None for the data set's default.
    """

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
    """Row of a table.

    Attributes:
        group: group of rows, such as the kind of query.
        stage: stage whose poses are scored; None for the final pose.
        paper: the paper's figures by column, shares from 0 to 1; empty for rows of our own.
    """

    group: str
    name: str
    query: RowQuery
    stage: str | None = None
    paper: Mapping[Column, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Table:
    """Table of the paper.

    Attributes:
        name: name for `lalaloc lab reproduce --table`.
        source: label of the paper's table or figure.
        form: a "figure" is also drawn; "times" runs one query at a time.
    """

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
