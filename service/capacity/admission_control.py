"""Admission control: slots for each class of route, and immediate refusal when all are in use.

Every request, except for probes, holds a slot from the end of its head to the end of its answer. An uploaded query
needs a second slot before it is computed, and waits for it in a short queue. All queues are bounded.
"""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from time import monotonic
from typing import Any, Literal, TypeVar

from cachetools import LRUCache

from service import errors
from service.capacity.cpu_accounts import CpuAccounts
from service.capacity.fair_share import MAX_RATIO, FairSemaphore, Shares
from service.settings import Settings
from service.telemetry import Telemetry

# Errors of every request that is no probe.
REFUSALS = (errors.OverloadedError, errors.StoppingError, errors.DeadlineExceededError)
_READS_AT_A_TIME = 4
# Weight of the newest request in the running mean of durations, which sets Retry-After.
_NEWEST = 0.1
_MAX_RETRY_AFTER_S = 30
# Weight of the newest query of a client, and clients whose durations are known.
_NEWEST_OF_CLIENT, _MAX_PACES = 0.3, 10_000
# Time (s) that the query of the current task was without its slot.
_AWAY_S: ContextVar[float] = ContextVar("away_s", default=0.0)

Endpoint = TypeVar("Endpoint", bound=Callable[..., Any])


@dataclass(frozen=True)
class RouteClass:
    """Treatment of the requests of a route.

    Attributes:
        slots: kind of the slot that a request holds; None for probes, which need none.
        is_query: the request localises photographs, so it waits for a second slot before it is computed.
        in_parts: the answer is sent part by part, and bounds the time of each part.
    """

    slots: Literal["requests", "reads", "streams"] | None
    is_query: bool = False
    in_parts: bool = False


PROBE, READ, CHANGE = RouteClass(None), RouteClass("reads"), RouteClass("requests")
STREAM = RouteClass("streams", in_parts=True)
QUERY = RouteClass("requests", is_query=True)
QUERY_IN_PARTS = replace(QUERY, in_parts=True)


def admitted_as(route_class: RouteClass) -> Callable[[Endpoint], Endpoint]:
    """Declare the class of a route; all others are `READ` or `CHANGE`, by their method."""

    def declare(endpoint: Endpoint) -> Endpoint:
        endpoint.__dict__["route_class"] = route_class
        return endpoint

    return declare


def declared_class(endpoint: Callable[..., Any]) -> RouteClass | None:
    """Return the class that `admitted_as` declared for a route; None without one."""
    return getattr(endpoint, "route_class", None)


class Slots:
    """Slots for requests of one kind, shared between clients (`Shares`); for one event loop.

    As many as `max_waiting` requests, shared between clients as well, can wait for a slot in `wait_and_hold`.
    """

    def __init__(self, limit: int, max_waiting: int = 0, accounts: CpuAccounts | None = None) -> None:
        self._limit = limit
        self._slots = FairSemaphore(limit, accounts or CpuAccounts())
        self._places = Shares(max_waiting)
        self._held_s = 0.0
        # Mean of the share of its time limit that a query of each client would take without the client's others.
        self._paces: LRUCache[str, float] = LRUCache(_MAX_PACES)

    @property
    def in_use(self) -> int:
        """Number of slots in use."""
        return self._slots.in_use

    @property
    def waiting(self) -> int:
        """Number of requests that wait for a slot."""
        return self._places.in_use

    @contextmanager
    def hold(self, client: str) -> Iterator[None]:
        """Hold a slot, or refuse the request if all slots, or the client's share of them, are in use."""
        if not self._slots.acquire_at_once(client):
            raise self._refusal(client)
        with self._held(client):
            yield

    @asynccontextmanager
    async def wait_and_hold(self, client: str, deadline: float) -> AsyncIterator[None]:
        """Wait for a slot until `deadline` (`monotonic`) and hold it; raises as `hold` does.

        The client that used the least CPU time lately is first. A client whose queries wait behind one another is
        refused at once, not when the deadline has passed.
        """
        begin, others = monotonic(), self._others(client)
        if others and (others + 1) * self._paces.get(client, 0.0) > 1.0:
            raise errors.ExpectedTooLateError(others, retry_after_s=self._retry_after_s())
        _AWAY_S.set(0.0)
        try:
            await self._wait(client, deadline)
            with self._held(client):
                yield
        finally:
            share = (monotonic() - begin - _AWAY_S.get()) / max(deadline - begin, 1e-3)
            mean = self._paces.get(client, 0.0)
            alone = share / (max(others, self._others(client)) + 1)
            self._paces[client] = mean + _NEWEST_OF_CLIENT * (alone - mean)

    @contextmanager
    def released(self, client: str) -> Iterator[None]:
        """Release the held slot during the block, and take it back afterwards."""
        self._slots.release(client)
        begin = monotonic()
        try:
            yield
        finally:
            _AWAY_S.set(_AWAY_S.get() + monotonic() - begin)
            # Without a check, so for a while more slots than the limit can be in use.
            self._slots.take(client)

    def check(self, client: str) -> None:
        """Check that a slot or a place in the queue is free for the client."""
        if not self._slots.may_take(client) and not self._places.may_take(client):
            raise self._refusal(client)

    async def _wait(self, client: str, deadline: float) -> None:
        if self._slots.acquire_at_once(client):
            return
        if not self._places.may_take(client):
            raise self._refusal(client)
        self._places.take(client)
        try:
            async with asyncio.timeout(max(deadline - monotonic(), 0.0)):
                await self._slots.acquire(client)
        except TimeoutError as error:
            raise self._refusal(client) from error
        finally:
            self._places.give_back(client)

    @contextmanager
    def _held(self, client: str) -> Iterator[None]:
        begin = monotonic()
        try:
            yield
        finally:
            self._held_s += _NEWEST * (monotonic() - begin - self._held_s)
            self._slots.release(client)

    def _others(self, client: str) -> int:
        """Return the number of requests of a client that hold a slot or wait for one."""
        return self._slots.held_by(client) + self._places.held_by(client)

    def _retry_after_s(self) -> int:
        rounds = 1.0 + self.waiting / max(self._limit, 1)
        return min(max(math.ceil(rounds * self._held_s), 1), _MAX_RETRY_AFTER_S)

    def _refusal(self, client: str) -> errors.OverloadedError:
        if self.in_use < self._limit:
            return errors.ShareExceededError(
                self._slots.held_by(client), self._limit, retry_after_s=self._retry_after_s()
            )
        return errors.OverloadedError(self._limit, retry_after_s=self._retry_after_s())


