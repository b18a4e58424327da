"""Venues that are stored or extended together with new plans: all of them, or nothing."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from sqlalchemy import Connection, select

from service.errors import TooManyFloorPlansError, UnknownVenueError
from service.storage.database import Database
from service.storage.plan_rows import PlanCache, PlanContent, insert_plans, new_record
from service.storage.records import NewPlan, PlanRecord, VenueMember, VenueRecord
from service.storage.statements import count_rows
from service.storage.stored_bytes import ROW_BYTES, StorageQuota, StoredBytes
from service.storage.tables import FLOORPLANS
from service.storage.venue_rows import (
    check_count,
    check_members,
    find_venue,
    insert_members,
    insert_venue,
    lock_venue,
    touch_venue,
)


class VenueImports:
    """Venues of all tenants with their plans."""

    def __init__(self, database: Database, cache: PlanCache, quota: StorageQuota) -> None:
        # The cache receives the plans, as far as it has room for unread ones.
        self._database, self._cache, self._quota = database, cache, quota

    def add(
        self, tenant: str, venue_id: str, name: str, plans: Sequence[NewPlan], *, max_plans: int, max_venues: int
    ) -> tuple[VenueRecord, list[PlanRecord]]:
        """Store plans and their venue in one transaction.

        If the id of the venue exists already, its first request was stored and the answer was lost.

        Returns:
            The venue, and the records of its plans in order; none if an earlier request stored them.
        """
        batch = _Batch.of(tenant, venue_id, plans)
        size = replace(batch.size, venues=ROW_BYTES * (1 + len(plans)))
        with self._database.writing(grows_by=size.total) as connection:
            is_new = find_venue(connection, tenant, venue_id) is None
            if is_new:
                self._check(connection, batch, size, max_plans)
                # The venue comes first, so that of two attempts of the same request only one stores plans.
                is_new = insert_venue(connection, self._database, tenant, venue_id, name, None)
            if is_new:
                insert_plans(connection, batch.records, batch.contents)
                insert_members(connection, venue_id, batch.members)
                self._settle(connection, tenant, size, max_plans)
                check_count(connection, tenant, max_venues)
            stored = find_venue(connection, tenant, venue_id)
        assert stored is not None
        return stored, self._cached(batch.records if is_new else [])

    def extend(
        self,
        tenant: str,
        venue_id: str,
        token: str,
        plans: Sequence[NewPlan],
        *,
        max_plans: int,
        max_venue_plans: int,
        expected: str | None = None,
    ) -> tuple[VenueRecord, list[PlanRecord]]:
        """Store plans and add them to a venue in one transaction.

        `token` has 32 hexadecimal digits, the same for every attempt of the request; plans of an earlier attempt, whose
        answer was lost, are not stored again. The limits are of the tenant's and of the venue's plans. The venue must
        have the revision `expected`, if there is one.

        Returns:
            The venue, and the records of the plans in order; none if an earlier attempt stored them.
        """
        batch = _Batch.of(tenant, token, plans)
        size = replace(batch.size, venues=ROW_BYTES * len(plans))
        with self._database.writing(grows_by=size.total) as connection:
            is_new = not batch.is_stored(connection)
            if is_new:
                # Waits for an attempt that runs beside.
                lock_venue(connection, tenant, venue_id, expected)
                is_new = not batch.is_stored(connection)
                if is_new:
                    self._check(connection, batch, size, max_plans)
                    insert_plans(connection, batch.records, batch.contents)
                    insert_members(connection, venue_id, batch.members)
                    check_members(connection, venue_id, max_venue_plans)
                    touch_venue(connection, venue_id, batch.now)
                    self._settle(connection, tenant, size, max_plans)
            stored = find_venue(connection, tenant, venue_id)
        if stored is None:
            raise UnknownVenueError(venue_id)
        return stored, self._cached(batch.records if is_new else [])

    def _check(self, connection: Connection, batch: _Batch, size: StoredBytes, max_plans: int) -> None:
        if count_rows(connection, FLOORPLANS, FLOORPLANS.c.tenant == batch.tenant) + len(batch.records) > max_plans:
            raise TooManyFloorPlansError(max_plans)
        self._quota.check(connection, batch.tenant, size.total + batch.later_bytes)

    def _settle(self, connection: Connection, tenant: str, size: StoredBytes, max_plans: int) -> None:
        self._quota.settle(connection, tenant, size)
        # Exact now, because settling locks the tenant.
        if count_rows(connection, FLOORPLANS, FLOORPLANS.c.tenant == tenant) > max_plans:
            raise TooManyFloorPlansError(max_plans)

    def _cached(self, records: list[PlanRecord]) -> list[PlanRecord]:
        for record in records:
            self._cache.put_unread(record)
        return records


@dataclass(frozen=True, eq=False)
class _Batch:
    """Plans of one request, prepared before the transaction."""

    tenant: str
    now: datetime
    records: list[PlanRecord]
    contents: list[PlanContent]
    members: list[VenueMember]
    later_bytes: int

    @classmethod
    def of(cls, tenant: str, token: str, plans: Sequence[NewPlan]) -> _Batch:
        """Prepare plans, whose ids are the same for every attempt of a request."""
        now = datetime.now(UTC)
        ids = [hashlib.sha256(f"{token} {number}".encode()).hexdigest()[:32] for number in range(len(plans))]
        records = [new_record(new, plan_id, tenant, now) for new, plan_id in zip(plans, ids, strict=True)]
        contents = [PlanContent.prepare(record.revision_id, new) for record, new in zip(records, plans, strict=True)]
        members = [VenueMember(record.id, new.level) for record, new in zip(records, plans, strict=True)]
        return cls(tenant, now, records, contents, members, sum(new.later_bytes for new in plans))

    @property
    def size(self) -> StoredBytes:
        stored = [content.stored for content in self.contents]
        return StoredBytes(plans=sum(size.plans for size in stored), grids=sum(size.grids for size in stored))

    def is_stored(self, connection: Connection) -> bool:
        """Return whether an earlier attempt stored the plans, of which some can be deleted by now."""
        ids = [record.id for record in self.records]
        return connection.scalar(select(FLOORPLANS.c.id).where(FLOORPLANS.c.id.in_(ids)).limit(1)) is not None
