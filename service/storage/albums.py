"""Albums: photographs of a plan or venue that are solved together, each with its correction and its pin.

An album expires some time after its last change. Photographs themselves are not stored, only their features.
"""

from __future__ import annotations

import uuid
from datetime import UTC, datetime, timedelta

from sqlalchemy import Connection, delete, func, select, update

from service.errors import RevisionMismatchError, TooManyAlbumsError, TooManyPhotographsError
from service.storage.album_rows import (
    NO_LEASE,
    AlbumRecord,
    NewAlbum,
    NewPhotograph,
    PhotographRecord,
    album_bytes,
    change_album,
    delete_albums,
    find_album,
    find_photograph,
    lock_album,
    select_albums,
    select_photographs,
)
from service.storage.database import Database
from service.storage.records import Cursor
from service.storage.statements import count_rows, lock_place, newest_first
from service.storage.stored_bytes import StorageQuota, StoredBytes, deleted_bytes
from service.storage.tables import ALBUM_PHOTOGRAPHS, ALBUMS

# Albums deleted per transaction of `purge`.
_PURGED_AT_ONCE = 100


class Albums:
    """Albums of all tenants, each visible to its own tenant."""

    def __init__(self, database: Database, quota: StorageQuota) -> None:
        self._database, self._quota = database, quota

    def add(self, tenant: str, album_id: str, new: NewAlbum, *, ttl_s: float, limit: int) -> AlbumRecord:
        """Store an album; return the one that exists under this id, if the request is repeated."""
        now, size, own = datetime.now(UTC), album_bytes(new), ALBUMS.c.tenant == tenant
        with self._database.writing(grows_by=size) as connection:
            lock_place(connection, tenant, new.plan_id, new.venue_id)
            if connection.scalar(select(ALBUMS.c.id).where(own, ALBUMS.c.id == album_id)) is not None:
                return find_album(connection, tenant, album_id, now)
            freed = delete_albums(connection, own, ALBUMS.c.expires_at < now)
            values = vars(new) | {
                "id": album_id,
                "tenant": tenant,
                "folded_name": new.name.casefold(),
                "revision_id": uuid.uuid4().hex,
                "number": 1,
                "created_at": now,
                "updated_at": now,
                "expires_at": now + timedelta(seconds=ttl_s),
                "photographs": 0,
                "solved_number": 0,
                "place_change": 0,
                "stored_bytes": size,
                **NO_LEASE,
            }
            connection.execute(ALBUMS.insert().values(values))
            # Counted after it: `settle` locks the tenant, so that the number is exact.
            self._quota.settle(connection, tenant, StoredBytes(albums=size - freed))
            if count_rows(connection, ALBUMS, own) > limit:
                raise TooManyAlbumsError(limit)
            return find_album(connection, tenant, album_id, now)

    def get(self, tenant: str, album_id: str) -> AlbumRecord:
        """Return an album."""
        with self._database.reading() as connection:
            return find_album(connection, tenant, album_id, datetime.now(UTC))

    def list_albums(
        self, tenant: str, *, limit: int, after: Cursor | None = None, name: str | None = None
    ) -> list[AlbumRecord]:
        """Return albums, newest first; arguments as for `Venues.list_venues`."""
        query = select_albums().where(ALBUMS.c.tenant == tenant, ALBUMS.c.expires_at >= datetime.now(UTC))
        rows = self._database.rows(newest_first(query, ALBUMS, limit=limit, after=after, name=name))
        return [AlbumRecord(**row._mapping) for row in rows]

    def by_ids(self, album_ids: set[str]) -> list[AlbumRecord]:
        """Return the albums that exist among some ids, regardless of tenant. Callers check access first."""
        query = select_albums().where(ALBUMS.c.id.in_(album_ids), ALBUMS.c.expires_at >= datetime.now(UTC))
        return [AlbumRecord(**row._mapping) for row in self._database.rows(query)]

    def delete(self, tenant: str, album_id: str, *, expected: str | None = None) -> None:
        """Delete an album with its photographs."""

        def work(connection: Connection) -> None:
            lock_album(connection, tenant, album_id, datetime.now(UTC), expected)
            freed = delete_albums(connection, ALBUMS.c.id == album_id)
            self._quota.settle(connection, tenant, StoredBytes(albums=-freed))

        self._database.freeing(work)

    def purge(self) -> int:
        """Delete expired albums, and return their number."""
        expired = select(ALBUMS.c.tenant, ALBUMS.c.id).where(ALBUMS.c.expires_at < datetime.now(UTC))
        count = 0
        while True:
            rows = self._database.rows(expired.order_by(ALBUMS.c.tenant, ALBUMS.c.id).limit(_PURGED_AT_ONCE))
            for tenant in sorted({row.tenant for row in rows}):
                own = ALBUMS.c.id.in_([row.id for row in rows if row.tenant == tenant])
                self._database.freeing(lambda connection, tenant=tenant, own=own: self._drop(connection, tenant, own))
            count += len(rows)
            if len(rows) < _PURGED_AT_ONCE:
                return count

    def _drop(self, connection: Connection, tenant: str, own: object) -> None:
        # Not those whose life was prolonged meanwhile.
        freed = delete_albums(connection, own, ALBUMS.c.expires_at < datetime.now(UTC))  # type: ignore[arg-type]
        self._quota.settle(connection, tenant, StoredBytes(albums=-freed))

    def photographs(self, album_id: str, *, limit: int, after: int = 0) -> list[PhotographRecord]:
        """Return photographs with numbers beyond `after`, regardless of tenant. Callers check access first."""
        own = ALBUM_PHOTOGRAPHS.c.album_id == album_id, ALBUM_PHOTOGRAPHS.c.number > after
        rows = self._database.rows(select_photographs(*own).limit(limit))
        return [PhotographRecord(**row._mapping) for row in rows]

    def photograph(self, album_id: str, photograph_id: str) -> PhotographRecord:
        """Return a photograph, regardless of tenant. Callers check access first."""
        with self._database.reading() as connection:
            return find_photograph(connection, album_id, photograph_id)

    def same_picture(self, album_id: str, sha256: str) -> PhotographRecord | None:
        """Return the photograph with a digest, regardless of tenant; None without one."""
        own = ALBUM_PHOTOGRAPHS.c.album_id == album_id, ALBUM_PHOTOGRAPHS.c.sha256 == sha256
        row = self._database.row(select_photographs(*own))
        return None if row is None else PhotographRecord(**row._mapping)

    def add_photograph(
        self, tenant: str, album_id: str, new: NewPhotograph, *, ttl_s: float, limit: int
    ) -> tuple[PhotographRecord, bool]:
        """Add a photograph to an album, which then lives for `ttl_s` (s), unless it has the same picture already.

        Returns:
            the photograph, and True if it was added.
        """
        now, columns = datetime.now(UTC), ALBUM_PHOTOGRAPHS.c
        with self._database.writing(grows_by=new.stored_bytes) as connection:
            album = lock_album(connection, tenant, album_id, now)
            own = columns.album_id == album_id
            row = connection.execute(select_photographs(own, columns.sha256 == new.sha256)).one_or_none()
            if row is not None:
                return PhotographRecord(**row._mapping), False
            if album.photographs >= limit:
                raise TooManyPhotographsError(album_id, limit)
            last = connection.scalar(select(func.max(columns.number)).where(own)) or 0
            values = vars(new) | {
                "id": uuid.uuid4().hex,
                "album_id": album_id,
                "number": last + 1,
                "revision_id": uuid.uuid4().hex,
                "created_at": now,
                "stored_bytes": new.stored_bytes,
            }
            connection.execute(ALBUM_PHOTOGRAPHS.insert().values(values))
            change_album(connection, album, 1, now, now + timedelta(seconds=ttl_s))
            self._quota.settle(connection, tenant, StoredBytes(albums=new.stored_bytes))
            return find_photograph(connection, album_id, values["id"]), True

    def correct(
        self,
        tenant: str,
        album_id: str,
        photograph_id: str,
        correction: str | None,
        *,
        ttl_s: float,
        expected: str | None = None,
    ) -> PhotographRecord:
        """Store the correction of a photograph as JSON; None undoes it."""
        now = datetime.now(UTC)
        with self._database.writing() as connection:
            album = lock_album(connection, tenant, album_id, now)
            found = find_photograph(connection, album_id, photograph_id)
            _check_revision(found, expected)
            if found.correction == correction:
                return found
            values = {"correction": correction, "revision_id": uuid.uuid4().hex}
            own = ALBUM_PHOTOGRAPHS.c.id == photograph_id
            connection.execute(update(ALBUM_PHOTOGRAPHS).where(own).values(**values))
            change_album(connection, album, 0, now, now + timedelta(seconds=ttl_s))
            return find_photograph(connection, album_id, photograph_id)

    def delete_photograph(
        self, tenant: str, album_id: str, photograph_id: str, *, ttl_s: float, expected: str | None = None
    ) -> None:
        """Delete a photograph; the rest is solved again."""

        def work(connection: Connection) -> None:
            now = datetime.now(UTC)
            album = lock_album(connection, tenant, album_id, now)
            _check_revision(find_photograph(connection, album_id, photograph_id), expected)
            own = ALBUM_PHOTOGRAPHS.c.id == photograph_id
            freed = deleted_bytes(connection, delete(ALBUM_PHOTOGRAPHS).where(own))
            change_album(connection, album, -1, now, now + timedelta(seconds=ttl_s))
            self._quota.settle(connection, tenant, StoredBytes(albums=-freed))

        self._database.freeing(work)


def _check_revision(found: PhotographRecord, expected: str | None) -> None:
    if expected not in (None, found.revision_id):
        raise RevisionMismatchError(found.id, expected, found.revision_id, what="photograph")
