"""Sessions of tracked cameras: their state between two photographs.

A photograph claims its session while it is computed, so that two at once cannot both move the camera. The claim of a
process that died ends with its lease; the state is then that before the photograph.
"""

from __future__ import annotations

import uuid
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sqlalchemy import Connection, Row, and_, delete, select, update

from service import errors
from service.storage.database import Database
from service.storage.records import PlanRecord, VenueRecord
from service.storage.statements import count_rows, lock_place
from service.storage.stored_bytes import ROW_BYTES, StorageQuota, StoredBytes, deleted_bytes
from service.storage.tables import SESSIONS

_COLUMNS = SESSIONS.c


@dataclass(frozen=True, kw_only=True)
class SessionRecord:
    """Stored session.

    Attributes:
        plan_id, venue_id: id of its plan, or of its venue; the other one is None.
        revision_id: revision of the plan or venue when it began.
        options: the request that began it, as JSON.
        photographs: number of photographs so far.
        state, pose: state of the filter, and last pose as JSON; None before the first photograph.
        claim: token of the claim, for `finish` and `release`; without one, token of the request that was answered last.
    """

    id: str
    tenant: str
    plan_id: str | None
    venue_id: str | None
    revision_id: str
    expires_at: datetime
    options: str
    photographs: int
    state: bytes | None
    pose: str | None
    claim: str


class Sessions:
    """Sessions of all tenants, each visible to its own tenant."""

    def __init__(self, database: Database, quota: StorageQuota, claim_s: float) -> None:
        self._database, self._quota = database, quota
        # Time limit (s) of a photograph, after which another one can be sent.
        self._claim_s = claim_s

    def add(
        self, tenant: str, session_id: str, place: PlanRecord | VenueRecord, options: str, *, ttl_s: float, limit: int
    ) -> SessionRecord:
        """Store a session in a plan or venue; return the one that exists under this id, if the request is repeated."""
        now, own = datetime.now(UTC), _COLUMNS.tenant == tenant
        size = ROW_BYTES + len(options.encode())
        values = {
            "id": session_id,
            "tenant": tenant,
            "plan_id": place.id if isinstance(place, PlanRecord) else None,
            "venue_id": place.id if isinstance(place, VenueRecord) else None,
            "revision_id": place.revision_id,
            "created_at": now,
            "expires_at": now + timedelta(seconds=ttl_s),
            "options": options,
            "photographs": 0,
            "claim": "",
            "claimed_until_s": 0.0,
            "stored_bytes": size,
        }
        with self._database.writing(grows_by=size) as connection:
            lock_place(connection, tenant, values["plan_id"], values["venue_id"])
            row = connection.execute(select(SESSIONS).where(own, _COLUMNS.id == session_id)).one_or_none()
            if row is not None:
                return _record(row)
            freed = deleted_bytes(connection, delete(SESSIONS).where(own, _COLUMNS.expires_at < now))
            if count_rows(connection, SESSIONS, own) >= limit:
                raise errors.TooManySessionsError(limit)
            row = connection.execute(SESSIONS.insert().values(values).returning(SESSIONS)).one()
            self._quota.settle(connection, tenant, StoredBytes(sessions=size - freed))
        return _record(row)

    def get(self, tenant: str, session_id: str) -> SessionRecord:
        """Return a session."""
        with self._database.reading() as connection:
            return _record(self._find(connection, tenant, session_id))

    def claim(self, tenant: str, session_id: str, number: int | None, token: str) -> SessionRecord:
        """Claim a session for its next photograph; the caller then calls `finish` or `release`.

        `number` is that of the photograph, from 1; None for the next one. `token` is the same for all attempts.

        Returns:
            The session; with `token` as its claim if the request was the last one to be answered, and nothing is to do.
        """
        free = ~self._database.is_live(_COLUMNS.claimed_until_s, _COLUMNS.claim_s)
        own = _COLUMNS.tenant == tenant, _COLUMNS.id == session_id, _COLUMNS.expires_at >= datetime.now(UTC)
        values = {
            "claim": uuid.uuid4().hex,
            "claimed_until_s": self._database.now_s() + self._claim_s,
            "claim_s": self._claim_s,
        }
        answered = select(SESSIONS).where(*own, free, _COLUMNS.claim == token).with_for_update()
        with self._database.writing() as connection:
            if (row := connection.execute(answered).one_or_none()) is not None:
                return _record(row)
            taken = connection.execute(update(SESSIONS).where(*own, free).values(**values).returning(SESSIONS))
            row = taken.one_or_none()
            if row is None:
                self._find(connection, tenant, session_id)
                raise errors.SessionBusyError(session_id)
            if number is not None and number != row.photographs + 1:
                # Rolls the claim back.
                raise errors.PhotographOutOfOrderError(session_id, number, row.photographs + 1)
            return _record(row)

    def finish(self, record: SessionRecord, token: str, state: bytes, pose: str, *, ttl_s: float) -> SessionRecord:
        """Store the state after the photograph of the request with a token, and end the claim."""
        size = ROW_BYTES + len(record.options.encode()) + len(state) + len(pose.encode())
        own = _COLUMNS.tenant == record.tenant, _COLUMNS.id == record.id
        with self._database.writing(grows_by=size) as connection:
            row = connection.execute(select(SESSIONS).where(*own).with_for_update()).one_or_none()
            if row is None:
                raise errors.UnknownSessionError(record.id)
            if row.claim != record.claim:
                raise errors.SessionOutdatedError(
                    record.id, "the photograph took too long, and another one was answered"
                )
            values = {
                "state": state,
                "pose": pose,
                "photographs": record.photographs + 1,
                "expires_at": datetime.now(UTC) + timedelta(seconds=ttl_s),
                "claim": token,
                "claimed_until_s": 0.0,
                "stored_bytes": size,
            }
            after = connection.execute(update(SESSIONS).where(*own).values(**values).returning(SESSIONS)).one()
            self._quota.settle(connection, record.tenant, StoredBytes(sessions=size - row.stored_bytes))
        return _record(after)

    def release(self, record: SessionRecord) -> None:
        """End the claim of a photograph that failed; the state stays as it was."""
        own = _COLUMNS.id == record.id, _COLUMNS.claim == record.claim
        with self._database.writing() as connection:
            connection.execute(update(SESSIONS).where(*own).values(claim="", claimed_until_s=0.0))

    def delete(self, tenant: str, session_id: str) -> bool:
        """Delete a session; False without one."""
        own = and_(_COLUMNS.tenant == tenant, _COLUMNS.id == session_id)
        return self._quota.purge("sessions", SESSIONS, own) > 0

    def purge(self) -> int:
        """Delete expired sessions, and return their number."""
        return self._quota.purge("sessions", SESSIONS, _COLUMNS.expires_at < datetime.now(UTC))

    def _find(self, connection: Connection, tenant: str, session_id: str) -> Row[tuple[object, ...]]:
        wanted = _COLUMNS.tenant == tenant, _COLUMNS.id == session_id, _COLUMNS.expires_at >= datetime.now(UTC)
        row = connection.execute(select(SESSIONS).where(*wanted)).one_or_none()
        if row is None:
            raise errors.UnknownSessionError(session_id)
        return row


def _record(row: Row[tuple[object, ...]]) -> SessionRecord:
    values = row._mapping
    return SessionRecord(**{name: values[name] for name in SessionRecord.__dataclass_fields__})
