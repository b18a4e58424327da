"""Plans of a venue: the rows of all of them, and the choice of those that a query searches in full."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from sqlalchemy import Row

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.errors import InvalidHintError
from lalaloc_core.localise.match import MatchingConfig, PoseGrid
from lalaloc_core.localise.query import DEFAULT_STD_M, CameraHeight, Query
from lalaloc_core.localise.venue.index_search import DividedIndex
from lalaloc_core.localise.venue.prototypes import most_probable
from service.bounded_cache import BoundedCache
from service.capacity.threads import BoundedReads, IdleCores
from service.grids import GridProvider
from service.schemas.query_fields import HeightFields
from service.storage import Store
from service.storage.records import PlanRecord, VenueCounts, VenueState
from service.venues.plan_list import ROW_BYTES, PlanList

# Limits of the plans searched in full: their number, and poses × heading hypotheses × camera heights. `VenuePlans` also
# limits the poses of their grids.
MAX_SEARCHED = 128
_MAX_COMPARISONS = 8_000_000


@dataclass(frozen=True, eq=False)
class _Venue:
    """Rows of a venue's plans, valid for one state of the venue."""

    state: VenueState
    rows: PlanList


@dataclass(frozen=True, eq=False)
class ChosenPlans:
    """Plans that are searched in full, most probable first.

    Attributes:
        members: rows of the plans, see `Venues.searchable_plans`.
        log_mass: (p,) log masses of all plans that are ready, see `localise.venue.plan_index`; None if all are chosen.
        index: (m,) numbers of the chosen plans among these.
    """

    members: Sequence[Row[Any]]
    log_mass: Float[np.ndarray, "p"] | None
    index: Int[np.ndarray, "m"]


