"""Rows of venues and of their plans."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import fields
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Connection, Row, delete, func, select, update

from lalaloc_core.floorplan.earth import Anchor
from service.errors import InvalidRequestError, RevisionMismatchError, TooManyVenuesError, UnknownVenueError
from service.storage.database import Database
from service.storage.records import VenueMember, VenueRecord
from service.storage.statements import count_rows
from service.storage.tables import VENUE_PLANS, VENUES


def find_venue(connection: Connection, tenant: str, venue_id: str) -> VenueRecord | None:
    """Return a venue; None if the tenant has none of this id."""
    row = connection.execute(select_venues(VENUES.c.id == venue_id, VENUES.c.tenant == tenant)).one_or_none()
    return None if row is None else venue_record(row)


def insert_venue(
    connection: Connection, database: Database, tenant: str, venue_id: str, name: str, anchor: Anchor | None
) -> bool:
    """Insert a venue without plans; False if its id exists already."""
    now = datetime.now(UTC)
    values = {"id": venue_id, "tenant": tenant, "number": 1, "created_at": now, **revision_values(name, anchor, now)}
    statement = database.insert(VENUES).values(values).on_conflict_do_nothing()
    return connection.scalar(statement.returning(VENUES.c.id)) is not None


def insert_members(connection: Connection, venue_id: str, members: Sequence[VenueMember]) -> None:
    """Insert plans of a venue."""
    if members:
        connection.execute(VENUE_PLANS.insert(), [{"venue_id": venue_id} | vars(member) for member in members])


def check_count(connection: Connection, tenant: str, limit: int) -> None:
    """Check the number of a tenant's venues, after `StorageQuota.settle`."""
    if count_rows(connection, VENUES, VENUES.c.tenant == tenant) > limit:
        raise TooManyVenuesError(limit)


def remove_from_venues(connection: Connection, plan_id: str) -> int:
    """Remove a plan, which the transaction deletes, from its venues with new revisions; return the number of rows."""
    own = select(VENUE_PLANS.c.venue_id).where(VENUE_PLANS.c.plan_id == plan_id)
    venues = select(VENUES.c.id).where(VENUES.c.id.in_(own)).order_by(VENUES.c.id).with_for_update()
    ids = connection.scalars(venues).all()
    rows = connection.execute(delete(VENUE_PLANS).where(VENUE_PLANS.c.plan_id == plan_id)).rowcount
    for venue_id in ids:
        touch_venue(connection, venue_id, datetime.now(UTC))
    return rows


def touch_venue(connection: Connection, venue_id: str, now: datetime) -> None:
    """Give a locked venue a new revision, because its plans have changed."""
    values = {"revision_id": uuid.uuid4().hex, "number": VENUES.c.number + 1, "updated_at": now}
    connection.execute(update(VENUES).where(VENUES.c.id == venue_id).values(**values))


def revision_values(name: str, anchor: Anchor | None, now: datetime) -> dict[str, Any]:
    """Return the columns that change with a venue's revision."""
    return {
        "name": name,
        "folded_name": name.casefold(),
        "revision_id": uuid.uuid4().hex,
        "updated_at": now,
        **{field.name: anchor and getattr(anchor, field.name) for field in fields(Anchor)},
    }


def select_venues(*conditions: Any) -> Any:
    """Return a query for the rows of `venue_record`."""
    own = VENUE_PLANS.c.venue_id == VENUES.c.id
    plans = select(func.count()).select_from(VENUE_PLANS).where(own).scalar_subquery().label("plans")
    return select(VENUES, plans).where(*conditions)


def venue_record(row: Row[Any]) -> VenueRecord:
    """Return the record of a venue's row."""
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


def lock_venue(connection: Connection, tenant: str, venue_id: str, expected: str | None) -> Row[Any]:
    """Return a venue's row, locked until the transaction ends."""
    query = select(VENUES).where(VENUES.c.id == venue_id, VENUES.c.tenant == tenant)
    row = connection.execute(query.with_for_update()).one_or_none()
    if row is None:
        raise UnknownVenueError(venue_id)
    if expected not in (None, row.revision_id):
        raise RevisionMismatchError(venue_id, expected, row.revision_id, what="venue")
    return row


def check_members(connection: Connection, venue_id: str, limit: int) -> int:
    """Check the number of a venue's plans after a change, and return it."""
    count = count_rows(connection, VENUE_PLANS, VENUE_PLANS.c.venue_id == venue_id)
    if count > limit:
        fault = f"the venue would have {count} plans; the limit is {limit} (LALALOC_MAX_VENUE_PLANS)"
        raise InvalidRequestError([("plans", fault)])
    return count
