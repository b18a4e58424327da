"""Parts that the commands of `lalaloc-service` share."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from service.settings import Settings
from service.storage import Store, open_store

_TENANT = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@contextmanager
def configured_store() -> Iterator[Store]:
    """Open the store of the settings in the environment."""
    store = open_store(Settings.load())
    try:
        yield store
    finally:
        store.close()


def tenant_name(given: str) -> str:
    """Return the name of a tenant.

    Raises:
        ArgumentTypeError: not a name of a tenant.
    """
    if not _TENANT.fullmatch(given):
        raise argparse.ArgumentTypeError("1 to 64 letters, digits, '.', '_' and '-', beginning with a letter or digit")
    return given


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as text, with columns as wide as their longest cell."""
    widths = [max(len(row[column]) for row in (head, *rows)) for column in range(len(head))]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows))
    return "\n".join(line.rstrip() for line in lines)
