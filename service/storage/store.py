"""The store: one object per group of tables of the database. Opening it migrates the schema."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path
from time import monotonic

from alembic.migration import MigrationContext
from alembic.operations import Operations
from alembic.script import ScriptDirectory
from alembic.script.revision import RevisionError
from alembic.util import CommandError
from sqlalchemy import text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from lalaloc_core.errors import ConfigError
from lalaloc_core.floorplan import FloorPlan
from service.capacity.threads import BoundedReads
from service.errors import StoreBusyError, StoreUnavailableError, UnknownFloorPlanError, UnknownVenueError
from service.settings import Settings
from service.storage.album_jobs import AlbumJobs
from service.storage.albums import Albums
from service.storage.api_keys import ApiKeys, Tenants
from service.storage.audit_log import AuditLog
from service.storage.database import CircuitBreaker, Database
from service.storage.kept_answers import MIN_LEASE_S, IdempotencyKeys, KeptAnswers
from service.storage.plan_rows import Originals, PlanCache
from service.storage.plans import Plans
from service.storage.records import PlanRecord, VenueRecord
from service.storage.sessions import Sessions
from service.storage.stored_bytes import StorageQuota
from service.storage.stored_grids import GridLeases, StoredGrids
from service.storage.venue_imports import VenueImports
from service.storage.venues import Venues

# Margin (s) of the lease of an idempotency key over the query timeout.
_CLAIM_MARGIN_S = 5.0
# Default limit of a tenant's stored bytes.
_STORED_BYTES = 10 * 2**30
# Plans or venues per read when a tenant is purged.
_PURGED_AT_ONCE = 100
_MIGRATIONS = Path(__file__).parent / "migrations"
# Advisory lock on PostgreSQL.
_MIGRATION_LOCK = 5_210_001


class Store:
    """All stored data; safe to share between threads and between processes.

    Every call can raise `StoreUnavailableError`; the next call reconnects.

    Attributes:
        originals: uploaded files of the plans.
        venue_imports: venues that are stored together with their plans.
        leases: leases on the computation of grids.
        album_jobs: leases on the solution of albums.
        quota: stored bytes of tenants.
        tenants: the operator's limits per tenant.
    """

    def __init__(
        self,
        url: str,
        *,
        connections: int = 8,
        wait_s: float = 2.0,
        claim_s: float = MIN_LEASE_S,
        plan_cache_bytes: int = 64 * 2**20,
        stored_bytes: int = _STORED_BYTES,
        idempotency_bytes: int = 64 * 2**20,
        audit_keep_s: float = 365 * 86400.0,
        max_audit_entries: int = 10**6,
    ) -> None:
        """Connect, and migrate the schema.

        The arguments are settings, see `open_store`. `claim_s` (s) is the lease of an idempotency key or session while
        its request runs, `stored_bytes` the limit of a tenant without a limit of its own.
        """
        try:
            database = Database(url, connections=connections, wait_s=wait_s)
            _migrate(database)
        except (ArgumentError, CommandError, RevisionError, ImportError, OSError, SQLAlchemyError) as error:
            reason = str(getattr(error, "orig", None) or error).strip()
            raise ConfigError(
                f"cannot open the database (LALALOC_DATABASE_URL): {reason}; if its file is damaged, restore a backup"
            ) from error
        self.database = database
        self.plan_cache = PlanCache(plan_cache_bytes)
        self.quota = StorageQuota(database, stored_bytes)
        self.plans = Plans(database, self.plan_cache, self.quota)
        self.originals = Originals(database)
        self.venues = Venues(database, self.quota)
        self.venue_imports = VenueImports(database, self.plan_cache, self.quota)
        self.grids = StoredGrids(database, self.quota)
        self.leases = GridLeases(database)
        self.idempotency_keys = IdempotencyKeys(database, self.quota, claim_s, max_bytes=idempotency_bytes)
        self.keys = ApiKeys(database)
        self.audit_log = AuditLog(database, keep_s=audit_keep_s, max_entries=max_audit_entries)
        self.answers = KeptAnswers(database, self.quota)
        self.sessions = Sessions(database, self.quota, claim_s)
        self.albums = Albums(database, self.quota)
        self.album_jobs = AlbumJobs(database)
        self.tenants = Tenants(database)

    def purge_tenant(self, tenant: str) -> int:
        """Delete all that a tenant stored, but not its API keys and limits, and return the number of plans.

        Each plan and venue is deleted in a transaction of its own, so that other tenants do not wait.
        """
        count = 0
        while plans := self.plans.list_plans(tenant, limit=_PURGED_AT_ONCE):
            count += sum(self.plans.delete(tenant, plan.id) for plan in plans)
        while venues := self.venues.list_venues(tenant, limit=_PURGED_AT_ONCE):
            for venue in venues:
                self.venues.delete(tenant, venue.id)
        self.idempotency_keys.delete_all(tenant)
        return count

    def close(self) -> None:
        """Close all connections."""
        self.database.close()


def open_store(settings: Settings) -> Store:
    """Open the configured database; the data folder of SQLite is created if it is missing."""
    if settings.database.url is None:
        try:
            settings.data_dir.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"cannot create the data folder '{settings.data_dir}': {error.strerror}") from error
    return Store(
        settings.database_url,
        connections=settings.database.connections,
        wait_s=settings.database.wait_s,
        # The lease outlasts a query, so that a running query is not started again.
        claim_s=max(MIN_LEASE_S, settings.requests.request_deadline_s + _CLAIM_MARGIN_S),
        plan_cache_bytes=settings.storage.plan_cache_bytes,
        stored_bytes=settings.storage.max_stored_bytes or _default_stored_bytes(settings),
        idempotency_bytes=settings.storage.max_idempotency_bytes,
        audit_keep_s=settings.storage.audit_keep_s,
        max_audit_entries=settings.storage.max_audit_entries,
    )


def _default_stored_bytes(settings: Settings) -> int:
    """Return the default limit of a tenant's stored bytes: with SQLite, no tenant can fill the volume alone."""
    path = make_url(settings.database_url).database
    if settings.database_url.startswith("sqlite") and path and (folder := Path(path).absolute().parent).is_dir():
        return min(_STORED_BYTES, shutil.disk_usage(folder).total // 2)
    return _STORED_BYTES


@cache
def _migrations() -> ScriptDirectory:
    return ScriptDirectory(str(_MIGRATIONS))


def _migrate(database: Database) -> None:
    """Run the missing migrations in one transaction; replicas that start together take turns."""
    script = _migrations()
    head = script.get_current_head()
    assert head is not None
    with database.engine_for_writing.begin() as connection:
        # On SQLite the transaction is the lock, because it begins as a writer.
        if database.is_postgresql:
            connection.execute(text("SET LOCAL statement_timeout = 0"))
            connection.execute(text("SET LOCAL lock_timeout = '60s'"))
            connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": _MIGRATION_LOCK})
        context = MigrationContext.configure(connection)
        current = context.get_current_revision()
        steps = reversed(list(script.iterate_revisions(head, current or "base")))
        with Operations.context(context):
            for step in steps:
                step.module.upgrade()
                context.stamp(script, step.revision)


class PlanLookup:
    """Lookup of plans and venues for queries; safe to share between threads."""

    def __init__(self, store: Store, *, max_age_s: float) -> None:
        self._store, self._max_age_s = store, max_age_s
        self._breaker = CircuitBreaker()

    async def find(self, tenant: str, plan_id: str, reads: BoundedReads) -> PlanRecord | None:
        """Return a plan at its current revision, or at one read recently while the database is unavailable."""
        if self._breaker.is_open and (known := self._recent(tenant, plan_id)) is not None:
            return known
        begin_s = monotonic()
        try:
            found = await reads.run(tenant, self._store.plans.find, tenant, plan_id)
        except StoreUnavailableError as error:
            if isinstance(error, StoreBusyError) or self._store.database.answered_since(begin_s):
                # The database answers, so the plan may have been deleted.
                raise
            self._breaker.trip()
            if (known := self._recent(tenant, plan_id)) is None:
                raise
            return known
        if found is None or isinstance(found.plan, FloorPlan):
            return None if found is None else self._store.plans.record(found)
        # On a thread of the tenant.
        return await reads.process(tenant, self._store.plans.record, found)

    async def place(
        self, tenant: str, plan_id: str | None, venue_id: str | None, reads: BoundedReads
    ) -> PlanRecord | VenueRecord:
        """Return a venue, or, without its id, a plan as `find` does."""
        if venue_id is not None:
            venue = await reads.run(tenant, self._store.venues.get, tenant, venue_id)
            if venue is None:
                raise UnknownVenueError(venue_id)
            return venue
        assert plan_id is not None
        record = await self.find(tenant, plan_id, reads)
        if record is None:
            raise UnknownFloorPlanError(plan_id)
        return record

    def _recent(self, tenant: str, plan_id: str) -> PlanRecord | None:
        return self._store.plan_cache.recent(tenant, plan_id, self._max_age_s)
