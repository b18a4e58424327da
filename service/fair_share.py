"""Fair sharing: what is scarce is shared between clients, so that none can take all of it from the others.

A client is a tenant or, where there are no API keys, the network address that asks. Two rules, without any settings:

* A client that holds some may take one more only while it holds fewer than three times as many as would then be left.
  Alone it gets three quarters; of n clients that want all they can get, each gets 3 / (3n + 1), and what is left is for
  whoever comes next (dynamic thresholds: Choudhury and Hahne, IEEE/ACM Transactions on Networking 6(2), 1998).
* Those that wait are served in turn, one of each client: who comes with one job waits for one of every other, however
  many jobs those have.
"""

from __future__ import annotations

import asyncio
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")

# How many times as much a client may hold as it leaves to others.
_TIMES_WHAT_IS_LEFT = 3


def with_headroom(count: int) -> int:
    """The limit at which a client that is alone gets `count`."""
    return count + -(-count // _TIMES_WHAT_IS_LEFT)


def max_per_client(limit: int) -> int:
    """How many of `limit` a client may hold while it is alone, one at least."""
    return max(limit * _TIMES_WHAT_IS_LEFT // (_TIMES_WHAT_IS_LEFT + 1), 1)


class Shares:
    """How much of something each client holds. Not locked: for one event loop, or under the lock of its owner."""

    def __init__(self, limit: int) -> None:
        """Args:
        limit: how much of it there is.
        """
        self.limit = limit
        self.in_use = 0
        self._held: Counter[Hashable] = Counter()

    def held_by(self, client: Hashable) -> int:
        """How much a client holds."""
        return self._held[client]

    def may_take(self, client: Hashable) -> bool:
        """Whether a client may take one more."""
        held, left = self._held[client], self.limit - self.in_use - 1
        return left >= 0 and (held == 0 or held < _TIMES_WHAT_IS_LEFT * left)

    def take(self, client: Hashable) -> None:
        """Note that a client holds one more, whether or not it may."""
        self.in_use += 1
        self._held[client] += 1

    def give_back(self, client: Hashable) -> None:
        """Note that a client holds one less."""
        self.in_use -= 1
        self._held[client] -= 1
        if not self._held[client]:
            # Those that come and go must not pile up.
            del self._held[client]


class FairQueue(Generic[T]):
    """What waits, oldest first for each client, and clients in turn. Not locked either."""

    def __init__(self) -> None:
        self._waiting: OrderedDict[Hashable, deque[T]] = OrderedDict()
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def append(self, client: Hashable, item: T) -> None:
        """Let something wait."""
        self._waiting.setdefault(client, deque()).append(item)
        self._length += 1

    def append_first(self, client: Hashable, item: T) -> None:
        """Let something wait before all else."""
        self._waiting.setdefault(client, deque()).appendleft(item)
        self._waiting.move_to_end(client, last=False)
        self._length += 1

    def take(self, may_take: Callable[[Hashable], bool] = lambda _client: True) -> tuple[Hashable, T] | None:
        """What is next of the clients that may take it; None when nothing is."""
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
        """Take out what nobody wants any more."""
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
    """A semaphore that is acquired by clients in turn, and shared out between them; for one event loop."""

    def __init__(self, limit: int) -> None:
        """Args:
        limit: permits in all, of which one client gets the share that `Shares` leaves to it.
        """
        self._shares = Shares(limit)
        self._waiting: FairQueue[asyncio.Future[None]] = FairQueue()

    async def acquire(self, client: Hashable) -> None:
        """Wait for a permit of a client, which must be released."""
        permit = asyncio.get_running_loop().create_future()
        self._waiting.append(client, permit)
        self._grant()
        try:
            await permit
        except asyncio.CancelledError:
            if permit.done() and not permit.cancelled():
                # It came at the very moment when nobody waited any more.
                self.release(client)
            raise

    def release(self, client: Hashable) -> None:
        """Give a permit back."""
        self._shares.give_back(client)
        self._grant()

    def _grant(self) -> None:
        while (found := self._waiting.take(self._shares.may_take)) is not None:
            client, permit = found
            if not permit.cancelled():
                self._shares.take(client)
                permit.set_result(None)
