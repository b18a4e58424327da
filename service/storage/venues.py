"""Venues: which floor plans belong together, on which levels; every call says whose venues it is about.

A venue has one revision at a time, which changes with its name, its anchor and its plans, also where a plan leaves it
by being deleted. Plans that get new revisions stay in it as they are.
"""

from __future__ import annotations

import uuid
from collections.abc import Collection, Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import (
    Connection,
    FromClause,
    Row,
    and_,
    case,
    delete,
    distinct,
    func,
    literal,
    or_,
    select,
    text,
    update,
)

from lalaloc_core.floorplan.earth import Anchor
from service.errors import InvalidRequestError, RevisionMismatchError, TooManyVenuesError, UnknownVenueError
from service.storage.database import Database
from service.storage.plan_places import lies_in_box
from service.storage.records import (
    Cursor,
    VenueCounts,
    VenueMember,
    VenuePlace,
    VenueRecord,
    VenueState,
)
from service.storage.statements import is_own_grid, newest_first
from service.storage.tables import FLOORPLANS, LATENT_GRIDS, REVISIONS, VENUE_PLANS, VENUES

# Whoever makes venues takes turns on PostgreSQL, so that their number is exact; differs from the other locks.
_COUNT_LOCK = 5_210_003
# Ids in one statement.
_BATCH_SIZE = 1000
# Ids in one refusal.
_NAMED = 5
# What a query needs to know of a plan, but for its level and its name.
_SEARCH_COLUMNS = (
    FLOORPLANS.c.id.label("plan_id"),
    FLOORPLANS.c.revision_id,
    FLOORPLANS.c.centre_x_m,
    FLOORPLANS.c.centre_y_m,
    FLOORPLANS.c.reach_m,
    FLOORPLANS.c.latitude,
    FLOORPLANS.c.longitude,
    REVISIONS.c.area_m2,
    REVISIONS.c.camera_height_m,
    REVISIONS.c.camera_height_std_m,
    REVISIONS.c.failure,
    LATENT_GRIDS.c.id.label("grid_id"),
    LATENT_GRIDS.c.sha256.label("grid_sha256"),
    LATENT_GRIDS.c.poses,
)


