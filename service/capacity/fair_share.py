"""Fair sharing of scarce resources between clients, which are tenants or, without API keys, client addresses.

There are two rules and no settings:

* A client gets one more unit only while it holds fewer than three times the units that then stay free. A client alone
  gets three quarters of the total; n greedy clients get 3 / (3n + 1) each, and the remainder stays free for new clients
  (dynamic thresholds: Choudhury and Hahne, IEEE/ACM Transactions on Networking 6(2), 1998).
* Among waiting clients, the one that used the least CPU time lately is served first (`CpuAccounts`); equals take turns.
"""

from __future__ import annotations

import asyncio
import threading
from bisect import insort
from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator, Callable, Iterator, Set
from concurrent.futures import Future
from contextlib import asynccontextmanager, contextmanager
from typing import Generic, TypeVar

from service.capacity.cpu_accounts import CpuAccounts

T = TypeVar("T")

# Largest ratio of the units of a client to the units that stay free.
MAX_RATIO = 3


def with_headroom(count: int) -> int:
    """Return the limit at which a client that is alone gets `count` units."""
    return count + -(-count // MAX_RATIO)


def max_per_client(limit: int) -> int:
    """Return the number of units, at least one, that a client alone can hold of `limit`."""
    return max(limit * MAX_RATIO // (MAX_RATIO + 1), 1)


class Shares:
    """Units held per client. Not thread-safe: for one event loop, or under the owner's lock."""

    def __init__(self, limit: int) -> None:
        self.limit, self.in_use = limit, 0
        self._held: Counter[str] = Counter()

    def held_by(self, client: str) -> int:
        """Return the number of units that a client holds."""
        return self._held[client]

    def held(self) -> dict[str, int]:
        """Return the number of units that each client holds."""
        return dict(self._held)

    def clients(self) -> Set[str]:
        """Return the clients that hold units."""
        return self._held.keys()

    def may_take(self, client: str) -> bool:
        """Return True if a client can take one more unit."""
        held, left = self._held[client], self.limit - self.in_use - 1
        return left >= 0 and (held == 0 or held < MAX_RATIO * left)

    def take(self, client: str, count: int = 1) -> None:
        """Count more units for a client, without a check."""
        self.in_use += count
        self._held[client] += count

    def give_back(self, client: str, count: int = 1) -> None:
        """Count fewer units for a client."""
        self.in_use -= count
        self._held[client] -= count
        if not self._held[client]:
            # Without this the counter would grow with every new client.
            del self._held[client]


class FairQueue(Generic[T]):
    """Queue that serves the client with the least recent CPU time, its item of the lowest `order`, the oldest, first.

    Not thread-safe.
    """

    def __init__(self, accounts: CpuAccounts, order: Callable[[T], float] = lambda _item: 0.0) -> None:
        self._accounts, self._order = accounts, order
        self._waiting: OrderedDict[str, deque[T]] = OrderedDict()

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def clients(self) -> Set[str]:
        """Return the clients with items."""
        return self._waiting.keys()

    def append(self, client: str, item: T) -> None:
        """Append an item of a client."""
        insort(self._waiting.setdefault(client, deque()), item, key=self._order)

    def append_first(self, client: str, item: T) -> None:
        """Put an item before all others of its client, and the client before its equals."""
        self._waiting.setdefault(client, deque()).appendleft(item)
        self._waiting.move_to_end(client, last=False)

    def take(self, may_take: Callable[[str], bool] = lambda _client: True) -> tuple[str, T] | None:
        """Remove and return the next item of the clients that `may_take` accepts; None if there is none."""
        # The first of equals, and the last served is moved to the end.
        client = min(filter(may_take, self._waiting), key=self._accounts.rank, default=None)
        if client is None:
            return None
        item = self._waiting[client].popleft()
        self._waiting.move_to_end(client)
        if not self._waiting[client]:
            del self._waiting[client]
        return client, item

    def drop(self, unwanted: Callable[[T], bool]) -> list[T]:
        """Remove and return the items that `unwanted` selects."""
        dropped: list[T] = []
        for client, items in list(self._waiting.items()):
            kept = deque[T]()
            for item in items:
                (dropped if unwanted(item) else kept).append(item)
            if kept:
                self._waiting[client] = kept
            else:
                del self._waiting[client]
        return dropped


class FairSemaphore:
    """Semaphore that is shared fairly between clients. Thread-safe.

    With `cores`, while other clients use CPU time, a client holds fewer permits than that, one less for each of them:
    its computations leave a core to theirs. It can always hold one.
    """

    def __init__(self, limit: int, accounts: CpuAccounts, *, cores: int | None = None) -> None:
        self._accounts, self._cores = accounts, cores
        self._lock = threading.Lock()
        self._shares = Shares(limit)
        self._waiting: FairQueue[Future[None]] = FairQueue(accounts)

    @property
    def in_use(self) -> int:
        """Number of permits that are held."""
        return self._shares.in_use

    def held_by(self, client: str) -> int:
        """Return the number of permits that a client holds."""
        return self._shares.held_by(client)

    def may_take(self, client: str) -> bool:
        """Return True if a client would get a permit at once."""
        return self._allowed()(client)

    async def acquire(self, client: str) -> None:
        """Wait for a permit; the caller must release it."""
        permit = self._queued(client)
        try:
            await asyncio.wrap_future(permit)
        except asyncio.CancelledError:
            if permit.cancel():
                with self._lock:
                    self._waiting.drop(lambda waiting: waiting is permit)
            else:
                # The permit was granted as the wait was cancelled.
                self.release(client)
            raise

    def acquire_at_once(self, client: str) -> bool:
        """Take a permit if one is free for the client, and return whether it was; the caller must release it."""
        with self._lock:
            # A client that waits never passes, because free permits go to the waiting first.
            if may_take := self.may_take(client):
                self._shares.take(client)
        return may_take

    def take(self, client: str) -> None:
        """Take a permit without a check, so for a while more than the limit can be held."""
        with self._lock:
            self._shares.take(client)

    @asynccontextmanager
    async def held(self, client: str) -> AsyncIterator[None]:
        """Wait for a permit and hold it during the block."""
        await self.acquire(client)
        try:
            yield
        finally:
            self.release(client)

    @contextmanager
    def hold(self, client: str) -> Iterator[None]:
        """Wait for a permit and hold it during the block, as `held` does, on a thread."""
        self._queued(client).result()
        try:
            yield
        finally:
            self.release(client)

    def give_way(self, client: str) -> None:
        """Release a permit to waiting clients with less CPU time lately, if any, and wait for it anew, on a thread."""
        # Queued before the release, which others get otherwise whatever they used.
        permit = self._queued(client)
        self.release(client)
        permit.result()

    def release(self, client: str) -> None:
        """Release a permit."""
        with self._lock:
            self._shares.give_back(client)
        self._grant()

    def _queued(self, client: str) -> Future[None]:
        permit = Future[None]()
        with self._lock:
            self._waiting.append(client, permit)
        self._grant()
        return permit

    def _grant(self) -> None:
        while True:
            with self._lock:
                found = self._waiting.take(self._allowed())
                if found is None:
                    return
                client, permit = found
                if not permit.set_running_or_notify_cancel():
                    continue
                self._shares.take(client)
            permit.set_result(None)

    def _allowed(self) -> Callable[[str], bool]:
        """Return the test of the clients that can take a permit now."""
        if self._cores is None:
            return self._shares.may_take
        active = len(self._accounts.active() | self._shares.clients() | self._waiting.clients())
        if active < 2:
            return self._shares.may_take
        most = max(self._cores - active + 1, self._cores // active, 1)
        return lambda client: self._shares.held_by(client) < most and self._shares.may_take(client)
