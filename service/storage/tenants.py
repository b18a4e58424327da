"""Limits that the operator sets per tenant, in the database and in memory."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sqlalchemy import Row, or_, select

from service.storage.database import Database
from service.storage.records import OperatorLimits
from service.storage.tables import TENANTS

# Column of each attribute of `OperatorLimits`.
_LIMITS = {
    "stored_bytes": TENANTS.c.max_stored_bytes,
    "bytes_in_flight": TENANTS.c.max_bytes_in_flight,
    "cpu_share": TENANTS.c.cpu_share,
}
_NO_LIMITS = OperatorLimits()


class Tenants:
    """The operator's limits in the database."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def limits(self, among: Collection[str] | None = None) -> dict[str, OperatorLimits]:
        """Return the limits of the tenants that have any, of all tenants or of some."""
        query = select(TENANTS).where(or_(*(column.is_not(None) for column in _LIMITS.values())))
        if among is not None:
            query = query.where(TENANTS.c.tenant.in_(among))
        with self._database.reading() as connection:
            return {row.tenant: _limits(row) for row in connection.execute(query)}

    def change_limits(self, tenant: str, **limits: float | None) -> OperatorLimits:
        """Change limits of a tenant, and return all of them.

        Args:
            tenant: the tenant; it need not have stored anything yet.
            limits: new values by the names of `OperatorLimits`; None for the limit in the settings. Others stay.
        """
        values = {_LIMITS[name].name: value for name, value in limits.items()}
        statement = self._database.insert(TENANTS).values(tenant=tenant, **values)
        # The tenant's name among the values, because PostgreSQL refuses an empty list.
        statement = statement.on_conflict_do_update(index_elements=["tenant"], set_=values | {"tenant": tenant})
        with self._database.writing() as connection:
            return _limits(connection.execute(statement.returning(TENANTS)).one())


class TenantLimits:
    """The operator's limits in memory, as of the last `refresh`; reading them never waits."""

    def __init__(self, tenants: Tenants) -> None:
        self._tenants = tenants
        self._limits: dict[str, OperatorLimits] = {}

    def of(self, tenant: str) -> OperatorLimits:
        """Return the limits of a tenant; attributes are None without a limit of its own."""
        return self._limits.get(tenant, _NO_LIMITS)

    def refresh(self) -> None:
        """Read the limits; `Sweeper` calls this every `LALALOC_SWEEP_S`.

        Raises:
            StoreUnavailableError: the database is away; the limits of before stay.
        """
        self._limits = self._tenants.limits()


def _limits(row: Row[Any]) -> OperatorLimits:
    return OperatorLimits(**{name: getattr(row, column.name) for name, column in _LIMITS.items()})
