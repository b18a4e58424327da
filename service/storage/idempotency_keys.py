"""Requests that may be sent twice and are carried out once: the answer is kept under the caller's key."""

from __future__ import annotations

import json
import uuid
from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, Connection, delete, select, update

from service.storage.database import Database
from service.storage.records import Claim, Claimed, Conflict, InProgress, StoredAnswer
from service.storage.tables import IDEMPOTENCY

KEPT_FOR = timedelta(hours=24)
# After a crash, callers wait for as long at least.
MIN_LEASE_S = 15.0
_COLUMNS = IDEMPOTENCY.c


class IdempotencyKeys:
    """Answers by (tenant, route, key), for a day."""

    def __init__(self, database: Database, lease_s: float = MIN_LEASE_S) -> None:
        """Args:
        lease_s: how long a request may take; after that its owner counts as dead, and the next one takes over. An
            owner that lives is overtaken under its own token: work is done twice, and nothing stored twice.
        """
        self._database = database
        self._lease_s = lease_s

    def begin(self, tenant: str, route: str, key: str, body_sha256: str) -> Claim:
        """Say that a request is about to be carried out.

        Returns:
            Claimed to whoever is to carry it out, and then calls `finish` or `abandon`; else why not to.
        """
        own = _where(tenant, route, key)
        token, now = uuid.uuid4().hex, datetime.now(UTC)
        until_s = self._database.now_s() + self._lease_s
        with self._database.writing() as connection:
            expired = _COLUMNS.created_at < now - KEPT_FOR
            connection.execute(delete(IDEMPOTENCY).where(*own, expired))
            statement = self._database.insert(IDEMPOTENCY).values(
                tenant=tenant,
                route=route,
                key=key,
                body_sha256=body_sha256,
                token=token,
                lease_until_s=until_s,
                lease_s=self._lease_s,
                created_at=now,
            )
            if connection.scalar(statement.on_conflict_do_nothing().returning(_COLUMNS.token)) == token:
                return Claimed(token)
            return self._repeated(connection, own, body_sha256, until_s)

    def finish(self, tenant: str, route: str, key: str, token: str, answer: StoredAnswer) -> None:
        """Keep the answer, unless one is kept already; whoever sends the same request again gets it."""
        values = {"status": answer.status, "headers": json.dumps(answer.headers), "body": answer.body}
        own = (*_where(tenant, route, key), _COLUMNS.token == token, _COLUMNS.status.is_(None))
        with self._database.writing() as connection:
            connection.execute(update(IDEMPOTENCY).where(*own).values(**values))

    def abandon(self, tenant: str, route: str, key: str, token: str) -> None:
        """Say that the request was not seen through; the next one is, at once and under the same token.

        The token stays because something may have been stored under it, whatever its owner believes.
        """
        own = (*_where(tenant, route, key), _COLUMNS.token == token, _COLUMNS.status.is_(None))
        with self._database.writing() as connection:
            connection.execute(update(IDEMPOTENCY).where(*own).values(lease_until_s=0.0))

    def purge(self) -> int:
        """Drop what is older than a day; returns how many."""
        statement = delete(IDEMPOTENCY).where(_COLUMNS.created_at < datetime.now(UTC) - KEPT_FOR)
        with self._database.writing() as connection:
            return connection.execute(statement).rowcount

    def _repeated(
        self, connection: Connection, own: list[ColumnElement[bool]], body_sha256: str, until_s: Any
    ) -> Claim:
        row = connection.execute(select(IDEMPOTENCY).where(*own).with_for_update()).one_or_none()
        if row is None:
            # Purged between two statements: as good as still in work, the caller tries again.
            return InProgress()
        if row.body_sha256 != body_sha256:
            return Conflict()
        if row.status is not None:
            return StoredAnswer(row.status, json.loads(row.headers), row.body)
        ran_out = ~self._database.is_live(_COLUMNS.lease_until_s, _COLUMNS.lease_s)
        values = {"lease_until_s": until_s, "lease_s": self._lease_s}
        taken = connection.execute(update(IDEMPOTENCY).where(*own, ran_out).values(**values))
        return Claimed(row.token) if taken.rowcount == 1 else InProgress()


def _where(tenant: str, route: str, key: str) -> list[ColumnElement[bool]]:
    return [_COLUMNS.tenant == tenant, _COLUMNS.route == route, _COLUMNS.key == key]
