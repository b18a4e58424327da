"""A few threads of their own for each kind of work that waits, so that one kind never fills those of another."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from contextvars import copy_context
from typing import Any, ParamSpec, TypeVar

from service.errors import StoreUnavailableError
from service.fair_share import FairSemaphore

P = ParamSpec("P")
T = TypeVar("T")


class Threads:
    """Runs blocking calls for one event loop; what waits for a thread is bounded by who is let in."""

    def __init__(self, name: str, count: int) -> None:
        """Args:
        count: how many there are; `run` shares them out between clients.
        """
        self._executor = ThreadPoolExecutor(count, thread_name_prefix=name)
        self._semaphore = FairSemaphore(count)

    async def run(self, client: str, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """The outcome of a client's call; one that has begun runs to its end, whether or not its caller waits."""
        await self._semaphore.acquire(client)
        loop = asyncio.get_running_loop()

        def release(_future: Future[T]) -> None:
            # A loop that is closed has nobody to wake.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(self._semaphore.release, client)

        try:
            future = self.submit(work, *args, **kwargs)
        except BaseException:
            self._semaphore.release(client)
            raise
        # Not when its caller leaves: the thread is busy for longer.
        future.add_done_callback(release)
        return await asyncio.wrap_future(future)

    def submit(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Begin a call in the caller's context, so that what it logs belongs to its request."""
        return self._executor.submit(copy_context().run, work, *args, **kwargs)

    def close(self, *, wait: bool = True) -> None:
        """Finish what has begun, drop the rest."""
        self._executor.shutdown(wait=wait, cancel_futures=True)


class BoundedReads:
    """Reads of the store that nobody waits for longer than a while, also when it hangs instead of failing."""

    def __init__(self, *, threads: int, max_pending: int, wait_s: float) -> None:
        """Args:
        max_pending: reads that may be at work or wait for a thread; no more are lost when the store hangs.
        wait_s: longest wait for one.
        """
        self._threads = Threads("lalaloc-reads", threads)
        self._max_pending = max_pending
        self._wait_s = wait_s
        self._begun: set[Future[Any]] = set()

    async def run(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What the store says.

        Raises:
            StoreUnavailableError: it did not answer in time, or too many reads are waiting for it already.
        """
        if len(self._begun) >= self._max_pending:
            raise StoreUnavailableError()
        future = self._threads.submit(work, *args, **kwargs)
        self._begun.add(future)
        # Also retrieves what was raised after nobody waited any more.
        loop_future = asyncio.wrap_future(future)
        loop_future.add_done_callback(lambda done: self._end(future, done))
        done, _ = await asyncio.wait({loop_future}, timeout=self._wait_s)
        if not done:
            raise StoreUnavailableError()
        return loop_future.result()

    def close(self) -> None:
        """Drop what waits; what hangs is left behind."""
        self._threads.close(wait=False)

    def _end(self, future: Future[Any], done: asyncio.Future[Any]) -> None:
        self._begun.discard(future)
        if not done.cancelled():
            done.exception()
