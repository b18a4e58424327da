"""Answers that are kept for a while, so that a link opens them again; the photographs are never stored."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

from sqlalchemy import and_, delete, select

from service.storage.database import Database
from service.storage.stored_bytes import ROW_BYTES, StorageQuota, StoredBytes, deleted_bytes
from service.storage.tables import FLOORPLANS, KEPT_ANSWERS

_COLUMNS = KEPT_ANSWERS.c


class KeptAnswers:
    """Kept answers of all tenants, each visible to its own tenant; answers are deleted with their plan."""

    def __init__(self, database: Database, quota: StorageQuota) -> None:
        self._database = database
        self._quota = quota

    def add(self, tenant: str, plan_id: str, content_of: Callable[[str], str], *, limit: int) -> str | None:
        """Keep an answer, and delete the tenant's oldest ones beyond `limit`.

        Args:
            tenant: owner of the answer.
            plan_id: plan of the answer.
            content_of: function from the answer's id to its text, which contains the id.
            limit: maximum number of answers of the tenant.

        Returns:
            The answer's id; None if the plan was deleted meanwhile.

        Raises:
            StorageQuotaError: the tenant would store too many bytes.
        """
        answer_id, now = uuid.uuid4().hex, datetime.now(UTC)
        own = _COLUMNS.tenant == tenant
        content = content_of(answer_id)
        size = ROW_BYTES + len(content.encode())
        with self._database.writing(grows_by=size) as connection:
            # Locked until the answer is stored, so that deleting the plan deletes the answer too.
            plan = select(FLOORPLANS.c.id).where(FLOORPLANS.c.id == plan_id, FLOORPLANS.c.tenant == tenant)
            if connection.scalar(plan.with_for_update(read=True)) is None:
                return None
            values = {"id": answer_id, "tenant": tenant, "plan_id": plan_id, "created_at": now, "stored_bytes": size}
            connection.execute(KEPT_ANSWERS.insert(), values | {"content": content})
            newest = select(_COLUMNS.id).where(own).order_by(_COLUMNS.created_at.desc(), _COLUMNS.id)
            surplus = connection.scalars(newest.offset(limit).limit(limit)).all()
            freed = 0
            if surplus:
                freed = deleted_bytes(connection, delete(KEPT_ANSWERS).where(_COLUMNS.id.in_(surplus)))
            self._quota.settle(connection, tenant, StoredBytes(answers=size - freed))
        return answer_id

    def get(self, tenant: str, answer_id: str, *, kept_s: float) -> str | None:
        """Return the text of an answer that is no older than `kept_s` (s); None without one."""
        oldest = datetime.now(UTC) - timedelta(seconds=kept_s)
        wanted = (_COLUMNS.tenant == tenant, _COLUMNS.id == answer_id, _COLUMNS.created_at >= oldest)
        with self._database.reading() as connection:
            return connection.scalar(select(_COLUMNS.content).where(*wanted))

    def delete(self, tenant: str, answer_id: str) -> bool:
        """Delete an answer; False without one."""
        own = and_(_COLUMNS.tenant == tenant, _COLUMNS.id == answer_id)
        return self._quota.purge("answers", KEPT_ANSWERS, own) > 0

    def purge(self, *, kept_s: float) -> int:
        """Delete answers older than `kept_s` (s), and return their number."""
        expired = _COLUMNS.created_at < datetime.now(UTC) - timedelta(seconds=kept_s)
        return self._quota.purge("answers", KEPT_ANSWERS, expired)
