"""Plans as queries need them: as the database has them, and from memory while it is away or silent."""

from __future__ import annotations

from time import monotonic

from service.errors import StoreBusyError, StoreUnavailableError
from service.storage.circuit_breaker import CircuitBreaker
from service.storage.records import PlanRecord
from service.storage.store import Store
from service.threads import BoundedReads


class PlanLookup:
    """Finds plans for queries; safe to share between threads."""

    def __init__(self, store: Store, *, max_age_s: float) -> None:
        """Args:
        max_age_s: how long after it was last read, or stored from here, a plan in memory counts as known.
        """
        self._store = store
        self._max_age_s = max_age_s
        self._breaker = CircuitBreaker()

    def get(self, tenant: str, plan_id: str) -> PlanRecord | None:
        """A plan at its current revision; while the database is away, at the one that it last had.

        Raises:
            StoreUnavailableError: the database is away, and the plan was not read lately.
            StoreBusyError: too many use it.
        """
        if (known := self._during_outage(tenant, plan_id)) is not None:
            return known
        try:
            return self._store.plans.get(tenant, plan_id)
        except StoreBusyError:
            # It is there, and the plan may be gone.
            raise
        except StoreUnavailableError as error:
            return self._despite(error, tenant, plan_id)

    async def find(self, tenant: str, plan_id: str, reads: BoundedReads) -> PlanRecord | None:
        """As `get`, for whoever must not wait for a database that is silent instead of failing.

        Args:
            reads: where the database is asked.
        """
        if (known := self._during_outage(tenant, plan_id)) is not None:
            return known
        begin_s = monotonic()
        try:
            return await reads.run(self.get, tenant, plan_id)
        except StoreUnavailableError as error:
            if self._store.answered_since(begin_s):
                # It is there, and the plan may be gone.
                raise
            return self._despite(error, tenant, plan_id)

    def _during_outage(self, tenant: str, plan_id: str) -> PlanRecord | None:
        """A plan that was read lately, if the database was away a moment ago; from memory, at once."""
        return self._recent(tenant, plan_id) if self._breaker.is_open else None

    def _despite(self, error: StoreUnavailableError, tenant: str, plan_id: str) -> PlanRecord:
        """A plan that was read lately, as the database is away.

        Raises:
            StoreUnavailableError: it was not.
        """
        self._breaker.trip()
        if (known := self._recent(tenant, plan_id)) is None:
            raise error
        return known

    def _recent(self, tenant: str, plan_id: str) -> PlanRecord | None:
        return self._store.plan_cache.recent(tenant, plan_id, self._max_age_s)
