"""How many requests may be in work: slots for each kind of them, and refusal at once when all are in use.

Every request but those to health and metrics holds a slot from its first byte to its last, be its body read, its
query computed, or its answer sent. A query that is uploaded waits for a slot of its own, in a short queue; nothing else
is waited for, so nothing behind the slots has more waiting than slots.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from time import monotonic

from service.errors import DeadlineExceededError, OverloadedError, ShareExceededError, StoppingError
from service.fair_share import FairQueue, FairSemaphore, Shares
from service.settings import Settings
from service.telemetry import Telemetry

EXEMPT = frozenset({"/healthz", "/readyz", "/metrics"})
# What every other request may be refused with, or end with.
REFUSALS = (OverloadedError, StoppingError, DeadlineExceededError)
_READING = frozenset({"GET", "HEAD", "OPTIONS"})
_QUERIES = frozenset({"/localise", "/localise/sequence", "/geopose"})
_STREAMS = "/events"
_READS_AT_A_TIME = 4
# How much the last request counts in the mean that Retry-After is told by.
_NEWEST = 0.1
_MAX_RETRY_AFTER_S = 30


def is_read(method: str, path: str) -> bool:
    """Whether the request changes nothing, and its answer has an end."""
    return method in _READING and not path.endswith(_STREAMS)


def is_stream(method: str, path: str) -> bool:
    """Whether the answer goes on for as long as its client listens."""
    return method in _READING and path.endswith(_STREAMS)


class Slots:
    """How many requests of one kind may be in work, and of these of one client (`Shares`); for one event loop."""

    def __init__(self, limit: int, max_waiting: int = 0) -> None:
        """Args:
        limit: how many may be in work.
        max_waiting: how many more may wait for that, in `wait_and_hold`; clients share these places as well.
        """
        self._shares = Shares(limit)
        self._places = Shares(max_waiting)
        self._waiting: FairQueue[asyncio.Future[None]] = FairQueue()
        self._held_s = 0.0

    @property
    def in_use(self) -> int:
        """How many are in work."""
        return self._shares.in_use

    @property
    def waiting(self) -> int:
        """How many wait for a slot."""
        return self._places.in_use

    @contextmanager
    def hold(self, client: str) -> Iterator[None]:
        """Hold a slot.

        Raises:
            OverloadedError: all are in use, or all that the client may have.
        """
        if not self._shares.may_take(client):
            raise self._refusal(client)
        self._shares.take(client)
        with self._held(client):
            yield

    @asynccontextmanager
    async def wait_and_hold(self, client: str, deadline: float) -> AsyncIterator[None]:
        """Hold a slot as soon as one is free; clients take turns.

        Args:
            deadline: until when (`monotonic`) it is worth waiting.

        Raises:
            OverloadedError: as many wait already as may, or as many of the client, or none was free in time.
        """
        await self._take_turn(client, deadline)
        with self._held(client):
            yield

    @contextmanager
    def released(self, client: str) -> Iterator[None]:
        """Lend the slot that one holds to others while the block only waits."""
        self._give_back(client)
        try:
            yield
        finally:
            # Whoever was let in is not sent away again: for a while there may be more than the limit.
            self._shares.take(client)

    def check(self, client: str) -> None:
        """Raises:
        OverloadedError: all are in use, or all that the client may have, and there is no place to wait for one either;
            by the time it says, those that are before it will be through.
        """
        if not self._shares.may_take(client) and not self._places.may_take(client):
            raise self._refusal(client)

    @contextmanager
    def _held(self, client: str) -> Iterator[None]:
        begin = monotonic()
        try:
            yield
        finally:
            self._held_s += _NEWEST * (monotonic() - begin - self._held_s)
            self._give_back(client)

    async def _take_turn(self, client: str, deadline: float) -> None:
        # Whoever waits is of a client that may take none.
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
            self._waiting.drop(lambda other: other is turn)
            if turn.done() and not turn.cancelled():
                # It came at the very moment when nobody waited any more.
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

    def _refusal(self, client: str) -> OverloadedError:
        rounds = 1.0 + self.waiting / max(self._shares.limit, 1)
        retry_after_s = min(max(math.ceil(rounds * self._held_s), 1), _MAX_RETRY_AFTER_S)
        if self.in_use < self._shares.limit:
            return ShareExceededError(self._shares.held_by(client), self._shares.limit, retry_after_s)
        return OverloadedError(self._shares.limit, retry_after_s)


@dataclass(frozen=True)
class AdmissionLimits:
    """How much may be in work.

    Attributes:
        requests: uploads and queries, from the first byte of the body on.
        queries: of these, queries that are uploaded and being computed or waiting for a thread.
        waiting_queries: more of these, that wait for one of the former to end.
        reads: requests that change nothing.
        streams: answers that go on for as long as their client listens.
        deadline_s: longest that a request may take, of whatever kind but streams; a last resort.
    """

    requests: int
    queries: int
    waiting_queries: int
    reads: int
    streams: int
    deadline_s: float

    @classmethod
    def of(cls, settings: Settings) -> AdmissionLimits:
        """The limits that the settings give."""
        return cls(
            requests=settings.pending_limit,
            queries=settings.query_limit,
            waiting_queries=settings.requests.max_waiting_queries,
            reads=settings.requests.max_reads,
            streams=settings.requests.max_streams,
            # An upload, its query or its conversion, and a slow reader's time to take the answer.
            deadline_s=settings.uploads.deadline_s
            + max(settings.requests.request_deadline_s, settings.plans.import_deadline_s)
            + settings.requests.request_deadline_s,
        )


class Admission:
    """The slots of one running app."""

    def __init__(self, limits: AdmissionLimits, telemetry: Telemetry) -> None:
        self.limits = limits
        self.requests = Slots(limits.requests)
        self.queries = Slots(limits.queries, limits.waiting_queries)
        self.reads = Slots(limits.reads)
        self.streams = Slots(limits.streams)
        # Reads compute a few at a time: more threads would only take the interpreter from queries.
        self.reading = FairSemaphore(_READS_AT_A_TIME)
        self.draining = False
        self.stopping = False
        telemetry.gauge(
            "lalaloc_requests_in_flight", "Uploads and queries not yet answered.", lambda: self.requests.in_use
        )
        telemetry.gauge(
            "lalaloc_queries_in_work",
            "Queries computed or waiting for it, besides those that wait for a grid.",
            lambda: self.queries.in_use,
        )
        telemetry.gauge("lalaloc_queries_waiting", "Queries that wait for others to end.", lambda: self.queries.waiting)
        telemetry.gauge("lalaloc_reads_in_flight", "Requests that change nothing.", lambda: self.reads.in_use)
        telemetry.gauge("lalaloc_streams", "Clients that follow events.", lambda: self.streams.in_use)

    def drain(self) -> None:
        """Say that the service is about to stop, and go on for now. May be called by a signal handler."""
        self.draining = True

    def stop(self) -> None:
        """Refuse every request from now on; those in work go on. May be called by a signal handler."""
        self.draining = self.stopping = True

    @property
    def idle(self) -> bool:
        """Whether nothing is in work that is worth waiting for."""
        return self.requests.in_use == self.reads.in_use == 0

    @contextmanager
    def slot_for(self, client: str, method: str, path: str) -> Iterator[None]:
        """Hold a slot for a request of a client whose head has arrived.

        Raises:
            StoppingError: no more requests are taken.
            OverloadedError: all slots of its kind are in use, or all that the client may have.
        """
        if self.stopping:
            raise StoppingError()
        if is_stream(method, path):
            slots = self.streams
        elif is_read(method, path):
            slots = self.reads
        else:
            slots = self.requests
            if path in _QUERIES:
                # A body that nobody could do anything with is not worth reading.
                self.queries.check(client)
        with slots.hold(client):
            yield