class BytesInFlight(Shares):
    """Bytes of request bodies in progress, from their heads to the end of their answers; for one event loop."""

    def __init__(self, total_bytes: int, limit_of: Callable[[str], int]) -> None:
        super().__init__(total_bytes)
        self._limit_of = limit_of

    def limit_of(self, client: str) -> int:
        """Return the limit (bytes) of a client."""
        return min(self._limit_of(client), self.limit)

    def take(self, client: str, count: int = 1) -> None:
        """Take some bytes for a client, or refuse the request."""
        held, limit = self.held_by(client), self.limit_of(client)
        if count > limit:
            raise errors.UploadTooLargeError("upload_tenant_bytes", limit, count)
        if held + count > limit:
            raise errors.BytesInFlightError(count, "your uploads", held, limit, "LALALOC_UPLOAD_TENANT_BYTES")
        left = self.limit - self.in_use - count
        if left < 0 or (held and held + count > MAX_RATIO * left):
            raise errors.BytesInFlightError(count, "all uploads", self.in_use, self.limit, "LALALOC_UPLOAD_TOTAL_BYTES")
        super().take(client, count)


class Admission:
    """Slots of one running app.

    Attributes:
        reading: permits to compute the answer to a read.
        deadline_s: timeout of every request whose answer is not sent in parts; others normally end it earlier.

    Args:
        settings: limits of requests in progress.
        telemetry: metrics, and the CPU time of the clients.
        bytes_limit_of: returns the limit of a client's bytes in flight; None: the one in the settings.
        by_tenant: returns the values of clients as values of tenants.
    """

    def __init__(
        self,
        settings: Settings,
        telemetry: Telemetry,
        bytes_limit_of: Callable[[str], int | None] = lambda _client: None,
        by_tenant: Callable[[Mapping[str, float]], Mapping[str, float]] = lambda values: values,
    ) -> None:
        requests, uploads = settings.requests, settings.uploads
        self.cpu_accounts = telemetry.cpu_accounts
        self.requests = Slots(settings.pending_limit)
        self.queries = Slots(settings.query_limit, requests.max_waiting_queries, telemetry.cpu_accounts)
        self.reads = Slots(requests.max_reads)
        self.streams = Slots(requests.max_streams)

        def limit_of(client: str) -> int:
            own = bytes_limit_of(client)
            return uploads.tenant_bytes if own is None else own

        self.bytes_in_flight = BytesInFlight(uploads.total_bytes, limit_of)
        # More reads at a time would only delay queries, because they share one interpreter. Beside other clients, a
        # client reads one at a time, so that each of their steps waits for one of its steps.
        self.reading = FairSemaphore(_READS_AT_A_TIME, telemetry.cpu_accounts, cores=1)
        # Time for the upload, the query or conversion, and sending the answer to a slow client.
        work_s = max(settings.sequence_deadline_s, settings.plans.import_deadline_s)
        self.deadline_s = uploads.deadline_s + work_s + requests.request_deadline_s
        # Draining is announced before the service stops.
        self.draining = self.stopping = False
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
    def slot_for(self, client: str, route_class: RouteClass) -> Iterator[None]:
        """Hold a slot for a request whose head has arrived, or refuse it."""
        if self.stopping:
            raise errors.StoppingError()
        if route_class.is_query:
            # Refuse before the body is read.
            self.queries.check(client)
        slots = {"requests": self.requests, "reads": self.reads, "streams": self.streams}[route_class.slots or "reads"]
        with slots.hold(client):
            yield
