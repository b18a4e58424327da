"""Fair sharing of scarce resources between clients.

A client is a tenant or, without API keys, a client address. There are two rules and no settings:

* A client gets one more unit only while it holds fewer than three times the units that then stay free. A client alone
  gets three quarters of the total; n greedy clients get 3 / (3n + 1) each, and the remainder stays free for new clients
  (dynamic thresholds: Choudhury and Hahne, IEEE/ACM Transactions on Networking 6(2), 1998).
* Waiting jobs are served round-robin by client, so a client with one job waits for at most one job of each other
  client.
"""

from __future__ import annotations

import asyncio
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")

# Largest ratio of the units of a client to the units that stay free.
_MAX_RATIO = 3


def with_headroom(count: int) -> int:
    """Return the limit at which a client that is alone gets `count` units."""
    return count + -(-count // _MAX_RATIO)


def max_per_client(limit: int) -> int:
    """Return the number of units, at least one, that a client alone can hold of `limit`."""
    return max(limit * _MAX_RATIO // (_MAX_RATIO + 1), 1)


class Shares:
    """Units held per client. Not thread-safe: for one event loop, or under the owner's lock.

    Args:
        limit: total number of units.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.in_use = 0
        self._held: Counter[Hashable] = Counter()

    def held_by(self, client: Hashable) -> int:
        """Return the number of units that a client holds."""
        return self._held[client]

    def may_take(self, client: Hashable) -> bool:
        """Return True if a client can take one more unit."""
        held, left = self._held[client], self.limit - self.in_use - 1
        return left >= 0 and (held == 0 or held < _MAX_RATIO * left)

    def take(self, client: Hashable) -> None:
        """Count one more unit for a client, without a check."""
        self.in_use += 1
        self._held[client] += 1

    def give_back(self, client: Hashable) -> None:
        """Count one unit less for a client."""
        self.in_use -= 1
        self._held[client] -= 1
        if not self._held[client]:
            # Without this the counter would grow with every new client.
            del self._held[client]


class FairQueue(Generic[T]):
    """Queue that serves clients round-robin, oldest item first. Not thread-safe."""

    def __init__(self) -> None:
        self._waiting: OrderedDict[Hashable, deque[T]] = OrderedDict()
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def append(self, client: Hashable, item: T) -> None:
        """Append an item of a client."""
        self._waiting.setdefault(client, deque()).append(item)
        self._length += 1

    def append_first(self, client: Hashable, item: T) -> None:
        """Put an item before all others."""
        self._waiting.setdefault(client, deque()).appendleft(item)
        self._waiting.move_to_end(client, last=False)
        self._length += 1

    def take(self, may_take: Callable[[Hashable], bool] = lambda _client: True) -> tuple[Hashable, T] | None:
        """Remove and return the next item of a client that `may_take` accepts; None if there is none."""
        client = next((client for client in self._waiting if may_take(client)), None)
        if client is None:
            return None
        item = self._waiting[client].popleft()
        self._length -= 1
        self._waiting.move_to_end(client)
        if not self._waiting[client]:
            del self._waiting[client]
        return client, item

    def drop(self, unwanted: Callable[[T], bool]) -> list[T]:
        """Remove and return the items that `unwanted` selects."""
        dropped: list[T] = []
        for client, items in list(self._waiting.items()):
            gone = [item for item in items if unwanted(item)]
            if len(gone) == len(items):
                del self._waiting[client]
            elif gone:
                self._waiting[client] = deque(item for item in items if item not in gone)
            dropped += gone
        self._length -= len(dropped)
        return dropped


class FairSemaphore:
    """Semaphore that is shared fairly between clients; for one event loop.

    Args:
        limit: number of permits.
    """

    def __init__(self, limit: int) -> None:
        self._shares = Shares(limit)
        self._waiting: FairQueue[asyncio.Future[None]] = FairQueue()

    async def acquire(self, client: Hashable) -> None:
        """Wait for a permit; the caller must release it."""
        permit = asyncio.get_running_loop().create_future()
        self._waiting.append(client, permit)
        self._grant()
        try:
            await permit
        except asyncio.CancelledError:
            if permit.done() and not permit.cancelled():
                # The permit was granted as the wait was cancelled.
                self.release(client)
            raise

    def release(self, client: Hashable) -> None:
        """Release a permit."""
        self._shares.give_back(client)
        self._grant()

    def _grant(self) -> None:
        while (found := self._waiting.take(self._shares.may_take)) is not None:
            client, permit = found
            if not permit.cancelled():
                self._shares.take(client)
                permit.set_result(None)
