"""Which plans of a venue a query is compared with, and in what form."""

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
from service.schemas import EarthPoint, LocaliseForm
from service.storage import Store
from service.storage.grid_format import SortedPrototypes
from service.storage.plan_places import distances_m
from service.storage.records import PlanRecord, VenueState
from service.telemetry import LOGGER_NAME
from service.threads import BoundedReads

# Plans that are searched in full, and what that may come to: poses times hypotheses of the heading times camera
# heights. How many poses their grids may have besides is an argument of `VenuePlans`.
MAX_SEARCHED = 128
_MAX_COMPARISONS = 8_000_000
# The largest circle around a plan, whose centre may be as far from a place that it covers; and plans near one place.
_MAX_REACH_M = 1000.0
_MAX_NEAR = 2000
# Prototypes that are read at a time, so that one read is short.
_BATCH_SIZE = 1000
# About what a plan takes in memory besides its prototypes: its row.
_ROW_BYTES = 600


# Runs a call on the threads that compute for queries.
Compute = Callable[[Callable[[], Any]], Awaitable[Any]]


@dataclass(frozen=True, eq=False)
class _Venue:
    """The plans of a venue, which hold as long as its state stays."""

    state: VenueState
    rows: Sequence[Row[Any]]


@dataclass(frozen=True, eq=False)
class _Indexed:
    """The index of some plans: of which of those that were asked for, in their order."""

    place: Int[np.ndarray, "p"]
    index: PlanIndex


@dataclass(frozen=True, eq=False)
class ChosenPlans:
    """What is searched in full, the most probable first.

    Attributes:
        members: the plans as `Venues.searched` tells them.
        log_mass: (p,) of all plans that are ready, chosen or not; see `localise.venue.plan_index`.
        index: (m,) which of those were chosen.
    """

    members: Sequence[Row[Any]]
    log_mass: Float[np.ndarray, "p"]
    index: Int[np.ndarray, "m"]


