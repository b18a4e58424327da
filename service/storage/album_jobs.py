"""Leases on the solution of albums, and its results.

An album is due when it, its plan or a plan of its venue has changed since it was solved. Any replica can take the lease
of a due album; the lease of one that died expires, so that another solves the album.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from sqlalchemy import Connection, bindparam, func, select, update

from service.storage.album_rows import NO_LEASE, AlbumRecord, is_due, select_albums
from service.storage.database import Database
from service.storage.tables import ALBUM_PHOTOGRAPHS, ALBUMS, TENANTS


@dataclass(frozen=True, kw_only=True)
class AlbumPart:
    """Photograph of an album that is solved.

    Attributes:
        entry: its features.
        correction, pin: as JSON; None without.
        evidence: what an attempt that did not end found about it; None without.
    """

    id: str
    name: str | None
    entry: bytes
    correction: str | None
    pin: str | None
    evidence: bytes | None


@dataclass(frozen=True, kw_only=True)
class AlbumJob:
    """Album under the lease of an owner.

    Attributes:
        place_change: number of the tenant's last change of a plan.
        attempts: number of claims since it was last solved or changed, this one included.
    """

    album: AlbumRecord
    photographs: list[AlbumPart]
    place_change: int
    attempts: int


class AlbumJobs:
    """Leases on albums of all tenants, regardless of caller."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def due(
        self, model_sha256: str, tenants: Collection[str], limit: int, later: Collection[str] = ()
    ) -> list[tuple[str, str]]:
        """Return tenant and id of albums that no replica solves, one per tenant but `tenants`, those `later` last."""
        columns = ALBUMS.c
        live = self._database.is_live(columns.lease_until_s, columns.lease_s)
        first = func.row_number().over(partition_by=columns.tenant, order_by=(columns.updated_at, columns.id))
        waiting = (
            select(columns.tenant, columns.id, columns.updated_at, first.label("place"))
            .where(columns.model_sha256 == model_sha256, columns.expires_at >= datetime.now(UTC), is_due(), ~live)
            .where(columns.tenant.not_in(list(tenants)))
            .subquery()
        )
        query = select(waiting.c.tenant, waiting.c.id).where(waiting.c.place == 1)
        query = query.order_by(waiting.c.tenant.in_(list(later)), waiting.c.updated_at)
        return [(row.tenant, row.id) for row in self._database.rows(query.limit(limit))]

    def claim(self, album_id: str, owner: str, lease_s: float) -> AlbumJob | None:
        """Take the lease on a due album; None if another owner holds it, or there is nothing to do."""
        columns = ALBUMS.c
        free = ~self._database.is_live(columns.lease_until_s, columns.lease_s)
        values = {
            "owner": owner,
            "lease_until_s": self._database.now_s() + lease_s,
            "lease_s": lease_s,
            "progress": 0.0,
            "attempts": columns.attempts + 1,
        }
        statement = update(ALBUMS).where(columns.id == album_id, free, is_due()).values(**values)
        with self._database.writing() as connection:
            attempts = connection.scalar(statement.returning(columns.attempts))
            if attempts is None:
                return None
            album = AlbumRecord(**connection.execute(select_albums().where(columns.id == album_id)).one()._mapping)
            changes = connection.scalar(select(TENANTS.c.changes).where(TENANTS.c.tenant == album.tenant))
            parts = ALBUM_PHOTOGRAPHS.c
            names = [parts[name] for name in AlbumPart.__dataclass_fields__]
            rows = connection.execute(select(*names).where(parts.album_id == album_id).order_by(parts.number))
            photographs = [AlbumPart(**row._mapping) for row in rows]
        return AlbumJob(album=album, photographs=photographs, place_change=changes or 0, attempts=attempts)

    def renew(self, album_id: str, owner: str, lease_s: float, progress: float, found: Mapping[str, bytes]) -> bool:
        """Renew a lease and store the progress and the evidence of photographs that was found since, by id.

        Returns:
            False if the owner lost the lease, or the album was deleted.
        """
        values = {"lease_until_s": self._database.now_s() + lease_s, "lease_s": lease_s, "progress": progress}
        own = ALBUMS.c.id == album_id, ALBUMS.c.owner == owner
        with self._database.writing(grows_by=sum(map(len, found.values()))) as connection:
            if connection.execute(update(ALBUMS).where(*own).values(**values)).rowcount != 1:
                return False
            _fill(connection, "evidence", found)
        return True

    def release(self, album_id: str, owner: str, *, failed: bool = False) -> None:
        """Release a lease without a solution; the attempt does not count unless it `failed`."""
        columns = ALBUMS.c
        attempts = columns.attempts if failed else columns.attempts - 1
        own = columns.id == album_id, columns.owner == owner
        with self._database.writing() as connection:
            connection.execute(update(ALBUMS).where(*own).values(NO_LEASE | {"attempts": attempts}))

    def finish(
        self,
        job: AlbumJob,
        owner: str,
        place_revision_id: str,
        *,
        pins: Mapping[str, str],
        solution: str | None,
        failure: str | None = None,
    ) -> bool:
        """Store the solution of an album, or the reason why there is none, and release the lease.

        An album that has changed since its claim stays due. `place_revision_id` is of the plan or venue, `pins` are
        JSON by id of the photographs, of which some may be deleted; without a common `solution`, the one before stays.

        Returns:
            False if the owner lost the lease, or the album was deleted.
        """
        values = NO_LEASE | {
            "solved_number": job.album.number,
            "place_revision_id": place_revision_id,
            "place_change": job.place_change,
            "failure": failure,
        }
        if solution is not None:
            values["solution"] = solution
        own = ALBUMS.c.id == job.album.id, ALBUMS.c.owner == owner
        parts = ALBUM_PHOTOGRAPHS.c
        found = parts.album_id == job.album.id, parts.evidence.is_not(None)
        with self._database.writing(grows_by=sum(map(len, pins.values()))) as connection:
            if connection.execute(update(ALBUMS).where(*own).values(**values)).rowcount != 1:
                return False
            _fill(connection, "pin", pins)
            connection.execute(update(ALBUM_PHOTOGRAPHS).where(*found).values(evidence=None))
        return True


def _fill(connection: Connection, column: str, values: Mapping[str, str] | Mapping[str, bytes]) -> None:
    """Set a column of photographs, by id, of which some may be deleted."""
    if values:
        one = update(ALBUM_PHOTOGRAPHS).where(ALBUM_PHOTOGRAPHS.c.id == bindparam("photograph_id"))
        rows = [{"photograph_id": key, "value": value} for key, value in values.items()]
        connection.execute(one.values({column: bindparam("value")}), rows)
