"""Rows of albums and of their photographs, as values."""

from __future__ import annotations

import uuid
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from sqlalchemy import ColumnElement, Connection, and_, delete, exists, func, or_, select, update

from service.errors import AlbumOutdatedError, RevisionMismatchError, UnknownAlbumError, UnknownAlbumPhotographError
from service.storage.stored_bytes import ROW_BYTES, deleted_bytes
from service.storage.tables import ALBUM_PHOTOGRAPHS, ALBUMS, FLOORPLANS, VENUE_PLANS, VENUES

AlbumState = Literal["empty", "solving", "solved", "failed", "outdated"]
# Bytes that count as stored for a correction and a pin with all its rooms and suggestions, and for the common part of a
# solution, whatever their size: a solve changes nothing that counts.
_PIN_BYTES, _SOLUTION_BYTES = 4096, 2048
# Columns of `PhotographRecord`: all but these.
_UNLISTED = ("album_id", "entry", "evidence", "stored_bytes")
_LISTED = [column for column in ALBUM_PHOTOGRAPHS.c if column.name not in _UNLISTED]
# Values of an album whose lease nobody holds.
NO_LEASE: dict[str, Any] = {"owner": "", "lease_until_s": 0.0, "progress": 0.0, "attempts": 0}


@dataclass(frozen=True, kw_only=True)
class NewAlbum:
    """Album that is stored.

    Attributes:
        plan_id, venue_id: id of its plan, or of its venue; the other one is None.
        options: the request that creates it, as JSON.
        model_sha256: digest of the model that encodes its photographs.
    """

    name: str
    plan_id: str | None
    venue_id: str | None
    options: str
    model_sha256: str


@dataclass(frozen=True, kw_only=True)
class AlbumRecord(NewAlbum):
    """Stored album.

    Attributes:
        revision_id: id of its revision, which changes with the photographs and their corrections.
        number: number of the revision, from 1.
        solved_number: number of the revision that was solved last; 0 before.
        place_revision_id: revision of the plan or venue that it was solved in; None before.
        solution: common part of the solution, as JSON.
        failure: reason why it could not be solved.
        progress: share of the solution that is done, while it is computed.
        due: it is to be solved again.
    """

    id: str
    tenant: str
    revision_id: str
    number: int
    created_at: datetime
    updated_at: datetime
    expires_at: datetime
    photographs: int
    solved_number: int
    place_revision_id: str | None
    solution: str | None
    failure: str | None
    progress: float
    due: bool

    def state(self, model_sha256: str) -> AlbumState:
        """Return the state of the album for a model that runs now."""
        if self.model_sha256 != model_sha256:
            return "outdated"
        if self.photographs == 0:
            return "empty"
        if self.due:
            return "solving"
        return "solved" if self.failure is None else "failed"

    def check_model(self, model_sha256: str) -> None:
        """Check that the running model encoded the album's photographs."""
        if self.model_sha256 != model_sha256:
            raise AlbumOutdatedError(self.id)


@dataclass(frozen=True, kw_only=True)
class NewPhotograph:
    """Photograph that is added to an album.

    Attributes:
        name: name of the file; None if the client sent none.
        facts: size, time and camera, as JSON.
        entry: features, as `lalaloc_core.localise.album` writes them.
    """

    sha256: str
    name: str | None
    facts: str
    entry: bytes

    @property
    def stored_bytes(self) -> int:
        """Bytes that count as stored."""
        texts = len(self.facts.encode()) + len((self.name or "").encode())
        return ROW_BYTES + _PIN_BYTES + len(self.entry) + texts


@dataclass(frozen=True, kw_only=True)
class PhotographRecord:
    """Stored photograph of an album, without its features.

    Attributes:
        number: position in the album, from 1, in the order of uploads.
        revision_id: id of its revision, which changes with the correction.
        correction, pin: as JSON; None without.
    """

    id: str
    number: int
    sha256: str
    revision_id: str
    name: str | None
    created_at: datetime
    facts: str
    correction: str | None
    pin: str | None


