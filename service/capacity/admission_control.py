"""Admission control: slots for each kind of request, and immediate refusal when all are in use.

Every request, except for health and metrics, holds a slot from the end of its head to the end of its answer. An
uploaded query needs a second slot to be computed, and waits for it in a short queue. All queues are bounded.
"""

from __future__ import annotations

import asyncio
import math
import threading
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from time import monotonic
from typing import Any
from weakref import WeakKeyDictionary

from service.capacity.bytes_in_flight import BytesInFlight
from service.capacity.cpu_accounts import CpuAccounts
from service.capacity.fair_share import FairQueue, FairSemaphore, Shares
from service.errors import (
    DeadlineExceededError,
    ExpectedTooLateError,
    OverloadedError,
    ShareExceededError,
    StoppingError,
)
from service.settings import Settings
from service.telemetry import Telemetry

EXEMPT = frozenset({"/healthz", "/readyz", "/metrics"})
# Errors of every request whose path is not exempt.
REFUSALS = (OverloadedError, StoppingError, DeadlineExceededError)
_READING = frozenset({"GET", "HEAD", "OPTIONS"})
BATCH = "/localise/batch"
_QUERIES = frozenset({"/localise", "/localise/sequence", BATCH})
_STREAMS, _PHOTOGRAPHS, _ALBUMS = "/events", "/photographs", "/albums/"
_READS_AT_A_TIME = 4
# Weight of the newest request in the running mean of durations, which sets Retry-After.
_NEWEST = 0.1
_MAX_RETRY_AFTER_S = 30
# Weight of the newest query of a client, and clients whose durations are known.
_NEWEST_OF_CLIENT, _MAX_PACES = 0.3, 10_000


def is_read(method: str, path: str) -> bool:
    """Return True for a read-only request other than an event stream."""
    return method in _READING and not path.endswith(_STREAMS)


def is_query(path: str) -> bool:
    """Return True for requests that localise photographs."""
    return path in _QUERIES or path.endswith(_PHOTOGRAPHS)


def is_stream(method: str, path: str) -> bool:
    """Return True for an event stream."""
    return method in _READING and path.endswith(_STREAMS)


def bounds_itself(method: str, path: str) -> bool:
    """Return True for answers that are sent part by part, and bound the time of each part."""
    if is_stream(method, path) or path == BATCH:
        return True
    return method == "POST" and path.startswith(_ALBUMS) and path.endswith(_PHOTOGRAPHS)


class _Pace:
    """Running means of the share of its time limit that a query of each client would take without the others.

    A client whose queries wait behind one another is refused at once, not when the deadline has passed.
    """

    def __init__(self) -> None:
        self._shares: OrderedDict[str, float] = OrderedDict()

    def exceeds_deadline(self, client: str, others: int) -> bool:
        """Return whether one more query beside others of the client is expected to miss its deadline."""
        return others > 0 and (others + 1) * self._shares.get(client, 0.0) > 1.0

    def note(self, client: str, share: float, others: int) -> None:
        """Note the share of its time limit that a query took beside others of its client."""
        mean = self._shares.pop(client, 0.0)
        self._shares[client] = mean + _NEWEST_OF_CLIENT * (share / (others + 1) - mean)
        if len(self._shares) > _MAX_PACES:
            self._shares.popitem(last=False)


