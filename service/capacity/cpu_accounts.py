"""CPU time that each client used, in total and recently."""

from __future__ import annotations

import threading
from collections.abc import Callable, Coroutine, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import takewhile
from time import monotonic, thread_time
from types import coroutine
from typing import Any, TypeVar

T = TypeVar("T")

# Client of health checks and metrics, which is never active: it leaves all cores to tenants.
PROBES = "(probes)"
# CPU time counts half after this time, so that a client that used much is served last for some tens of seconds.
_HALF_LIFE_S = 10.0
# A client is active for this long after it last used CPU time.
_ACTIVE_S = 1.0
# Time of rest per CPU time while others are active. Shorter CPU times (s) add up first; longer rests (s) are cut.
_REST_RATIO, _LEAST_OWED_S, _LONGEST_REST_S = 3.0, 0.005, 0.5
# Clients whose recent CPU time differs by less take turns.
_RANK_S = 0.02
# Without API keys every client address is a client.
_MAX_CLIENTS = 4096


@dataclass
class _Account:
    total_s: float = 0.0
    recent_s: float = 0.0
    charged_at: float = 0.0
    owed_s: float = 0.0
    rest_until: float = 0.0
    refused_until: float = 0.0

    def recent_at(self, now: float) -> float:
        return self.recent_s * 0.5 ** ((now - self.charged_at) / _HALF_LIFE_S)


_NOTHING = _Account()


class CpuAccounts:
    """CPU seconds per client. Thread-safe.

    Attributes:
        share: returns the weight of a client; the recent CPU time of a client with weight 2 counts half.
    """

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self.share: Callable[[str], float] = lambda _client: 1.0
        self._clock, self._lock = clock, threading.Lock()
        self._accounts: dict[str, _Account] = {}

    def charge(self, client: str, cpu_s: float, *, rests: bool = False) -> None:
        """Add CPU time (s) to a client's account; `rests`: it counts for `rest_s`."""
        with self._lock:
            now = self._clock()
            account = self._accounts.pop(client, None)
            if account is None:
                self._make_room(now)
                account = _Account()
            # The last one charged is the last in the dictionary.
            self._accounts[client] = account
            account.recent_s, account.charged_at = account.recent_at(now) + cpu_s, now
            account.total_s += cpu_s
            account.owed_s += cpu_s if rests else 0.0

    def refuse(self, client: str, cpu_s: float) -> None:
        """Let the queries of a client rest for the CPU time (s) of one that was refused, which was charged already."""
        with self._lock:
            now = self._clock()
            account = self._accounts.get(client)
            if account is not None and self._active(now) - {client}:
                until = max(account.refused_until, now) + _REST_RATIO * cpu_s
                account.refused_until = min(until, now + _LONGEST_REST_S)

    def refused_rest_s(self, client: str) -> float:
        """Return how long (s) queries of a client must rest now because others of it were refused."""
        return max(self._accounts.get(client, _NOTHING).refused_until - self._clock(), 0.0)

    @contextmanager
    def charged(self, client: str, *, rests: bool = False) -> Iterator[Callable[[], None]]:
        """Charge the CPU time that this thread uses in the block; the function charges what it used until then."""
        begin = thread_time()

        def charge() -> None:
            nonlocal begin
            before, begin = begin, thread_time()
            self.charge(client, begin - before, rests=rests)

        try:
            yield charge
        finally:
            charge()

    @coroutine
    def charged_steps(
        self,
        client: str,
        work: Coroutine[Any, Any, T],
        *,
        rests: bool = False,
        spend: Callable[[float], None] = lambda _cpu_s: None,
    ) -> Generator[Any, Any, T]:
        """Run a coroutine and charge the CPU time of its steps, without those of other tasks in between.

        `spend` receives the CPU time (s) of each step, too.
        """
        value, error = None, None
        while True:
            begin = thread_time()
            try:
                awaited = work.send(value) if error is None else work.throw(error)
            except StopIteration as done:
                return done.value
            finally:
                cpu_s = thread_time() - begin
                self.charge(client, cpu_s, rests=rests)
                spend(cpu_s)
            value, error = None, None
            try:
                value = yield awaited
            except BaseException as thrown:
                error = thrown

    def recent_s(self, client: str) -> float:
        """Return the CPU time (s) that a client used lately, by its weight."""
        return self._accounts.get(client, _NOTHING).recent_at(self._clock()) / self.share(client)

    def active(self) -> set[str]:
        """Return the clients that used CPU time within the last second."""
        with self._lock:
            return self._active(self._clock())

    def rest_s(self, client: str) -> float:
        """Return how long (s) a client must rest now: while others are active, three times as long as it computed.

        So a client whose requests follow each other computes for a quarter of the time, and leaves the interpreter to
        others for the rest. Only CPU time since its last rest counts that was charged with `rests`.
        """
        with self._lock:
            now = self._clock()
            account = self._accounts.get(client)
            if account is None:
                return 0.0
            if account.rest_until <= now and account.owed_s >= _LEAST_OWED_S:
                rest_s = min(_REST_RATIO * account.owed_s, _LONGEST_REST_S) if self._active(now) - {client} else 0.0
                account.owed_s, account.rest_until = 0.0, now + rest_s
            return max(account.rest_until - now, 0.0)

    def rank(self, client: str) -> int:
        """Return the place of a client in a queue, the lowest first: its recent CPU time in units that matter."""
        return int(self.recent_s(client) / _RANK_S)

    def total_s(self, client: str) -> float:
        """Return all CPU time (s) that a client used since the start."""
        return self._accounts.get(client, _NOTHING).total_s

    def totals(self) -> dict[str, float]:
        """Return `total_s` of every client."""
        with self._lock:
            return {client: account.total_s for client, account in self._accounts.items()}

    def _active(self, now: float) -> set[str]:
        latest = takewhile(lambda item: item[1].charged_at >= now - _ACTIVE_S, reversed(self._accounts.items()))
        return {client for client, _ in latest} - {PROBES}

    def _make_room(self, now: float) -> None:
        """Forget the quarter of the clients that used the least CPU time lately if there are too many."""
        if len(self._accounts) >= _MAX_CLIENTS:
            by_use = sorted(self._accounts, key=lambda client: self._accounts[client].recent_at(now))
            for client in by_use[: _MAX_CLIENTS // 4]:
                del self._accounts[client]
