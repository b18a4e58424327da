"""How many requests may be in work: slots for each kind of them, and refusal at once when all are in use.

Every request but those to health and metrics holds a slot from its first byte to its last, be its body read, its
query computed, or its answer sent. No slot is waited for, so nothing behind them has more waiting than slots.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic

from service.errors import DeadlineExceededError, OverloadedError, ShareExceededError, StoppingError
from service.settings import Settings
from service.sharing import FairTurns, Shares
from service.telemetry import Telemetry

EXEMPT = frozenset({"/healthz", "/readyz", "/metrics"})
# What every other request may be refused with, or end with.
REFUSALS = (OverloadedError, StoppingError, DeadlineExceededError)
_READING = frozenset({"GET", "HEAD", "OPTIONS"})
_QUERIES = "/localise"
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
    """How many requests of one kind may be in work, and of these of one party (`Shares`); for one event loop."""

    def __init__(self, limit: int) -> None:
        self._shares = Shares(limit)
        self._held_s = 0.0

    @property
    def in_use(self) -> int:
        """How many are in work."""
        return self._shares.in_use

    @contextmanager
    def hold(self, party: str) -> Iterator[None]:
        """Hold a slot.

        Raises:
            OverloadedError: all are in use, or all that the party may have.
        """
        self.check(party)
        self._shares.take(party)
        begin = monotonic()
        try:
            yield
        finally:
            self._shares.give_back(party)
            self._held_s += _NEWEST * (monotonic() - begin - self._held_s)

    @contextmanager
    def released(self, party: str) -> Iterator[None]:
        """Lend the slot that one holds to others while the block only waits."""
        self._shares.give_back(party)
        try:
            yield
        finally:
            # Whoever was let in is not sent away again: for a while there may be more than the limit.
            self._shares.take(party)

    def check(self, party: str) -> None:
        """Raises:
        OverloadedError: all are in use, or all that the party may have; by the time it says, those that hold them will
            be through.
        """
        if not self._shares.may_take(party):
            retry_after_s = min(max(math.ceil(self._held_s), 1), _MAX_RETRY_AFTER_S)
            if self.in_use < self._shares.limit:
                raise ShareExceededError(self._shares.held_by(party), self._shares.limit, retry_after_s)
            raise OverloadedError(self._shares.limit, retry_after_s)


@dataclass(frozen=True)
class AdmissionLimits:
    """How much may be in work.

    Attributes:
        requests: uploads and queries, from the first byte of the body on.
        queries: of these, queries that are uploaded and being computed or waiting for it.
        reads: requests that change nothing.
        streams: answers that go on for as long as their client listens.
        deadline_s: longest that a request may take, of whatever kind but streams; a last resort.
    """

    requests: int
    queries: int
    reads: int
    streams: int
    deadline_s: float

    @classmethod
    def of(cls, settings: Settings) -> AdmissionLimits:
        """The limits that the settings give."""
        return cls(
            requests=settings.pending_limit,
            queries=settings.query_limit,
            reads=settings.max_reads,
            streams=settings.max_streams,
            # An upload, its query or its conversion, and a slow reader's time to take the answer.
            deadline_s=settings.upload_deadline_s
            + max(settings.request_deadline_s, settings.import_deadline_s)
            + settings.request_deadline_s,
        )


class Admission:
    """The slots of one running app."""

    def __init__(self, limits: AdmissionLimits, telemetry: Telemetry) -> None:
        self.limits = limits
        self.requests = Slots(limits.requests)
        self.queries = Slots(limits.queries)
        self.reads = Slots(limits.reads)
        self.streams = Slots(limits.streams)
        # Reads compute a few at a time: more threads would only take the interpreter from queries.
        self.reading = FairTurns(_READS_AT_A_TIME)
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
    def slot_for(self, party: str, method: str, path: str) -> Iterator[None]:
        """Hold a slot for a request of a party whose head has arrived.

        Raises:
            StoppingError: no more requests are taken.
            OverloadedError: all slots of its kind are in use, or all that the party may have.
        """
        if self.stopping:
            raise StoppingError()
        if is_stream(method, path):
            slots = self.streams
        elif is_read(method, path):
            slots = self.reads
        else:
            slots = self.requests
            if path == _QUERIES:
                # A body that nobody could do anything with is not worth reading.
                self.queries.check(party)
        with slots.hold(party):
            yield
