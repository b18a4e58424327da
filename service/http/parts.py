"""Answers of many bytes, sent in pieces."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

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
    """

    def __init__(self, parts: Parts, size_bytes: int, media_type: str, headers: Mapping[str, str]) -> None:
        super().__init__(None, 200, {**headers, "Content-Length": str(size_bytes)}, media_type)
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
