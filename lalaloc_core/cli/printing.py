"""Output of commands: tables, JSON and warnings."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Sequence
from functools import reduce
from typing import Any

from lalaloc_core.shown_text import printable

# Decimals of printed poses: micrometres, and mm² of covariances.
JSON_DECIMALS = 6
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
# Options by what messages about photographs call them, as fields.
_OPTIONS = {"hfov_deg": "--hfov", "projection=": "--projection ", "as one query with motion=turn": "with --turn"}


def print_json(value: Any, decimals: int | None = None) -> None:
    """Print indented JSON, its numbers rounded to some decimals; None: as they are."""
    print(json.dumps(value if decimals is None else _rounded(value, decimals), indent=2))


def _rounded(value: Any, decimals: int) -> Any:
    if isinstance(value, float):
        # Adding 0.0 turns -0.0 into 0.0.
        return round(value, decimals) + 0.0
    if isinstance(value, dict):
        return {name: _rounded(item, decimals) for name, item in value.items()}
    return [_rounded(item, decimals) for item in value] if isinstance(value, list | tuple) else value


def pose_cells(document: dict[str, Any]) -> tuple[str, ...]:
    """Return the columns room, x, y and heading of a table, from a document with a pose."""
    x_m, y_m = document["position"].values()
    return document["room"], f"{x_m:.2f}", f"{y_m:.2f}", f"{document['heading_deg'] or 0.0:.1f}"


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print aligned columns: the first to the left, the others to the right."""
    columns = list(zip(head, *rows, strict=True))
    widths = [max(len(cell) for cell in column) for column in columns]
    for row in (head, ["-" * width for width in widths], *rows):
        first, *others = (
            cell.ljust(width) if index == 0 else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        print(printable("  ".join([first, *others]).rstrip()))


def with_options(message: object) -> str:
    """Return a message about a photograph with the names of options instead of those of fields."""
    return reduce(lambda text, field: text.replace(field, _OPTIONS[field]), _OPTIONS, str(message))


def print_warnings(warnings: Iterable[tuple[str, str]]) -> None:
    """Print warnings, by names and texts, to standard error, each cause once: its texts differ in numbers only."""
    causes: dict[str, list[tuple[str, str]]] = {}
    for name, text in warnings:
        causes.setdefault(_NUMBER.sub("#", text), []).append((name, with_options(text)))
    for (name, text), *others in causes.values():
        more = len({other for other, _ in others} - {name})
        print(printable(f"warning: {name}{f' and {more} more' if more else ''}: {text}"), file=sys.stderr)
