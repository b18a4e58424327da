"""Separate threads for each kind of blocking work."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack
from contextvars import ContextVar, copy_context
from typing import Any, ParamSpec, TypeVar

from service.capacity.cpu_accounts import PROBES, CpuAccounts
from service.capacity.fair_share import FairSemaphore
from service.errors import StoreUnavailableError

P = ParamSpec("P")
T = TypeVar("T")

# Client of the call that a thread computes, and the function that charges what the call used until now.
_CLIENT: ContextVar[str] = ContextVar("client", default=PROBES)
_CHARGE: ContextVar[Callable[[], None]] = ContextVar("charge")


def charge_until_now() -> None:
    """Charge the CPU time of this thread's call, which goes on: others with less are served first from now on."""
    _CHARGE.get()()


class Threads:
    """Threads for blocking calls of one event loop, shared fairly between clients; admission control bounds the queue.

    Args:
        name: prefix of thread names.
        count: number of threads.
        accounts: CPU time of the clients, to which calls are charged.
        cores: cores to compute on, of which each call holds one; None: calls hold none.
        beside_others: limits the threads of a client beside other clients, as `cores` of `FairSemaphore`.
        rests: the calls count for `CpuAccounts.rest_s`.
    """

    def __init__(
        self,
        name: str,
        count: int,
        accounts: CpuAccounts | None = None,
        cores: FairSemaphore | None = None,
        *,
        beside_others: int | None = None,
        rests: bool = False,
    ) -> None:
        self._rests = rests
        self._executor = ThreadPoolExecutor(count, thread_name_prefix=name)
        self._accounts = accounts or CpuAccounts()
        threads = FairSemaphore(count, self._accounts, cores=beside_others)
        self._needed = [threads] if cores is None else [threads, cores]

    async def run(self, client: str, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run a call for a client and return its result; a call that has begun is never cancelled."""
        with ExitStack() as taken:
            for semaphore in self._needed:
                await semaphore.acquire(client)
                taken.callback(semaphore.release, client)
            future = self.submit(self._charged, client, work, *args, **kwargs)
            # Released when the thread is done, even if the caller was cancelled.
            kept = taken.pop_all()
            future.add_done_callback(lambda _future: kept.close())
        return await asyncio.wrap_future(future)

    def _charged(self, client: str, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        _CLIENT.set(client)
        with self._accounts.charged(client, rests=self._rests) as charge:
            _CHARGE.set(charge)
            return work(*args, **kwargs)

    def submit(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Start a call in the caller's context, so that its log lines have the request's ids."""
        return self._executor.submit(copy_context().run, work, *args, **kwargs)

    def close(self, *, wait: bool = True) -> None:
        """Finish running calls and drop the rest."""
        self._executor.shutdown(wait=wait, cancel_futures=True)


class IdleCores(Executor):
    """Threads that take over parts of the calls of `Threads` while cores are idle; charged to the calls' clients.

    As many cores are busy as are held.
    """

    def __init__(self, count: int, accounts: CpuAccounts, cores: FairSemaphore) -> None:
        self._executor = ThreadPoolExecutor(max(count // 2, 1), thread_name_prefix="idle-core")
        self._count, self._accounts, self._cores = count, accounts, cores

    def if_any(self) -> IdleCores | None:
        """Return these threads if a core is idle."""
        return self if self._cores.in_use < self._count else None

    def submit(self, work: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Start a part of the call that the current thread computes."""
        return self._executor.submit(self._charged, _CLIENT.get(), work, *args, **kwargs)

    def _charged(self, client: str, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        with self._accounts.charged(client):
            return work(*args, **kwargs)

    def close(self) -> None:
        """Finish what is running."""
        self._executor.shutdown()


class BoundedReads:
    """Reads of the store with a timeout, which also applies while the store hangs; shared fairly between tenants.

    `max_pending` limits running and waiting reads, and so the threads and requests that a hanging store blocks.
    """

    def __init__(self, *, threads: int, max_pending: int, wait_s: float) -> None:
        self._threads = Threads("lalaloc-reads", threads)
        self._max_pending, self._wait_s = max_pending, wait_s
        self._begun: set[asyncio.Future[Any]] = set()

    async def run(self, tenant: str, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run a read for a tenant and return its result; one that has begun is never cancelled."""
        if len(self._begun) >= self._max_pending:
            raise StoreUnavailableError()
        begun = asyncio.ensure_future(self._threads.run(tenant, work, *args, **kwargs))
        self._begun.add(begun)
        begun.add_done_callback(self._end)
        done, _ = await asyncio.wait({begun}, timeout=self._wait_s)
        if not done:
            raise StoreUnavailableError()
        return begun.result()

    async def process(self, tenant: str, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run work on what was read, which does not touch the store and has no timeout."""
        return await self._threads.run(tenant, work, *args, **kwargs)

    def close(self) -> None:
        """Drop waiting reads and abandon hanging ones."""
        self._threads.close(wait=False)

    def _end(self, done: asyncio.Future[Any]) -> None:
        # The result is also taken after a timeout.
        self._begun.discard(done)
        if not done.cancelled():
            done.exception()
