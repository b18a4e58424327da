"""Answers that are kept: by idempotency key, for a request that is sent twice, and by id, for links to them."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, Connection, and_, delete, exists, or_, select, update

from service.errors import StorageQuotaError
from service.storage.database import Database
from service.storage.records import Claim, Claimed, Conflict, InProgress, StoredAnswer
from service.storage.stored_bytes import ROW_BYTES, Account, StorageQuota, StoredBytes, deleted_bytes
from service.storage.tables import ALBUMS, FLOORPLANS, IDEMPOTENCY, KEPT_ANSWERS, SESSIONS, VENUES

KEPT_FOR = timedelta(hours=24)
# Minimum time (s) that callers wait after a crash.
MIN_LEASE_S = 15.0
# Keys per read when old ones are deleted.
_BATCH_SIZE = 100
_KEYS, _ANSWERS = IDEMPOTENCY.c, KEPT_ANSWERS.c
# Answers about something that was stored, under the request's token, and deleted since: the request is executed again.
_IS_GONE = and_(
    _KEYS.status == 201, *(~exists().where(made.c.id == _KEYS.token) for made in (FLOORPLANS, VENUES, SESSIONS, ALBUMS))
)


class IdempotencyKeys:
    """Answers by (tenant, route, key), kept for a day, or until newer ones of the tenant need their space."""

    def __init__(
        self, database: Database, quota: StorageQuota, lease_s: float = MIN_LEASE_S, *, max_bytes: int = 64 * 2**20
    ) -> None:
        self._database, self._quota = database, quota
        # Time limit of a request, after which the next attempt takes over. If the first one is still alive, both work
        # under the same token: work is done twice, nothing is stored twice.
        self._lease_s = lease_s
        # Limit of a tenant's keys and answers; the oldest are deleted first.
        self._max_bytes = max_bytes

    def begin(self, tenant: str, route: str, key: str, body_sha256: str) -> Claim:
        """Claim a request.

        Returns:
            `Claimed` if the caller is to carry out the request and then call `finish` or `abandon`; else the reason
            not to.
        """
        own = _where(tenant, route, key)
        token, now = uuid.uuid4().hex, datetime.now(UTC)
        until_s = self._database.now_s() + self._lease_s
        size = ROW_BYTES + 2 * len(key)
        with self._database.writing(grows_by=size) as connection:
            expired = or_(_KEYS.created_at < now - KEPT_FOR, _IS_GONE)
            freed = deleted_bytes(connection, delete(IDEMPOTENCY).where(*own, expired))
            statement = self._database.insert(IDEMPOTENCY).values(
                tenant=tenant,
                route=route,
                key=key,
                body_sha256=body_sha256,
                token=token,
                lease_until_s=until_s,
                lease_s=self._lease_s,
                created_at=now,
                stored_bytes=size,
            )
            if connection.scalar(statement.on_conflict_do_nothing().returning(_KEYS.token)) == token:
                # Never refused: a few rows of requests in progress can exceed the tenant's limit.
                change = StoredBytes(idempotency=size - freed)
                account = self._quota.settle(connection, tenant, change, refuse=False)
                self._make_room(connection, tenant, account)
                return Claimed(token)
            return self._repeated(connection, own, body_sha256, until_s)

    def finish(self, tenant: str, route: str, key: str, token: str, answer: StoredAnswer) -> None:
        """Store the answer, unless one is stored already; later attempts get it.

        Raises:
            StorageQuotaError: the answer does not fit, even without older ones; it is not stored.
        """
        values = {"status": answer.status, "headers": json.dumps(answer.headers), "body": answer.body}
        size = len(values["headers"]) + len(answer.body)
        own = (*_where(tenant, route, key), _KEYS.token == token, _KEYS.status.is_(None))
        with self._database.writing(grows_by=size) as connection:
            counted = {"stored_bytes": _KEYS.stored_bytes + size}
            if connection.execute(update(IDEMPOTENCY).where(*own).values(**values, **counted)).rowcount == 1:
                account = self._quota.settle(connection, tenant, StoredBytes(idempotency=size), refuse=False)
                others = account.used.total - account.used.idempotency
                if size > min(self._max_bytes, account.limit - others):
                    raise StorageQuotaError(others, size, account.limit, "LALALOC_MAX_STORED_BYTES")
                self._make_room(connection, tenant, account, keep=token)

    def abandon(self, tenant: str, route: str, key: str, token: str) -> None:
        """Release a request that was not finished; the next attempt takes over at once, under the same token.

        The token is kept, because the failed attempt may have stored something under it.
        """
        own = (*_where(tenant, route, key), _KEYS.token == token, _KEYS.status.is_(None))
        with self._database.writing() as connection:
            connection.execute(update(IDEMPOTENCY).where(*own).values(lease_until_s=0.0))

    def purge(self) -> int:
        """Delete keys older than a day, and return their number."""
        return self._quota.purge("idempotency", IDEMPOTENCY, _KEYS.created_at < datetime.now(UTC) - KEPT_FOR)

    def delete_all(self, tenant: str) -> int:
        """Delete all keys of a tenant, and return their number."""
        return self._quota.purge("idempotency", IDEMPOTENCY, _KEYS.tenant == tenant)

    def _make_room(self, connection: Connection, tenant: str, account: Account, *, keep: str = "") -> None:
        """Delete the oldest keys of a tenant, except the one of `keep`, until the limits hold."""
        # Rows that another transaction holds are skipped, because it waits for the tenant's row.
        idle = or_(_KEYS.status.is_not(None), ~self._database.is_live(_KEYS.lease_until_s, _KEYS.lease_s))
        query = select(_KEYS.route, _KEYS.key).where(_KEYS.tenant == tenant, _KEYS.token != keep, idle)
        oldest = query.order_by(_KEYS.created_at).limit(_BATCH_SIZE).with_for_update(skip_locked=True)
        while _excess(account, self._max_bytes) > 0 and (rows := connection.execute(oldest).all()):
            for row in rows:
                freed = deleted_bytes(connection, delete(IDEMPOTENCY).where(*_where(tenant, row.route, row.key)))
                account = self._quota.settle(connection, tenant, StoredBytes(idempotency=-freed))
                if _excess(account, self._max_bytes) <= 0:
                    break

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
        expired_lease = ~self._database.is_live(_KEYS.lease_until_s, _KEYS.lease_s)
        values = {"lease_until_s": until_s, "lease_s": self._lease_s}
        taken = connection.execute(update(IDEMPOTENCY).where(*own, expired_lease).values(**values))
        return Claimed(row.token) if taken.rowcount == 1 else InProgress()


def _excess(account: Account, max_bytes: int) -> int:
    """Return the bytes by which the keys of a tenant exceed their own limit or that of all it stores."""
    return max(account.used.idempotency - max_bytes, account.used.total - account.limit)


def _where(tenant: str, route: str, key: str) -> list[ColumnElement[bool]]:
    return [_KEYS.tenant == tenant, _KEYS.route == route, _KEYS.key == key]


class KeptAnswers:
    """Kept answers of all tenants, each visible to its own tenant; answers are deleted with their plan."""

    def __init__(self, database: Database, quota: StorageQuota) -> None:
        self._database, self._quota = database, quota

    def add(self, tenant: str, plan_id: str, content_of: Callable[[str], str], *, limit: int) -> str | None:
        """Keep an answer, and delete the tenant's oldest ones beyond `limit`.

        `content_of` returns the text for the answer's id, which it contains.

        Returns:
            The answer's id; None if the plan was deleted meanwhile.
        """
        answer_id, now = uuid.uuid4().hex, datetime.now(UTC)
        own = _ANSWERS.tenant == tenant
        content = content_of(answer_id)
        size = ROW_BYTES + len(content.encode())
        with self._database.writing(grows_by=size) as connection:
            # Locked until the answer is stored, so that deleting the plan deletes the answer too.
            plan = select(FLOORPLANS.c.id).where(FLOORPLANS.c.id == plan_id, FLOORPLANS.c.tenant == tenant)
            if connection.scalar(plan.with_for_update(read=True)) is None:
                return None
            values = {"id": answer_id, "tenant": tenant, "plan_id": plan_id, "created_at": now, "stored_bytes": size}
            connection.execute(KEPT_ANSWERS.insert(), values | {"content": content})
            newest = select(_ANSWERS.id).where(own).order_by(_ANSWERS.created_at.desc(), _ANSWERS.id)
            surplus = newest.offset(limit).limit(limit)
            freed = deleted_bytes(connection, delete(KEPT_ANSWERS).where(_ANSWERS.id.in_(surplus)))
            self._quota.settle(connection, tenant, StoredBytes(answers=size - freed))
        return answer_id

    def get(self, tenant: str, answer_id: str, *, kept_s: float) -> str | None:
        """Return the text of an answer that is no older than `kept_s` (s); None without one."""
        oldest = datetime.now(UTC) - timedelta(seconds=kept_s)
        wanted = (_ANSWERS.tenant == tenant, _ANSWERS.id == answer_id, _ANSWERS.created_at >= oldest)
        return self._database.value(select(_ANSWERS.content).where(*wanted))

    def delete(self, tenant: str, answer_id: str) -> bool:
        """Delete an answer; False without one."""
        own = and_(_ANSWERS.tenant == tenant, _ANSWERS.id == answer_id)
        return self._quota.purge("answers", KEPT_ANSWERS, own) > 0

    def purge(self, *, kept_s: float) -> int:
        """Delete answers older than `kept_s` (s), and return their number."""
        expired = _ANSWERS.created_at < datetime.now(UTC) - timedelta(seconds=kept_s)
        return self._quota.purge("answers", KEPT_ANSWERS, expired)
