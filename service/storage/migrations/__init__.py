"""Migrations of the schema, one module per step in `versions/`, run in order by `service.storage.store`.

Begin with `versions/v0001_revisions_and_leases.py`. `service.storage.tables` describes the current schema, with the
same functions for columns that tables repeat; released steps use them, so they cannot change.
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa


def required(kind: Any, *names: str) -> list[sa.Column[Any]]:
    """Return columns of one type that have a value in every row."""
    return [sa.Column(name, kind, nullable=False) for name in names]


def optional(kind: Any, *names: str) -> list[sa.Column[Any]]:
    """Return columns of one type that can be NULL."""
    return [sa.Column(name, kind) for name in names]


def counter(name: str) -> sa.Column[int]:
    """Return a column of counted bytes or changes; 0 in rows of versions of the service that do not count them."""
    return sa.Column(name, sa.BigInteger, nullable=False, server_default="0")


def owned() -> list[sa.Column[str]]:
    """Return the id of a row, and the tenant that owns it."""
    return [sa.Column("id", sa.String(32), primary_key=True), *required(sa.String(64), "tenant")]


def part_of(owners: str, name: str, **options: Any) -> sa.Column[str]:
    """Return the id of the row of another table with which a row is deleted."""
    return sa.Column(name, sa.String(32), sa.ForeignKey(f"{owners}.id", ondelete="CASCADE"), **options)


def chunk() -> list[sa.Column[Any]]:
    """Return number and content of a part of a file; the first column of its table names the file."""
    return [
        sa.Column("number", sa.Integer, primary_key=True, autoincrement=False),
        *required(sa.LargeBinary, "content"),
    ]
