"""Plans of a venue: the rows of all of them, and the choice of those that a query searches in full."""

from __future__ import annotations

import hashlib
import logging
import math
import threading
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
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
from service.query.prototype_file import BlockKey, PrototypeFile
from service.schemas import EarthPoint
from service.schemas.query_fields import CameraFields
from service.storage import Store
from service.storage.grid_format import SortedPrototypes
from service.storage.plan_lookup import parsed
from service.storage.plan_places import distances_m
from service.storage.records import PlanRecord, VenueState
from service.telemetry import LOGGER_NAME
from service.threads import BoundedReads

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


# Function that runs CPU work on the threads of `Localiser`.
Compute = Callable[[Callable[[], Any]], Awaitable[Any]]


@dataclass(frozen=True, eq=False)
class _Venue:
    """Rows of a venue's plans, valid for one state of the venue."""

    state: VenueState
    rows: Sequence[Row[Any]]


@dataclass(frozen=True, eq=False)
class _Indexed:
    """Index of plans, and the numbers of these plans among the requested ones."""

    place: Int[np.ndarray, "p"]
    index: PlanIndex


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

    Prototypes lie in a file of this replica, filled from the database on demand. The rows of a venue's plans and the
    places of their prototypes stay in memory until the state of the venue changes.
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
        """
        self._store = store
        self._grids = grids
        self._reads = reads
        self._path, self._file_bytes = path, file_bytes
        self._max_poses = max_poses
        self._venues: BoundedCache[str, _Venue] = BoundedCache(limit_bytes, lambda venue: _ROW_BYTES * len(venue.rows))
        # Keys are digests of the plans' grids in order.
        self._indices: BoundedCache[bytes, _Indexed] = BoundedCache(
            limit_bytes, lambda indexed: indexed.place.nbytes + indexed.index.nbytes
        )
        self._file: PrototypeFile | None = None
        self._building = threading.Lock()

    async def members(self, tenant: str, venue_id: str) -> Sequence[Row[Any]]:
        """Return the current row of every plan of a venue."""
        return await self._reads.run(tenant, self._members, venue_id)

    async def near(self, tenant: str, place: EarthPoint, within_m: float) -> Sequence[Row[Any]]:
        """Return rows of the tenant's anchored plans within `within_m` of a place, nearest first."""
        latitude, longitude = place.latitude, place.longitude
        reach_m = within_m + _MAX_REACH_M
        near = self._store.venues.searchable_plans_near
        rows = await self._reads.run(tenant, near, tenant, latitude, longitude, reach_m, *self._grids.model)
        distance_m = distances_m(rows, None, latitude, longitude)
        order = np.argsort(distance_m, kind="stable")
        unique = {rows[int(k)].plan_id: rows[int(k)] for k in order if distance_m[k] <= within_m}
        return list(unique.values())[:_MAX_NEAR]

    def needs_choice(self, ready: Sequence[Row[Any]], query: Query) -> bool:
        """Tell whether the plans are too many, or too large, to search all of them in full."""
        return len(ready) > MAX_SEARCHED or sum(row.poses for row in ready) > most_poses(query, self._max_poses)

    async def index(
        self, tenant: str, ready: Sequence[Row[Any]], compute: Compute
    ) -> tuple[Sequence[Row[Any]], PlanIndex]:
        """Return the index of plans that are ready, and their rows in its order, without plans whose grid was deleted.

        Prototypes that are missing, or of an earlier format, are made and stored.

        Args:
            tenant: their owner.
            ready: rows of the plans.
            compute: runs CPU work.
        """
        digest = hashlib.sha256("".join(f"{row.grid_id} {row.grid_sha256} " for row in ready).encode()).digest()
        indexed = self._indices.get(digest)
        if indexed is None:
            found = await compute(partial(self._in_file, ready))
            fresh = await self._fetched(tenant, [row for row in ready if _key(row) not in found])
            place = np.array([k for k, row in enumerate(ready) if _key(row) in found or _key(row) in fresh], np.intp)
            if not len(place):
                # All were deleted or replaced just now; a retry finds the current ones.
                raise StoreUnavailableError
            there = [ready[int(k)] for k in place]
            index = await compute(partial(self._indexed, there, fresh))
            if index is None:
                # The file has no room for all of them, so this index keeps them in memory.
                fresh |= await self._fetched(tenant, [row for row in there if _key(row) not in fresh])
                index = await compute(partial(self._in_memory, there, fresh))
            indexed = _Indexed(place, index)
            self._indices.put(digest, indexed)
        return [ready[int(k)] for k in indexed.place], indexed.index

    def choose(
        self,
        known: Sequence[Row[Any]],
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
        masses = [index.log_masses(query, weights, MatchingConfig()) + log_prior for query, weights in choosing]
        log_mass = masses[0]
        if len(masses) > 1:
            shares = [mass - np.logaddexp.reduce(mass) for mass in masses]
            log_mass = np.logaddexp.reduce(shares) - math.log(len(shares))
        poses = np.array([row.poses for row in known])
        ranked = log_mass if favour is None else log_mass + favour
        max_poses = min(most_poses(query, self._max_poses) for query, _ in choosing)
        chosen = most_probable(ranked, poses, max_plans=MAX_SEARCHED, max_poses=max_poses)
        return ChosenPlans([known[int(k)] for k in chosen], log_mass, chosen)

    async def load(self, tenant: str, members: Sequence[Row[Any]]) -> list[tuple[Row[Any], PlanRecord, PoseGrid]]:
        """Return chosen plans with their pose grids, without those that were deleted or replaced meanwhile."""
        loaded = []
        for row in members:
            plans = self._store.plans
            found = await self._reads.run(tenant, plans.find, tenant, row.plan_id, row.revision_id)
            record = await parsed(found, plans, self._reads)
            key = self._grids.key(row.revision_id, row.camera_height_m)
            grid = self._grids.cached(key) or await self._reads.run(tenant, self._grids.find, key)
            if record is not None and grid is not None:
                loaded.append((row, record, grid))
        return loaded

    def close(self) -> None:
        """Release the prototype file for other processes."""
        if self._file is not None:
            self._file.close()

    def _members(self, venue_id: str) -> Sequence[Row[Any]]:
        # State before rows: a change in between makes the next query read the rows again.
        state = self._store.venues.state(venue_id, *self._grids.model)
        venue = self._venues.get(venue_id)
        if venue is None or venue.state != state:
            rows = self._store.venues.searchable_plans(venue_id, *self._grids.model)
            venue = _Venue(state, list({row.plan_id: row for row in rows}.values()))
            self._venues.put(venue_id, venue)
        return venue.rows

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

    def _indexed(self, known: Sequence[Row[Any]], fresh: Mapping[BlockKey, SortedPrototypes]) -> PlanIndex | None:
        """Add prototypes to the file and index it; None if it has no room for all plans."""
        keys = [_key(row) for row in known]
        with self._building:
            file = self._opened()
            there = file.find(fresh)
            try:
                file.add({key: prototypes.in_shipped_cells() for key, prototypes in fresh.items() if key not in there})
            except OSError as error:
                logging.getLogger(LOGGER_NAME).warning("cannot write the prototype file: %s", error)
            rows, found = file.rows(), file.find(keys)
        if not all(key in found for key in keys):
            return None
        begin, count = np.array([found[key] for key in keys], np.int64).T
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


def not_excluded(ready: Sequence[Row[Any]], log_prior: Float[np.ndarray, "p"]) -> Sequence[Row[Any]]:
    """Return the plans with a finite log prior.

    Raises:
        InvalidHintError: there is none.
    """
    possible = np.isfinite(log_prior)
    if possible.all():
        return ready
    if not possible.any():
        raise InvalidHintError("strict", f"none of the {len(ready)} floor plans that are ready matches all hints")
    return [ready[k] for k in np.flatnonzero(possible).tolist()]


def venue_height(form: CameraFields, ready: Sequence[Row[Any]]) -> CameraHeight:
    """Return the camera height in the request, else the one that all plans of a venue share, else an unknown one."""
    if form.camera_height_m is not None:
        std_m = DEFAULT_STD_M if form.camera_height_std_m is None else form.camera_height_std_m
        return CameraHeight(form.camera_height_m, std_m)
    heights = Counter((row.camera_height_m, row.camera_height_std_m) for row in ready)
    (height_m, std_m), _ = heights.most_common(1)[0]
    if len(heights) > 1 or std_m is None:
        std_m = math.inf
    return CameraHeight(height_m, std_m if form.camera_height_std_m is None else form.camera_height_std_m)


def _key(row: Row[Any]) -> BlockKey:
    return BlockKey(row.grid_id, row.grid_sha256)
