"""Pose grids in memory, in front of those in the store."""

from __future__ import annotations

from collections.abc import Collection

from lalaloc_core.localise.match import PoseGrid
from service.capacity.bounded_cache import BoundedCache
from service.grids.embedding import grid_bytes
from service.storage import Store
from service.storage.records import GridKey
from service.telemetry import Telemetry


class GridCache(BoundedCache[GridKey, PoseGrid]):
    """Cache of computed pose grids; safe to share between threads."""

    def __init__(self, store: Store, limit_bytes: int, telemetry: Telemetry) -> None:
        super().__init__(limit_bytes, grid_bytes)
        self._store = store
        self._telemetry = telemetry

    def cached(self, key: GridKey) -> PoseGrid | None:
        """Return a grid from memory."""
        grid = self.get(key)
        if grid is not None:
            self._telemetry.grid_cache_hits.inc()
        return grid

    def find(self, key: GridKey) -> PoseGrid | None:
        """Return a grid from memory or from the store.

        Raises:
            StoreUnavailableError: the grid is not in memory, and the database is unavailable.
        """
        grid = self.cached(key)
        if grid is not None:
            return grid
        self._telemetry.grid_cache_misses.inc()
        return self.load(key)

    def find_all(self, keys: Collection[GridKey]) -> dict[GridKey, PoseGrid]:
        """Return the grids of a model that are in memory or in the store, as `find` does; one read for all others."""
        found = {key: grid for key in keys if (grid := self.cached(key)) is not None}
        missing = [key for key in keys if key not in found]
        self._telemetry.grid_cache_misses.inc(len(missing))
        loaded = self._store.grids.get_all(missing) if missing else {}
        for key, grid in loaded.items():
            self.put(key, grid)
        return found | loaded

    def load(self, key: GridKey) -> PoseGrid | None:
        """Return a grid as `find` does, without metrics."""
        return self.get_or_make(key, lambda: self._store.grids.get(key))

    def put(self, key: GridKey, value: PoseGrid) -> int:
        """Keep a grid; see `BoundedCache.put`."""
        evicted = super().put(key, value)
        self._telemetry.grid_cache_evictions.inc(evicted)
        return evicted