def album_bytes(new: NewAlbum) -> int:
    """Return the bytes of an album without its photographs that count as stored."""
    return ROW_BYTES + _SOLUTION_BYTES + len(new.options.encode()) + len(new.name.encode())


def select_albums() -> Any:
    """Return a query for the columns of `AlbumRecord`."""
    names = [name for name in AlbumRecord.__dataclass_fields__ if name != "due"]
    return select(*(ALBUMS.c[name] for name in names), is_due().label("due"))


def is_due() -> ColumnElement[bool]:
    """Return the condition that an album is to be solved: it, its plan or a plan of its venue has changed."""
    albums, plans = ALBUMS.c, FLOORPLANS.c
    plan_now = select(plans.revision_id).where(plans.id == albums.plan_id).scalar_subquery()
    venue_now = select(VENUES.c.revision_id).where(VENUES.c.id == albums.venue_id).scalar_subquery()
    changed = exists().where(
        plans.tenant == albums.tenant,
        plans.changed > albums.place_change,
        VENUE_PLANS.c.plan_id == plans.id,
        VENUE_PLANS.c.venue_id == albums.venue_id,
    )
    moved = or_(
        albums.place_revision_id.is_(None), albums.place_revision_id != func.coalesce(plan_now, venue_now), changed
    )
    return and_(albums.photographs > 0, or_(albums.solved_number < albums.number, moved))


def find_album(connection: Connection, tenant: str, album_id: str, now: datetime) -> AlbumRecord:
    """Return an album."""
    own = ALBUMS.c.id == album_id, ALBUMS.c.tenant == tenant, ALBUMS.c.expires_at >= now
    row = connection.execute(select_albums().where(*own)).one_or_none()
    if row is None:
        raise UnknownAlbumError(album_id)
    return AlbumRecord(**row._mapping)


def lock_album(
    connection: Connection, tenant: str, album_id: str, now: datetime, expected: str | None = None
) -> AlbumRecord:
    """Lock an album until the transaction ends, and return it."""
    connection.execute(select(ALBUMS.c.id).where(ALBUMS.c.id == album_id).with_for_update())
    found = find_album(connection, tenant, album_id, now)
    if expected not in (None, found.revision_id):
        raise RevisionMismatchError(album_id, expected, found.revision_id, what="album")
    return found


def change_album(connection: Connection, album: AlbumRecord, photographs: int, now: datetime, until: datetime) -> None:
    """Store a new revision of a locked album, which is solved again; `photographs` is added to their number."""
    values = {
        "revision_id": uuid.uuid4().hex,
        "number": album.number + 1,
        "updated_at": now,
        "expires_at": until,
        "photographs": album.photographs + photographs,
        "failure": None,
        "attempts": 0,
    }
    connection.execute(update(ALBUMS).where(ALBUMS.c.id == album.id).values(**values))


def find_photograph(connection: Connection, album_id: str, photograph_id: str) -> PhotographRecord:
    """Return a photograph of an album."""
    own = ALBUM_PHOTOGRAPHS.c.album_id == album_id, ALBUM_PHOTOGRAPHS.c.id == photograph_id
    row = connection.execute(select_photographs(*own)).one_or_none()
    if row is None:
        raise UnknownAlbumPhotographError(album_id, photograph_id)
    return PhotographRecord(**row._mapping)


def select_photographs(*conditions: ColumnElement[bool]) -> Any:
    """Return a query for the columns of `PhotographRecord`, in the order of their numbers."""
    return select(*_LISTED).where(*conditions).order_by(ALBUM_PHOTOGRAPHS.c.number)


def delete_albums(connection: Connection, *conditions: ColumnElement[bool]) -> int:
    """Delete albums with their photographs, and return the freed bytes."""
    ids = select(ALBUMS.c.id).where(*conditions)
    # Locked first, so that no photograph is added in between.
    found = connection.scalars(ids.order_by(ALBUMS.c.id).with_for_update()).all()
    freed = deleted_bytes(connection, delete(ALBUM_PHOTOGRAPHS).where(ALBUM_PHOTOGRAPHS.c.album_id.in_(ids)))
    if not found:
        return freed
    return freed + deleted_bytes(connection, delete(ALBUMS).where(*conditions))
