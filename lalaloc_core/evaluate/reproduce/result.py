"""A table with our figures beside the paper's, as it is written down."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import ConfigError, RunError
from lalaloc_core.evaluate.runs.predictions import without_infinity

Budget = Literal["small", "full"]


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A measured figure, with its 95 % bootstrap interval where it has one; None: infinite (too many misses)."""

    value: float | None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, kw_only=True)
class RowResult:
    """One row: n queries, our figures and the paper's by column, and the model that answered."""

    group: str
    name: str
    n: int
    skipped: int = 0
    model: dict[str, str] | None = None
    figures: dict[str, Figure] = field(default_factory=dict)
    paper: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class TableResult:
    """One table; `dataset` names what our figures were measured on, the paper's are of Structured3D."""

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
        """As indented JSON text."""
        return json.dumps(without_infinity(dataclasses.asdict(self)), indent=1, allow_nan=False) + "\n"

    @classmethod
    def read(cls, path: Path) -> TableResult:
        """A table from its file.

        Raises:
            RunError: missing, or not a table.
        """
        try:
            return build_config(cls, json.loads(path.read_text(encoding="utf-8")), path=path.name)
        except (OSError, ValueError, ConfigError) as error:
            raise RunError(f"'{path}' is no table of results: {error}") from error