class Venues:
    """Venues of all tenants; another tenant's venue is one that does not exist."""

    def __init__(self, database: Database) -> None:
        self._database = database

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
        """Store a venue; one that has the id already is the one, whose answer got lost.

        Args:
            limit: most venues that the tenant may have.

        Raises:
            TooManyVenuesError: there are `limit` already.
            InvalidRequestError: the tenant has not all of the plans.
        """
        now = datetime.now(UTC)
        with self._database.writing() as connection:
            if self._database.is_postgresql:
                connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _COUNT_LOCK})
            if (stored := _find(connection, tenant, venue_id)) is None:
                own = select(func.count()).select_from(VENUES).where(VENUES.c.tenant == tenant)
                if (connection.scalar(own) or 0) >= limit:
                    raise TooManyVenuesError(limit)
                _check_plans(connection, tenant, [member.plan_id for member in members])
                values = {"id": venue_id, "tenant": tenant, "number": 1, "created_at": now}
                connection.execute(VENUES.insert(), values | _head(name, anchor, now))
                _insert(connection, venue_id, members)
                stored = _find(connection, tenant, venue_id)
        assert stored is not None
        return _record(stored)

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
        """Give a venue another revision.

        Args:
            name, anchor: None leaves them as they are.
            drop_anchor: from now on it has none.
            members: plans that come in, or change their level or name.
            removed: ids of plans that leave it.
            replace_members: `members` are all that it has.
            max_plans: most plans that it may have.
            expected: id of the revision that it must have; None for any.

        Raises:
            UnknownVenueError: the tenant has no such venue.
            RevisionMismatchError: it has another revision.
            InvalidRequestError: the tenant has not all of `members`, `removed` are not all in it, or it has too many.
        """
        now = datetime.now(UTC)
        with self._database.writing() as connection:
            # Plans before their venues, as where a plan is deleted: otherwise the two could wait for each other.
            _check_plans(connection, tenant, [member.plan_id for member in members])
            row = _locked(connection, tenant, venue_id, expected)
            if replace_members:
                connection.execute(delete(VENUE_PLANS).where(VENUE_PLANS.c.venue_id == venue_id))
            _remove(connection, venue_id, removed)
            _remove(connection, venue_id, [member.plan_id for member in members], strict=False)
            _insert(connection, venue_id, members)
            count = _count(connection, venue_id)
            if count > max_plans:
                fault = f"the venue would have {count} plans, at most {max_plans} are allowed (max_venue_plans)"
                raise InvalidRequestError([("plans", fault)])
            kept = None if drop_anchor else _record(row).anchor if anchor is None else anchor
            values = _head(row.name if name is None else name, kept, now) | {"number": row.number + 1}
            connection.execute(update(VENUES).where(VENUES.c.id == venue_id).values(**values))
            found = _find(connection, tenant, venue_id)
        assert found is not None
        return _record(found)

    def get(self, tenant: str, venue_id: str) -> VenueRecord | None:
        """A venue."""
        with self._database.reading() as connection:
            row = _find(connection, tenant, venue_id)
        return None if row is None else _record(row)

    def list_venues(
        self, tenant: str, *, limit: int, after: Cursor | None = None, name: str | None = None
    ) -> list[VenueRecord]:
        """Venues, newest first.

        Args:
            after: the last venue of the page before.
            name: only venues with this in their name, whatever the case of letters.
        """
        page = newest_first(_select(VENUES.c.tenant == tenant), VENUES, limit=limit, after=after, name=name)
        with self._database.reading() as connection:
            return [_record(row) for row in connection.execute(page)]

    def plans(
        self, venue_id: str, *, limit: int, after: VenuePlace | None = None, level: float | None = None
    ) -> list[VenueMember]:
        """Plans of a venue by level, for callers that were let at it before.

        Args:
            after: the last one of the page before.
            level: only plans of this one.
        """
        own_level, plan_id = VENUE_PLANS.c.level, VENUE_PLANS.c.plan_id
        query = select(plan_id, own_level, VENUE_PLANS.c.name).where(VENUE_PLANS.c.venue_id == venue_id)
        if level is not None:
            query = query.where(own_level == level)
        if after is not None:
            query = query.where(or_(own_level > after.level, and_(own_level == after.level, plan_id > after.plan_id)))
        with self._database.reading() as connection:
            rows = connection.execute(query.order_by(own_level, plan_id).limit(limit))
            return [VenueMember(**row._mapping) for row in rows]

    def counts(self, venue_id: str, model_sha256: str, step_m: float) -> VenueCounts:
        """How many plans of a venue can be asked about, for a model and a grid step."""
        plan, grid, failure = VENUE_PLANS.c.plan_id, LATENT_GRIDS.c.id, REVISIONS.c.failure
        ready = case((grid.is_not(None), plan))
        failed = case((and_(grid.is_(None), failure.is_not(None)), plan))
        counts = select(*(func.count(distinct(counted)) for counted in (plan, ready, failed)))
        query = _in_venue(counts, venue_id, model_sha256, step_m)
        with self._database.reading() as connection:
            return VenueCounts(*connection.execute(query).one())

    def state(self, venue_id: str, model_sha256: str, step_m: float) -> VenueState:
        """What tells whether `searched` would answer as it did: a look at indices, without the rows themselves."""
        grid, own_revision = LATENT_GRIDS.c.id, VENUES.c.revision_id
        failed = case((and_(grid.is_(None), REVISIONS.c.failure.is_not(None)), 1))
        sums = (func.coalesce(func.sum(summed), 0) for summed in (REVISIONS.c.number, grid))
        counts = select(func.count(), func.count(grid), func.count(failed), *sums)
        query = _in_venue(counts, venue_id, model_sha256, step_m)
        with self._database.reading() as connection:
            revision_id = connection.scalar(select(own_revision).where(VENUES.c.id == venue_id))
            counted = connection.execute(query).one()
        # PostgreSQL sums up to decimals.
        return VenueState(revision_id, *map(int, counted))

    def searchable_plans(self, venue_id: str, model_sha256: str, step_m: float) -> Sequence[Row[Any]]:
        """What a query needs to know of every plan of a venue.

        Returns:
            rows of `plan_id`, `revision_id`, `level`, `name`, `camera_height_m`, `camera_height_std_m`, `failure`,
            `area_m2`, of where the plan lies (`plan_places`), and of the plan's own grid `grid_id`,
            `grid_sha256` and `poses`, None where it is not stored.
        """
        name = func.coalesce(VENUE_PLANS.c.name, FLOORPLANS.c.name).label("name")
        columns = (VENUE_PLANS.c.level, name, *_SEARCH_COLUMNS)
        query = _in_venue(select(*columns), venue_id, model_sha256, step_m)
        with self._database.reading() as connection:
            return connection.execute(query.order_by(VENUE_PLANS.c.level, VENUE_PLANS.c.plan_id)).all()

    def searchable_plans_near(
        self, tenant: str, latitude: float, longitude: float, within_m: float, model_sha256: str, step_m: float
    ) -> Sequence[Row[Any]]:
        """As `searched`, of the plans of a tenant that may lie so near a place; all are on level 0."""
        columns = (literal(0.0).label("level"), FLOORPLANS.c.name, *_SEARCH_COLUMNS)
        near = lies_in_box(latitude, longitude, within_m)
        query = _with_grids(select(*columns), FLOORPLANS, model_sha256, step_m)
        with self._database.reading() as connection:
            return connection.execute(query.where(FLOORPLANS.c.tenant == tenant, near).order_by(FLOORPLANS.c.id)).all()

    def delete(self, tenant: str, venue_id: str, *, expected: str | None = None) -> bool:
        """Delete a venue, and none of its plans; False when there was none.

        Raises:
            RevisionMismatchError: it has another revision than `expected`.
        """
        with self._database.writing() as connection:
            try:
                _locked(connection, tenant, venue_id, expected)
            except UnknownVenueError:
                return False
            return connection.execute(delete(VENUES).where(VENUES.c.id == venue_id)).rowcount == 1


