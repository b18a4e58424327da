"""Limit on the queries that a client sends at the same time."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from lalaloc_client.asynchronous.backend import FetchLimit, Lock, Semaphore, try_acquire


class AsyncConcurrencyLimit:
    """Limit on concurrent queries, fetched from the service when a second query starts beside the first."""

    def __init__(self, max_queries: int | None, fetch: FetchLimit) -> None:
        """Create a limit of `max_queries` concurrent queries; None fetches the service's limit, at least 1."""
        self._slots = Semaphore(max_queries or 1)
        self._known = max_queries is not None
        self._fetch = fetch
        self._fetching = Lock()

    @asynccontextmanager
    async def hold(self) -> AsyncIterator[None]:
        """Wait for a free slot and hold it for the block."""
        if not await try_acquire(self._slots):
            await self._fetch_once()
            await self._slots.acquire()
        try:
            yield
        finally:
            self._slots.release()

    async def _fetch_once(self) -> None:
        async with self._fetching:
            if not self._known:
                for _ in range(await self._fetch() - 1):
                    self._slots.release()
                self._known = True
