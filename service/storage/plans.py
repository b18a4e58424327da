"""Stored floor plans, with their revisions and uploaded files. Calls are per tenant unless noted otherwise."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import ColumnElement, Connection, Row, delete, func, select, true, update

from lalaloc_core.floorplan import FloorPlan
from service.bounded_cache import SingleFlight
from service.errors import RevisionMismatchError, TooManyFloorPlansError, UnknownFloorPlanError
from service.plan_documents import PlanDocument, StoredPlan
from service.storage.album_rows import delete_albums
from service.storage.database import Database
from service.storage.plan_rows import PlanCache, PlanContent, insert_plan, insert_revisions, new_record, revision_values
from service.storage.records import Cursor, NewPlan, PlanRecord, PlanSummary
from service.storage.statements import (
    count_rows,
    damaged,
    lock_plan_of,
    newest_first,
    select_revisions,
    select_summaries,
)
from service.storage.stored_bytes import ROW_BYTES, StorageQuota, StoredBytes, deleted_bytes
from service.storage.tables import ALBUMS, FLOORPLANS, KEPT_ANSWERS, LATENT_GRIDS, REVISIONS, SESSIONS
from service.storage.venue_rows import remove_from_venues

# Ids per statement.
_BATCH_SIZE = 500


@dataclass(frozen=True)
class FoundPlan:
    """Row of a plan with the plan itself if it is in memory, otherwise with its document."""

    row: Row[Any]
    plan: FloorPlan | PlanDocument
    is_current: bool


class Plans:
    """Plans of all tenants; calls treat plans of other tenants as missing."""

    def __init__(self, database: Database, cache: PlanCache, quota: StorageQuota) -> None:
        # The cache receives every plan that is read or stored at its current revision.
        self._database, self._cache, self._quota = database, cache, quota
        self._parse: Callable[[PlanDocument], FloorPlan | None] = PlanDocument.plan
        self._parsing = SingleFlight[str, FloorPlan | None]()

    def parse_with(self, parse: Callable[[PlanDocument], FloorPlan | None]) -> None:
        """Set the function that parses documents; it returns None for a damaged one."""
        self._parse = parse

    def add(self, tenant: str, plan_id: str, new: NewPlan, *, limit: int) -> PlanRecord:
        """Store a plan, its uploaded file, and its grid if it is already computed.

        An existing id is a repeated upload whose first answer was lost; the stored plan is returned. Callers never
        choose ids. `limit` is the maximum number of the tenant's plans.
        """
        record = new_record(new, plan_id, tenant, datetime.now(UTC))
        content = PlanContent.prepare(record.revision_id, new)
        with self._database.writing(grows_by=content.stored.total) as connection:
            stored = self._find(connection, _select_current(tenant, plan_id))
            if stored is None:
                if count_rows(connection, FLOORPLANS, FLOORPLANS.c.tenant == tenant) >= limit:
                    raise TooManyFloorPlansError(limit)
                self._quota.check(connection, tenant, content.stored.total + new.later_bytes)
                if insert_plan(connection, self._database, record, content):
                    self._quota.settle(connection, tenant, content.stored)
                    # Exact now, because settling locks the tenant.
                    if count_rows(connection, FLOORPLANS, FLOORPLANS.c.tenant == tenant) > limit:
                        raise TooManyFloorPlansError(limit)
                else:
                    # Another attempt of the same upload was faster.
                    stored = self._find(connection, _select_current(tenant, plan_id))
        if stored is not None:
            record = self.record(stored)
        self._cache.put(record)
        return record

    def add_revision(
        self, tenant: str, plan_id: str, new: NewPlan, *, keep: int, expected: str | None = None
    ) -> PlanRecord:
        """Store a new revision of a plan, and delete revisions beyond `keep`.

        Grids of the new and the previous revision are kept, because running queries may need them. The plan must be at
        the revision `expected`, if there is one.
        """
        record = new_record(new, plan_id, tenant, datetime.now(UTC))
        content = PlanContent.prepare(record.revision_id, new)
        with self._database.writing(grows_by=content.stored.total) as connection:
            query = select(FLOORPLANS).where(FLOORPLANS.c.id == plan_id, FLOORPLANS.c.tenant == tenant)
            row = connection.execute(query.with_for_update()).one_or_none()
            if row is None:
                raise UnknownFloorPlanError(plan_id)
            if expected is not None and row.revision_id != expected:
                raise RevisionMismatchError(plan_id, expected, row.revision_id)
            own = REVISIONS.c.plan_id == plan_id
            number = (connection.scalar(select(func.max(REVISIONS.c.number)).where(own)) or 0) + 1
            record = replace(record, revision=number, created_at=row.created_at)
            freed = _delete_revisions(connection, own, grids_before=number - 1, before=number - keep + 1)
            change = content.stored - freed
            self._quota.check(connection, tenant, change.total + new.later_bytes)
            insert_revisions(connection, [record], [content])
            connection.execute(update(FLOORPLANS).where(FLOORPLANS.c.id == plan_id).values(**revision_values(record)))
            self._quota.settle(connection, tenant, change, changed_plan=plan_id)
        self._cache.put(record)
        return record

    def find(self, tenant: str, plan_id: str, revision_id: str | None = None) -> FoundPlan | None:
        """Return a plan for `record`, at its current or another stored revision."""
        if revision_id is not None:
            own = REVISIONS.c.id == revision_id, FLOORPLANS.c.id == plan_id, FLOORPLANS.c.tenant == tenant
            return self._read(_select_heads(current=False).where(*own))
        found = self._read(_select_current(tenant, plan_id), current=True)
        if found is None:
            self._cache.forget(tenant, plan_id)
        return found

    def find_revisions(self, tenant: str, revision_ids: Sequence[str]) -> dict[str, FoundPlan]:
        """Return plans at revisions for `record`, by revision; those that were deleted are left out."""
        rows = dict[str, tuple[Row[Any], bool]]()
        documents = dict[str, PlanDocument]()
        columns = REVISIONS.c
        with self._database.reading() as connection:
            # Almost all are current, so that nothing is left for the second statement.
            for current in (True, False):
                wanted = [revision_id for revision_id in revision_ids if revision_id not in rows]
                for first in range(0, len(wanted), _BATCH_SIZE):
                    own = FLOORPLANS.c.tenant == tenant, columns.id.in_(wanted[first : first + _BATCH_SIZE])
                    found = connection.execute(_select_heads(current=current).where(*own))
                    rows |= {row.revision_id: (row, current) for row in found}
            known = {key: self._cache.get(tenant, row.id, key) for key, (row, _) in rows.items()}
            unknown = [revision_id for revision_id, record in known.items() if record is None]
            for first in range(0, len(unknown), _BATCH_SIZE):
                query = select(columns.id, columns.document, columns.document_sha256, columns.warnings)
                for row in connection.execute(query.where(columns.id.in_(unknown[first : first + _BATCH_SIZE]))):
                    documents[row.id] = PlanDocument(row.document, row.document_sha256, row.warnings)
        plans = documents | {key: record.plan for key, record in known.items() if record is not None}
        return {key: FoundPlan(row, plans[key], current) for key, (row, current) in rows.items() if key in plans}

    def record(self, found: FoundPlan) -> PlanRecord:
        """Parse a plan unless it is in memory. This is slow for large plans, and does not touch the database."""
        row, plan = found.row, found.plan
        if isinstance(plan, PlanDocument):
            document = plan
            plan = self._parsing.run(row.revision_id, lambda: self._parse(document))
            if plan is None:
                raise damaged("document", row.id, row.revision_id)
        record = PlanRecord(**row._mapping, plan=plan)
        if found.is_current:
            self._cache.put(record)
        return record

    def get(self, tenant: str, plan_id: str, revision_id: str | None = None) -> PlanRecord | None:
        """Return a plan at its current or another stored revision."""
        found = self.find(tenant, plan_id, revision_id)
        return None if found is None else self.record(found)

    def get_by_revision(self, revision_id: str) -> PlanRecord | None:
        """Return a plan at a revision, regardless of tenant, for work on grids."""
        found = self._read(_select_heads(current=False).where(REVISIONS.c.id == revision_id))
        return None if found is None else self.record(found)

    def has_revision(self, revision_id: str) -> bool:
        """Tell whether a revision exists, regardless of tenant."""
        return self._database.value(select(REVISIONS.c.id).where(REVISIONS.c.id == revision_id)) is not None

    def summary(self, tenant: str, plan_id: str, revision_id: str | None = None) -> PlanSummary | None:
        """Return a plan without its document, even if that is damaged, at its current or another stored revision."""
        query = select_summaries(current=revision_id is None)
        query = query.where(FLOORPLANS.c.id == plan_id, FLOORPLANS.c.tenant == tenant)
        if revision_id is not None:
            query = query.where(REVISIONS.c.id == revision_id)
        return next(iter(self._summaries(query)), None)

    def stored(self, revision_id: str) -> StoredPlan | None:
        """Return a plan at a revision with its unparsed document, regardless of tenant. Callers check access first."""
        query = select_revisions(REVISIONS.c.report, current=False).where(REVISIONS.c.id == revision_id)
        with self._database.reading() as connection:
            row = connection.execute(query).one_or_none()
            if row is None:
                return None
            return StoredPlan(**row._mapping, document=_document(connection, revision_id))

    def any_stored(self) -> bool:
        """Tell whether any tenant has a plan."""
        return self._database.value(select(FLOORPLANS.c.id).limit(1)) is not None

    def list_plans(
        self, tenant: str, *, limit: int, after: Cursor | None = None, name: str | None = None
    ) -> list[PlanSummary]:
        """Return plans, newest first; `name` is a part of the name, case-insensitive."""
        query = select_summaries().where(FLOORPLANS.c.tenant == tenant)
        return self._summaries(newest_first(query, FLOORPLANS, limit=limit, after=after, name=name))

    def summaries(self, plan_ids: Collection[str]) -> list[PlanSummary]:
        """Return the plans that exist among `plan_ids`, regardless of tenant. Callers check access first."""
        return self._summaries(select_summaries().where(FLOORPLANS.c.id.in_(plan_ids)))

    def delete(self, tenant: str, plan_id: str, *, expected: str | None = None) -> bool:
        """Delete a plan with its revisions, files, grids, sessions and albums, and remove it from its venues.

        The plan must be at the revision `expected`, if there is one. False without the plan.
        """
        deleted = self._database.freeing(lambda connection: self._delete(connection, tenant, plan_id, expected))
        self._cache.forget(tenant, plan_id)
        return deleted

    def set_failure(self, revision_id: str, reason: str | None) -> None:
        """Store the error of the computation of a revision's own grid; None deletes it."""
        with self._database.writing() as connection:
            plan = lock_plan_of(connection, revision_id)
            if plan is not None:
                connection.execute(update(REVISIONS).where(REVISIONS.c.id == revision_id).values(failure=reason))
                self._quota.settle(connection, plan.tenant, StoredBytes(), refuse=False, changed_plan=plan.id)

    def clear_failures(self) -> None:
        """Delete all stored errors, so that these grids are computed again."""
        with self._database.reading() as connection:
            failed = connection.scalars(select(REVISIONS.c.id).where(REVISIONS.c.failure.is_not(None))).all()
        for revision_id in failed:
            self.set_failure(revision_id, None)

    def current_revisions(self, revision_ids: Collection[str]) -> set[str]:
        """Return the revisions among `revision_ids` that are the current ones of their plans."""
        query = select(FLOORPLANS.c.revision_id).where(FLOORPLANS.c.revision_id.in_(revision_ids))
        with self._database.reading() as connection:
            return set(connection.scalars(query))

    def _delete(self, connection: Connection, tenant: str, plan_id: str, expected: str | None) -> bool:
        mine = (FLOORPLANS.c.id == plan_id, FLOORPLANS.c.tenant == tenant)
        revision_id = connection.scalar(select(FLOORPLANS.c.revision_id).where(*mine).with_for_update())
        if revision_id is None:
            return False
        if expected not in (None, revision_id):
            raise RevisionMismatchError(plan_id, expected, revision_id)
        own = REVISIONS.c.plan_id == plan_id
        # Waits for grids that are being stored.
        connection.execute(select(REVISIONS.c.id).where(own).with_for_update())
        members = remove_from_venues(connection, plan_id)
        answers = deleted_bytes(connection, delete(KEPT_ANSWERS).where(KEPT_ANSWERS.c.plan_id == plan_id))
        sessions = deleted_bytes(connection, delete(SESSIONS).where(SESSIONS.c.plan_id == plan_id))
        albums = delete_albums(connection, ALBUMS.c.plan_id == plan_id)
        freed = replace(
            _delete_revisions(connection, own),
            venues=ROW_BYTES * members,
            answers=answers,
            sessions=sessions,
            albums=albums,
        )
        connection.execute(delete(FLOORPLANS).where(*mine))
        self._quota.settle(connection, tenant, StoredBytes() - freed)
        return True

    def _summaries(self, query: Any) -> list[PlanSummary]:
        return [PlanSummary(**row._mapping) for row in self._database.rows(query)]

    def _read(self, query: Any, *, current: bool = False) -> FoundPlan | None:
        with self._database.reading() as connection:
            return self._find(connection, query, current=current)

    def _find(self, connection: Connection, query: Any, *, current: bool = True) -> FoundPlan | None:
        """Return a plan's row; read its document only if the plan is not in memory."""
        row = connection.execute(query).one_or_none()
        if row is None:
            return None
        if (known := self._cache.get(row.tenant, row.id, row.revision_id)) is not None:
            return FoundPlan(row, known.plan, current)
        return FoundPlan(row, _document(connection, row.revision_id), current)