def remove_from_venues(connection: Connection, plan_id: str) -> None:
    """Before a plan is deleted, in the same transaction: every venue that has it gets a revision without it."""
    own = select(VENUE_PLANS.c.venue_id).where(VENUE_PLANS.c.plan_id == plan_id)
    venues = select(VENUES.c.id).where(VENUES.c.id.in_(own)).order_by(VENUES.c.id).with_for_update()
    ids = connection.scalars(venues).all()
    connection.execute(delete(VENUE_PLANS).where(VENUE_PLANS.c.plan_id == plan_id))
    now = datetime.now(UTC)
    for venue_id in ids:
        values = {"revision_id": uuid.uuid4().hex, "number": VENUES.c.number + 1, "updated_at": now}
        connection.execute(update(VENUES).where(VENUES.c.id == venue_id).values(**values))


def _head(name: str, anchor: Anchor | None, now: datetime) -> dict[str, Any]:
    """What changes of a venue with a revision."""
    return {
        "name": name,
        "folded_name": name.casefold(),
        "revision_id": uuid.uuid4().hex,
        "updated_at": now,
        "latitude": None if anchor is None else anchor.latitude,
        "longitude": None if anchor is None else anchor.longitude,
        "altitude_m": None if anchor is None else anchor.altitude_m,
        "north_deg": None if anchor is None else anchor.north_deg,
    }


def _select(*conditions: Any) -> Any:
    own = VENUE_PLANS.c.venue_id == VENUES.c.id
    plans = select(func.count()).select_from(VENUE_PLANS).where(own).scalar_subquery().label("plans")
    return select(VENUES, plans).where(*conditions)


def _find(connection: Connection, tenant: str, venue_id: str) -> Row[Any] | None:
    return connection.execute(_select(VENUES.c.id == venue_id, VENUES.c.tenant == tenant)).one_or_none()


