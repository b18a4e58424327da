"""Gives every request its slot, or refuses it, and notices when its client hangs up."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import DeadlineExceededError, MalformedRequestError, OverloadedError, StoppingError
from service.http.admission import EXEMPT, Admission, is_stream
from service.http.problems import problem_answer


class AdmissionMiddleware:
    """Gives a slot to a request, or refuses it before its body is read; lets go when its client hangs up."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        # An app that has not been started, or is used without its lifespan, has no slots.
        admission: Admission | None = getattr(scope["app"].state, "admission", None)
        if scope["type"] == "http" and _framed_twice(scope):
            await self._refuse_framing(scope, receive, send)
            return
        if scope["type"] != "http" or scope["path"] in EXEMPT or admission is None:
            await self._app(scope, receive, send)
            return
        try:
            with admission.slot_for(scope["method"], scope["path"]):
                await self._handle(admission, scope, receive, send)
        except (OverloadedError, StoppingError) as error:
            await problem_answer(Request(scope), error)(scope, receive, send)

    async def _refuse_framing(self, scope: Scope, receive: Receive, send: Send) -> None:
        error = MalformedRequestError("the request has both Content-Length and Transfer-Encoding, it must have one")
        answer = problem_answer(Request(scope), error)
        # Where the body ends is not agreed on, so nothing that follows on this connection is another request.
        answer.headers["Connection"] = "close"
        await answer(scope, receive, send)

    async def _handle(self, admission: Admission, scope: Scope, receive: Receive, send: Send) -> None:
        client = _Client(receive, send)
        limit_s = None if is_stream(scope["method"], scope["path"]) else admission.limits.deadline_s
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


def _framed_twice(scope: Scope) -> bool:
    """Whether the body's length is told in two ways, and a proxy may have believed the other one (RFC 9112, 6.1)."""
    return {b"content-length", b"transfer-encoding"} <= {name for name, _ in scope["headers"]}


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