class Slots:
    """Slots for requests of one kind, shared between clients (`Shares`); for one event loop.

    Args:
        limit: number of slots.
        max_waiting: number of requests that can wait for a slot in `wait_and_hold`, shared between clients as well.
        accounts: CPU time of the clients, by which the waiting ones are served.
    """

    def __init__(self, limit: int, max_waiting: int = 0, accounts: CpuAccounts | None = None) -> None:
        self._shares = Shares(limit)
        self._places = Shares(max_waiting)
        self._waiting: FairQueue[asyncio.Future[None]] = FairQueue(accounts or CpuAccounts())
        self._held_s = 0.0
        self._pace = _Pace()
        # Time (s) that the query of a task was without its slot.
        self._away_s: WeakKeyDictionary[asyncio.Task[Any], float] = WeakKeyDictionary()

    @property
    def in_use(self) -> int:
        """Number of slots in use."""
        return self._shares.in_use

    @property
    def waiting(self) -> int:
        """Number of requests that wait for a slot."""
        return self._places.in_use

    @contextmanager
    def hold(self, client: str) -> Iterator[None]:
        """Hold a slot.

        Raises:
            OverloadedError: all slots, or the client's share of them, are in use.
        """
        if not self._shares.may_take(client):
            raise self._refusal(client)
        self._shares.take(client)
        with self._held(client):
            yield

    @asynccontextmanager
    async def wait_and_hold(self, client: str, deadline: float) -> AsyncIterator[None]:
        """Wait for a slot and hold it; the client that used the least CPU time lately is first.

        Args:
            client: tenant or client address.
            deadline: end of the wait (`monotonic`).
        """
        begin, others = monotonic(), self._others(client)
        if self._pace.exceeds_deadline(client, others):
            raise ExpectedTooLateError(others, self._retry_after_s())
        try:
            await self._take_turn(client, deadline)
            with self._held(client):
                yield
        finally:
            task = asyncio.current_task()
            spent_s = monotonic() - begin - (self._away_s.pop(task, 0.0) if task is not None else 0.0)
            self._pace.note(client, spent_s / max(deadline - begin, 1e-3), max(others, self._others(client)))

    @contextmanager
    def released(self, client: str) -> Iterator[None]:
        """Release the held slot during the block, and take it back afterwards."""
        self._give_back(client)
        begin, task = monotonic(), asyncio.current_task()
        try:
            yield
        finally:
            if task is not None:
                self._away_s[task] = self._away_s.get(task, 0.0) + monotonic() - begin
            # Taken without a check, so for a while more slots than the limit can be in use.
            self._shares.take(client)

    def check(self, client: str) -> None:
        """Check that a slot or a place in the queue is free for the client."""
        if not self._shares.may_take(client) and not self._places.may_take(client):
            raise self._refusal(client)

    def _others(self, client: str) -> int:
        """Return the number of queries of a client that hold a slot or wait for one."""
        return self._shares.held_by(client) + self._places.held_by(client)

    @contextmanager
    def _held(self, client: str) -> Iterator[None]:
        begin = monotonic()
        try:
            yield
        finally:
            self._held_s += _NEWEST * (monotonic() - begin - self._held_s)
            self._give_back(client)

    async def _take_turn(self, client: str, deadline: float) -> None:
        # A client with waiting requests never passes this check, because a free slot goes to them first.
        if self._shares.may_take(client):
            self._shares.take(client)
            return
        if not self._places.may_take(client):
            raise self._refusal(client)
        turn = asyncio.get_running_loop().create_future()
        self._places.take(client)
        self._waiting.append(client, turn)
        try:
            async with asyncio.timeout(max(deadline - monotonic(), 0.0)):
                await turn
        except (TimeoutError, asyncio.CancelledError) as error:
            self._waiting.drop(lambda waiting: waiting is turn)
            if turn.done() and not turn.cancelled():
                # The slot was granted as the wait ended.
                self._give_back(client)
            if isinstance(error, TimeoutError):
                raise self._refusal(client) from error
            raise
        finally:
            self._places.give_back(client)

    def _give_back(self, client: str) -> None:
        self._shares.give_back(client)
        while (found := self._waiting.take(self._shares.may_take)) is not None:
            next_client, turn = found
            if not turn.done():
                self._shares.take(next_client)
                turn.set_result(None)

    def _retry_after_s(self) -> int:
        rounds = 1.0 + self.waiting / max(self._shares.limit, 1)
        return min(max(math.ceil(rounds * self._held_s), 1), _MAX_RETRY_AFTER_S)

    def _refusal(self, client: str) -> OverloadedError:
        retry_after_s = self._retry_after_s()
        if self.in_use < self._shares.limit:
            return ShareExceededError(self._shares.held_by(client), self._shares.limit, retry_after_s)
        return OverloadedError(self._shares.limit, retry_after_s)


@dataclass(frozen=True)
class AdmissionLimits:
    """Limits of requests in progress.

    Attributes:
        requests: uploads and queries, from the end of the head.
        queries: queries that are computed or wait for a thread.
        waiting_queries: queries that wait for a slot.
        reads: read-only requests.
        streams: event streams.
        tenant_bytes: bytes of bodies in progress per client, for clients without a limit of their own.
        total_bytes: bytes of bodies in progress.
        deadline_s: timeout of every request except streams and batches; other timeouts normally end a request earlier.
    """

    requests: int
    queries: int
    waiting_queries: int
    reads: int
    streams: int
    tenant_bytes: int
    total_bytes: int
    deadline_s: float

    @classmethod
    def from_settings(cls, settings: Settings) -> AdmissionLimits:
        """Return the limits in the settings."""
        return cls(
            requests=settings.pending_limit,
            queries=settings.query_limit,
            waiting_queries=settings.requests.max_waiting_queries,
            reads=settings.requests.max_reads,
            streams=settings.requests.max_streams,
            tenant_bytes=settings.uploads.tenant_bytes,
            total_bytes=settings.uploads.total_bytes,
            # Time for the upload, the query or conversion, and sending the answer to a slow client.
            deadline_s=settings.uploads.deadline_s
            + max(settings.sequence_deadline_s, settings.plans.import_deadline_s)
            + settings.requests.request_deadline_s,
        )


