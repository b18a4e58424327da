"""Rows of a plan's revision: its documents, its uploaded file, and its pose grid if it is computed already."""

from __future__ import annotations

import hashlib
import math
import uuid
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from time import monotonic
from typing import Any, Self

import numpy as np
from sqlalchemy import Connection, select

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.query import DEFAULT_STD_M
from service.bounded_cache import BoundedCache
from service.plan_documents import PlanDocument
from service.storage.database import Database
from service.storage.grid_format import PackedGrid, pack
from service.storage.records import JSON, GridKey, NewPlan, Original, PlanRecord
from service.storage.statements import damaged, read_chunks, write_chunks
from service.storage.stored_bytes import ROW_BYTES, StoredBytes
from service.storage.stored_grids import grid_bytes, insert_grids
from service.storage.tables import FLOORPLANS, ORIGINAL_CHUNKS, REVISIONS

# Plans per statement, so that copies of their files and grids are few.
_TOGETHER = 50


def place_columns(plan: FloorPlan) -> dict[str, float | None]:
    """Return the columns of a plan's place: the circle around it, and the circle's centre on Earth."""
    x_min, y_min, x_max, y_max = (float(value) for value in plan.bounds_m)
    x_m, y_m = 0.5 * (x_min + x_max), 0.5 * (y_min + y_max)
    columns: dict[str, float | None] = {
        "centre_x_m": x_m,
        "centre_y_m": y_m,
        "reach_m": 0.5 * math.dist((x_min, y_min), (x_max, y_max)),
        "latitude": None,
        "longitude": None,
    }
    if plan.anchor is not None:
        ((longitude, latitude),) = plan.anchor.to_earth(np.array([[x_m, y_m]]))
        columns |= {"latitude": float(latitude), "longitude": float(longitude)}
    return columns


@dataclass(frozen=True)
class PlanContent:
    """Documents, file and grid of a new revision, prepared before the transaction."""

    document: PlanDocument
    original: Original
    original_sha256: str
    grid: tuple[GridKey, PackedGrid] | None

    @classmethod
    def prepare(cls, revision_id: str, new: NewPlan) -> Self:
        """Prepare the rows of a new revision."""
        packed = None if new.grid is None else (new.grid.key(revision_id), pack(new.grid.grid, new.grid.prototypes))
        document = new.document or PlanDocument.from_plan(new.plan)
        return cls(document, new.original, hashlib.sha256(new.original.content).hexdigest(), packed)

    @property
    def stored(self) -> StoredBytes:
        """Size of the rows."""
        texts = (self.document.document, self.document.warnings, self.original.report)
        # The texts are ASCII.
        plan = ROW_BYTES + sum(len(text or "") for text in texts) + len(self.original.content)
        return StoredBytes(plans=plan, grids=0 if self.grid is None else grid_bytes(self.grid[1]))


def new_record(new: NewPlan, plan_id: str, tenant: str, now: datetime) -> PlanRecord:
    """Return the record of a plan at its first revision."""
    return PlanRecord(
        id=plan_id,
        tenant=tenant,
        revision_id=uuid.uuid4().hex,
        revision=1,
        created_at=now,
        updated_at=now,
        plan=new.plan,
        failure=None,
        report=new.original.report,
    )


def insert_plan(connection: Connection, database: Database, record: PlanRecord, content: PlanContent) -> bool:
    """Insert a plan with its first revision; False if its id exists already."""
    statement = database.insert(FLOORPLANS).values(_plan_values(record)).on_conflict_do_nothing()
    if connection.scalar(statement.returning(FLOORPLANS.c.id)) is None:
        return False
    insert_revisions(connection, [record], [content])
    return True


def insert_plans(connection: Connection, records: Sequence[PlanRecord], contents: Sequence[PlanContent]) -> None:
    """Insert new plans with their first revisions, a few statements for many plans at a time."""
    for first in range(0, len(records), _TOGETHER):
        part = slice(first, first + _TOGETHER)
        connection.execute(FLOORPLANS.insert(), [_plan_values(record) for record in records[part]])
        insert_revisions(connection, records[part], contents[part])


def _plan_values(record: PlanRecord) -> dict[str, Any]:
    return {"id": record.id, "tenant": record.tenant, "created_at": record.created_at, **revision_values(record)}


def revision_values(record: PlanRecord) -> dict[str, Any]:
    """Return the columns of `floorplans` that change with a revision."""
    name = record.plan.name
    return {
        "name": name,
        "folded_name": name.casefold(),
        "revision_id": record.revision_id,
        "updated_at": record.updated_at,
        **place_columns(record.plan),
    }


