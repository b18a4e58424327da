"""Venues that are stored together with their plans: all of them, or nothing."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from lalaloc_core.floorplan import FloorPlan
from service.errors import TooManyFloorPlansError
from service.storage.database import Database
from service.storage.plan_cache import PlanCache
from service.storage.plan_rows import PlanContent, count_plans, insert_plan, new_record
from service.storage.records import ComputedGrid, Original, PlanRecord, VenueMember, VenueRecord
from service.storage.stored_bytes import ROW_BYTES, StorageQuota, StoredBytes
from service.storage.venue_rows import check_count, find_venue, insert_members, insert_venue
from service.stored_plan import PlanDocument


@dataclass(frozen=True, kw_only=True)
class NewPlan:
    """Plan that is stored with its venue.

    Attributes:
        plan: the plan.
        level: its level in the venue.
        original: the uploaded file.
        document: its stored form, if it is made already.
        grid: its own grid, if it is computed already.
        later_bytes: expected size of its own grid if that is computed later.
    """

    plan: FloorPlan
    level: float
    original: Original
    document: PlanDocument | None = None
    grid: ComputedGrid | None = None
    later_bytes: int = 0


class VenueImports:
    """Venues of all tenants with their plans."""

    def __init__(self, database: Database, cache: PlanCache, quota: StorageQuota) -> None:
        """Use a database.

        Args:
            database: the database.
            cache: receives every plan that is stored.
            quota: counts the stored bytes.
        """
        self._database = database
        self._cache = cache
        self._quota = quota

    def add(
        self, tenant: str, venue_id: str, name: str, plans: Sequence[NewPlan], *, max_plans: int, max_venues: int
    ) -> tuple[VenueRecord, list[PlanRecord]]:
        """Store plans and their venue in one transaction.

        If the id of the venue exists already, its first request was stored and the answer was lost.

        Args:
            tenant: owner of the venue.
            venue_id: id of the venue.
            name: name of the venue.
            plans: its plans.
            max_plans: limit of the tenant's plans.
            max_venues: limit of the tenant's venues.

        Returns:
            The venue, and the records of its plans in order; none if an earlier request stored them.

        Raises:
            TooManyFloorPlansError, TooManyVenuesError: the tenant would have too many plans or venues.
            StorageQuotaError: the tenant would store too many bytes.
        """
        now = datetime.now(UTC)
        records = [
            new_record(
                new.plan,
                new.original,
                plan_id=uuid.uuid4().hex,
                tenant=tenant,
                number=1,
                created_at=now,
                updated_at=now,
            )
            for new in plans
        ]
        contents = [
            PlanContent.prepare(record, new.original, new.document, new.grid)
            for record, new in zip(records, plans, strict=True)
        ]
        size = StoredBytes(
            plans=sum(content.stored.plans for content in contents),
            grids=sum(content.stored.grids for content in contents),
            venues=ROW_BYTES * (1 + len(plans)),
        )
        later_bytes = sum(new.later_bytes for new in plans)
        with self._database.writing(grows_by=size.total) as connection:
            is_new = find_venue(connection, tenant, venue_id) is None
            if is_new:
                if count_plans(connection, tenant) + len(plans) > max_plans:
                    raise TooManyFloorPlansError(max_plans)
                self._quota.check(connection, tenant, size.total + later_bytes)
                # The venue comes first, so that of two attempts of the same request only one stores plans.
                is_new = insert_venue(connection, self._database, tenant, venue_id, name, None)
            if is_new:
                for record, content in zip(records, contents, strict=True):
                    insert_plan(connection, self._database, record, content)
                levels = zip(records, plans, strict=True)
                insert_members(connection, venue_id, [VenueMember(record.id, new.level) for record, new in levels])
                self._quota.settle(connection, tenant, size)
                # Exact now, because settling locks the tenant.
                if count_plans(connection, tenant) > max_plans:
                    raise TooManyFloorPlansError(max_plans)
                check_count(connection, tenant, max_venues)
            stored = find_venue(connection, tenant, venue_id)
        assert stored is not None
        if not is_new:
            return stored, []
        for record in records:
            self._cache.put(record)
        return stored, records
