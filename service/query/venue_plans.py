"""Plans of a venue: the rows of all of them, and the choice of those that a query searches in full."""

from __future__ import annotations

import hashlib
import logging
import math
import threading
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from cachetools import LRUCache
from jaxtyping import Float, Int, UInt64
from sqlalchemy import Row

from lalaloc_core.errors import InvalidHintError
from lalaloc_core.localise.bundle import MatchingWeights
from lalaloc_core.localise.camera_height import DEFAULT_STD_M, CameraHeight
from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.poses import PoseGrid, Query
from lalaloc_core.localise.venue.plan_index import PlanIndex
from lalaloc_core.localise.venue.prototype_cells import shipped_cells
from lalaloc_core.localise.venue.prototypes import most_probable
from service.bounded_cache import BoundedCache
from service.errors import StoreUnavailableError
from service.grids import GridProvider
from service.query.plan_list import PlanList
from service.query.prototype_file import BlockKey, PrototypeFile
from service.schemas import EarthPoint
from service.schemas.query_fields import CameraFields
from service.storage import Store
from service.storage.grid_format import SortedPrototypes
from service.storage.plan_places import distances_m
from service.storage.records import PlanRecord, VenueState
from service.telemetry import LOGGER_NAME
from service.threads import BoundedReads, IdleCores

# Limits of the plans searched in full: their number, and poses × heading hypotheses × camera heights. `VenuePlans` also
# limits the poses of their grids.
MAX_SEARCHED = 128
_MAX_COMPARISONS = 8_000_000
# Maximum radius of the circle around a plan, and maximum number of plans near a place.
_MAX_REACH_M = 1000.0
_MAX_NEAR = 2000
# Prototypes per read, so that a read is short.
_BATCH_SIZE = 1000
# Approximate memory of a plan's row.
_ROW_BYTES = 600
# Maximum number of venues whose last index is remembered; the indices themselves are bounded in bytes.
_MAX_LATEST = 1000


# Function that runs CPU work on the threads of `Localiser`.
Compute = Callable[[Callable[[], Any]], Awaitable[Any]]


@dataclass(frozen=True, eq=False)
class _Venue:
    """Rows of a venue's plans, valid for one state of the venue."""

    state: VenueState
    rows: PlanList


@dataclass(frozen=True, eq=False)
class _Indexed:
    """Index of plans, and the keys of their grids (`PlanList.keys`) in its order."""

    keys: UInt64[np.ndarray, "p"]
    index: PlanIndex

    def numbers(self, plans: PlanList) -> Int[np.ndarray, "q"]:
        """Return the number of each plan in the index; -1 for plans that are not in it."""
        order = np.argsort(self.keys)
        place = np.minimum(np.searchsorted(self.keys, plans.keys, sorter=order), len(order) - 1)
        return np.where(self.keys[order[place]] == plans.keys, order[place], -1)


class _NotInFileError(Exception):
    """The prototype file has no room for all plans of an index."""


@dataclass(frozen=True, eq=False)
class ChosenPlans:
    """Plans that are searched in full, most probable first.

    Attributes:
        members: rows of the plans, see `Venues.searchable_plans`.
        log_mass: (p,) log masses of all plans that are ready, see `localise.venue.plan_index`.
        index: (m,) numbers of the chosen plans among these.
    """

    members: Sequence[Row[Any]]
    log_mass: Float[np.ndarray, "p"]
    index: Int[np.ndarray, "m"]


