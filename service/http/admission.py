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

from service.errors import DeadlineExceededError, OverloadedError, StoppingError
from service.settings import Settings
from service.telemetry import Telemetry

EXEMPT = frozenset({"/healthz", "/readyz", "/metrics"})
# What every other request may be refused with, or end with.
REFUSALS = (OverloadedError, StoppingError, DeadlineExceededError)
_READING = frozenset({"GET", "HEAD", "OPTIONS"})
_QUERIES = "/localise"
_STREAMS = "/events"
# How much the last request counts in the mean that Retry-After is told by.
_NEWEST = 0.1
_MAX_RETRY_AFTER_S = 30


def is_stream(method: str, path: str) -> bool:
    """Whether the answer goes on for as long as its client listens."""
    return method in _READING and path.endswith(_STREAMS)


class Slots:
    """How many requests of one kind may be in work; for one event loop."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.in_use = 0
        self._held_s = 0.0

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Hold a slot.

        Raises:
            OverloadedError: all are in use.
        """
        self.check()
        self.in_use += 1
        begin = monotonic()
        try:
            yield
        finally:
            self.in_use -= 1
            self._held_s += _NEWEST * (monotonic() - begin - self._held_s)

    @contextmanager
    def released(self) -> Iterator[None]:
        """Lend the slot that one holds to others while the block only waits."""
        self.in_use -= 1
        try:
            yield
        finally:
            # Whoever was let in is not sent away again: for a while there may be more than the limit.
            self.in_use += 1

    def check(self) -> None:
        """Raises:
        OverloadedError: all are in use; by the time it says, those that hold them will be through.
        """
        if self.in_use >= self.limit:
            raise OverloadedError(self.limit, min(max(math.ceil(self._held_s), 1), _MAX_RETRY_AFTER_S))


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
            # An upload, its query, and a slow reader's time to take the answer.
            deadline_s=settings.upload_deadline_s + 2.0 * settings.request_deadline_s,
        )


class Admission:
    """The slots of one running app."""

    def __init__(self, limits: AdmissionLimits, telemetry: Telemetry) -> None:
        self.limits = limits
        self.requests = Slots(limits.requests)
        self.queries = Slots(limits.queries)
        self.reads = Slots(limits.reads)
        self.streams = Slots(limits.streams)
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
    def slot_for(self, method: str, path: str) -> Iterator[None]:
        """Hold a slot for a request whose head has arrived.

        Raises:
            StoppingError: no more requests are taken.
            OverloadedError: all slots of its kind are in use.
        """
        if self.stopping:
            raise StoppingError()
        if is_stream(method, path):
            slots = self.streams
        elif method in _READING:
            slots = self.reads
        else:
            slots = self.requests
            if path == _QUERIES:
                # A body that nobody could do anything with is not worth reading.
                self.queries.check()
        with slots.hold():
            yield
