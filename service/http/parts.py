"""Answers of many bytes, sent in pieces."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

# Other requests take turns after each piece, and a slow client has no more than some of them in memory.
_PIECE_BYTES = 256 * 1024


class PartsResponse(Response):
    """Answer whose body is given in parts, which are not copied together.

    Args:
        parts: the body.
        media_type: media type of the body.
        headers: headers of the answer, without the length.
    """

    def __init__(self, parts: Sequence[bytes | memoryview], media_type: str, headers: Mapping[str, str]) -> None:
        size = sum(len(part) for part in parts)
        super().__init__(None, 200, {**headers, "Content-Length": str(size)}, media_type)
        self._parts = parts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the answer."""
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        for part in self._parts:
            for first in range(0, len(part), _PIECE_BYTES):
                piece = bytes(part[first : first + _PIECE_BYTES])
                await send({"type": "http.response.body", "body": piece, "more_body": True})
                await asyncio.sleep(0)
        await send({"type": "http.response.body", "body": b""})
