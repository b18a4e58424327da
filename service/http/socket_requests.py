"""Requests that arrive over a WebSocket and are handled as HTTP requests by the same application.

Every request passes all middleware: ids and log line, key and tenant, rate limit, slots, limits of uploads. A file is
read from the socket while its request is handled, and nothing is read between its end and the answer, so that a client
that sends faster is slowed down by TCP.
"""

from __future__ import annotations

import asyncio
import json
import re
import uuid
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import Message, Scope
from starlette.websockets import WebSocket

from service.http.uploads import JSON, MULTIPART

# Headers of the handshake that its requests repeat.
_REPEATED = frozenset({b"authorization", b"host", b"origin", b"traceparent", b"user-agent"})
_SCOPE_KEYS = ("asgi", "client", "http_version", "root_path", "server")
_FIELD = re.compile(r"[a-z_]{1,40}")
_MAX_HEAD = 16 * 1024
_SIZE = "bytes"
# Far above every limit of uploads; larger numbers are no sizes.
_MAX_STATED_BYTES = 2**50


class SocketProtocolError(Exception):
    """Message that breaks the protocol; the connection cannot continue."""


class SocketClosedError(Exception):
    """The client has closed the connection."""


@dataclass(frozen=True)
class SocketAnswer:
    """Answer to a request."""

    status: int
    headers: Headers
    body: bytes


@dataclass(frozen=True)
class FileHead:
    """Announced file: its size and the form fields that are sent with it."""

    size_bytes: int
    fields: Mapping[str, str]

    @classmethod
    def parse(cls, text: str) -> FileHead:
        """Parse a text message: a JSON object with `bytes` and fields.

        Raises:
            SocketProtocolError: it is something else.
        """
        if len(text) > _MAX_HEAD:
            raise SocketProtocolError(f"a text message has {len(text)} characters; the limit is {_MAX_HEAD}")
        try:
            values = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise SocketProtocolError("a text message is not JSON; send an object with bytes and fields") from error
        size = values.pop(_SIZE, None) if isinstance(values, dict) else None
        if type(size) is not int or not 1 <= size <= _MAX_STATED_BYTES:
            raise SocketProtocolError(f"{_SIZE} is {str(size)[:20]}; send the size of the photograph's file")
        if unknown := next((name for name in values if not _FIELD.fullmatch(name)), None):
            raise SocketProtocolError(f"'{unknown[:20]}' is no name of a field; fields are those of the HTTP route")
        return cls(size, {name: _text(value) for name, value in values.items() if value is not None})


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