class VenuePlans:
    """Finds the plans of a venue, and chooses among them by an index of their prototypes.

    Prototypes lie in a file of this replica, which is filled from the database with what is asked for. Which plans a
    venue has, and where their prototypes are, is kept in memory for as long as the database says that nothing of it has
    changed.
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
        """Args:
        path: of the file of prototypes; None for one that is gone with the process.
        file_bytes: how large that may become.
        limit_bytes: memory for what is kept of venues.
        max_poses: that the grids of chosen plans may have in sum.
        """
        self._store = store
        self._grids = grids
        self._reads = reads
        self._path, self._file_bytes = path, file_bytes
        self._max_poses = max_poses
        self._venues: BoundedCache[str, _Venue] = BoundedCache(limit_bytes, lambda one: _ROW_BYTES * len(one.rows))
        # By a digest of the plans' grids, in their order.
        self._indices: BoundedCache[bytes, _Indexed] = BoundedCache(
            limit_bytes, lambda one: one.place.nbytes + one.index.nbytes
        )
        self._file: PrototypeFile | None = None
        self._building = threading.Lock()

    async def members(self, venue_id: str) -> Sequence[Row[Any]]:
        """All plans of a venue as they are now, each once."""
        return await self._reads.run(self._members, venue_id)

    async def near(self, tenant: str, place: EarthPoint, within_m: float) -> Sequence[Row[Any]]:
        """Plans of a tenant with an anchor that lie so near a place, the nearest first."""
        latitude, longitude = place.latitude, place.longitude
        reach_m = within_m + _MAX_REACH_M
        near = self._store.venues.searched_near
        rows = await self._reads.run(near, tenant, latitude, longitude, reach_m, *self._grids.model)
        away_m = distances_m(rows, None, latitude, longitude)
        order = np.argsort(away_m, kind="stable")
        unique = {rows[int(k)].plan_id: rows[int(k)] for k in order if away_m[k] <= within_m}
        return list(unique.values())[:_MAX_NEAR]

    def needs_choice(self, ready: Sequence[Row[Any]], query: Query) -> bool:
        """Whether not all of some plans can be searched in full."""
        return len(ready) > MAX_SEARCHED or sum(row.poses for row in ready) > most_poses(query, self._max_poses)

    async def index(self, ready: Sequence[Row[Any]], compute: Compute) -> tuple[Sequence[Row[Any]], PlanIndex]:
        """The index of plans that are ready, with the plans in its order: without those whose grid is gone by now.

        Prototypes of grids that were stored without, or by an earlier version of the service, are made and stored.

        Args:
            compute: what takes the processor is done with it.
        """
        asked = hashlib.sha256("".join(f"{row.grid_id} {row.grid_sha256} " for row in ready).encode()).digest()
        indexed = self._indices.get(asked)
        if indexed is None:
            found = await compute(partial(self._in_file, ready))
            fresh = await self._fetched([row for row in ready if _key(row) not in found])
            place = np.array([k for k, row in enumerate(ready) if _key(row) in found or _key(row) in fresh], np.intp)
            if not len(place):
                # Gone since a moment: whoever asks again finds what took their place.
                raise StoreUnavailableError
            there = [ready[int(k)] for k in place]
            index = await compute(partial(self._indexed, there, fresh))
            if index is None:
                # The file has no room for all of them: this index has them in memory.
                fresh |= await self._fetched([row for row in there if _key(row) not in fresh])
                index = await compute(partial(self._in_memory, there, fresh))
            indexed = _Indexed(place, index)
            self._indices.put(asked, indexed)
        return [ready[int(k)] for k in indexed.place], indexed.index

    def choose(
        self,
        known: Sequence[Row[Any]],
        index: PlanIndex,
        query: Query,
        weights: MatchingWeights,
        log_prior: Float[np.ndarray, "p"],
    ) -> ChosenPlans:
        """The most probable plans of an index.

        Args:
            log_prior: what is known of plans beforehand.
        """
        log_mass = index.log_masses(query, weights, MatchingConfig()) + log_prior
        poses = np.array([row.poses for row in known])
        chosen = most_probable(log_mass, poses, most_plans=MAX_SEARCHED, most_poses=most_poses(query, self._max_poses))
        return ChosenPlans([known[int(k)] for k in chosen], log_mass, chosen)

    async def load(self, tenant: str, members: Sequence[Row[Any]]) -> list[tuple[Row[Any], PlanRecord, PoseGrid]]:
        """Chosen plans with their grids; those that were deleted or replaced a moment ago are left out."""
        loaded = []
        for row in members:
            record = await self._reads.run(self._store.plans.get_revision, tenant, row.plan_id, row.revision_id)
            key = self._grids.key(row.revision_id, row.camera_height_m)
            grid = self._grids.cached(key) or await self._reads.run(self._grids.find, key)
            if record is not None and grid is not None:
                loaded.append((row, record, grid))
        return loaded

    def close(self) -> None:
        """Let another process have the file."""
        if self._file is not None:
            self._file.close()

    def _members(self, venue_id: str) -> Sequence[Row[Any]]:
        # The state first: what changes in between is found out by the next query.
        state = self._store.venues.state(venue_id, *self._grids.model)
        venue = self._venues.get(venue_id)
        if venue is None or venue.state != state:
            rows = self._store.venues.searched(venue_id, *self._grids.model)
            venue = _Venue(state, list({row.plan_id: row for row in rows}.values()))
            self._venues.put(venue_id, venue)
        return venue.rows

    def _in_file(self, ready: Sequence[Row[Any]]) -> dict[BlockKey, tuple[int, int]]:
        with self._building:
            return self._opened().find(_key(row) for row in ready)

    async def _fetched(self, rows: Sequence[Row[Any]]) -> dict[BlockKey, SortedPrototypes]:
        """Prototypes of some plans from the database; those that it has not are made, of grids that are still there."""
        fetched: dict[BlockKey, SortedPrototypes] = {}
        for first in range(0, len(rows), _BATCH_SIZE):
            part = rows[first : first + _BATCH_SIZE]
            stored = await self._reads.run(self._store.grids.prototypes, [row.grid_id for row in part])
            for row in part:
                prototypes = stored.get(row.grid_id)
                if prototypes is None:
                    key = self._grids.key(row.revision_id, row.camera_height_m)
                    prototypes = await self._reads.run(self._grids.make_prototypes, key, row.grid_id)
                if prototypes is not None:
                    fetched[_key(row)] = prototypes
        return fetched

    def _indexed(self, known: Sequence[Row[Any]], fresh: Mapping[BlockKey, SortedPrototypes]) -> PlanIndex | None:
        """The index of some plans, of which some are not in the file yet; None where that has no room for them."""
        keys = [_key(row) for row in known]
        with self._building:
            file = self._opened()
            there = file.find(fresh)
            try:
                file.add({key: one.in_shipped_cells() for key, one in fresh.items() if key not in there})
            except OSError as error:
                logging.getLogger(LOGGER_NAME).warning("cannot write the file of prototypes: %s", error)
            rows, found = file.rows(), file.find(keys)
        if not all(key in found for key in keys):
            return None
        begin, count = np.array([found[key] for key in keys], np.int64).T
        return PlanIndex.of(rows, begin, count, step_m=self._grids.model[1], cells=shipped_cells())

    def _in_memory(self, known: Sequence[Row[Any]], fresh: Mapping[BlockKey, SortedPrototypes]) -> PlanIndex:
        blocks = [fresh[_key(row)].in_shipped_cells() for row in known]
        count = np.array([len(block) for block in blocks])
        rows, begin = np.concatenate(blocks), np.cumsum(count) - count
        return PlanIndex.of(rows, begin, count, step_m=self._grids.model[1], cells=shipped_cells())

    def _opened(self) -> PrototypeFile:
        if self._file is None:
            version, limit_bytes = shipped_cells().version, self._file_bytes
            try:
                self._file = PrototypeFile(self._path, cells_version=version, limit_bytes=limit_bytes)
            except OSError as error:
                logging.getLogger(LOGGER_NAME).warning("cannot open the file of prototypes: %s", error)
                self._file = PrototypeFile(None, cells_version=version, limit_bytes=limit_bytes)
        return self._file


def most_poses(query: Query, max_poses: int) -> int:
    """How many poses all plans may have that are searched in full: so many comparisons, and at most `max_poses`."""
    return min(max_poses, _MAX_COMPARISONS // (len(query.roll) * len(query.camera_height.offsets)))


def not_excluded(ready: Sequence[Row[Any]], log_prior: Float[np.ndarray, "p"]) -> Sequence[Row[Any]]:
    """The plans that are possible at all.

    Raises:
        InvalidHintError: none is.
    """
    possible = np.isfinite(log_prior)
    if possible.all():
        return ready
    if not possible.any():
        raise InvalidHintError("strict", f"all hints hold in none of the {len(ready)} floor plans that are ready")
    return [ready[k] for k in np.flatnonzero(possible).tolist()]


def venue_height(form: LocaliseForm, ready: Sequence[Row[Any]]) -> CameraHeight:
    """What is known of the camera's height before anything is compared, the same for all plans of a venue.

    What the request says, else what all plans say, if they say the same; else nothing: then any height is possible.
    """
    if form.camera_height_m is not None:
        std_m = DEFAULT_STD_M if form.camera_height_std_m is None else form.camera_height_std_m
        return CameraHeight(form.camera_height_m, std_m)
    said = Counter((row.camera_height_m, row.camera_height_std_m) for row in ready)
    (height_m, std_m), _ = said.most_common(1)[0]
    if len(said) > 1 or std_m is None:
        std_m = math.inf
    return CameraHeight(height_m, std_m if form.camera_height_std_m is None else form.camera_height_std_m)


def _key(row: Row[Any]) -> BlockKey:
    return BlockKey(row.grid_id, row.grid_sha256)
