"""Idempotency keys: a request that is sent twice is carried out once, and its stored answer is returned again."""

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
# Minimum time (s) that callers wait after a crash.
MIN_LEASE_S = 15.0
_COLUMNS = IDEMPOTENCY.c


class IdempotencyKeys:
    """Answers by (tenant, route, key), kept for a day."""

    def __init__(self, database: Database, lease_s: float = MIN_LEASE_S) -> None:
        """Create the access to the table.

        Args:
            database: the database.
            lease_s: time limit (s) of a request, after which the next attempt takes over. If the first one is still
                alive,
                both work under the same token: work is done twice, nothing is stored twice.
        """
        self._database = database
        self._lease_s = lease_s

    def begin(self, tenant: str, route: str, key: str, body_sha256: str) -> Claim:
        """Claim a request.

        Returns:
            `Claimed` if the caller is to carry out the request and then call `finish` or `abandon`; else the reason
            not to.
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
        """Store the answer, unless one is stored already; later attempts get it."""
        values = {"status": answer.status, "headers": json.dumps(answer.headers), "body": answer.body}
        own = (*_where(tenant, route, key), _COLUMNS.token == token, _COLUMNS.status.is_(None))
        with self._database.writing() as connection:
            connection.execute(update(IDEMPOTENCY).where(*own).values(**values))

    def abandon(self, tenant: str, route: str, key: str, token: str) -> None:
        """Release a request that was not finished; the next attempt takes over at once, under the same token.

        The token is kept, because the failed attempt may have stored something under it.
        """
        own = (*_where(tenant, route, key), _COLUMNS.token == token, _COLUMNS.status.is_(None))
        with self._database.writing() as connection:
            connection.execute(update(IDEMPOTENCY).where(*own).values(lease_until_s=0.0))

    def purge(self) -> int:
        """Delete keys older than a day, and return their number."""
        statement = delete(IDEMPOTENCY).where(_COLUMNS.created_at < datetime.now(UTC) - KEPT_FOR)
        with self._database.writing() as connection:
            return connection.execute(statement).rowcount

    def _repeated(
        self, connection: Connection, own: list[ColumnElement[bool]], body_sha256: str, until_s: Any
    ) -> Claim:
        row = connection.execute(select(IDEMPOTENCY).where(*own).with_for_update()).one_or_none()
        if row is None:
            # Purged between two statements; the caller tries again.
            return InProgress()
        if row.body_sha256 != body_sha256:
            return Conflict()
        if row.status is not None:
            return StoredAnswer(row.status, json.loads(row.headers), row.body)
        expired_lease = ~self._database.is_live(_COLUMNS.lease_until_s, _COLUMNS.lease_s)
        values = {"lease_until_s": until_s, "lease_s": self._lease_s}
        taken = connection.execute(update(IDEMPOTENCY).where(*own, expired_lease).values(**values))
        return Claimed(row.token) if taken.rowcount == 1 else InProgress()


def _where(tenant: str, route: str, key: str) -> list[ColumnElement[bool]]:
    return [_COLUMNS.tenant == tenant, _COLUMNS.route == route, _COLUMNS.key == key]
