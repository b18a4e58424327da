"""Plans for queries, from the database, or from memory while the database does not answer."""

from __future__ import annotations

from time import monotonic

from service.errors import StoreBusyError, StoreUnavailableError
from service.storage.circuit_breaker import CircuitBreaker
from service.storage.records import PlanRecord
from service.storage.store import Store
from service.threads import BoundedReads


class PlanLookup:
    """Lookup of plans for queries; safe to share between threads."""

    def __init__(self, store: Store, *, max_age_s: float) -> None:
        """Create the lookup.

        Args:
            store: the store.
            max_age_s: maximum age (s) of a plan in memory since it was last read or stored.
        """
        self._store = store
        self._max_age_s = max_age_s
        self._breaker = CircuitBreaker()

    def get(self, tenant: str, plan_id: str) -> PlanRecord | None:
        """Return a plan at its current revision, or at the last known one while the database is unavailable.

        Raises:
            StoreUnavailableError: the database is unavailable, and the plan was not read recently.
            StoreBusyError: all connections are in use.
        """
        if (known := self._during_outage(tenant, plan_id)) is not None:
            return known
        try:
            return self._store.plans.get(tenant, plan_id)
        except StoreBusyError:
            # The database answers, so the plan may have been deleted.
            raise
        except StoreUnavailableError as error:
            return self._despite(error, tenant, plan_id)

    async def find(self, tenant: str, plan_id: str, reads: BoundedReads) -> PlanRecord | None:
        """Return a plan as `get` does, without blocking on a silent database.

        Args:
            tenant: owner of the plan.
            plan_id: id of the plan.
            reads: threads for reads of the database.

        Raises:
            StoreUnavailableError: see `get`; or too many reads wait already.
        """
        if (known := self._during_outage(tenant, plan_id)) is not None:
            return known
        begin_s = monotonic()
        try:
            return await reads.run(self.get, tenant, plan_id)
        except StoreUnavailableError as error:
            if self._store.answered_since(begin_s):
                # The database answers, so the plan may have been deleted.
                raise
            return self._despite(error, tenant, plan_id)

    def _during_outage(self, tenant: str, plan_id: str) -> PlanRecord | None:
        """Return a recently read plan from memory if the database failed a moment ago."""
        return self._recent(tenant, plan_id) if self._breaker.is_open else None

    def _despite(self, error: StoreUnavailableError, tenant: str, plan_id: str) -> PlanRecord:
        """Return a recently read plan, because the database failed.

        Raises:
            StoreUnavailableError: the plan was not read recently.
        """
        self._breaker.trip()
        if (known := self._recent(tenant, plan_id)) is None:
            raise error
        return known

    def _recent(self, tenant: str, plan_id: str) -> PlanRecord | None:
        return self._store.plan_cache.recent(tenant, plan_id, self._max_age_s)
