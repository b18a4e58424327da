"""Venues: sets of floor plans with their levels. Every call names the tenant, except where noted.

The revision of a venue changes with its name, its anchor and its plans, also when one of its plans is deleted. It does
not change when a plan of it gets a new revision.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

from cachetools import LRUCache
from sqlalchemy import Connection, Row, and_, case, delete, distinct, func, or_, select, update

from lalaloc_core.floorplan.earth import Anchor
from service.errors import InvalidRequestError, UnknownVenueError
from service.storage.album_rows import delete_albums
from service.storage.database import Database
from service.storage.records import Cursor, VenueCounts, VenueMember, VenuePlace, VenueRecord, VenueState
from service.storage.statements import count_rows, is_own_grid, newest_first
from service.storage.stored_bytes import ROW_BYTES, StorageQuota, StoredBytes, deleted_bytes
from service.storage.tables import ALBUMS, FLOORPLANS, LATENT_GRIDS, REVISIONS, SESSIONS, TENANTS, VENUE_PLANS, VENUES
from service.storage.venue_rows import (
    check_count,
    check_members,
    find_venue,
    insert_members,
    insert_venue,
    lock_venue,
    revision_values,
    select_venues,
    venue_record,
)

# Ids per statement.
_BATCH_SIZE = 1000
# Venues whose plans are not counted anew for every reader.
_COUNTED = 1000
# Ids listed in an error message.
_NAMED = 5
# Columns of a plan that a query needs, besides level and name.
_SEARCH_COLUMNS = (
    FLOORPLANS.c.id.label("plan_id"), FLOORPLANS.c.revision_id, FLOORPLANS.c.centre_x_m, FLOORPLANS.c.centre_y_m,
    FLOORPLANS.c.reach_m, FLOORPLANS.c.latitude, FLOORPLANS.c.longitude, REVISIONS.c.area_m2,
    REVISIONS.c.camera_height_m, REVISIONS.c.camera_height_std_m, REVISIONS.c.failure,
    LATENT_GRIDS.c.id.label("grid_id"), LATENT_GRIDS.c.sha256.label("grid_sha256"), LATENT_GRIDS.c.poses,
)  # fmt: skip


class Venues:
    """Venues of all tenants; a venue of another tenant counts as missing."""

    def __init__(self, database: Database, quota: StorageQuota) -> None:
        self._database, self._quota = database, quota
        self._counts: LRUCache[tuple[str, str, float], tuple[VenueState, VenueCounts]] = LRUCache(_COUNTED)
        self._lock = threading.Lock()

    def add(
        self,
        tenant: str,
        venue_id: str,
        name: str,
        anchor: Anchor | None,
        members: Sequence[VenueMember],
        *,
        limit: int,
    ) -> VenueRecord:
        """Store a venue; if the id exists already, its first request was stored and the answer was lost."""
        size = ROW_BYTES * (1 + len(members))
        with self._database.writing(grows_by=size) as connection:
            if (stored := find_venue(connection, tenant, venue_id)) is None:
                _check_plans(connection, tenant, [member.plan_id for member in members])
                if insert_venue(connection, self._database, tenant, venue_id, name, anchor):
                    insert_members(connection, venue_id, members)
                    self._quota.settle(connection, tenant, StoredBytes(venues=size))
                    check_count(connection, tenant, limit)
                stored = find_venue(connection, tenant, venue_id)
        assert stored is not None
        return stored

    def change(
        self,
        tenant: str,
        venue_id: str,
        *,
        name: str | None = None,
        anchor: Anchor | None = None,
        drop_anchor: bool = False,
        members: Sequence[VenueMember] = (),
        removed: Collection[str] = (),
        replace_members: bool = False,
        max_plans: int,
        expected: str | None = None,
    ) -> VenueRecord:
        """Store a new revision of a venue, which must have the revision `expected` before, if there is one.

        A name or anchor of None keeps the old one, unless the anchor is dropped. `members` are added, change level or
        name, or replace all plans.
        """
        now = datetime.now(UTC)
        with self._database.writing(grows_by=ROW_BYTES * len(members)) as connection:
            # Plans are locked before venues, as in the deletion of a plan, to avoid a deadlock.
            _check_plans(connection, tenant, [member.plan_id for member in members])
            row = lock_venue(connection, tenant, venue_id, expected)
            before = count_rows(connection, VENUE_PLANS, VENUE_PLANS.c.venue_id == venue_id)
            if replace_members:
                connection.execute(delete(VENUE_PLANS).where(VENUE_PLANS.c.venue_id == venue_id))
            _remove(connection, venue_id, removed)
            _remove(connection, venue_id, [member.plan_id for member in members], strict=False)
            insert_members(connection, venue_id, members)
            count = check_members(connection, venue_id, max_plans)
            kept = None if drop_anchor else venue_record(row).anchor if anchor is None else anchor
            values = revision_values(row.name if name is None else name, kept, now) | {"number": row.number + 1}
            connection.execute(update(VENUES).where(VENUES.c.id == venue_id).values(**values))
            found = find_venue(connection, tenant, venue_id)
            self._quota.settle(connection, tenant, StoredBytes(venues=ROW_BYTES * (count - before)))
        assert found is not None
        return found

    def get(self, tenant: str, venue_id: str) -> VenueRecord | None:
        """Return a venue."""
        with self._database.reading() as connection:
            return find_venue(connection, tenant, venue_id)

    def list_venues(
        self, tenant: str, *, limit: int, after: Cursor | None = None, name: str | None = None
    ) -> list[VenueRecord]:
        """Return venues, newest first; `name` is a part of the name, case-insensitive."""
        page = newest_first(select_venues(VENUES.c.tenant == tenant), VENUES, limit=limit, after=after, name=name)
        return [venue_record(row) for row in self._database.rows(page)]

    def plans(
        self, venue_id: str, *, limit: int, after: VenuePlace | None = None, level: float | None = None
    ) -> list[VenueMember]:
        """Return the plans of a venue by level, regardless of tenant. Callers check access first.

        `after` is the last plan of the previous page.
        """
        own_level, plan_id = VENUE_PLANS.c.level, VENUE_PLANS.c.plan_id
        query = select(plan_id, own_level, VENUE_PLANS.c.name).where(VENUE_PLANS.c.venue_id == venue_id)
        if level is not None:
            query = query.where(own_level == level)
        if after is not None:
            query = query.where(or_(own_level > after.level, and_(own_level == after.level, plan_id > after.plan_id)))
        rows = self._database.rows(query.order_by(own_level, plan_id).limit(limit))
        return [VenueMember(**row._mapping) for row in rows]

    def counts(self, venue_id: str, model_sha256: str, step_m: float) -> VenueCounts:
        """Return the numbers of a venue's plans, for a model and a grid step; they are counted once per state."""
        # State before counts: a change in between makes the next call count again.
        state, key = self.state(venue_id), (venue_id, model_sha256, step_m)
        with self._lock:
            counted = self._counts.get(key)
        if counted is None or counted[0] != state:
            counted = state, self._count(venue_id, model_sha256, step_m)
            with self._lock:
                self._counts[key] = counted
        return counted[1]

    def _count(self, venue_id: str, model_sha256: str, step_m: float) -> VenueCounts:
        plan, grid, failure = VENUE_PLANS.c.plan_id, LATENT_GRIDS.c.id, REVISIONS.c.failure
        ready = case((grid.is_not(None), plan))
        failed = case((and_(grid.is_(None), failure.is_not(None)), plan))
        counts = select(*(func.count(distinct(counted)) for counted in (plan, ready, failed)))
        query = _in_venue(counts, venue_id, model_sha256, step_m)
        with self._database.reading() as connection:
            return VenueCounts(*connection.execute(query).one())

    def state(self, venue_id: str) -> VenueState:
        """Return the state of a venue, from two rows."""
        counted = (TENANTS.c.plans_bytes, TENANTS.c.grids_bytes, TENANTS.c.venues_bytes)
        numbers = (func.coalesce(number, 0) for number in (TENANTS.c.changes, sum(counted) - TENANTS.c.counted_bytes))
        tenants = VENUES.outerjoin(TENANTS, TENANTS.c.tenant == VENUES.c.tenant)
        query = select(VENUES.c.revision_id, *numbers).select_from(tenants)
        row = self._database.row(query.where(VENUES.c.id == venue_id))
        return VenueState(None, 0, 0) if row is None else VenueState(*row)

    def members(self, venue_id: str) -> Sequence[Any]:
        """Return `level`, `plan_id` and `name`, None for the plan's own one, of every plan of a venue."""
        columns = VENUE_PLANS.c
        query = select(columns.level, columns.plan_id, columns.name).where(columns.venue_id == venue_id)
        return self._database.rows(query)

    def changed_plans(self, tenant: str, after: int) -> Sequence[str]:
        """Return the ids of a tenant's plans that changed after the change with a number, see `VenueState`."""
        query = select(FLOORPLANS.c.id).where(FLOORPLANS.c.tenant == tenant, FLOORPLANS.c.changed > after)
        with self._database.reading() as connection:
            return connection.scalars(query).all()

    def searchable_plans(
        self, venue_id: str, model_sha256: str, step_m: float, plan_ids: Sequence[str] | None = None
    ) -> list[Row[Any]]:
        """Return a row for every plan of a venue, regardless of tenant. Callers check access first.

        With `plan_ids`, only those of them that are in the venue.

        Returns:
            Rows of `plan_id`, `revision_id`, `level`, `name`, `name_in_venue`, `camera_height_m`,
            `camera_height_std_m`, `failure`, `area_m2`, the columns of `plan_places`, and `grid_id`, `grid_sha256` and
            `poses` of the plan's own grid, None without it; by level and id.
        """
        name_in_venue = VENUE_PLANS.c.name.label("name_in_venue")
        name = func.coalesce(VENUE_PLANS.c.name, FLOORPLANS.c.name).label("name")
        columns = (VENUE_PLANS.c.level, name, name_in_venue, *_SEARCH_COLUMNS)
        query = _in_venue(select(*columns), venue_id, model_sha256, step_m)
        query = query.order_by(VENUE_PLANS.c.level, VENUE_PLANS.c.plan_id)
        parts = [query] if plan_ids is None else [query.where(VENUE_PLANS.c.plan_id.in_(p)) for p in _parts(plan_ids)]
        with self._database.reading() as connection:
            return [row for part in parts for row in connection.execute(part)]

    def delete(self, tenant: str, venue_id: str, *, expected: str | None = None) -> bool:
        """Delete a venue with its sessions and albums, but none of its plans; False without one."""

        def work(connection: Connection) -> bool:
            try:
                lock_venue(connection, tenant, venue_id, expected)
            except UnknownVenueError:
                return False
            rows = 1 + count_rows(connection, VENUE_PLANS, VENUE_PLANS.c.venue_id == venue_id)
            sessions = deleted_bytes(connection, delete(SESSIONS).where(SESSIONS.c.venue_id == venue_id))
            albums = delete_albums(connection, ALBUMS.c.venue_id == venue_id)
            connection.execute(delete(VENUES).where(VENUES.c.id == venue_id))
            freed = StoredBytes(venues=ROW_BYTES * rows, sessions=sessions, albums=albums)
            self._quota.settle(connection, tenant, StoredBytes() - freed)
            return True

        return self._database.freeing(work)


