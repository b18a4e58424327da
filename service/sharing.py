"""How what is scarce is shared between parties, so that none can take all of it from the others.

A party is a tenant or, where there are no API keys, the network address of a client. Two rules, without any settings:

* A party that holds some may take one more only while it holds fewer than three times as many as would then be left.
  Alone it gets three quarters; of n parties that want all they can get, each gets 3 / (3n + 1), and what is left is for
  whoever comes next (dynamic thresholds: Choudhury and Hahne, IEEE/ACM Transactions on Networking 6(2), 1998).
* Those that wait are served in turn, one of each party: who comes with one job waits for one of every other, however
  many jobs those have.
"""

from __future__ import annotations

import asyncio
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")

# How many times as much a party may hold as it leaves to others.
_TIMES_WHAT_IS_LEFT = 3


def with_spare(count: int) -> int:
    """How many there must be for a party to get `count` of them by itself."""
    return count + -(-count // _TIMES_WHAT_IS_LEFT)


def most_of_one(limit: int) -> int:
    """How many of so many a party may hold while it is alone, of one at least."""
    return max(limit * _TIMES_WHAT_IS_LEFT // (_TIMES_WHAT_IS_LEFT + 1), 1)


class Shares:
    """How much of something each party holds. Not locked: for one event loop, or under the lock of its owner."""

    def __init__(self, limit: int) -> None:
        """
        Args:
            limit: how much of it there is.
        """
        self.limit = limit
        self.in_use = 0
        self._held: Counter[Hashable] = Counter()

    def held_by(self, party: Hashable) -> int:
        """How much a party holds."""
        return self._held[party]

    def may_take(self, party: Hashable) -> bool:
        """Whether a party may take one more."""
        held, left = self._held[party], self.limit - self.in_use - 1
        return left >= 0 and (held == 0 or held < _TIMES_WHAT_IS_LEFT * left)

    def take(self, party: Hashable) -> None:
        """Note that a party holds one more, whether or not it may."""
        self.in_use += 1
        self._held[party] += 1

    def give_back(self, party: Hashable) -> None:
        """Note that a party holds one less."""
        self.in_use -= 1
        self._held[party] -= 1
        if not self._held[party]:
            # Those that come and go must not pile up.
            del self._held[party]


class FairQueue(Generic[T]):
    """What waits, oldest first for each party, and parties in turn. Not locked either."""

    def __init__(self) -> None:
        self._waiting: OrderedDict[Hashable, deque[T]] = OrderedDict()
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def append(self, party: Hashable, item: T) -> None:
        """Let something wait."""
        self._waiting.setdefault(party, deque()).append(item)
        self._length += 1

    def append_first(self, party: Hashable, item: T) -> None:
        """Let something wait before all else."""
        self._waiting.setdefault(party, deque()).appendleft(item)
        self._waiting.move_to_end(party, last=False)
        self._length += 1

    def take(self, may_take: Callable[[Hashable], bool] = lambda _party: True) -> tuple[Hashable, T] | None:
        """What is next of the parties that may take it; None when nothing is."""
        party = next((party for party in self._waiting if may_take(party)), None)
        if party is None:
            return None
        item = self._waiting[party].popleft()
        self._length -= 1
        self._waiting.move_to_end(party)
        if not self._waiting[party]:
            del self._waiting[party]
        return party, item

    def drop(self, unwanted: Callable[[T], bool]) -> list[T]:
        """Take out what nobody wants any more."""
        dropped: list[T] = []
        for party, items in list(self._waiting.items()):
            gone = [item for item in items if unwanted(item)]
            if len(gone) == len(items):
                del self._waiting[party]
            elif gone:
                self._waiting[party] = deque(item for item in items if item not in gone)
            dropped += gone
        self._length -= len(dropped)
        return dropped


class FairTurns:
    """So many at a time, the others wait; for one event loop."""

    def __init__(self, limit: int) -> None:
        """
        Args:
            limit: how many have their turn at a time, of which one party gets the share that `Shares` leaves to it.
        """
        self._shares = Shares(limit)
        self._waiting: FairQueue[asyncio.Future[None]] = FairQueue()

    async def acquire(self, party: Hashable) -> None:
        """Wait for a turn of a party, which must be given back."""
        turn = asyncio.get_running_loop().create_future()
        self._waiting.append(party, turn)
        self._pass_on()
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                # It came at the very moment when nobody waited any more.
                self.release(party)
            raise

    def release(self, party: Hashable) -> None:
        """Give a turn back."""
        self._shares.give_back(party)
        self._pass_on()

    def _pass_on(self) -> None:
        while (found := self._waiting.take(self._shares.may_take)) is not None:
            party, turn = found
            if not turn.cancelled():
                self._shares.take(party)
                turn.set_result(None)
