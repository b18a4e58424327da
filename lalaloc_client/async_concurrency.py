"""Queries of several tasks wait for their turn."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager


class AsyncConcurrencyLimit:
    """As `ConcurrencyLimit`."""

    def __init__(self, max_queries: int | None, ask: Callable[[], Awaitable[int]]) -> None:
        """See `ConcurrencyLimit`."""
        self._slots = asyncio.Semaphore(max_queries or 1)
        self._known = max_queries is not None
        self._ask = ask
        self._asking = asyncio.Lock()

    @asynccontextmanager
    async def hold(self) -> AsyncIterator[None]:
        """See `ConcurrencyLimit.hold`."""
        if self._slots.locked():
            await self._learn()
        async with self._slots:
            yield

    async def _learn(self) -> None:
        async with self._asking:
            if not self._known:
                for _ in range(await self._ask() - 1):
                    self._slots.release()
                self._known = True
