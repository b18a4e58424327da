"""Representations in answers (RFC 9110): the media type by `Accept`, entity tags and conditions, and bodies in pieces.

All tags are strong: equal tags mean equal bytes. The tag of a plan is `"<revision id>.<digest>"`, because status and
progress change within a revision; the digest is that of all that the bytes depend on, so that a tag is compared before
the bytes are made. `If-Match` compares the part before the dot only, so it accepts every tag
of the current revision, and the plain `"<revision id>"`. Venues have tags of the same kind.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
from collections.abc import AsyncGenerator, AsyncIterator, Mapping, Sequence

from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from lalaloc_core import __version__
from service.errors import InvalidRequestError, RangeError, RevisionMismatchError


def preferred(request: Request, offered: tuple[str, ...]) -> str:
    """Return the offered media type that the request prefers; the first one if several tie or none is accepted."""
    accepted = ",".join(request.headers.getlist("accept"))
    ranges = [_range(part) for part in accepted.split(",") if part.strip()]
    if not ranges:
        return offered[0]
    return max(offered, key=lambda media: _quality(media, ranges))


def _range(text: str) -> tuple[str, float]:
    """Return a media range and its weight; other parameters are ignored."""
    media, *parameters = (part.strip().lower() for part in text.split(";"))
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                return media, min(max(float(value), 0.0), 1.0)
            except ValueError:
                return media, 0.0
    return media, 1.0


def _quality(media: str, ranges: list[tuple[str, float]]) -> float:
    """Return the weight of the most specific range that contains a media type."""
    kind = media.split("/")[0]
    for pattern in (media, f"{kind}/*", "*/*"):
        found = [weight for accepted, weight in ranges if accepted == pattern]
        if found:
            return max(found)
    return 0.0


NDJSON = "application/x-ndjson"
# Other requests take turns after each piece, and a slow client has no more than some of them in memory.
_PIECE_BYTES = 256 * 1024

Part = bytes | memoryview
Parts = Sequence[Part] | AsyncIterator[Part]


class PartsResponse(Response):
    """Answer whose body is given in parts, which are not copied together."""

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

    It stops reading if it does not take a line within `patience_s` (s).
    """

    media_type = NDJSON

    def __init__(self, lines: AsyncGenerator[str], patience_s: float) -> None:
        # Proxies must not hold lines back.
        super().__init__(None, 200, {"X-Accel-Buffering": "no"})
        del self.headers["content-length"]
        self._lines, self._patience_s = lines, patience_s

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


# Private, and revalidated each time: keys can be revoked and plans replaced.
_CACHED = {"Cache-Control": "private, no-cache"}
_TAG = re.compile(r'[ \t,]*(W/)?("[\x21\x23-\x7e\x80-\xff]*")[ \t]*(?:,[ \t,]*|\Z)')
_DIGITS = 32
_RANGE = re.compile(r"bytes=[ \t]*([0-9]{0,18})-([0-9]{0,18})[ \t]*")


def digest_etag(digest: str) -> str:
    """Return the entity tag of the bytes with a SHA-256 digest."""
    return f'"{digest[:_DIGITS]}"'


def revision_etag(revision_id: str, *parts: object) -> str:
    """Return the entity tag of a representation of a revision: `parts` are all else that its bytes depend on."""
    digest = hashlib.sha256(repr((__version__, *parts)).encode()).hexdigest()
    return f'"{revision_id}.{digest[:_DIGITS]}"'


def not_modified(request: Request, etag: str, headers: Mapping[str, str] | None = None) -> Response | None:
    """Return 304 if the client has the representation with this tag already; otherwise None."""
    if {"*", etag}.intersection(_tags(request, "If-None-Match") or ()):
        return Response(status_code=304, headers={"ETag": etag, **_CACHED, **(headers or {})})
    return None


def byte_range(request: Request, etag: str, size_bytes: int) -> range | None:
    """Return the bytes that the client asks for; None for the whole representation, or several ranges."""
    values = request.headers.getlist("Range")
    found = _RANGE.fullmatch(values[0]) if len(values) == 1 else None
    if found is None or not any(found.groups()) or request.headers.get("If-Range", etag) != etag:
        return None
    first, last = (int(text) if text else None for text in found.groups())
    if first is None:
        # The last bytes.
        first, last = max(size_bytes - (last or 0), 0), None
    elif last is not None and last < first:
        return None
    if first >= size_bytes:
        raise RangeError(size_bytes)
    return range(first, size_bytes if last is None else min(last + 1, size_bytes))


def tagged_answer(
    parts: Sequence[Part], media_type: str, etag: str, headers: Mapping[str, str] | None = None
) -> Response:
    """Return a representation, given in parts, with its tag."""
    return tagged_stream(parts, sum(map(len, parts)), media_type, etag, headers)


def tagged_stream(
    parts: Parts,
    size_bytes: int,
    media_type: str,
    etag: str,
    headers: Mapping[str, str] | None = None,
    status: int = 200,
) -> Response:
    """Return a representation of known size, whose parts can be made while it is sent, with its tag."""
    return PartsResponse(parts, size_bytes, media_type, {"ETag": etag, **_CACHED, **(headers or {})}, status)


def expected_revision(request: Request, resource_id: str, revision_id: str, *, what: str = "floor plan") -> str | None:
    """Check the preconditions of a change to a plan or venue at its current revision.

    Returns:
        The revision that must still be current when the change is stored; None for any.
    """
    match, none_match = _tags(request, "If-Match", weak=False), _tags(request, "If-None-Match") or set()
    if "*" in none_match or revision_id in _revisions(none_match):
        raise RevisionMismatchError(resource_id, "any other (If-None-Match)", revision_id, what=what)
    if match is None or "*" in match:
        return None
    named = _revisions(match)
    if revision_id not in named:
        raise RevisionMismatchError(resource_id, ", ".join(sorted(named)) or "a weak tag", revision_id, what=what)
    return revision_id


def _revisions(tags: set[str]) -> set[str]:
    return {tag.strip('"').partition(".")[0] for tag in tags}


def _tags(request: Request, name: str, *, weak: bool = True) -> set[str] | None:
    """Return the tags of a header in their quotes, `*` without, weak ones only if wanted; None without the header."""
    values = request.headers.getlist(name)
    if not values:
        return None
    text = ", ".join(values).strip(" \t")
    if text == "*":
        return {"*"}
    found: list[tuple[bool, str]] = []
    end = 0
    while end < len(text) and (tag := _TAG.match(text, end)) is not None:
        found.append((tag[1] is not None, tag[2]))
        end = tag.end()
    if not found or end < len(text):
        fault = f"is '{text[:100]}', which is neither * nor a list of entity tags in double quotes"
        raise InvalidRequestError([(name, fault)])
    return {opaque for is_weak, opaque in found if weak or not is_weak}
