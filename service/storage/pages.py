"""Pages of what a tenant has, plans or venues."""

from __future__ import annotations

from typing import Any, TypeVar

from sqlalchemy import Select, Table, and_, or_

from service.storage.records import Cursor

Query = TypeVar("Query", bound=Select[Any])


def newest_first(query: Query, table: Table, *, limit: int, after: Cursor | None, name: str | None) -> Query:
    """A page of a query about a table that has `id`, `created_at` and `folded_name`.

    Args:
        after: the last one of the page before.
        name: only those with this in their name, whatever the case of letters.
    """
    age, own_id = table.c.created_at, table.c.id
    if name:
        query = query.where(table.c.folded_name.contains(name.casefold(), autoescape=True))
    if after is not None:
        query = query.where(or_(age < after.created_at, and_(age == after.created_at, own_id < after.id)))
    return query.order_by(age.desc(), own_id.desc()).limit(limit)
