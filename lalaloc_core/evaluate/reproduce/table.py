"""What a table of the paper consists of: rows that ask something of a method, and the paper's own figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from lalaloc_core.evaluate.methods.method import QueryKind
from lalaloc_core.evaluate.runs.predictions import MethodName
from lalaloc_core.learn.data.dataset import Split

# What the columns of tables are called: fields of `evaluation.score.Scores` and of its `StageScores`, or seconds per
# query of a stage ("seconds:vdr"), of all together ("seconds").
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

# A trained model by name: the bundle that ships, or one of the variants in `reproduce.ablations`.
SHIPPED = "ring"


# The paper's plans show bare walls, its cameras' heights and headings are exact. Structured3D's annotation has openings
# and types of rooms as well, which our search would weigh.
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
    """What a row asks.

    Attributes:
        model: `SHIPPED` or the name of a trained variant; None for methods without a model.
        furniture: of the photographs; None for the data set's usual.
    """

    method: MethodName = "lalaloc"
    kind: QueryKind = "panorama"
    model: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    grid_step_m: float = 0.5
    furniture: str | None = None

    @property
    def run_settings(self) -> dict[str, Any]:
        """Settings of the run: the paper's setting, and what the row says of its own."""
        return {**(PAPER_SETTING if self.method == "lalaloc" else {}), **self.settings}


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row.

    Attributes:
        group: what the row belongs to, such as the type of query.
        stage: the stage whose poses are scored; None for the answer.
        paper: the paper's figures by column, shares from 0 to 1; empty for what the paper does not have.
    """

    group: str
    name: str
    ask: RowQuery
    stage: str | None = None
    paper: Mapping[Column, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Table:
    """One table of the paper.

    Attributes:
        name: what `lalaloc reproduce --table` calls it.
        source: label of the paper's table or figure.
        form: a "figure" is drawn as well; of "times", queries are asked one at a time.
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
        """Trained variants that the rows need, besides the bundle that ships."""
        names = [row.ask.model for row in self.rows if row.ask.model not in (None, SHIPPED)]
        return tuple(dict.fromkeys(name for name in names if name is not None))