def _document(connection: Connection, revision_id: str) -> PlanDocument:
    columns = REVISIONS.c
    query = select(columns.document, columns.document_sha256, columns.warnings).where(columns.id == revision_id)
    return PlanDocument(**connection.execute(query).one()._mapping)


def _delete_revisions(
    connection: Connection, own: ColumnElement[bool], *, grids_before: int | None = None, before: int | None = None
) -> StoredBytes:
    """Delete revisions of a plan and grids by their numbers, by default all, and return the freed bytes."""
    numbers = REVISIONS.c.number
    old = select(REVISIONS.c.id).where(own, true() if grids_before is None else numbers < grids_before)
    grids = deleted_bytes(connection, delete(LATENT_GRIDS).where(LATENT_GRIDS.c.revision_id.in_(old)))
    dropped = delete(REVISIONS).where(own, true() if before is None else numbers < before)
    return StoredBytes(plans=deleted_bytes(connection, dropped), grids=grids)


def _select_current(tenant: str, plan_id: str) -> Any:
    return _select_heads(current=True).where(FLOORPLANS.c.id == plan_id, FLOORPLANS.c.tenant == tenant)


def _select_heads(*, current: bool) -> Any:
    """Return a query for the columns of `PlanRecord` except `plan`, at the current or at every revision."""
    return select_revisions(FLOORPLANS.c.tenant, REVISIONS.c.failure, REVISIONS.c.report, current=current)