class VenuePlans:
    """Reader of a venue's plans, which chooses among them by an index of their prototypes.

    Prototypes lie in a file of this replica, filled from the database on demand. The rows of a venue's plans and their
    index stay in memory. When plans of the venue change, their rows are read again, and a new index takes the others
    from the old one.
    """

    def __init__(
        self,
        store: Store,
        grids: GridProvider,
        reads: BoundedReads,
        *,
        path: Path | None,
        file_bytes: int,
        limit_bytes: int,
        max_poses: int,
        idle_cores: IdleCores | None = None,
    ) -> None:
        """Create the reader; files are opened on first use.

        Args:
            store: the store.
            grids: provider of pose grids.
            reads: threads for reads of the store.
            path: path of the prototype file; None for a temporary one.
            file_bytes: maximum size of that file.
            limit_bytes: memory limit for each of the two caches, of rows and of indices.
            max_poses: maximum number of poses in all grids of the chosen plans.
            idle_cores: threads that take over a part of a search; None: the caller's does all.
        """
        self._store = store
        self._grids = grids
        self._reads = reads
        self._path, self._file_bytes = path, file_bytes
        self._max_poses = max_poses
        self._idle_cores = idle_cores
        self._venues: BoundedCache[str, _Venue] = BoundedCache(limit_bytes, lambda venue: _ROW_BYTES * len(venue.rows))
        # Keys are digests of the plans' grids in order.
        self._indices: BoundedCache[bytes, _Indexed] = BoundedCache(
            limit_bytes, lambda indexed: indexed.keys.nbytes + indexed.index.nbytes
        )
        # Keys of the last index of all plans of a venue that are ready, which the next one begins with.
        self._latest: LRUCache[str, bytes] = LRUCache(_MAX_LATEST)
        self._file: PrototypeFile | None = None
        self._building = threading.Lock()

    async def members(self, tenant: str, venue_id: str) -> PlanList:
        """Return the current row of every plan of a venue."""
        return await self._reads.run(tenant, self._members, tenant, venue_id)

    async def near(self, tenant: str, place: EarthPoint, within_m: float) -> PlanList:
        """Return rows of the tenant's anchored plans within `within_m` of a place, nearest first."""
        latitude, longitude = place.latitude, place.longitude
        reach_m = within_m + _MAX_REACH_M
        near = self._store.venues.searchable_plans_near
        rows = await self._reads.run(tenant, near, tenant, latitude, longitude, reach_m, *self._grids.model)
        distance_m = distances_m(rows, None, latitude, longitude)
        order = np.argsort(distance_m, kind="stable")
        return PlanList(PlanList.of([rows[int(k)] for k in order if distance_m[k] <= within_m])[:_MAX_NEAR])

    def needs_choice(self, ready: PlanList, query: Query) -> bool:
        """Tell whether the plans are too many, or too large, to search all of them in full."""
        return len(ready) > MAX_SEARCHED or int(ready.poses.sum()) > most_poses(query, self._max_poses)

    async def index(
        self, tenant: str, ready: PlanList, compute: Compute, *, venue_id: str | None = None
    ) -> tuple[PlanList, PlanIndex]:
        """Return the index of plans that are ready, and their rows in its order, without plans whose grid was deleted.

        Prototypes that are missing, or of an earlier format, are made and stored.

        Args:
            tenant: their owner.
            ready: rows of the plans.
            compute: runs CPU work.
            venue_id: id of the venue, if these are all of its plans that are ready.
        """
        digest = hashlib.sha256(ready.keys.tobytes()).digest()
        indexed = self._indices.get(digest)
        if indexed is None:
            latest = None if venue_id is None else self._latest.get(venue_id)
            base = None if latest is None else self._indices.get(latest)
            if base is not None and 2 * int((base.numbers(ready) >= 0).sum()) < max(len(ready), len(base.keys)):
                base = None
            indexed = await self._make_index(tenant, ready, compute, base)
            if base is not None and latest != digest:
                # Queries in progress keep it; most of its memory is in the new one as well.
                self._indices.drop(lambda key, _: key == latest)
            self._indices.put(digest, indexed)
        if venue_id is not None:
            self._latest[venue_id] = digest
        if len(indexed.keys) == len(ready):
            return ready, indexed.index
        return ready.chosen(np.isin(ready.keys, indexed.keys)), indexed.index

    def choose(
        self,
        known: PlanList,
        index: PlanIndex,
        choosing: Sequence[tuple[Query, MatchingWeights]],
        log_prior: Float[np.ndarray, "p"],
        favour: Float[np.ndarray, "p"] | None = None,
    ) -> ChosenPlans:
        """Return the most probable plans of an index, those that are probable for any of the photographs.

        Args:
            known: rows of the index's plans.
            index: the index.
            choosing: the encoded photographs, each with the weights of its matching cost.
            log_prior: (p,) log prior of the plans.
            favour: (p,) log factors by which plans are preferred in the choice alone.
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
        """Return chosen plans with their pose grids, without those that were deleted or replaced meanwhile."""
        keys = {row.revision_id: self._grids.key(row.revision_id, row.camera_height_m) for row in members}
        plans = self._store.plans
        found = await self._reads.run(tenant, plans.find_revisions, tenant, list(keys))

        def parsed() -> dict[str, PlanRecord]:
            return {revision_id: plans.record(plan) for revision_id, plan in found.items()}

        in_memory = all(plan.is_parsed for plan in found.values())
        records = parsed() if in_memory else await self._reads.process(tenant, parsed)
        grids = {key: grid for key in keys.values() if (grid := self._grids.cached(key)) is not None}
        if len(grids) < len(keys):
            missing = [key for key in keys.values() if key not in grids]
            grids |= await self._reads.run(tenant, self._grids.find_all, missing)
        return [
            (row, records[row.revision_id], grids[keys[row.revision_id]])
            for row in members
            if row.revision_id in records and keys[row.revision_id] in grids
        ]

    def close(self) -> None:
        """Release the prototype file for other processes."""
        if self._file is not None:
            self._file.close()

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
        store, before = self._store.venues, set(venue.rows.members)
        after, changed = before, set(store.changed_plans(tenant, venue.state.changes))
        if state.revision_id != venue.state.revision_id:
            after = set(map(tuple, store.members(venue_id)))
        left = {member for member in before & after if member[1] not in changed}
        read = [plan_id for _, plan_id, _ in after - left]
        if 2 * len(read) > len(after):
            return None
        fresh = PlanList.of(store.searchable_plans(venue_id, *self._grids.model, read) if read else [])
        return venue.rows.updated({plan_id for _, plan_id, _ in before - left}, fresh)

    async def _make_index(self, tenant: str, ready: PlanList, compute: Compute, base: _Indexed | None) -> _Indexed:
        """Return the index of plans, beginning with that of most of them if there is one."""
        is_known = np.zeros(len(ready), bool) if base is None else base.numbers(ready) >= 0
        unknown = [ready[k] for k in np.flatnonzero(~is_known).tolist()]
        found = await compute(partial(self._in_file, unknown))
        fresh = await self._fetched(tenant, [row for row in unknown if _key(row) not in found])
        is_found = np.array([_key(row) in found or _key(row) in fresh for row in unknown], bool)
        there = ready.chosen(np.isin(np.arange(len(ready)), np.flatnonzero(~is_known)[~is_found], invert=True))
        if not there:
            # All were deleted or replaced just now; a retry finds the current ones.
            raise StoreUnavailableError
        try:
            index = await compute(partial(self._indexed, there, fresh, base))
        except _NotInFileError:
            if base is not None:
                return await self._make_index(tenant, ready, compute, None)
            # The file has no room for all of them, so this index keeps them in memory.
            fresh |= await self._fetched(tenant, [row for row in there if _key(row) not in fresh])
            index = await compute(partial(self._in_memory, there, fresh))
        return _Indexed(there.keys, index)

    def _in_file(self, ready: Sequence[Row[Any]]) -> dict[BlockKey, tuple[int, int]]:
        with self._building:
            return self._opened().find(_key(row) for row in ready)

    async def _fetched(self, tenant: str, rows: Sequence[Row[Any]]) -> dict[BlockKey, SortedPrototypes]:
        """Return prototypes of plans from the database; missing ones are made from the stored grids."""
        fetched: dict[BlockKey, SortedPrototypes] = {}
        for first in range(0, len(rows), _BATCH_SIZE):
            part = rows[first : first + _BATCH_SIZE]
            stored = await self._reads.run(tenant, self._store.grids.prototypes, [row.grid_id for row in part])
            for row in part:
                prototypes = stored.get(row.grid_id)
                if prototypes is None:
                    key = self._grids.key(row.revision_id, row.camera_height_m)
                    prototypes = await self._reads.run(tenant, self._grids.make_prototypes, key, row.grid_id)
                if prototypes is not None:
                    fetched[_key(row)] = prototypes
        return fetched

    def _indexed(self, known: PlanList, fresh: Mapping[BlockKey, SortedPrototypes], base: _Indexed | None) -> PlanIndex:
        """Add prototypes to the file and index it.

        Raises:
            _NotInFileError: the file has no room for all plans.
        """
        with self._building:
            file = self._opened()
            there = file.find(fresh)
            try:
                file.add({key: prototypes.in_shipped_cells() for key, prototypes in fresh.items() if key not in there})
            except OSError as error:
                logging.getLogger(LOGGER_NAME).warning("cannot write the prototype file: %s", error)

        def located(numbers: Int[np.ndarray, "p"]) -> tuple[np.ndarray, Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
            keys = [_key(known[k]) for k in numbers.tolist()]
            with self._building:
                rows, found = file.rows(), file.find(keys)
            if not all(key in found for key in keys):
                raise _NotInFileError
            begin, count = np.array([found[key] for key in keys], np.int64).T
            return rows, begin, count

        if base is not None:
            number = base.numbers(known)
            place = np.full(len(base.keys), -1)
            place[number[number >= 0]] = np.flatnonzero(number >= 0)
            return base.index.updated(place, np.flatnonzero(number < 0), located)
        rows, begin, count = located(np.arange(len(known)))
        return PlanIndex.build(rows, begin, count, step_m=self._grids.model[1], cells=shipped_cells())

    def _in_memory(self, known: Sequence[Row[Any]], fresh: Mapping[BlockKey, SortedPrototypes]) -> PlanIndex:
        blocks = [fresh[_key(row)].in_shipped_cells() for row in known]
        count = np.array([len(block) for block in blocks])
        rows, begin = np.concatenate(blocks), np.cumsum(count) - count
        return PlanIndex.build(rows, begin, count, step_m=self._grids.model[1], cells=shipped_cells())

    def _opened(self) -> PrototypeFile:
        if self._file is None:
            version, limit_bytes = shipped_cells().version, self._file_bytes
            try:
                self._file = PrototypeFile(self._path, cells_version=version, limit_bytes=limit_bytes)
            except OSError as error:
                logging.getLogger(LOGGER_NAME).warning(
                    "cannot open the prototype file, using a temporary one: %s", error
                )
                self._file = PrototypeFile(None, cells_version=version, limit_bytes=limit_bytes)
        return self._file


def most_poses(query: Query, max_poses: int) -> int:
    """Return the maximum number of poses in all plans that are searched in full."""
    return min(max_poses, _MAX_COMPARISONS // (len(query.roll) * len(query.camera_height.offsets)))


def not_excluded(ready: PlanList, log_prior: Float[np.ndarray, "p"]) -> PlanList:
    """Return the plans with a finite log prior.

    Raises:
        InvalidHintError: there is none.
    """
    possible = np.isfinite(log_prior)
    if not possible.any():
        raise InvalidHintError("strict", f"none of the {len(ready)} floor plans that are ready matches all hints")
    return ready.chosen(possible)


def venue_height(form: CameraFields, ready: PlanList) -> CameraHeight:
    """Return the camera height in the request, else the one that all plans of a venue share, else an unknown one."""
    if form.camera_height_m is not None:
        std_m = DEFAULT_STD_M if form.camera_height_std_m is None else form.camera_height_std_m
        return CameraHeight(form.camera_height_m, std_m)
    height_m, std_m, is_shared = ready.most_common_height
    if not is_shared or std_m is None:
        std_m = math.inf
    return CameraHeight(height_m, std_m if form.camera_height_std_m is None else form.camera_height_std_m)


def _key(row: Row[Any]) -> BlockKey:
    return BlockKey(row.grid_id, row.grid_sha256)
