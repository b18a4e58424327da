"""Uploaded files of plans, read in chunks: the whole files of many requests would fill the memory."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from sqlalchemy import select

from service.storage.database import Database
from service.storage.records import JSON
from service.storage.statements import damaged, read_chunks
from service.storage.tables import ORIGINAL_CHUNKS, REVISIONS


@dataclass(frozen=True)
class OriginalFile:
    """Uploaded file of a revision, without its content."""

    media_type: str
    size_bytes: int


class Originals:
    """Uploaded files of all tenants. Callers check access first."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def digest(self, revision_id: str) -> str | None:
        """Return the SHA-256 digest of a revision's file."""
        with self._database.reading() as connection:
            return connection.scalar(select(REVISIONS.c.original_sha256).where(REVISIONS.c.id == revision_id))

    def checked(self, revision_id: str) -> OriginalFile | None:
        """Compare a revision's file with its digest, and return the file."""
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
        return OriginalFile(row.original_media_type or JSON, size_bytes)

    def chunk(self, revision_id: str, number: int) -> bytes | None:
        """Return one chunk of a revision's file; None after the last, and if the revision was deleted."""
        own, place = ORIGINAL_CHUNKS.c.revision_id == revision_id, ORIGINAL_CHUNKS.c.number == number
        with self._database.reading() as connection:
            return connection.scalar(select(ORIGINAL_CHUNKS.c.content).where(own, place))
