"""Audit log: actions of callers and operators, which are added and read, and deleted by age only."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, Row, Select, and_, delete, or_, select

from service.storage.database import Database
from service.storage.records import ANONYMOUS, AuditEntry, Cursor, StoredAuditEntry
from service.storage.statements import newest_first
from service.storage.tables import AUDIT_LOG

_COLUMNS = AUDIT_LOG.c
_BATCH_SIZE = 500
# Part of the log that requests of unknown callers can fill, so that they cannot displace other entries.
_ANONYMOUS_SHARE = 0.1


class AuditLog:
    """Entries of all tenants.

    They are deleted after `keep_s` (s), and the oldest beyond `max_entries`.
    """

    def __init__(self, database: Database, *, keep_s: float, max_entries: int) -> None:
        self._database = database
        self._keep = timedelta(seconds=keep_s)
        self._max_entries = max_entries

    def add(self, entries: Sequence[AuditEntry]) -> None:
        """Store entries, all or none."""
        if not entries:
            return
        rows = [{**asdict(entry), "id": uuid.uuid4().hex} for entry in entries]
        with self._database.writing() as connection:
            connection.execute(AUDIT_LOG.insert(), rows)

    def page(
        self,
        *,
        limit: int,
        after: Cursor | None = None,
        tenant: str | None = None,
        actor: str | None = None,
        since: datetime | None = None,
        until: datetime | None = None,
    ) -> list[StoredAuditEntry]:
        """Return a page of the entries, newest first.

        `after` is the last entry of the previous page; only those of a tenant or actor, or between two times.
        """
        query = _filtered(tenant, actor, since, until)
        return [_entry(row) for row in self._database.rows(newest_first(query, AUDIT_LOG, limit=limit, after=after))]

    def export(
        self, *, tenant: str | None = None, since: datetime | None = None, until: datetime | None = None
    ) -> Iterator[StoredAuditEntry]:
        """Yield the entries, oldest first, in batches of their own transactions; arguments as of `page`."""
        query = _filtered(tenant, None, since, until).order_by(_COLUMNS.created_at, _COLUMNS.id).limit(_BATCH_SIZE)
        last: Row[Any] | None = None
        while True:
            rows = self._database.rows(query if last is None else query.where(_is_after(last)))
            yield from map(_entry, rows)
            if len(rows) < _BATCH_SIZE:
                return
            last = rows[-1]

    def purge(self) -> int:
        """Delete entries that are too old or too many, and return their number."""
        anonymous = _COLUMNS.actor == ANONYMOUS
        share = int(_ANONYMOUS_SHARE * self._max_entries)
        count = self._delete(_COLUMNS.created_at < datetime.now(UTC) - self._keep)
        count += self._delete(self._surplus(anonymous, share))
        return count + self._delete(self._surplus(~anonymous, self._max_entries - share))

    def _surplus(self, kind: ColumnElement[bool], limit: int) -> ColumnElement[bool] | None:
        """Return the condition of the entries of a kind beyond the newest `limit`; None without any."""
        query = select(_COLUMNS.created_at).where(kind).order_by(_COLUMNS.created_at.desc()).offset(limit).limit(1)
        last = self._database.value(query)
        return None if last is None else and_(kind, _COLUMNS.created_at <= last)

    def _delete(self, condition: ColumnElement[bool] | None) -> int:
        if condition is None:
            return 0
        batch = select(_COLUMNS.id).where(condition).limit(_BATCH_SIZE)
        statement = delete(AUDIT_LOG).where(_COLUMNS.id.in_(batch))
        count, deleted = 0, _BATCH_SIZE
        while deleted == _BATCH_SIZE:
            deleted = self._database.freeing(lambda connection: connection.execute(statement).rowcount)
            count += deleted
        return count


def _filtered(
    tenant: str | None, actor: str | None, since: datetime | None, until: datetime | None
) -> Select[tuple[Any, ...]]:
    query = select(AUDIT_LOG)
    if tenant is not None:
        query = query.where(_COLUMNS.tenant == tenant)
    if actor is not None:
        query = query.where(_COLUMNS.actor == actor)
    if since is not None:
        query = query.where(_COLUMNS.created_at >= since)
    if until is not None:
        query = query.where(_COLUMNS.created_at < until)
    return query


def _is_after(row: Row[Any]) -> ColumnElement[bool]:
    age = _COLUMNS.created_at
    return or_(age > row.created_at, and_(age == row.created_at, _COLUMNS.id > row.id))


def _entry(row: Row[Any]) -> StoredAuditEntry:
    return StoredAuditEntry(**row._mapping)