def _check_plans(connection: Connection, tenant: str, plan_ids: Sequence[str]) -> None:
    """Lock the plans of a tenant against deletion until the transaction ends."""
    found: set[str] = set()
    own = FLOORPLANS.c.tenant == tenant
    for part in _parts(sorted(plan_ids)):
        query = select(FLOORPLANS.c.id).where(own, FLOORPLANS.c.id.in_(part)).order_by(FLOORPLANS.c.id)
        found |= set(connection.scalars(query.with_for_update(read=True, key_share=True)))
    if missing := [plan_id for plan_id in plan_ids if plan_id not in found]:
        raise InvalidRequestError([("plans", f"floor plan {_named(missing)} does not exist")])


def _remove(connection: Connection, venue_id: str, plan_ids: Collection[str], *, strict: bool = True) -> None:
    own, left = VENUE_PLANS.c.venue_id == venue_id, set(plan_ids)
    for part in _parts(sorted(plan_ids)):
        statement = delete(VENUE_PLANS).where(own, VENUE_PLANS.c.plan_id.in_(part))
        left -= set(connection.scalars(statement.returning(VENUE_PLANS.c.plan_id)))
    if left and strict:
        raise InvalidRequestError([("remove", f"the venue does not have floor plan {_named(sorted(left))}")])


def _in_venue(query: Any, venue_id: str, model_sha256: str, step_m: float) -> Any:
    """Return a query about the plans of a venue, joined with their current revision and, if stored, their own grid."""
    plans = VENUE_PLANS.join(FLOORPLANS, FLOORPLANS.c.id == VENUE_PLANS.c.plan_id)
    joined = plans.join(REVISIONS, REVISIONS.c.id == FLOORPLANS.c.revision_id)
    joined = joined.outerjoin(LATENT_GRIDS, is_own_grid(model_sha256, step_m))
    return query.select_from(joined).where(VENUE_PLANS.c.venue_id == venue_id)


def _named(ids: Sequence[str]) -> str:
    more = f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else ""
    return ", ".join(f"'{plan_id[:64]}'" for plan_id in ids[:_NAMED]) + more


def _parts(ids: Sequence[str]) -> Iterable[Sequence[str]]:
    return (ids[first : first + _BATCH_SIZE] for first in range(0, len(ids), _BATCH_SIZE))
