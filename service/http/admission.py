"""Who gets in: places for requests, refusal at once when all are taken, and what happens when a client hangs up.

Every request but those to health and metrics holds a place from its first byte to its last, be its body read, its
query computed, or its answer sent. No place is waited for, so nothing behind them has more waiting than places.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from time import monotonic

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import DeadlineExceededError, OverloadedError, StoppingError
from service.http.problems import problem_answer
from service.settings import Settings
from service.telemetry import Telemetry

EXEMPT = frozenset({"/healthz", "/readyz", "/metrics"})
# What every other request may be refused with, or end with.
REFUSALS = (OverloadedError, StoppingError, DeadlineExceededError)
_READING = frozenset({"GET", "HEAD", "OPTIONS"})
_QUERIES = "/localise"
# Answers that go on for as long as their client listens.
_STREAMS = "/events"
# How much the last request counts in the mean that Retry-After is told by.
_NEWEST = 0.1
_LONGEST_RETRY_S = 30


class Places:
    """How many requests of one kind may be in work; for one event loop."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.taken = 0
        self._held_s = 0.0

    @contextmanager
    def one(self) -> Iterator[None]:
        """Hold a place.

        Raises:
            OverloadedError: all are taken.
        """
        self.check()
        self.taken += 1
        begin = monotonic()
        try:
            yield
        finally:
            self.taken -= 1
            self._held_s += _NEWEST * (monotonic() - begin - self._held_s)

    @contextmanager
    def lent(self) -> Iterator[None]:
        """Lend the place that one holds to others while the block only waits."""
        self.taken -= 1
        try:
            yield
        finally:
            # Whoever was let in is not sent away again: for a while there may be more than the limit.
            self.taken += 1

    def check(self) -> None:
        """Raises:
        OverloadedError: all are taken; by the time it says, those that hold them will be through.
        """
        if self.taken >= self.limit:
            raise OverloadedError(self.limit, min(max(math.ceil(self._held_s), 1), _LONGEST_RETRY_S))


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
    """The places of one running app."""

    def __init__(self, limits: AdmissionLimits, telemetry: Telemetry) -> None:
        self.limits = limits
        self.requests = Places(limits.requests)
        self.queries = Places(limits.queries)
        self.reads = Places(limits.reads)
        self.streams = Places(limits.streams)
        self.draining = False
        self.stopping = False
        telemetry.gauge(
            "lalaloc_requests_in_flight", "Uploads and queries not yet answered.", lambda: self.requests.taken
        )
        telemetry.gauge(
            "lalaloc_queries_in_work",
            "Queries computed or waiting for it, besides those that wait for a grid.",
            lambda: self.queries.taken,
        )
        telemetry.gauge("lalaloc_reads_in_flight", "Requests that change nothing.", lambda: self.reads.taken)
        telemetry.gauge("lalaloc_streams", "Clients that follow events.", lambda: self.streams.taken)

    def drain(self) -> None:
        """Say that the service is about to stop, and go on for now. May be called by a signal handler."""
        self.draining = True

    def stop(self) -> None:
        """Refuse every request from now on; those in work go on. May be called by a signal handler."""
        self.draining = self.stopping = True

    @property
    def idle(self) -> bool:
        """Whether nothing is in work that is worth waiting for."""
        return self.requests.taken == self.reads.taken == 0

    @contextmanager
    def place_for(self, method: str, path: str) -> Iterator[None]:
        """Hold a place for a request whose head has arrived.

        Raises:
            StoppingError: no more requests are taken.
            OverloadedError: all places of its kind are taken.
        """
        if self.stopping:
            raise StoppingError()
        if method in _READING:
            places = self.streams if path.endswith(_STREAMS) else self.reads
        else:
            places = self.requests
            if path == _QUERIES:
                # A body that nobody could do anything with is not worth reading.
                self.queries.check()
        with places.one():
            yield


class AdmissionMiddleware:
    """Gives a place to a request, or refuses it before its body is read; lets go when its client hangs up."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        # An app that has not been started, or is used without its lifespan, has no places.
        admission: Admission | None = getattr(scope["app"].state, "admission", None)
        if scope["type"] != "http" or scope["path"] in EXEMPT or admission is None:
            await self._app(scope, receive, send)
            return
        try:
            with admission.place_for(scope["method"], scope["path"]):
                await self._handle(admission, scope, receive, send)
        except (OverloadedError, StoppingError) as error:
            await problem_answer(Request(scope), error)(scope, receive, send)

    async def _handle(self, admission: Admission, scope: Scope, receive: Receive, send: Send) -> None:
        client = _Client(receive, send)
        endless = scope["method"] in _READING and scope["path"].endswith(_STREAMS)
        limit_s = None if endless else admission.limits.deadline_s
        try:
            async with asyncio.timeout(limit_s), client:
                await self._app(scope, client.receive, client.send)
        except asyncio.CancelledError:
            # The server, stopping, ends what did not finish in time.
            if not admission.stopping or client.answered:
                raise
            await problem_answer(Request(scope), StoppingError())(scope, receive, send)
        except TimeoutError:
            if not client.answered:
                error = DeadlineExceededError(admission.limits.deadline_s)
                await problem_answer(Request(scope), error)(scope, receive, send)


class _Client:
    """The other end of a request. Once its body is there, a hang-up cancels whoever works on the answer."""

    def __init__(self, receive: Receive, send: Send) -> None:
        self.answered = False
        self._receive = receive
        self._send = send
        self._gone = asyncio.Event()
        self._watch: asyncio.Task[None] | None = None
        self._worker: asyncio.Task[object] | None = None

    async def __aenter__(self) -> _Client:
        self._worker = asyncio.current_task()
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_error: object) -> bool:
        if self._watch is not None:
            self._watch.cancel()
            with suppress(asyncio.CancelledError):
                await self._watch
        if kind is not None and issubclass(kind, asyncio.CancelledError) and self._gone.is_set():
            assert self._worker is not None
            # Ours, unless somebody else cancelled it as well.
            return self._worker.uncancel() == 0
        return False

    async def receive(self) -> Message:
        """The next part of the body; after the last, the hang-up."""
        if self._watch is not None:
            await self._gone.wait()
            return {"type": "http.disconnect"}
        message = await self._receive()
        if message["type"] == "http.request" and not message.get("more_body", False):
            self._watch = asyncio.create_task(self._wait_for_hang_up())
        return message

    async def send(self, message: Message) -> None:
        """Pass a part of the answer on."""
        self.answered = True
        await self._send(message)

    async def _wait_for_hang_up(self) -> None:
        while (await self._receive())["type"] != "http.disconnect":
            pass
        self._gone.set()
        # With the answer on its way there is nothing left to save, and the server knows that nobody reads it.
        if not self.answered and self._worker is not None:
            self._worker.cancel()