class VenuePlans:
    """Reader of a venue's plans, which chooses among them by an index of their prototypes.

    The rows of a venue's plans stay in memory, up to `limit_bytes`. When plans of the venue change, their rows are read
    again. `max_poses` limits the poses of the chosen plans.
    """

    def __init__(
        self,
        store: Store,
        grids: GridProvider,
        reads: BoundedReads,
        *,
        limit_bytes: int,
        max_poses: int,
        idle_cores: IdleCores | None = None,
    ) -> None:
        self._store, self._grids, self._reads = store, grids, reads
        self._max_poses, self._idle_cores = max_poses, idle_cores
        self._venues: BoundedCache[str, _Venue] = BoundedCache(limit_bytes, lambda venue: ROW_BYTES * len(venue.rows))

    async def members(self, tenant: str, venue_id: str) -> PlanList:
        """Return the current row of every plan of a venue."""
        return await self._reads.run(tenant, self._members, tenant, venue_id)

    def counts(self, tenant: str, venue_id: str) -> VenueCounts:
        """Return the numbers of a venue's plans; rows in memory are brought up to date, others stay in the database."""
        if self._venues.get(venue_id) is None:
            return self._store.venues.counts(venue_id, *self._grids.model)
        rows = self._members(tenant, venue_id)
        return VenueCounts(len(rows), len(rows.ready), rows.failed)

    def needs_choice(self, ready: PlanList, query: Query) -> bool:
        """Tell whether the plans are too many, or too large, to search all of them in full."""
        return len(ready) > MAX_SEARCHED or int(ready.poses.sum()) > most_poses(query, self._max_poses)

    def choose(
        self,
        known: PlanList,
        index: DividedIndex,
        choosing: Sequence[tuple[Query, MatchingWeights]],
        log_prior: Float[np.ndarray, "p"],
        favour: Float[np.ndarray, "p"] | None = None,
    ) -> ChosenPlans:
        """Return the most probable plans of an index, those that are probable for any of the photographs.

        `known` are the rows of its plans, `choosing` the encoded photographs, each with the weights of its matching
        cost, and `favour` log factors by which plans are preferred in the choice alone.
        """
        helper = None if self._idle_cores is None else self._idle_cores.if_any()
        masses = [
            index.log_masses(query, weights, MatchingConfig(), helper=helper) + log_prior for query, weights in choosing
        ]
        log_mass = masses[0]
        if len(masses) > 1:
            shares = [mass - np.logaddexp.reduce(mass) for mass in masses]
            log_mass = np.logaddexp.reduce(shares) - math.log(len(shares))
        ranked = log_mass if favour is None else log_mass + favour
        max_poses = min(most_poses(query, self._max_poses) for query, _ in choosing)
        chosen = most_probable(ranked, known.poses, max_plans=MAX_SEARCHED, max_poses=max_poses)
        return ChosenPlans([known[int(k)] for k in chosen], log_mass, chosen)

    async def load(self, tenant: str, members: Sequence[Row[Any]]) -> list[tuple[Row[Any], PlanRecord, PoseGrid]]:
        """Return chosen plans with their pose grids.

        Plans that are not in memory are left out if they were deleted or replaced since their rows were read.
        """
        keys = {row.revision_id: self._grids.key(row.revision_id, row.camera_height_m) for row in members}
        in_memory = [self._store.plan_cache.get(tenant, row.plan_id, row.revision_id) for row in members]
        records = {record.revision_id: record for record in in_memory if record is not None}
        if len(records) < len(keys):
            plans = self._store.plans
            missing = [revision_id for revision_id in keys if revision_id not in records]
            found = await self._reads.run(tenant, plans.find_revisions, tenant, missing)
            parsed = await self._reads.process(tenant, lambda: [plans.record(plan) for plan in found.values()])
            records |= {record.revision_id: record for record in parsed}
        grids = {key: grid for key in keys.values() if (grid := self._grids.cache.cached(key)) is not None}
        if len(grids) < len(keys):
            missing = [key for key in keys.values() if key not in grids]
            grids |= await self._reads.run(tenant, self._grids.cache.find_all, missing)
        return [
            (row, records[row.revision_id], grids[keys[row.revision_id]])
            for row in members
            if row.revision_id in records and keys[row.revision_id] in grids
        ]

    def _members(self, tenant: str, venue_id: str) -> PlanList:
        # State before rows: a change in between makes the next query read the changed rows again.
        state = self._store.venues.state(venue_id)
        venue = self._venues.get(venue_id)
        if venue is None or venue.state != state:
            rows = None if venue is None else self._changed(tenant, venue_id, venue, state)
            if rows is None:
                rows = PlanList.of(self._store.venues.searchable_plans(venue_id, *self._grids.model))
            venue = _Venue(state, rows)
            self._venues.put(venue_id, venue)
        return venue.rows

    def _changed(self, tenant: str, venue_id: str, venue: _Venue, state: VenueState) -> PlanList | None:
        """Return the rows of a venue after a change, most of them from before; None to read all of them."""
        if not state.shows_changes_since(venue.state):
            return None
        store, rows = self._store.venues, venue.rows
        gone = read = rows.plan_ids_among(store.changed_plans(tenant, venue.state.changes))
        if state.revision_id != venue.state.revision_id:
            before, after = set(rows.members), set(map(tuple, store.members(venue_id)))
            gone = gone.union(plan_id for _, plan_id, _ in before - after)
            read = read.union(plan_id for _, plan_id, _ in after - before)
        if 2 * len(read) > len(rows):
            return None
        fresh = PlanList.of(store.searchable_plans(venue_id, *self._grids.model, list(read)) if read else [])
        return rows.updated(gone, fresh)


def most_poses(query: Query, max_poses: int) -> int:
    """Return the maximum number of poses in all plans that are searched in full."""
    return min(max_poses, _MAX_COMPARISONS // (len(query.roll) * len(query.camera_height.offsets)))


def possible_plans(ready: PlanList, log_prior: Float[np.ndarray, "p"]) -> PlanList:
    """Return the plans with a finite log prior."""
    possible = np.isfinite(log_prior)
    if not possible.any():
        raise InvalidHintError("strict", f"none of the {len(ready)} floor plans that are ready matches all hints")
    return ready.chosen(possible)


def venue_height(form: HeightFields, ready: PlanList) -> CameraHeight:
    """Return the camera height in the request, else the one that all plans of a venue share, else an unknown one."""
    if form.camera_height_m is not None:
        std_m = DEFAULT_STD_M if form.camera_height_std_m is None else form.camera_height_std_m
        return CameraHeight(form.camera_height_m, std_m)
    height_m, std_m, is_shared = ready.most_common_height
    if not is_shared or std_m is None:
        std_m = math.inf
    return CameraHeight(height_m, std_m if form.camera_height_std_m is None else form.camera_height_std_m)
