"""API keys, stored as hashes, and the operator's limits of tenants."""

from __future__ import annotations

import uuid
from collections.abc import Collection
from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import Row, or_, select, update

from service.storage.database import Database
from service.storage.records import ApiKey, Cursor, OperatorLimits
from service.storage.statements import newest_first
from service.storage.tables import API_KEYS, TENANTS


class ApiKeys:
    """API keys of all tenants, including revoked ones."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(
        self,
        tenant: str,
        name: str,
        key_hash: str,
        scopes: Collection[str],
        *,
        rate_per_minute: int | None = None,
        lifetime: timedelta | None = None,
    ) -> ApiKey:
        """Store a new key by the hash of its secret; without a lifetime it has no end."""
        now = datetime.now(UTC)
        values = {
            "id": uuid.uuid4().hex,
            "tenant": tenant,
            "name": name,
            "hash": key_hash,
            "scopes": " ".join(sorted(set(scopes))),
            "rate_per_minute": rate_per_minute,
            "created_at": now,
            "expires_at": None if lifetime is None else now + lifetime,
            "lifetime_s": None if lifetime is None else lifetime.total_seconds(),
        }
        with self._database.writing() as connection:
            return _key(connection.execute(API_KEYS.insert().values(**values).returning(API_KEYS)).one())

    def rotate(self, key_id: str, key_hash: str, *, overlap: timedelta) -> ApiKey | None:
        """Store a successor with the same tenant, name, scopes, rate and lifetime; None without a valid key.

        Both keys are valid for the overlap, unless the replaced one expires before.
        """
        now = datetime.now(UTC)
        alive = or_(API_KEYS.c.expires_at.is_(None), API_KEYS.c.expires_at > now)
        wanted = select(API_KEYS).where(API_KEYS.c.id == key_id, API_KEYS.c.revoked_at.is_(None), alive)
        with self._database.writing() as connection:
            row = connection.execute(wanted.with_for_update()).one_or_none()
            if row is None:
                return None
            end = now + overlap if row.expires_at is None else min(now + overlap, row.expires_at)
            connection.execute(update(API_KEYS).where(API_KEYS.c.id == key_id).values(expires_at=end))
            values = {name: getattr(row, name) for name in ("tenant", "name", "scopes", "rate_per_minute")}
            values |= {"id": uuid.uuid4().hex, "hash": key_hash, "created_at": now, "replaces": key_id}
            if row.lifetime_s is not None:
                values |= {"lifetime_s": row.lifetime_s, "expires_at": now + timedelta(seconds=row.lifetime_s)}
            return _key(connection.execute(API_KEYS.insert().values(**values).returning(API_KEYS)).one())

    def list_keys(self, tenant: str | None = None) -> list[ApiKey]:
        """Return the keys of one tenant or of all, oldest first."""
        query = select(API_KEYS).order_by(API_KEYS.c.created_at, API_KEYS.c.id)
        if tenant is not None:
            query = query.where(API_KEYS.c.tenant == tenant)
        return [_key(row) for row in self._database.rows(query)]

    def page(self, *, limit: int, after: Cursor | None, tenant: str | None) -> list[ApiKey]:
        """Return a page of the keys, newest first; arguments as of `newest_first`."""
        query = select(API_KEYS) if tenant is None else select(API_KEYS).where(API_KEYS.c.tenant == tenant)
        rows = self._database.rows(newest_first(query, API_KEYS, limit=limit, after=after))
        return [_key(row) for row in rows]

    def revoke(self, key_id: str) -> ApiKey | None:
        """Revoke a key for good; None if it does not exist or was revoked before."""
        statement = update(API_KEYS).where(API_KEYS.c.id == key_id, API_KEYS.c.revoked_at.is_(None))
        with self._database.writing() as connection:
            revoked = statement.values(revoked_at=datetime.now(UTC)).returning(API_KEYS)
            row = connection.execute(revoked).one_or_none()
        return None if row is None else _key(row)

    def get(self, key_id: str) -> ApiKey | None:
        """Return a key in any state; None if it does not exist."""
        row = self._database.row(select(API_KEYS).where(API_KEYS.c.id == key_id))
        return None if row is None else _key(row)

    def find(self, key_hash: str) -> ApiKey | None:
        """Return the key with this hash, unless it was revoked; callers check its end."""
        query = select(API_KEYS).where(API_KEYS.c.hash == key_hash, API_KEYS.c.revoked_at.is_(None))
        row = self._database.row(query)
        return None if row is None else _key(row)

    def touch(self, key_id: str) -> None:
        """Record that a key is in use; callers do so at intervals, not for every request."""
        statement = update(API_KEYS).where(API_KEYS.c.id == key_id).values(last_used_at=datetime.now(UTC))
        with self._database.writing() as connection:
            connection.execute(statement)


def _key(row: Row[Any]) -> ApiKey:
    values = {name: getattr(row, name) for name in ApiKey.__dataclass_fields__ if name != "scopes"}
    return ApiKey(**values, scopes=frozenset(row.scopes.split()))


# Column of each attribute of `OperatorLimits`.
_LIMITS = {
    "stored_bytes": TENANTS.c.max_stored_bytes,
    "bytes_in_flight": TENANTS.c.max_bytes_in_flight,
    "cpu_share": TENANTS.c.cpu_share,
}
_NO_LIMITS = OperatorLimits()


class Tenants:
    """The operator's limits, in the database, and in memory as of the last `refresh`."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._limits: dict[str, OperatorLimits] = {}

    def of(self, tenant: str) -> OperatorLimits:
        """Return the limits of a tenant in memory, without waiting; attributes are None without a limit of its own."""
        return self._limits.get(tenant, _NO_LIMITS)

    def refresh(self) -> None:
        """Read the limits into memory; `Sweeper` calls this every 5 s.

        Without the database, the limits of before stay.
        """
        self._limits = self.limits()

    def limits(self, among: Collection[str] | None = None) -> dict[str, OperatorLimits]:
        """Return the limits of the tenants that have any, of all tenants or of some."""
        query = select(TENANTS).where(or_(*(column.is_not(None) for column in _LIMITS.values())))
        if among is not None:
            query = query.where(TENANTS.c.tenant.in_(among))
        return {row.tenant: _limits(row) for row in self._database.rows(query)}

    def change_limits(self, tenant: str, **limits: float | None) -> OperatorLimits:
        """Change limits of a tenant, and return all of them.

        The tenant need not have stored anything yet; None sets the limit in the settings, and others stay.
        """
        values = {_LIMITS[name].name: value for name, value in limits.items()}
        statement = self._database.insert(TENANTS).values(tenant=tenant, **values)
        # The tenant's name among the values, because PostgreSQL refuses an empty list.
        statement = statement.on_conflict_do_update(index_elements=["tenant"], set_=values | {"tenant": tenant})
        with self._database.writing() as connection:
            return _limits(connection.execute(statement.returning(TENANTS)).one())


def _limits(row: Row[Any]) -> OperatorLimits:
    return OperatorLimits(**{name: getattr(row, column.name) for name, column in _LIMITS.items()})
