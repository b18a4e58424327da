"""Answers that are sent piece by piece: of many bytes, and of lines that are computed meanwhile."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Mapping, Sequence

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

NDJSON = "application/x-ndjson"
# Other requests take turns after each piece, and a slow client has no more than some of them in memory.
_PIECE_BYTES = 256 * 1024

Part = bytes | memoryview
Parts = Sequence[Part] | AsyncIterator[Part]


class PartsResponse(Response):
    """Answer whose body is given in parts, which are not copied together.

    Args:
        parts: the body.
        size_bytes: length of the body.
        media_type: media type of the body.
        headers: headers of the answer, without the length.
        status: HTTP status.
    """

    def __init__(
        self, parts: Parts, size_bytes: int, media_type: str, headers: Mapping[str, str], status: int = 200
    ) -> None:
        super().__init__(None, status, {**headers, "Content-Length": str(size_bytes)}, media_type)
        self._parts = parts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the answer."""
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        async for part in _in_order(self._parts):
            for first in range(0, len(part), _PIECE_BYTES):
                piece = bytes(part[first : first + _PIECE_BYTES])
                await send({"type": "http.response.body", "body": piece, "more_body": True})
                await asyncio.sleep(0)
        await send({"type": "http.response.body", "body": b""})


async def _in_order(parts: Parts) -> AsyncIterator[Part]:
    if isinstance(parts, AsyncIterator):
        async for part in parts:
            yield part
    else:
        for part in parts:
            yield part


class LinesResponse(Response):
    """Answer of lines that ends, and ends their computation, as soon as its client leaves or stops reading.

    Args:
        lines: the lines, without line breaks.
        patience_s: time (s) in which the client must take a line.
    """

    media_type = NDJSON

    def __init__(self, lines: AsyncGenerator[str], patience_s: float) -> None:
        # Proxies must not hold lines back.
        super().__init__(None, 200, {"X-Accel-Buffering": "no"})
        del self.headers["content-length"]
        self._lines = lines
        self._patience_s = patience_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the answer."""
        gone = asyncio.ensure_future(_disconnect(receive))
        try:
            await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
            while (line := await self._next_unless(gone)) is not None:
                async with asyncio.timeout(self._patience_s):
                    await send({"type": "http.response.body", "body": f"{line}\n".encode(), "more_body": True})
            if not gone.done():
                await send({"type": "http.response.body", "body": b""})
        except TimeoutError:
            # Without its end the answer is incomplete, which the client sees if it reads on.
            pass
        finally:
            gone.cancel()
            await self._lines.aclose()

    async def _next_unless(self, gone: asyncio.Future[None]) -> str | None:
        """Wait for the next line; None at the end, or if the client has left."""
        line = asyncio.ensure_future(anext(self._lines, None))
        try:
            await asyncio.wait({line, gone}, return_when=asyncio.FIRST_COMPLETED)
            return line.result() if line.done() else None
        finally:
            if not line.done():
                line.cancel()
                await asyncio.wait({line})


async def _disconnect(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
