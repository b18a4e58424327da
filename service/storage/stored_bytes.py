"""Stored bytes of tenants: their definition, counters in the database, and the quota.

A write settles its change last in its transaction: the counters stay exact under concurrency, and the tenant's row is
locked only briefly. The same order everywhere, plans and venues before tenants, avoids deadlocks.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Self

from sqlalchemy import ColumnElement, Connection, Delete, Row, Table, delete, func, select, update

from service.errors import StorageQuotaError
from service.storage.database import Database
from service.storage.tables import (
    ALBUM_PHOTOGRAPHS,
    ALBUMS,
    FLOORPLANS,
    IDEMPOTENCY,
    KEPT_ANSWERS,
    LATENT_GRIDS,
    REVISIONS,
    SESSIONS,
    TENANTS,
    VENUE_PLANS,
    VENUES,
)

# Estimated size of a row with its ids and index entries.
ROW_BYTES = 512


@dataclass(frozen=True, kw_only=True)
class StoredBytes:
    """Stored bytes of a tenant, or a change of them.

    Attributes:
        plans: plans with their uploaded files and reports, all revisions.
        grids: pose grids and prototypes.
        venues: venues and the rows of their plans.
        albums: albums and their photographs.
        idempotency: idempotency keys and their answers.
    """

    plans: int = 0
    grids: int = 0
    venues: int = 0
    answers: int = 0
    sessions: int = 0
    albums: int = 0
    idempotency: int = 0

    @property
    def total(self) -> int:
        """The sum of all kinds."""
        return sum(asdict(self).values())

    def __sub__(self, freed: StoredBytes) -> Self:
        return replace(self, **{name: value - getattr(freed, name) for name, value in asdict(self).items()})


@dataclass(frozen=True)
class Account:
    """Stored bytes of a tenant with their limit; `own_limit` if the operator set it for this tenant."""

    used: StoredBytes
    limit: int
    own_limit: bool = False

    def check(self, growth: int) -> None:
        """Check that a tenant can store more bytes, which `used` does not contain."""
        if growth > 0 and self.used.total + growth > self.limit:
            setting = "`lalaloc-service tenants limit`" if self.own_limit else "LALALOC_MAX_STORED_BYTES"
            raise StorageQuotaError(self.used.total, growth, self.limit, setting)


class StorageQuota:
    """Counters of stored bytes, and their limits."""

    def __init__(self, database: Database, default_bytes: int) -> None:
        self._database = database
        # Limit of tenants without one of their own.
        self._default_bytes = default_bytes

    def account(self, tenant: str) -> Account:
        """Return the stored bytes of a tenant."""
        with self._database.reading() as connection:
            return self._find(connection, tenant)

    def accounts(self, *, after: str = "", limit: int | None = None) -> dict[str, Account]:
        """Return the stored bytes of the tenants that stored anything or have limits, by name from `after` on."""
        query = select(TENANTS).where(TENANTS.c.tenant > after).order_by(TENANTS.c.tenant).limit(limit)
        return {row.tenant: self._account(row) for row in self._database.rows(query)}

    def check(self, connection: Connection, tenant: str, growth: int) -> None:
        """Check early that a write fits, before it writes much; only `settle` is exact."""
        self._find(connection, tenant).check(growth)

    def settle(
        self,
        connection: Connection,
        tenant: str,
        change: StoredBytes,
        *,
        refuse: bool = True,
        changed_plan: str | None = None,
    ) -> Account:
        """Count a change in the last call of its transaction, and return the tenant's account after it.

        A growth beyond the limit rolls the transaction back, unless `refuse` is off. `changed_plan` is the id of a plan
        whose row the transaction has locked, and whose revision, grid or failure it changed: the plan gets the number
        of this change. Numbers rise in the order of the commits, as the tenant's row stays locked until then.
        """
        counted = {_column(name): value for name, value in asdict(change).items() if value}
        searched_bytes = change.plans + change.grids + change.venues
        if changed_plan is not None or change.plans or change.grids or change.venues:
            counted |= {"changes": 1, "counted_bytes": searched_bytes}
        statement = self._database.insert(TENANTS).values(tenant=tenant, **counted)
        sums = {name: TENANTS.c[name] + value for name, value in counted.items()}
        # The tenant's name among the values, because PostgreSQL refuses an empty list.
        statement = statement.on_conflict_do_update(index_elements=["tenant"], set_=sums | {"tenant": tenant})
        row = connection.execute(statement.returning(TENANTS)).one()
        account = self._account(row)
        if refuse:
            replace(account, used=account.used - change).check(change.total)
        if changed_plan is not None:
            own = update(FLOORPLANS).where(FLOORPLANS.c.id == changed_plan)
            connection.execute(own.values(changed=row.changes))
        return account

    def purge(self, kind: str, table: Table, condition: ColumnElement[bool]) -> int:
        """Delete rows of a kind, of any tenants, and return their number."""
        statement = delete(table).where(condition)

        def work(connection: Connection) -> int:
            rows = connection.execute(statement.returning(table.c.tenant, table.c.stored_bytes)).all()
            freed = Counter[str]()
            for row in rows:
                freed[row.tenant] += row.stored_bytes
            # In the same order everywhere, to avoid deadlocks.
            for tenant in sorted(freed):
                self.settle(connection, tenant, StoredBytes(**{kind: -freed[tenant]}))
            return len(rows)

        return self._database.freeing(work)

    def recount(self) -> None:
        """Count everything again: earlier versions of the service, running beside, change the tables uncounted."""
        tables = (FLOORPLANS, VENUES, KEPT_ANSWERS, SESSIONS, ALBUMS, IDEMPOTENCY, TENANTS)
        with self._database.reading() as connection:
            tenants = {name for table in tables for name in connection.scalars(select(table.c.tenant).distinct())}
        for tenant in sorted(tenants):
            with self._database.writing() as connection:
                # Locks the tenant's row: a write that is not yet settled adds its change afterwards.
                self.settle(connection, tenant, StoredBytes(), refuse=False)
                counted = {_column(name): value for name, value in asdict(_count(connection, tenant)).items()}
                connection.execute(update(TENANTS).where(TENANTS.c.tenant == tenant).values(**counted))

    def _find(self, connection: Connection, tenant: str) -> Account:
        row = connection.execute(select(TENANTS).where(TENANTS.c.tenant == tenant)).one_or_none()
        return Account(StoredBytes(), self._default_bytes) if row is None else self._account(row)

    def _account(self, row: Row[Any]) -> Account:
        used = StoredBytes(**{field.name: getattr(row, _column(field.name)) for field in fields(StoredBytes)})
        if row.max_stored_bytes is None:
            return Account(used, self._default_bytes)
        return Account(used, row.max_stored_bytes, own_limit=True)


def deleted_bytes(connection: Connection, statement: Delete) -> int:
    """Delete rows of a table with `stored_bytes`, and return their sum, which is exact under concurrency."""
    table = statement.table
    assert isinstance(table, Table)
    return sum(connection.scalars(statement.returning(table.c.stored_bytes)))


def _column(kind: str) -> str:
    return f"{kind}_bytes"


def _count(connection: Connection, tenant: str) -> StoredBytes:
    own_plans = FLOORPLANS.join(REVISIONS, REVISIONS.c.plan_id == FLOORPLANS.c.id)
    own_grids = own_plans.join(LATENT_GRIDS, LATENT_GRIDS.c.revision_id == REVISIONS.c.id)
    own_photographs = ALBUMS.join(ALBUM_PHOTOGRAPHS, ALBUM_PHOTOGRAPHS.c.album_id == ALBUMS.c.id)
    own_members = VENUES.join(VENUE_PLANS, VENUE_PLANS.c.venue_id == VENUES.c.id)

    def total(summed: Any, source: Any, owner: Any) -> int:
        # PostgreSQL returns sums as decimals.
        return int(connection.scalar(select(summed).select_from(source).where(owner == tenant)) or 0)

    of_plan, of_venue = FLOORPLANS.c.tenant, VENUES.c.tenant
    venue_rows = total(func.count(), VENUES, of_venue) + total(func.count(), own_members, of_venue)
    return StoredBytes(
        plans=total(func.sum(REVISIONS.c.stored_bytes), own_plans, of_plan),
        grids=total(func.sum(LATENT_GRIDS.c.stored_bytes), own_grids, of_plan),
        venues=ROW_BYTES * venue_rows,
        answers=total(func.sum(KEPT_ANSWERS.c.stored_bytes), KEPT_ANSWERS, KEPT_ANSWERS.c.tenant),
        sessions=total(func.sum(SESSIONS.c.stored_bytes), SESSIONS, SESSIONS.c.tenant),
        albums=total(func.sum(ALBUMS.c.stored_bytes), ALBUMS, ALBUMS.c.tenant)
        + total(func.sum(ALBUM_PHOTOGRAPHS.c.stored_bytes), own_photographs, ALBUMS.c.tenant),
        idempotency=total(func.sum(IDEMPOTENCY.c.stored_bytes), IDEMPOTENCY, IDEMPOTENCY.c.tenant),
    )
