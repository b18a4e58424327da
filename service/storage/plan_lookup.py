"""Plans for queries, from the database, or from memory while the database does not answer."""

from __future__ import annotations

from time import monotonic

from service.capacity.threads import BoundedReads
from service.errors import StoreBusyError, StoreUnavailableError
from service.storage.circuit_breaker import CircuitBreaker
from service.storage.plans import FoundPlan, Plans
from service.storage.records import PlanRecord
from service.storage.store import Store


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

    async def find(self, tenant: str, plan_id: str, reads: BoundedReads) -> PlanRecord | None:
        """Return a plan at its current revision, or at the last known one while the database is unavailable.

        Args:
            tenant: owner of the plan.
            plan_id: id of the plan.
            reads: threads for reads of the database, which may be silent.

        Raises:
            StoreUnavailableError: the database is unavailable, and the plan was not read recently; or too many reads
                wait already.
            StoreBusyError: all connections are in use.
        """
        if self._breaker.is_open and (known := self._recent(tenant, plan_id)) is not None:
            return known
        begin_s = monotonic()
        try:
            found = await reads.run(tenant, self._store.plans.find, tenant, plan_id)
        except StoreUnavailableError as error:
            if isinstance(error, StoreBusyError) or self._store.answered_since(begin_s):
                # The database answers, so the plan may have been deleted.
                raise
            self._breaker.trip()
            if (known := self._recent(tenant, plan_id)) is None:
                raise
            return known
        return await parsed(found, self._store.plans, reads)

    def _recent(self, tenant: str, plan_id: str) -> PlanRecord | None:
        return self._store.plan_cache.recent(tenant, plan_id, self._max_age_s)


async def parsed(found: FoundPlan | None, plans: Plans, reads: BoundedReads) -> PlanRecord | None:
    """Parse a plan that was read, on a thread of its tenant if it is not in memory.

    Raises:
        DamagedDataError: its document is damaged.
    """
    if found is None or found.is_parsed:
        return None if found is None else plans.record(found)
    return await reads.process(found.row.tenant, plans.record, found)
