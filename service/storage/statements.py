"""Statements that several tables share: pages of listings, values in chunks, plans with their own pose grids."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, TypeVar

from sqlalchemy import ColumnElement, Connection, Select, Table, and_, func, or_, select

from service.errors import DamagedDataError, UnknownFloorPlanError, UnknownVenueError
from service.storage.records import Cursor
from service.storage.tables import FLOORPLANS, LATENT_GRIDS, REVISIONS, VENUES
from service.telemetry import LOGGER_NAME

# Large values are stored in pieces, so that neither database nor driver handles one of them whole.
CHUNK_BYTES = 2**20
# Chunks per statement.
_CHUNKS_TOGETHER = 16

Query = TypeVar("Query", bound=Select[Any])


def newest_first(query: Query, table: Table, *, limit: int, after: Cursor | None, name: str | None = None) -> Query:
    """Return a page of a query about a table with `id` and `created_at`, and for searches `folded_name`.

    `after` is the last row of the previous page, `name` a part of the name, case-insensitive.
    """
    age, own_id = table.c.created_at, table.c.id
    if name:
        query = query.where(table.c.folded_name.contains(name.casefold(), autoescape=True))
    if after is not None:
        query = query.where(or_(age < after.created_at, and_(age == after.created_at, own_id < after.id)))
    return query.order_by(age.desc(), own_id.desc()).limit(limit)


def count_rows(connection: Connection, table: Table, *conditions: ColumnElement[bool]) -> int:
    """Return the number of rows; exact for those of a tenant after `StorageQuota.settle`, which locks the tenant."""
    return connection.scalar(select(func.count()).select_from(table).where(*conditions)) or 0


def write_chunks(connection: Connection, table: Table, values: Iterable[tuple[dict[str, Any], memoryview]]) -> None:
    """Write values, each with name and value of the column that identifies it."""
    rows = (
        {**owner, "number": number, "content": bytes(content[first : first + CHUNK_BYTES])}
        for owner, content in values
        for number, first in enumerate(range(0, len(content), CHUNK_BYTES))
    )
    while part := list(islice(rows, _CHUNKS_TOGETHER)):
        connection.execute(table.insert(), part)


def read_chunks(connection: Connection, table: Table, owner: dict[str, Any]) -> Iterator[bytes]:
    """Yield the chunks of a value in order, one statement each."""
    query = select(table.c.content).where(*(table.c[name] == value for name, value in owner.items()))
    number = 0
    while (content := connection.scalar(query.where(table.c.number == number))) is not None:
        yield content
        number += 1


def read_exactly(connection: Connection, table: Table, owner: dict[str, Any], size_bytes: int) -> bytearray | None:
    """Return a value of known size, assembled in place; None if its size differs."""
    content, filled = bytearray(size_bytes), 0
    for chunk in read_chunks(connection, table, owner):
        if filled + len(chunk) > size_bytes:
            return None
        content[filled : filled + len(chunk)] = chunk
        filled += len(chunk)
    return content if filled == size_bytes else None


def damaged(part: str, plan_id: str, revision_id: str) -> DamagedDataError:
    """Log that a part of a stored plan is damaged, and return the error."""
    fields = {"floorplan": plan_id, "revision": revision_id}
    logging.getLogger(LOGGER_NAME).error(f"the stored {part} of a floor plan is damaged", extra={"fields": fields})
    return DamagedDataError(f"the {part} of floor plan '{plan_id}' at revision '{revision_id}' is damaged")


def select_summaries(*, current: bool = True) -> Any:
    """Return a query for the columns of `PlanSummary`, of all plans at their current or at every revision."""
    numbers = (REVISIONS.c.room_count, REVISIONS.c.area_m2, REVISIONS.c.camera_height_m)
    anchored = FLOORPLANS.c.latitude.is_not(None).label("anchored")
    return select_revisions(FLOORPLANS.c.name, *numbers, REVISIONS.c.failure, anchored, current=current)


def select_revisions(*columns: Any, current: bool) -> Any:
    """Return a query for ids, numbers and times of plans at their current or at every revision, and more columns."""
    link = FLOORPLANS.c.revision_id == REVISIONS.c.id if current else FLOORPLANS.c.id == REVISIONS.c.plan_id
    return select(
        FLOORPLANS.c.id,
        REVISIONS.c.id.label("revision_id"),
        REVISIONS.c.number.label("revision"),
        FLOORPLANS.c.created_at,
        REVISIONS.c.created_at.label("updated_at"),
        *columns,
    ).join_from(FLOORPLANS, REVISIONS, link)


def lock_plan_of(connection: Connection, revision_id: str) -> Any:
    """Lock the plan of a revision until the transaction ends; return its id and tenant, None if it was deleted."""
    plan_id = select(REVISIONS.c.plan_id).where(REVISIONS.c.id == revision_id).scalar_subquery()
    query = select(FLOORPLANS.c.id, FLOORPLANS.c.tenant).where(FLOORPLANS.c.id == plan_id)
    return connection.execute(query.with_for_update(key_share=True)).one_or_none()


def lock_place(connection: Connection, tenant: str, plan_id: str | None, venue_id: str | None) -> None:
    """Lock a plan or venue against deletion until the transaction ends."""
    table, place_id, error = FLOORPLANS, plan_id, UnknownFloorPlanError
    if place_id is None:
        table, place_id, error = VENUES, venue_id or "", UnknownVenueError
    query = select(table.c.id).where(table.c.id == place_id, table.c.tenant == tenant)
    if connection.scalar(query.with_for_update(read=True)) is None:
        raise error(place_id)


def is_complete_grid() -> ColumnElement[bool]:
    """Return the condition that a grid has a digest; earlier versions of the service, running beside, write none."""
    return LATENT_GRIDS.c.sha256.is_not(None)


def is_own_height(table: Table) -> ColumnElement[bool]:
    """Return the condition that a row is for the plan's own camera height, to half a millimetre."""
    return and_(
        table.c.camera_height_mm >= REVISIONS.c.camera_height_m * 1000.0 - 0.501,
        table.c.camera_height_mm <= REVISIONS.c.camera_height_m * 1000.0 + 0.501,
    )


def is_own_grid(model_sha256: str, step_m: float) -> ColumnElement[bool]:
    """Return the condition that joins a revision with the grid for its own camera height."""
    return and_(
        LATENT_GRIDS.c.revision_id == REVISIONS.c.id,
        LATENT_GRIDS.c.model_sha256 == model_sha256,
        LATENT_GRIDS.c.step_m == step_m,
        is_complete_grid(),
        is_own_height(LATENT_GRIDS),
    )