class SocketRequests:
    """Requests of one connection, one at a time."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket

    async def get(self, path: str) -> tuple[SocketAnswer, Request]:
        """Handle a GET request; return its answer, and the request with its caller."""
        scope = self._scope("GET", path, {})
        answer = await self._handle(scope, _Body([b""]))
        return answer, Request(scope)

    async def post_file(
        self, path: str, name: str, head: FileHead, on_answer: Callable[[SocketAnswer], Awaitable[None]]
    ) -> int:
        """Handle a form with a file whose bytes the next binary messages have.

        Args:
            path: path of the request.
            name: name of the file's part.
            head: size and fields.
            on_answer: sends the answer, while the request still holds its slot.

        Returns:
            the bytes of the file that were not read, as the request was refused before.

        Raises:
            SocketProtocolError: the file is not followed by its bytes.
            SocketClosedError: the client has closed the connection before the end of the file.
        """
        boundary = uuid.uuid4().hex
        before, after = _envelope(boundary, name, head.fields)
        body = _Body([before, after], self._socket, head.size_bytes)
        headers = {
            "content-type": f"{MULTIPART}; boundary={boundary}",
            "content-length": str(len(before) + head.size_bytes + len(after)),
        }
        await self._handle(self._scope("POST", path, headers), body, on_answer)
        if body.failure is not None:
            raise body.failure
        return body.left_bytes

    async def skip(self, count: int) -> None:
        """Read and drop the next bytes of a refused file.

        Raises:
            SocketProtocolError, SocketClosedError: see `post_file`.
        """
        while count > 0:
            count -= len(await _next_bytes(self._socket, count))

    async def _handle(
        self, scope: Scope, body: _Body, on_answer: Callable[[SocketAnswer], Awaitable[None]] | None = None
    ) -> SocketAnswer:
        head: Message = {"status": 500, "headers": []}
        content = bytearray()
        answer: SocketAnswer | None = None

        async def send(message: Message) -> None:
            nonlocal answer, head
            if message["type"] == "http.response.start":
                head = message
                return
            content.extend(message.get("body", b""))
            if not message.get("more_body", False):
                answer = SocketAnswer(head["status"], Headers(raw=head["headers"]), bytes(content))
                if on_answer is not None and body.failure is None:
                    await on_answer(answer)

        await self._socket.app(scope, body.receive, send)
        assert answer is not None
        return answer

    def _scope(self, method: str, path: str, headers: Mapping[str, str]) -> Scope:
        socket = self._socket.scope
        repeated = [(name, value) for name, value in socket["headers"] if name in _REPEATED]
        own = {"accept": JSON, **headers}
        return {
            **{key: socket[key] for key in _SCOPE_KEYS if key in socket},
            "type": "http",
            "scheme": "https" if socket.get("scheme") == "wss" else "http",
            "method": method,
            "path": path,
            "raw_path": quote(path).encode("ascii"),
            "query_string": b"",
            "headers": [*repeated, *((name.encode(), value.encode()) for name, value in own.items())],
            "state": dict(socket.get("state", {})),
        }


class _Body:
    """Body of a request: its parts, and between the first and the last the file from the socket."""

    def __init__(self, parts: list[bytes], socket: WebSocket | None = None, file_bytes: int = 0) -> None:
        self._parts = parts
        self._socket = socket
        self._begun = False
        self.left_bytes = file_bytes
        self.failure: SocketProtocolError | SocketClosedError | None = None

    async def receive(self) -> Message:
        """Return the next part of the body."""
        if self.failure is not None:
            return {"type": "http.disconnect"}
        if self._begun and self._socket is not None and self.left_bytes:
            try:
                content = await _next_bytes(self._socket, self.left_bytes)
            except (SocketProtocolError, SocketClosedError) as error:
                self.failure = error
                return {"type": "http.disconnect"}
            self.left_bytes -= len(content)
            return {"type": "http.request", "body": content, "more_body": True}
        if not self._parts:
            # A photograph that has arrived is counted, so its client cannot take it back. Cancelled with the answer.
            await asyncio.Event().wait()
        self._begun = True
        part = self._parts.pop(0)
        return {"type": "http.request", "body": part, "more_body": bool(self._parts)}


async def _next_bytes(socket: WebSocket, most: int) -> bytes:
    message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise SocketClosedError
    content: bytes | None = message.get("bytes")
    if content is None:
        raise SocketProtocolError(f"a text message came before the last {most} bytes of a photograph")
    if len(content) > most:
        raise SocketProtocolError(f"the photograph has {len(content) - most} bytes more than stated")
    return content


def _envelope(boundary: str, name: str, fields: Mapping[str, str]) -> tuple[bytes, bytes]:
    """Return what stands before and after the file in a multipart body."""
    lines: list[str] = []
    for field, value in fields.items():
        lines += [f"--{boundary}", f'Content-Disposition: form-data; name="{field}"', "", value]
    lines += [f"--{boundary}", f'Content-Disposition: form-data; name="{name}"; filename="{name}"', "", ""]
    return "\r\n".join(lines).encode(errors="replace"), f"\r\n--{boundary}--\r\n".encode("ascii")


def answer_text(name: str, answer: SocketAnswer) -> str:
    """Return an answer as a text message: its status and its JSON as `name`, or as `problem` with `retry_after_s`."""
    document: dict[str, Any] = {"status": answer.status}
    if answer.status >= 400 and (retry := answer.headers.get("retry-after")) is not None:
        document["retry_after_s"] = int(retry)
    document[name if answer.status < 400 else "problem"] = json.loads(answer.body)
    return json.dumps(document)
