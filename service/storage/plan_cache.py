"""Plans as queries need them: read anew for each one, and from memory while the database is away or silent."""

from __future__ import annotations

from time import monotonic

from service.bounded_cache import BoundedCache
from service.errors import StoreBusyError, StoreUnavailableError
from service.storage.plans import plan_bytes
from service.storage.records import PlanRecord
from service.storage.store import Store
from service.threads import BoundedReads

# After a failure the database is left alone for so long by queries that can be answered without it.
_LEFT_ALONE_S = 1.0


class PlanCache:
    """Finds plans for queries; safe to share between threads."""

    def __init__(self, store: Store, *, limit_bytes: int, max_age_s: float) -> None:
        """Nothing is known at first.

        Args:
            max_age_s: how long after it was last read a plan counts as known.
        """
        self._store = store
        self._max_age_s = max_age_s
        self._known: BoundedCache[tuple[str, str], tuple[PlanRecord, float]] = BoundedCache(
            limit_bytes, lambda entry: plan_bytes(entry[0].plan)
        )
        self._away_until = 0.0

    def get(self, tenant: str, plan_id: str) -> PlanRecord | None:
        """A plan at its current revision; while the database is away, at the one that it last had.

        Raises:
            StoreUnavailableError: the database is away, and the plan was not read lately.
            StoreBusyError: too many use it.
        """
        if (known := self._during_outage(tenant, plan_id)) is not None:
            return known
        key = (tenant, plan_id)
        try:
            record = self._store.plans.get(tenant, plan_id)
        except StoreBusyError:
            # It is there, and the plan may be gone.
            raise
        except StoreUnavailableError:
            self._note_outage()
            known = self._lately(key)
            if known is None:
                raise
            return known
        if record is None:
            self._known.drop(lambda other, _: other == key)
        else:
            self._known.put(key, (record, monotonic()))
        return record

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
        except StoreUnavailableError:
            if self._store.answered_since(begin_s):
                # It is there, and the plan may be gone.
                raise
            self._note_outage()
            if (known := self._during_outage(tenant, plan_id)) is None:
                raise
            return known

    def revisions(self) -> set[str]:
        """The revisions in memory."""
        return {record.revision_id for _, (record, _) in self._known.items()}

    def drop(self, revision_ids: set[str]) -> None:
        """Forget plans at revisions that are gone."""
        self._known.drop(lambda _, entry: entry[0].revision_id in revision_ids)

    def _during_outage(self, tenant: str, plan_id: str) -> PlanRecord | None:
        """A plan that was read lately, if the database was away a moment ago; from memory, at once."""
        return self._lately((tenant, plan_id)) if monotonic() < self._away_until else None

    def _note_outage(self) -> None:
        """The database does not answer: leave it alone for a moment."""
        self._away_until = monotonic() + _LEFT_ALONE_S

    def _lately(self, key: tuple[str, str]) -> PlanRecord | None:
        entry = self._known.get(key)
        if entry is None or monotonic() - entry[1] > self._max_age_s:
            return None
        return entry[0]