def _record(row: Row[Any]) -> VenueRecord:
    anchor = None
    if row.latitude is not None:
        anchor = Anchor(row.latitude, row.longitude, row.altitude_m, row.north_deg)
    return VenueRecord(
        id=row.id,
        tenant=row.tenant,
        revision_id=row.revision_id,
        revision=row.number,
        name=row.name,
        anchor=anchor,
        plans=getattr(row, "plans", 0),
        created_at=row.created_at,
        updated_at=row.updated_at,
    )


def _locked(connection: Connection, tenant: str, venue_id: str, expected: str | None) -> Row[Any]:
    """A venue that nobody else changes until the transaction ends."""
    query = select(VENUES).where(VENUES.c.id == venue_id, VENUES.c.tenant == tenant)
    row = connection.execute(query.with_for_update()).one_or_none()
    if row is None:
        raise UnknownVenueError(venue_id)
    if expected not in (None, row.revision_id):
        raise RevisionMismatchError(venue_id, expected, row.revision_id, what="venue")
    return row


def _check_plans(connection: Connection, tenant: str, plan_ids: Sequence[str]) -> None:
    """Keep the plans of a tenant from being deleted until the transaction ends.

    Raises:
        InvalidRequestError: not all of them are there.
    """
    found: set[str] = set()
    own = FLOORPLANS.c.tenant == tenant
    for part in _parts(sorted(plan_ids)):
        query = select(FLOORPLANS.c.id).where(own, FLOORPLANS.c.id.in_(part)).order_by(FLOORPLANS.c.id)
        found |= set(connection.scalars(query.with_for_update(read=True, key_share=True)))
    if missing := [plan_id for plan_id in plan_ids if plan_id not in found]:
        raise InvalidRequestError([("plans", f"there is no floor plan {_named(missing)}")])


def _insert(connection: Connection, venue_id: str, members: Sequence[VenueMember]) -> None:
    if members:
        values = [
            {"venue_id": venue_id, "plan_id": one.plan_id, "level": one.level, "name": one.name} for one in members
        ]
        connection.execute(VENUE_PLANS.insert(), values)


def _remove(connection: Connection, venue_id: str, plan_ids: Collection[str], *, strict: bool = True) -> None:
    own, left = VENUE_PLANS.c.venue_id == venue_id, set(plan_ids)
    for part in _parts(sorted(plan_ids)):
        statement = delete(VENUE_PLANS).where(own, VENUE_PLANS.c.plan_id.in_(part))
        left -= set(connection.scalars(statement.returning(VENUE_PLANS.c.plan_id)))
    if left and strict:
        raise InvalidRequestError([("remove", f"the venue does not have floor plan {_named(sorted(left))}")])


def _count(connection: Connection, venue_id: str) -> int:
    own = VENUE_PLANS.c.venue_id == venue_id
    return connection.scalar(select(func.count()).select_from(VENUE_PLANS).where(own)) or 0


def _in_venue(query: Any, venue_id: str, model_sha256: str, step_m: float) -> Any:
    """Return a query about the plans of a venue, joined as in `_with_grids`."""
    plans = VENUE_PLANS.join(FLOORPLANS, FLOORPLANS.c.id == VENUE_PLANS.c.plan_id)
    return _with_grids(query, plans, model_sha256, step_m).where(VENUE_PLANS.c.venue_id == venue_id)


def _with_grids(query: Any, plans: FromClause, model_sha256: str, step_m: float) -> Any:
    """Plans joined with their current revision, and with their own grids where those are."""
    joined = plans.join(REVISIONS, REVISIONS.c.id == FLOORPLANS.c.revision_id)
    return query.select_from(joined.outerjoin(LATENT_GRIDS, is_own_grid(model_sha256, step_m)))


def _named(ids: Sequence[str]) -> str:
    more = f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else ""
    return ", ".join(f"'{one[:64]}'" for one in ids[:_NAMED]) + more


def _parts(ids: Sequence[str]) -> Iterable[Sequence[str]]:
    return (ids[first : first + _BATCH_SIZE] for first in range(0, len(ids), _BATCH_SIZE))
