"""Pose grids, and the leases of the replicas that compute them."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import asdict
from typing import Any

from sqlalchemy import ColumnElement, Connection, Table, and_, delete, exists, func, or_, select, update
from sqlalchemy.exc import IntegrityError

from lalaloc_core.localise.match import PoseGrid
from service.storage.database import Database
from service.storage.grid_format import (
    PackedGrid,
    SortedPrototypes,
    digest_of,
    pack,
    pack_prototypes,
    unpack,
    unpack_prototypes,
)
from service.storage.records import GridKey, PlanSummary
from service.storage.statements import (
    CHUNK_BYTES,
    is_complete_grid,
    is_own_grid,
    is_own_height,
    lock_plan_of,
    read_exactly,
    select_summaries,
    write_chunks,
)
from service.storage.stored_bytes import ROW_BYTES, StorageQuota, StoredBytes, deleted_bytes
from service.storage.tables import FLOORPLANS, GRID_CHUNKS, GRID_LEASES, LATENT_GRIDS, REVISIONS
from service.telemetry import LOGGER_NAME

# Grids per statement.
_BATCH_SIZE = 1000


class StoredGrids:
    """Stored pose grids; a grid is stored completely or not at all."""

    def __init__(self, database: Database, quota: StorageQuota) -> None:
        self._database, self._quota = database, quota

    def get(self, key: GridKey) -> PoseGrid | None:
        """Return a grid; None if it is not stored, or damaged and to be computed again."""
        return self.get_all([key]).get(key)

    def get_all(self, keys: Collection[GridKey]) -> dict[GridKey, PoseGrid]:
        """Return the grids among `keys` that are stored and not damaged; keys are of one model."""
        left, found, columns = list(keys), dict[GridKey, PoseGrid](), LATENT_GRIDS.c
        for first in range(0, len(left), _BATCH_SIZE):
            part = {(key.revision_id, key.camera_height_mm): key for key in left[first : first + _BATCH_SIZE]}
            query = select(
                columns.id, columns.revision_id, columns.camera_height_mm, columns.size_bytes, columns.sha256
            )
            same_model = columns.model_sha256 == left[0].model_sha256, columns.step_m == left[0].step_m
            query = query.where(columns.revision_id.in_({name for name, _ in part}), *same_model, is_complete_grid())
            with self._database.reading() as connection:
                rows = [row for row in connection.execute(query) if (row.revision_id, row.camera_height_mm) in part]
                small = [row.id for row in rows if row.size_bytes <= CHUNK_BYTES]
                chunks = select(GRID_CHUNKS.c.grid_id, GRID_CHUNKS.c.content).where(GRID_CHUNKS.c.grid_id.in_(small))
                read = connection.execute(chunks).all() if small else []
                contents: dict[int, Any] = {row.grid_id: row.content for row in read}
                # Large grids are few, and assembled in place.
                for row in rows:
                    if row.size_bytes > CHUNK_BYTES:
                        owner = {"grid_id": row.id}
                        contents[row.id] = read_exactly(connection, GRID_CHUNKS, owner, row.size_bytes)
            for row in rows:
                key = part[row.revision_id, row.camera_height_mm]
                if (grid := _unpacked(key, contents.get(row.id), row.sha256)) is not None:
                    found[key] = grid
        return found

    def prototypes(self, grid_ids: Sequence[int]) -> dict[int, SortedPrototypes]:
        """Return the stored prototypes by the ids of their grids."""
        found: dict[int, SortedPrototypes] = {}
        columns = LATENT_GRIDS.c
        for first in range(0, len(grid_ids), _BATCH_SIZE):
            query = select(columns.id, columns.prototypes).where(
                columns.id.in_(grid_ids[first : first + _BATCH_SIZE]), columns.prototypes.is_not(None)
            )
            rows = self._database.rows(query)
            for row in rows:
                if (prototypes := unpack_prototypes(row.prototypes)) is not None:
                    found[row.id] = prototypes
        return found

    def put_prototypes(self, grid_id: int, prototypes: SortedPrototypes) -> None:
        """Store the prototypes of a grid that an earlier version of the service stored without, or in its format."""
        packed = pack_prototypes(prototypes)
        revisions = LATENT_GRIDS.join(REVISIONS, REVISIONS.c.id == LATENT_GRIDS.c.revision_id)
        owner = (
            select(FLOORPLANS.c.tenant)
            .select_from(revisions.join(FLOORPLANS, FLOORPLANS.c.id == REVISIONS.c.plan_id))
            .where(LATENT_GRIDS.c.id == grid_id)
        )
        column = LATENT_GRIDS.c.prototypes
        bytes_before = func.coalesce(func.length(column), 0)
        # Another replica can have stored the same meanwhile.
        is_new = or_(column.is_(None), column != packed)
        statement = update(LATENT_GRIDS).where(LATENT_GRIDS.c.id == grid_id, is_new)
        values = {"prototypes": packed, "stored_bytes": LATENT_GRIDS.c.stored_bytes + len(packed) - bytes_before}
        with self._database.writing(grows_by=len(packed)) as connection:
            tenant = connection.scalar(owner)
            before = connection.scalar(select(bytes_before).where(LATENT_GRIDS.c.id == grid_id))
            if tenant is not None and connection.execute(statement.values(values)).rowcount == 1:
                # Small beside the grid, and needed by queries of venues, so never refused.
                self._quota.settle(connection, tenant, StoredBytes(grids=len(packed) - (before or 0)), refuse=False)

    def poses(
        self, model_sha256: str, step_m: float, revision_ids: Sequence[str] | None = None
    ) -> dict[tuple[str, int], int]:
        """Return numbers of poses of a model's grids by (revision, camera height in mm), of all revisions or some."""
        columns = LATENT_GRIDS.c
        query = select(columns.revision_id, columns.camera_height_mm, columns.poses).where(
            columns.model_sha256 == model_sha256, columns.step_m == step_m, is_complete_grid()
        )
        if revision_ids is not None:
            query = query.where(columns.revision_id.in_(revision_ids))
        return {(row.revision_id, row.camera_height_mm): row.poses for row in self._database.rows(query)}

    def put(
        self,
        key: GridKey,
        grid: PoseGrid,
        *,
        keep: int,
        always_keep_mm: int,
        prototypes: SortedPrototypes | None = None,
    ) -> bool:
        """Store a grid, delete the oldest of its revision beyond `keep`, and end its lease.

        The latest grids for one other model or grid step are kept: while a model is replaced, replicas with the old
        and the new one serve the same plans. The grid for the camera height `always_keep_mm` is never deleted.

        Returns:
            False if the revision was deleted; the grid is then not stored.
        """
        packed = pack(grid, prototypes)
        revision = select(REVISIONS.c.id).where(REVISIONS.c.id == key.revision_id)
        with self._database.writing(grows_by=grid_bytes(packed)) as connection:
            # Replicas that store grids of one plan take turns. Plans are locked before revisions, as in their deletion,
            # to avoid a deadlock.
            plan = lock_plan_of(connection, key.revision_id)
            if plan is None or connection.scalar(revision.with_for_update(key_share=True)) is None:
                return False
            connection.execute(delete(GRID_LEASES).where(*_where(GRID_LEASES, key)))
            freed = deleted_bytes(connection, delete(LATENT_GRIDS).where(*_where(LATENT_GRIDS, key)))
            freed += _drop_older_models(connection, key)
            freed += _make_room(connection, key, keep=keep, always_keep_mm=always_keep_mm)
            change = StoredBytes(grids=grid_bytes(packed) - freed)
            self._quota.check(connection, plan.tenant, change.total)
            insert_grids(connection, [(key, packed)])
            self._quota.settle(connection, plan.tenant, change, changed_plan=plan.id)
        return True

    def missing(self, model_sha256: str, step_m: float, limit: int) -> list[PlanSummary]:
        """Return plans, oldest first, without an own grid, a live lease on it, or a failure."""
        leased = (
            GRID_LEASES.c.revision_id == REVISIONS.c.id,
            GRID_LEASES.c.model_sha256 == model_sha256,
            GRID_LEASES.c.step_m == step_m,
            is_own_height(GRID_LEASES),
            self._database.is_live(GRID_LEASES.c.lease_until_s, GRID_LEASES.c.length_s),
        )
        query = select_summaries().where(*_unprepared(model_sha256, step_m), ~exists().where(*leased))
        query = query.order_by(FLOORPLANS.c.created_at, FLOORPLANS.c.id).limit(limit)
        return [PlanSummary(**row._mapping) for row in self._database.rows(query)]

    def count_unprepared(self, model_sha256: str, step_m: float) -> int:
        """Return the number of plans without an own grid or a failure."""
        query = select_summaries().where(*_unprepared(model_sha256, step_m))
        return self._database.value(select(func.count()).select_from(query.subquery())) or 0