class Admission:
    """Slots of one running app.

    Args:
        limits: limits of requests in progress.
        telemetry: metrics, and the CPU time of the clients.
        by_tenant: returns the values of clients as values of tenants.
        bytes_limit_of: returns the limit of a client's bytes in flight; None: the one in `limits`.
    """

    def __init__(
        self,
        limits: AdmissionLimits,
        telemetry: Telemetry,
        bytes_limit_of: Callable[[str], int | None] = lambda _client: None,
        by_tenant: Callable[[Mapping[str, float]], Mapping[str, float]] = lambda values: values,
    ) -> None:
        self.cpu_accounts = telemetry.cpu_accounts
        self.limits = limits
        self.requests = Slots(limits.requests)
        self.queries = Slots(limits.queries, limits.waiting_queries, telemetry.cpu_accounts)
        self.reads = Slots(limits.reads)
        self.streams = Slots(limits.streams)

        def limit_of(client: str) -> int:
            own = bytes_limit_of(client)
            return limits.tenant_bytes if own is None else own

        self.bytes_in_flight = BytesInFlight(limits.total_bytes, limit_of)
        # More reads at a time would only delay queries, because they share one interpreter. Beside other clients, a
        # client reads one at a time, so that each of their steps waits for one of its steps.
        self.reading = FairSemaphore(_READS_AT_A_TIME, telemetry.cpu_accounts, cores=1)
        self.draining = False
        self.stopping = False
        self._at_stop: list[Callable[[], None]] = []
        telemetry.tenant_counter(
            "lalaloc_tenant_cpu_seconds",
            "CPU time of each tenant's requests and pose grids.",
            lambda: by_tenant(self.cpu_accounts.totals()),
        )
        telemetry.tenant_gauge(
            "lalaloc_tenant_bytes_in_flight",
            "Bytes of each tenant's request bodies in progress.",
            lambda: by_tenant(self.bytes_in_flight.held()),
        )
        telemetry.gauge("lalaloc_requests_in_flight", "Uploads and queries in progress.", lambda: self.requests.in_use)
        telemetry.gauge(
            "lalaloc_queries_in_work",
            "Queries being computed, without those that wait for a pose grid.",
            lambda: self.queries.in_use,
        )
        telemetry.gauge("lalaloc_queries_waiting", "Queries waiting for a slot.", lambda: self.queries.waiting)
        telemetry.gauge("lalaloc_reads_in_flight", "Read-only requests in progress.", lambda: self.reads.in_use)
        telemetry.gauge("lalaloc_streams", "Open event streams.", lambda: self.streams.in_use)

    def drain(self) -> None:
        """Announce that the service will stop soon. Safe to call in a signal handler."""
        self.draining = True

    def at_stop(self, action: Callable[[], None]) -> None:
        """Run an action on a thread of its own when the service stops, for work that requests must not wait for."""
        self._at_stop.append(action)

    def stop(self) -> None:
        """Refuse new requests; running requests continue. Safe to call in a signal handler."""
        self.draining = self.stopping = True
        while self._at_stop:
            threading.Thread(target=self._at_stop.pop(), daemon=True).start()

    @property
    def idle(self) -> bool:
        """True if nothing is in progress except streams."""
        return self.requests.in_use == self.reads.in_use == 0

    @contextmanager
    def slot_for(self, client: str, method: str, path: str) -> Iterator[None]:
        """Hold a slot for a request whose head has arrived.

        Raises:
            StoppingError: the service is stopping.
            OverloadedError: all slots of its kind, or the client's share of them, are in use.
        """
        if self.stopping:
            raise StoppingError()
        if is_stream(method, path):
            slots = self.streams
        elif is_read(method, path):
            slots = self.reads
        else:
            slots = self.requests
            if is_query(path):
                # Refuse before the body is read.
                self.queries.check(client)
        with slots.hold(client):
            yield
