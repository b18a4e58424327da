"""Indices of the plans of venues in memory, and the file of their prototypes."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol
from weakref import WeakValueDictionary

import numpy as np
from cachetools import LRUCache
from jaxtyping import Int, UInt64
from sqlalchemy import Row

from lalaloc_core.localise.venue.index_search import DividedIndex
from lalaloc_core.localise.venue.plan_index import PlanIndex
from lalaloc_core.localise.venue.prototype_cells import shipped_cells
from service.bounded_cache import BoundedCache
from service.capacity.threads import BoundedReads
from service.errors import StoreUnavailableError
from service.grids import GridProvider
from service.storage import Store
from service.storage.grid_format import SortedPrototypes
from service.telemetry import LOGGER_NAME
from service.venues.plan_list import PlanList
from service.venues.prototype_file import BlockKey, PrototypeFile

# Prototypes per read, so that a read is short.
_BATCH_SIZE = 1000
# Maximum number of venues whose last index is remembered; the indices themselves are bounded in bytes.
_MAX_LATEST = 1000

# Function that runs CPU work on the threads of `Executor`.
Compute = Callable[[Callable[[], Any]], Awaitable[Any]]


class IndexSource(Protocol):
    """Source of the indices of plans."""

    async def index(
        self, tenant: str, ready: PlanList, compute: Compute, *, venue_id: str | None = None
    ) -> tuple[PlanList, DividedIndex]:
        """See `PlanIndices.index`."""
        ...


@dataclass(frozen=True, eq=False)
class Indexed:
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


class PlanIndices:
    """Indices of plans in this process.

    Prototypes lie in a file of this replica, without a `path` a temporary one, which is opened on first use and filled
    from the database on demand. When plans of a venue change, a new index takes the others from the old one.
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
    ) -> None:
        self._store, self._grids, self._reads = store, grids, reads
        self._path, self._file_bytes = path, file_bytes
        # Keys are digests of the plans' grids in order.
        self._indices: BoundedCache[bytes, Indexed] = BoundedCache(
            limit_bytes, lambda indexed: indexed.keys.nbytes + indexed.index.nbytes
        )
        # Keys of the last index of all plans of a venue that are ready, which the next one begins with.
        self._latest: LRUCache[str, bytes] = LRUCache(_MAX_LATEST)
        # One query at a time makes the index with a key.
        self._turns: WeakValueDictionary[bytes, asyncio.Lock] = WeakValueDictionary()
        self._file: PrototypeFile | None = None
        self._building = threading.Lock()

    async def index(
        self, tenant: str, ready: PlanList, compute: Compute, *, venue_id: str | None = None
    ) -> tuple[PlanList, DividedIndex]:
        """Return the index of plans that are ready, and their rows in its order, without plans whose grid was deleted.

        Prototypes that are missing, or of an earlier format, are made and stored. `venue_id` is given if these are all
        plans of the venue that are ready.
        """
        digest = ready.digest
        indexed = self._indices.get(digest)
        if indexed is None:
            # Other queries wait, and find what the first one made.
            async with self._turns.setdefault(digest, asyncio.Lock()):
                latest = None if venue_id is None else self._latest.get(venue_id)
                indexed = self._indices.get(digest) or await self._make_index(tenant, ready, compute, latest)
        if venue_id is not None:
            self._latest[venue_id] = digest
        if len(indexed.keys) == len(ready):
            return ready, indexed.index.whole
        return ready.chosen(np.isin(ready.keys, indexed.keys)), indexed.index.whole

    def held(self, digest: bytes) -> Indexed | None:
        """Return the index that was asked for plans with a digest, if it is still in memory."""
        return self._indices.get(digest)

    def close(self) -> None:
        """Release the prototype file for other processes."""
        if self._file is not None:
            self._file.close()

    async def _make_index(self, tenant: str, ready: PlanList, compute: Compute, latest: bytes | None) -> Indexed:
        """Return the index of plans, beginning with the one with the key `latest` if it has most of them."""
        base = None if latest is None else self._indices.get(latest)
        if base is not None and 2 * int((base.numbers(ready) >= 0).sum()) < max(len(ready), len(base.keys)):
            base = None
        is_known = np.zeros(len(ready), bool) if base is None else base.numbers(ready) >= 0
        unknown = [ready[k] for k in np.flatnonzero(~is_known).tolist()]
        found = await compute(partial(self._in_file, unknown))
        fresh = await self._fetched(tenant, [row for row in unknown if _key(row) not in found])
        is_found = np.array([_key(row) in found or _key(row) in fresh for row in unknown], bool)
        there = ready.chosen(np.isin(np.arange(len(ready)), np.flatnonzero(~is_known)[~is_found], invert=True))
        if not there:
            # All were deleted or replaced just now; a retry finds the current ones.
            raise StoreUnavailableError

        def kept(make: Callable[[], PlanIndex]) -> Indexed:
            def indexed() -> Indexed:
                made = Indexed(there.keys, make())
                if base is not None:
                    # Queries in progress keep it; most of its memory is in the new one as well.
                    self._indices.drop(lambda key, _: key == latest)
                return made

            # Once on all threads: this one makes it to the end, even if its query misses the deadline.
            return self._indices.get_or_make(ready.digest, indexed)

        try:
            return await compute(partial(kept, partial(self._indexed, there, fresh, base)))
        except _NotInFileError:
            if base is not None:
                return await self._make_index(tenant, ready, compute, None)
            # The file has no room for all of them, so this index keeps them in memory.
            fresh |= await self._fetched(tenant, [row for row in there if _key(row) not in fresh])
            return await compute(partial(kept, partial(self._in_memory, there, fresh)))

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

    def _indexed(self, known: PlanList, fresh: Mapping[BlockKey, SortedPrototypes], base: Indexed | None) -> PlanIndex:
        """Add prototypes to the file and index it."""
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


def _key(row: Row[Any]) -> BlockKey:
    return BlockKey(row.grid_id, row.grid_sha256)