def insert_revisions(connection: Connection, records: Sequence[PlanRecord], contents: Sequence[PlanContent]) -> None:
    """Insert one revision each of plans that exist."""
    pairs = list(zip(records, contents, strict=True))
    connection.execute(REVISIONS.insert(), [_revision_row(record, content) for record, content in pairs])
    originals = (
        ({"revision_id": record.revision_id}, memoryview(content.original.content)) for record, content in pairs
    )
    write_chunks(connection, ORIGINAL_CHUNKS, originals)
    insert_grids(connection, [content.grid for content in contents if content.grid is not None])


def _revision_row(record: PlanRecord, content: PlanContent) -> dict[str, Any]:
    plan = record.plan
    return {
        "id": record.revision_id,
        "plan_id": record.id,
        "number": record.revision,
        "created_at": record.updated_at,
        **asdict(content.document),
        "original_sha256": content.original_sha256,
        "original_media_type": content.original.media_type,
        "report": content.original.report,
        "room_count": len(plan.rooms),
        "area_m2": plan.area_m2,
        "camera_height_m": plan.camera_height_m,
        "camera_height_std_m": _height_std_m(plan),
        "stored_bytes": content.stored.plans,
    }


def _height_std_m(plan: FloorPlan) -> float | None:
    """Return the standard deviation (m) of a plan's camera height; None for an unknown height."""
    if plan.camera_height_std_m is not None:
        return plan.camera_height_std_m
    return DEFAULT_STD_M if plan.states_camera_height else None


class Originals:
    """Uploaded files of all tenants. Callers check access first."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def digest(self, revision_id: str) -> str | None:
        """Return the SHA-256 digest of a revision's file."""
        return self._database.value(select(REVISIONS.c.original_sha256).where(REVISIONS.c.id == revision_id))

    def checked(self, revision_id: str) -> tuple[str, int] | None:
        """Compare a revision's file with its digest, and return its media type and size (bytes)."""
        columns = REVISIONS.c
        query = select(columns.plan_id, columns.original_sha256, columns.original_media_type)
        digest, size_bytes = hashlib.sha256(), 0
        with self._database.reading() as connection:
            row = connection.execute(query.where(columns.id == revision_id)).one_or_none()
            if row is None:
                return None
            for chunk in read_chunks(connection, ORIGINAL_CHUNKS, {"revision_id": revision_id}):
                digest.update(chunk)
                size_bytes += len(chunk)
        if digest.hexdigest() != row.original_sha256:
            raise damaged("original", row.plan_id, revision_id)
        return row.original_media_type or JSON, size_bytes

    def chunk(self, revision_id: str, number: int) -> bytes | None:
        """Return one chunk of a revision's file; None after the last, and if the revision was deleted."""
        own, place = ORIGINAL_CHUNKS.c.revision_id == revision_id, ORIGINAL_CHUNKS.c.number == number
        return self._database.value(select(ORIGINAL_CHUNKS.c.content).where(own, place))


class PlanCache:
    """Plans by tenant and id, of about `limit_bytes` (0: none); safe to share between threads."""

    def __init__(self, limit_bytes: int) -> None:
        self._records: BoundedCache[tuple[str, str], tuple[PlanRecord, float]] = BoundedCache(
            limit_bytes, lambda entry: plan_bytes(entry[0].plan) + len(entry[0].report or "")
        )

    def put(self, record: PlanRecord) -> None:
        """Keep a plan at its current revision, as of now."""
        self._records.put((record.tenant, record.id), (record, monotonic()))

    def put_unread(self, record: PlanRecord) -> None:
        """Keep one of many new plans; see `BoundedCache.put_unread`."""
        self._records.put_unread((record.tenant, record.id), (record, monotonic()))

    def get(self, tenant: str, plan_id: str, revision_id: str) -> PlanRecord | None:
        """Return a plan if it is in memory at this revision."""
        entry = self._records.get((tenant, plan_id))
        return None if entry is None or entry[0].revision_id != revision_id else entry[0]

    def recent(self, tenant: str, plan_id: str, max_age_s: float) -> PlanRecord | None:
        """Return a plan that was read or stored within `max_age_s` (s)."""
        entry = self._records.get((tenant, plan_id))
        return None if entry is None or monotonic() - entry[1] > max_age_s else entry[0]

    def revisions(self) -> set[str]:
        """Return the revisions in memory."""
        return {record.revision_id for _, (record, _) in self._records.items()}

    def forget(self, tenant: str, plan_id: str) -> None:
        """Drop a deleted plan."""
        self._records.drop(lambda key, _: key == (tenant, plan_id))

    def forget_revisions(self, revision_ids: set[str]) -> None:
        """Drop plans at deleted revisions."""
        self._records.drop(lambda _, entry: entry[0].revision_id in revision_ids)


def plan_bytes(plan: FloorPlan) -> int:
    """Estimate the memory of a plan: its walls as arrays, and its corners three times."""
    return plan.wall_table.nbytes + 3 * sum(room.polygon_m.nbytes for room in plan.rooms) + 2000 * len(plan.rooms)
