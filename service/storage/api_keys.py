"""API keys, stored as hashes."""

from __future__ import annotations

import uuid
from collections.abc import Collection
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Row, select, update

from service.storage.database import Database
from service.storage.records import ApiKey
from service.storage.tables import API_KEYS


class ApiKeys:
    """API keys of all tenants, including revoked ones."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(
        self, tenant: str, name: str, key_hash: str, scopes: Collection[str], *, rate_per_minute: int | None = None
    ) -> ApiKey:
        """Store a new key by the hash of its secret."""
        values = {
            "id": uuid.uuid4().hex,
            "tenant": tenant,
            "name": name,
            "hash": key_hash,
            "scopes": " ".join(sorted(set(scopes))),
            "rate_per_minute": rate_per_minute,
            "created_at": datetime.now(UTC),
        }
        with self._database.writing() as connection:
            return _key(connection.execute(API_KEYS.insert().values(**values).returning(API_KEYS)).one())

    def list_keys(self, tenant: str | None = None) -> list[ApiKey]:
        """Return the keys of one tenant or of all, oldest first."""
        query = select(API_KEYS).order_by(API_KEYS.c.created_at, API_KEYS.c.id)
        if tenant is not None:
            query = query.where(API_KEYS.c.tenant == tenant)
        with self._database.reading() as connection:
            return [_key(row) for row in connection.execute(query)]

    def revoke(self, key_id: str) -> bool:
        """Revoke a key for good; False if it does not exist or was revoked before."""
        statement = update(API_KEYS).where(API_KEYS.c.id == key_id, API_KEYS.c.revoked_at.is_(None))
        with self._database.writing() as connection:
            return connection.execute(statement.values(revoked_at=datetime.now(UTC))).rowcount == 1

    def find(self, key_hash: str) -> ApiKey | None:
        """Return the key with this hash, unless it was revoked."""
        query = select(API_KEYS).where(API_KEYS.c.hash == key_hash, API_KEYS.c.revoked_at.is_(None))
        with self._database.reading() as connection:
            row = connection.execute(query).one_or_none()
        return None if row is None else _key(row)

    def touch(self, key_id: str) -> None:
        """Record that a key is in use; callers do so at intervals, not for every request."""
        statement = update(API_KEYS).where(API_KEYS.c.id == key_id).values(last_used_at=datetime.now(UTC))
        with self._database.writing() as connection:
            connection.execute(statement)


def _key(row: Row[Any]) -> ApiKey:
    return ApiKey(
        id=row.id,
        tenant=row.tenant,
        name=row.name,
        scopes=frozenset(row.scopes.split()),
        rate_per_minute=row.rate_per_minute,
        created_at=row.created_at,
        revoked_at=row.revoked_at,
        last_used_at=row.last_used_at,
    )