class GridLeases:
    """Leases on the computation of grids; a lease expires unless it is renewed, and is deleted with its revision."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def claim(self, key: GridKey, owner: str, lease_s: float) -> int | None:
        """Take the lease on a grid if it is free or has expired.

        Returns:
            The number of claims, this one included, since the grid was finished or the lease released; None if another
            owner holds the lease, or the revision was deleted.
        """
        columns = GRID_LEASES.c
        until_s = self._database.now_s() + lease_s
        values = {"owner": owner, "lease_until_s": until_s, "length_s": lease_s, "progress": 0.0}
        statement = self._database.insert(GRID_LEASES).values(**asdict(key), **values, attempts=1)
        statement = statement.on_conflict_do_update(
            index_elements=list(GRID_LEASES.primary_key),
            set_=values | {"attempts": columns.attempts + 1},
            where=~self._database.is_live(columns.lease_until_s, columns.length_s) | (columns.owner == owner),
        )
        try:
            with self._database.writing() as connection:
                return connection.scalar(statement.returning(columns.attempts))
        except IntegrityError:
            return None

    def renew(self, key: GridKey, owner: str, lease_s: float, progress: float) -> bool:
        """Renew a lease and store the progress; False if the owner lost it, or the revision was deleted."""
        statement = (
            update(GRID_LEASES)
            .where(*_where(GRID_LEASES, key), GRID_LEASES.c.owner == owner)
            .values(lease_until_s=self._database.now_s() + lease_s, length_s=lease_s, progress=progress)
        )
        with self._database.writing() as connection:
            return connection.execute(statement).rowcount == 1

    def release(self, key: GridKey, owner: str) -> None:
        """Release a lease without a finished grid."""
        with self._database.writing() as connection:
            connection.execute(delete(GRID_LEASES).where(*_where(GRID_LEASES, key), GRID_LEASES.c.owner == owner))

    def progress(self, model_sha256: str, step_m: float, revision_ids: Sequence[str]) -> dict[tuple[str, int], float]:
        """Return the progress of grids under live leases by (revision, camera height in mm)."""
        columns = GRID_LEASES.c
        query = select(columns.revision_id, columns.camera_height_mm, columns.progress).where(
            columns.model_sha256 == model_sha256,
            columns.step_m == step_m,
            columns.revision_id.in_(revision_ids),
            self._database.is_live(columns.lease_until_s, columns.length_s),
        )
        return {(row.revision_id, row.camera_height_mm): row.progress for row in self._database.rows(query)}


def grid_bytes(packed: PackedGrid) -> int:
    """Return the stored bytes of a packed grid."""
    return ROW_BYTES + len(packed.content) + len(packed.prototypes or b"")


def insert_grids(connection: Connection, grids: Sequence[tuple[GridKey, PackedGrid]]) -> None:
    """Insert packed grids, one per revision, within a transaction."""
    if not grids:
        return
    statement = LATENT_GRIDS.insert().returning(LATENT_GRIDS.c.id, LATENT_GRIDS.c.revision_id)
    inserted = connection.execute(statement, [_row(key, packed) for key, packed in grids])
    ids = {row.revision_id: row.id for row in inserted}
    chunks = [({"grid_id": ids[key.revision_id]}, memoryview(packed.content)) for key, packed in grids]
    write_chunks(connection, GRID_CHUNKS, chunks)


def _row(key: GridKey, packed: PackedGrid) -> dict[str, Any]:
    return {
        **asdict(key),
        "poses": packed.poses,
        "size_bytes": len(packed.content),
        "sha256": packed.sha256,
        "prototypes": packed.prototypes,
        "stored_bytes": grid_bytes(packed),
    }


def _unpacked(key: GridKey, content: bytes | bytearray | None, sha256: str) -> PoseGrid | None:
    """Return the grid in a blob; None, with an entry in the log, if it is damaged."""
    grid = None
    if content is not None and digest_of(content) == sha256:
        grid = unpack(content, step_m=key.step_m, camera_height_m=key.camera_height_m)
    if grid is None:
        fields = {"revision": key.revision_id, "camera_height_mm": key.camera_height_mm}
        logging.getLogger(LOGGER_NAME).error("a stored pose grid is damaged", extra={"fields": fields})
    return grid


def _where(table: Table, key: GridKey) -> list[ColumnElement[bool]]:
    return [table.c[name] == value for name, value in asdict(key).items()]


def _drop_older_models(connection: Connection, key: GridKey) -> int:
    """Delete the grids of all other models but the latest, and return the freed bytes."""
    columns = LATENT_GRIDS.c
    own = columns.revision_id == key.revision_id
    same_model = and_(columns.model_sha256 == key.model_sha256, columns.step_m == key.step_m)
    query = select(columns.model_sha256, columns.step_m).where(own, ~same_model).order_by(columns.id.desc()).limit(1)
    latest = connection.execute(query).one_or_none()
    if latest is None:
        return 0
    latest_model = and_(columns.model_sha256 == latest.model_sha256, columns.step_m == latest.step_m)
    return deleted_bytes(connection, delete(LATENT_GRIDS).where(own, ~same_model, ~latest_model))


def _make_room(connection: Connection, key: GridKey, *, keep: int, always_keep_mm: int) -> int:
    """Delete the oldest grids on demand beyond `keep`, and return the freed bytes."""
    if key.camera_height_mm == always_keep_mm:
        return 0
    columns = LATENT_GRIDS.c
    on_demand = select(columns.id).where(
        columns.revision_id == key.revision_id,
        columns.model_sha256 == key.model_sha256,
        columns.step_m == key.step_m,
        columns.camera_height_mm != always_keep_mm,
    )
    # Two grids are not among them: the plan's own, and the one about to be stored.
    surplus = connection.scalars(on_demand.order_by(columns.id.desc()).offset(max(keep - 2, 0))).all()
    return deleted_bytes(connection, delete(LATENT_GRIDS).where(columns.id.in_(surplus)))


def _unprepared(model_sha256: str, step_m: float) -> list[ColumnElement[bool]]:
    return [REVISIONS.c.failure.is_(None), ~exists().where(is_own_grid(model_sha256, step_m))]
