"""Tables of the paper, of `paper_tables.toml`."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

from lalaloc_core.configuration import build_config
from lalaloc_core.evaluate.reproduce.table import Table

_PATH = Path(__file__).with_name("paper_tables.toml")


def _table(values: dict[str, Any]) -> Table:
    for row in values["rows"]:
        figures = zip(values["columns"], row.get("paper", ()), strict="paper" in row)
        row["paper"] = {column: figure for column, figure in figures if not math.isnan(figure)}
    return build_config(Table, values, path=_PATH.name)


TABLES = tuple(map(_table, tomllib.loads(_PATH.read_text(encoding="utf-8"))["tables"]))
