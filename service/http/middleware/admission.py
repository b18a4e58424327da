"""Slots for requests, and cancellation of requests whose client disconnects."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from contextlib import asynccontextmanager, suppress
from typing import Any, cast

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.capacity.admission_control import CHANGE, PROBE, READ, Admission, BytesInFlight, RouteClass, declared_class
from service.capacity.cpu_accounts import PROBES, CpuAccounts
from service.capacity.fair_share import FairSemaphore
from service.errors import DeadlineExceededError, OverloadedError, StoppingError
from service.http.problems import problem_answer
from service.http.uploads import ending_request
from service.security.access_control import routed_path
from service.security.permissions import OPEN_PATHS, caller_of

# Bytes of a query's body that arrive without a rest, and the time (s) that the server takes to receive a byte.
_FREE_BYTES, _RECEIVING_S = 8 * 2**20, 5e-9
# CPU time (s) of a refused query that is not measured: of its connection, head and key.
_REFUSED_S = 1e-3
# Budget that a body of unknown length takes at a time.
_STEP_BYTES = 2**20
_READING = frozenset({"GET", "HEAD", "OPTIONS"})
_SCOPE_KEY = "lalaloc.read_permit"


class AdmissionMiddleware:
    """Middleware that holds a slot for a request, or refuses it before its body is read.

    Some of the routes declare the class of their requests (`admitted_as`).
    """

    def __init__(self, app: ASGIApp, routes: Sequence[Route]) -> None:
        self._app = app
        classes = [(route, declared_class(route.endpoint)) for route in routes]
        self._declared = [(route, declared) for route, declared in classes if declared is not None]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        # An app without its lifespan has no slots.
        admission: Admission | None = getattr(scope["app"].state, "admission", None)
        if scope["type"] != "http" or admission is None:
            await self._app(scope, receive, send)
            return
        route_class = self._class_of(scope)
        if route_class == PROBE:
            # Without a key.
            await _Rests(admission.cpu_accounts, PROBES, query=False).take()
            handled = cast(Coroutine[Any, Any, None], self._app(scope, receive, send))
            await admission.cpu_accounts.charged_steps(PROBES, handled, rests=True)
            return
        try:
            client = caller_of(scope).client
            with admission.slot_for(client, route_class):
                await self._handle(admission, route_class, client, scope, receive, send)
        except (OverloadedError, StoppingError) as error:
            await problem_answer(Request(scope), error)(scope, receive, send)

    def _class_of(self, scope: Scope) -> RouteClass:
        method, path = scope["method"], routed_path(scope)
        if path in OPEN_PATHS:
            # Nobody is known to be the caller of any method.
            return PROBE
        for route, declared in self._declared:
            if method in (route.methods or ()) and route.path_regex.match(path):
                return declared
        return READ if method in _READING else CHANGE

    async def _handle(
        self, admission: Admission, route_class: RouteClass, client: str, scope: Scope, receive: Receive, send: Send
    ) -> None:
        rests = _Rests(admission.cpu_accounts, client, query=route_class.is_query)
        permit = scope[_SCOPE_KEY] = ReadPermit(admission.reading, client, rests)
        stated = Headers(scope=scope).get("content-length", "")
        body = _BodyBudget(admission.bytes_in_flight, client, int(stated) if stated.isdecimal() else None)
        connection = _Connection(receive, send, body, rests, on_answer=permit.end)
        limit_s = None if route_class.in_parts else admission.deadline_s
        try:
            async with asyncio.timeout(limit_s), connection, permit.until_the_answer(needed=route_class == READ):
                with ending_request(scope):
                    handled = cast(Coroutine[Any, Any, None], self._app(scope, connection.receive, connection.send))
                    steps = admission.cpu_accounts.charged_steps(
                        client, handled, rests=not route_class.is_query, spend=rests.spend
                    )
                    await steps
        except asyncio.CancelledError:
            # The stopping server cancels requests that did not finish in time.
            if not admission.stopping or connection.answered:
                raise
            await problem_answer(Request(scope), StoppingError())(scope, receive, send)
        except TimeoutError:
            if not connection.answered:
                error = DeadlineExceededError(admission.deadline_s)
                await problem_answer(Request(scope), error)(scope, receive, send)
        finally:
            if route_class.is_query and 400 <= connection.status < 500:
                admission.cpu_accounts.refuse(client, _REFUSED_S + rests.spent_s)


def read_permit(scope: Scope) -> ReadPermit:
    """Return the permit to read of a request."""
    return scope[_SCOPE_KEY]


class _Rests:
    """Rests of one request.

    A query only rests while a large body arrives, as queries share threads of their own, and after others of its client
    were refused, which only the event loop works for.

    Attributes:
        spent_s: CPU time (s) of the request so far.
    """

    def __init__(self, accounts: CpuAccounts, client: str, *, query: bool) -> None:
        self._accounts, self._client = accounts, client
        self._free_bytes = _FREE_BYTES if query else 0
        self.spent_s = 0.0

    def spend(self, cpu_s: float) -> None:
        self.spent_s += cpu_s

    @property
    def left_s(self) -> float:
        """Time (s) that the client must rest now."""
        accounts = self._accounts
        return accounts.refused_rest_s(self._client) if self._free_bytes > 0 else accounts.rest_s(self._client)

    async def take(self) -> None:
        while (left_s := self.left_s) > 0.0:
            await asyncio.sleep(left_s)

    async def receive(self, size: int) -> None:
        self._free_bytes -= size
        if self._free_bytes <= 0:
            self._accounts.charge(self._client, size * _RECEIVING_S, rests=True)
        await self.take()


class ReadPermit:
    """Permit to compute the answer to a read, of which a request holds at most one."""

    def __init__(self, semaphore: FairSemaphore, client: str, rests: _Rests) -> None:
        self._semaphore, self._client, self._rests, self._is_held = semaphore, client, rests, False

    @asynccontextmanager
    async def until_the_answer(self, *, needed: bool) -> AsyncIterator[None]:
        """Rest, and hold the permit until the answer begins to be sent if it is `needed`."""
        await self._rests.take()
        if needed:
            await self._semaphore.acquire(self._client)
            while self._rests.left_s > 0.0:
                # Other clients can have the permit meanwhile.
                self._semaphore.release(self._client)
                await self._rests.take()
                await self._semaphore.acquire(self._client)
            self._is_held = True
        try:
            yield
        finally:
            self.end()

    @asynccontextmanager
    async def for_a_part(self) -> AsyncIterator[None]:
        """Hold the permit for a part of the answer, which is no wait while the request holds it already."""
        if self._is_held:
            yield
            return
        async with self._semaphore.held(self._client):
            yield

    @asynccontextmanager
    async def away(self) -> AsyncIterator[None]:
        """Give the permit back while the request waits for a worker, so that others of its client read."""
        was_held = self._is_held
        self.end()
        yield
        if was_held:
            await self._semaphore.acquire(self._client)
            self._is_held = True

    def end(self) -> None:
        """Give the permit back, once."""
        if self._is_held:
            self._is_held = False
            self._semaphore.release(self._client)


class _BodyBudget:
    """Budget of one request's body, which takes the stated length, or one step after the other."""

    def __init__(self, budget: BytesInFlight, client: str, stated_bytes: int | None) -> None:
        self._budget, self._client = budget, client
        self._first_bytes = _STEP_BYTES if stated_bytes is None else stated_bytes
        self._taken = self._received = 0

    def begin(self) -> None:
        """Take budget before the body is read; raises as `BytesInFlight.take` does."""
        self._take(self._first_bytes)

    def receive(self, count: int) -> None:
        """Count received bytes, and take the next step if they exceed what was taken; raises as `begin` does."""
        self._received += count
        while self._received > self._taken:
            self._take(_STEP_BYTES)

    def end(self) -> None:
        self._budget.give_back(self._client, self._taken)
        self._taken = 0

    def _take(self, count: int) -> None:
        self._budget.take(self._client, count)
        self._taken += count


