"""Parsed plans in memory, each at the revision that was current when it was last read or stored."""

from __future__ import annotations

from time import monotonic

from lalaloc_core.floorplan import FloorPlan
from service.capacity.bounded_cache import BoundedCache
from service.storage.records import PlanRecord


class PlanCache:
    """Plans by tenant and id, bounded in bytes; safe to share between threads."""

    def __init__(self, limit_bytes: int) -> None:
        """Create an empty cache.

        Args:
            limit_bytes: approximate memory limit; 0 keeps no plans.
        """
        self._records: BoundedCache[tuple[str, str], tuple[PlanRecord, float]] = BoundedCache(
            limit_bytes, lambda entry: plan_bytes(entry[0].plan) + len(entry[0].report or "")
        )

    def put(self, record: PlanRecord) -> None:
        """Keep a plan at its current revision, as of now."""
        self._records.put((record.tenant, record.id), (record, monotonic()))

    def put_unread(self, record: PlanRecord) -> None:
        """Keep one of many new plans; see `BoundedCache.put_unread`."""
        self._records.put_unread((record.tenant, record.id), (record, monotonic()))

    def get(self, tenant: str, plan_id: str, revision_id: str) -> PlanRecord | None:
        """Return a plan if it is in memory at this revision."""
        entry = self._records.get((tenant, plan_id))
        return None if entry is None or entry[0].revision_id != revision_id else entry[0]

    def recent(self, tenant: str, plan_id: str, max_age_s: float) -> PlanRecord | None:
        """Return a plan that was read or stored within `max_age_s` (s)."""
        entry = self._records.get((tenant, plan_id))
        return None if entry is None or monotonic() - entry[1] > max_age_s else entry[0]

    def revisions(self) -> set[str]:
        """Return the revisions in memory."""
        return {record.revision_id for _, (record, _) in self._records.items()}

    def forget(self, tenant: str, plan_id: str) -> None:
        """Drop a deleted plan."""
        self._records.drop(lambda key, _: key == (tenant, plan_id))

    def forget_revisions(self, revision_ids: set[str]) -> None:
        """Drop plans at deleted revisions."""
        self._records.drop(lambda _, entry: entry[0].revision_id in revision_ids)


def plan_bytes(plan: FloorPlan) -> int:
    """Estimate the memory of a plan: its walls as arrays, and its corners three times."""
    return plan.wall_table.nbytes + 3 * sum(room.polygon_m.nbytes for room in plan.rooms) + 2000 * len(plan.rooms)
