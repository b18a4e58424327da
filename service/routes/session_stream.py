"""WebSocket of a session: photographs in, answers out, each handled by `POST /sessions/{session_id}/photographs`."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from time import monotonic
from typing import Any

from fastapi import APIRouter
from starlette.responses import Response
from starlette.websockets import WebSocket, WebSocketDisconnect

from service.capacity.admission_control import Admission
from service.errors import ExposedWithoutKeysError, OverloadedError, StoppingError
from service.http.problems import problem_answer
from service.http.socket_requests import (
    FileHead,
    SocketAnswer,
    SocketClosedError,
    SocketProtocolError,
    SocketRequests,
    answer_text,
)
from service.routes.query_request import PHOTO
from service.runtime import Runtime
from service.security import caller_of
from service.security.audit import entry_of
from service.security.permissions import put_caller

router = APIRouter(tags=["sessions"])
_SUFFIX = "/stream"
_POLL_INTERVAL_S = 0.25
# Close codes of RFC 6455.
_IDLE, _PROTOCOL, _POLICY, _TOO_LARGE, _STOPPING = 1000, 1003, 1008, 1009, 1012
_MAX_REASON_BYTES = 123


async def stream_session(socket: WebSocket) -> None:
    """Follow a camera over one connection.

    The first message is the session. Each photograph is a text message, a JSON object with the file's size as `bytes`
    and the form fields of the HTTP route, followed by its bytes in binary messages. Each answer is a text message with
    `status` and `session`, or `problem`.
    """
    runtime: Runtime = socket.app.state.runtime
    admission = runtime.admission
    requests = SocketRequests(socket)
    path = socket.scope["path"].removesuffix(_SUFFIX)
    answer, request = await requests.get(path)
    if answer.status != 200:
        await _deny(socket, Response(answer.body, answer.status, dict(answer.headers)))
        return
    # Parsing of its frames is charged to the caller.
    put_caller(socket.scope, caller_of(request.scope))
    try:
        runtime.access_control.check_handshake(request)
        with admission.streams.hold(caller_of(request.scope).client), suppress(WebSocketDisconnect):
            await socket.accept()
            await socket.send_text(answer_text("session", answer))
            await _serve(socket, requests, f"{path}/photographs", runtime)
    except (ExposedWithoutKeysError, OverloadedError) as error:
        denial = problem_answer(request, error)
        if isinstance(error, ExposedWithoutKeysError):
            runtime.audit_trail.count(entry_of(request.scope, denial.status_code))
        await _deny(socket, denial)


async def _serve(socket: WebSocket, requests: SocketRequests, path: str, runtime: Runtime) -> None:
    """Answer photographs until the client leaves, is idle for too long, or the service stops."""
    settings = runtime.settings

    async def send(answer: SocketAnswer) -> None:
        # A client that has left is noticed when its next message is awaited.
        with suppress(WebSocketDisconnect):
            await socket.send_text(answer_text("session", answer))

    try:
        while (text := await _next_text(socket, runtime.admission, settings.storage.session_ttl_s)) is not None:
            left_bytes = await requests.post_file(path, PHOTO, FileHead.parse(text), send)
            if left_bytes > settings.photographs.max_photograph_bytes:
                await _close(socket, _TOO_LARGE, "the photograph is too large to skip it")
                return
            async with asyncio.timeout(settings.uploads.deadline_s):
                await requests.skip(left_bytes)
    except SocketProtocolError as error:
        await _close(socket, _PROTOCOL, str(error))
    except TimeoutError:
        await _close(socket, _POLICY, "the refused photograph took too long to arrive (upload_deadline_s)")
    except SocketClosedError:
        pass


async def _next_text(socket: WebSocket, admission: Admission, idle_s: float) -> str | None:
    """Wait for the next text message; None if the connection was closed instead."""
    until = monotonic() + idle_s
    waiting = asyncio.ensure_future(socket.receive())
    try:
        while not waiting.done():
            if admission.stopping:
                await _close(socket, _STOPPING, str(StoppingError()))
                return None
            if monotonic() > until:
                await _close(socket, _IDLE, f"no photograph for {idle_s:g} s (session_ttl_s)")
                return None
            await asyncio.wait([waiting], timeout=_POLL_INTERVAL_S)
        message: dict[str, Any] = dict(waiting.result())
    finally:
        waiting.cancel()
    if message["type"] == "websocket.disconnect":
        raise SocketClosedError
    if message.get("text") is None:
        raise SocketProtocolError("bytes came without a text message that states their number")
    return message["text"]


async def _close(socket: WebSocket, code: int, reason: str) -> None:
    short = reason.encode()[:_MAX_REASON_BYTES].decode(errors="ignore")
    # The client can have closed the connection meanwhile.
    with suppress(RuntimeError):
        await socket.close(code, short)


async def _deny(socket: WebSocket, response: Response) -> None:
    """Refuse the handshake with an HTTP response, or without one under servers that cannot send it."""
    if "websocket.http.response" in socket.scope.get("extensions", {}):
        await socket.send_denial_response(response)
    else:
        await socket.close(_POLICY)


router.add_websocket_route(f"/sessions/{{session_id}}{_SUFFIX}", stream_session)