class _Connection:
    """Connection of a request. Once the body is read, a disconnect cancels the work on the answer."""

    def __init__(
        self, receive: Receive, send: Send, body: _BodyBudget, rests: _Rests, *, on_answer: Callable[[], None]
    ) -> None:
        self._body, self._rests, self._on_answer = body, rests, on_answer
        self._begun, self.answered = False, False
        # Status of the answer; 0 before it begins.
        self.status, self._receive, self._send = 0, receive, send
        self._gone = asyncio.Event()
        self._watch: asyncio.Task[None] | None = None
        self._worker: asyncio.Task[object] | None = None

    async def __aenter__(self) -> _Connection:
        self._worker = asyncio.current_task()
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_error: object) -> bool:
        self._body.end()
        if self._watch is not None:
            self._watch.cancel()
            with suppress(asyncio.CancelledError):
                await self._watch
        if kind is not None and issubclass(kind, asyncio.CancelledError) and self._gone.is_set():
            assert self._worker is not None
            # False if another party cancelled it as well.
            return self._worker.uncancel() == 0
        return False

    async def receive(self) -> Message:
        """Return the next part of the body; after the last, the disconnect."""
        if self._watch is not None:
            await self._gone.wait()
            return {"type": "http.disconnect"}
        if not self._begun:
            self._begun = True
            self._body.begin()
        message = await self._receive()
        size = len(message.get("body", b""))
        self._body.receive(size)
        await self._rests.receive(size)
        if message["type"] == "http.request" and not message.get("more_body", False):
            self._watch = asyncio.create_task(self._wait_for_disconnect())
        return message

    async def send(self, message: Message) -> None:
        self.answered = True
        self.status = message.get("status", self.status)
        self._on_answer()
        await self._send(message)

    async def _wait_for_disconnect(self) -> None:
        while (await self._receive())["type"] != "http.disconnect":
            pass
        self._gone.set()
        # An answer that is being sent needs no cancelling.
        if not self.answered and self._worker is not None:
            self._worker.cancel()
