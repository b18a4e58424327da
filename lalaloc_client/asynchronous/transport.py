"""Connections, retries and decoding of answers."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping, Sequence
from contextlib import aclosing
from dataclasses import replace
from datetime import UTC, datetime
from random import random
from time import monotonic
from typing import Any, ParamSpec, TypeVar

import httpx

from lalaloc_client.albums import AddedPhotograph, Album, AlbumPhotograph
from lalaloc_client.answers import BatchAnswer
from lalaloc_client.asynchronous.backend import run_blocking, sleep
from lalaloc_client.asynchronous.concurrency import AsyncConcurrencyLimit
from lalaloc_client.asynchronous.device import AsyncDevice
from lalaloc_client.errors import ConflictError, ConnectionFailedError, ProblemError, problem_of
from lalaloc_client.model import FloorPlan, ImportStep, Venue
from lalaloc_client.on_device import Film, TurnFeatures, split_options
from lalaloc_client.options import Options
from lalaloc_client.parsing import page_of, parse
from lalaloc_client.requests import JSON, NDJSON, Photograph, Request, http_options, query_request, text_values
from lalaloc_client.retry import RetryPolicy, may_retry, retry_after_s

P = ParamSpec("P")
StoredT = TypeVar("StoredT", FloorPlan, Venue, Album, AlbumPhotograph)
LineT = TypeVar("LineT", BatchAnswer, AddedPhotograph)
RowT = TypeVar("RowT")

# Used when the service does not state its limit; every service allows this many.
_DEFAULT_MAX_QUERIES = 3
# Failures before any byte of a request was sent.
_UNSENT = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout)
# A stream without data for this long is dead: the service sends a heartbeat every 15 s.
_STREAM_TIMEOUT_S = 30.0
_FIRST_POLL_S, _MAX_POLL_S = 0.1, 2.0
_FOREIGN_FEATURES = "urn:lalaloc:problem:foreign-features"


class AsyncTransport:
    """Connection to a service."""

    def __init__(
        self,
        base_url: str,
        *,
        api_key: str | None = None,
        timeout_s: float = 60.0,
        retry: RetryPolicy | None = None,
        max_queries: int | None = None,
    ) -> None:
        """Connect to a service.

        Args:
            base_url: address of the service, with `http://` or `https://`.
            api_key: key to send as `Authorization: Bearer`.
            timeout_s: timeout of connecting, sending, and waiting for each part of an answer.
            retry: policy for requests that fail because the service is overloaded or unreachable.
            max_queries: maximum number of concurrent queries, further ones wait; None: the limit in the service's
                `/limits`.

        Raises:
            ValueError: an argument is out of range.
        """
        if max_queries is not None and max_queries < 1:
            raise ValueError(f"max_queries is {max_queries}; it must be at least 1")
        self._http = httpx.AsyncClient(**http_options(base_url, api_key, timeout_s))
        self._retry = retry or RetryPolicy()
        self._device = AsyncDevice(self._fetch)
        self._concurrency = AsyncConcurrencyLimit(max_queries, self._fetch_max_queries)

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def limits(self) -> Mapping[str, Any]:
        """Return the service's limits by name."""
        return parse(dict[str, Any], await self.content(Request("GET", "/limits")))

    async def _fetch_max_queries(self) -> int:
        try:
            limit = (await self.limits()).get("max_queries_per_tenant")
        except ProblemError:
            # A key with the scope to query may lack the scope to read.
            return _DEFAULT_MAX_QUERIES
        return limit if isinstance(limit, int) and limit > 0 else _DEFAULT_MAX_QUERIES

    async def query(self, make: Callable[P, Request], *args: P.args, **kwargs: P.kwargs) -> bytes:
        """Build a query and send it as soon as the concurrency limit allows both; return the answer's content."""
        async with self._concurrency.hold():
            # Reading and encoding pictures blocks.
            request = await run_blocking(make, *args, **kwargs)
            return await self.content(request)

    async def localise_query(
        self,
        path: str,
        photographs: Sequence[Photograph],
        values: Mapping[str, object],
        options: Options,
        *,
        on_device: bool = False,
    ) -> bytes:
        """Send a query about photographs, or about their features if they stay `on_device`; return the answer."""
        if not on_device:
            return await self.query(query_request, path, photographs, values, options)
        camera, others = split_options(options)

        async def send() -> bytes:
            features = await self._device.features(photographs, camera)
            return await self.query(query_request, path, features, values, others)

        return await self._with_current_model(send)

    async def localise_turn(
        self, turn: Film | Sequence[Photograph], values: Mapping[str, object], options: Options
    ) -> tuple[bytes, TurnFeatures]:
        """Send the features of a turn with its angles; return the answer, and what was sent."""
        camera, others = split_options(options)
        fields = {**values, **others, "motion": "turn"}

        async def send() -> tuple[bytes, TurnFeatures]:
            sent = await self._device.turn(turn, camera)
            angles: dict[str, object] = {"relative_heading_deg": sent.relative_heading_deg}
            if sent.relative_heading_deg is not None:
                angles["relative_heading_std_deg"] = sent.relative_heading_std_deg
            path = "/localise/sequence"
            return await self.query(query_request, path, sent.features, {**fields, **angles}), sent

        return await self._with_current_model(send)

    async def _with_current_model(self, send: Callable[[], Any]) -> Any:
        """Return what `send` does; if the service has another model than its features, load that and send again."""
        try:
            return await send()
        except ConflictError as error:
            if error.type != _FOREIGN_FEATURES:
                raise
        self._device.forget()
        return await send()

    async def _fetch(self, path: str) -> bytes:
        return await self.content(Request("GET", path, headers={"Accept": "*/*"}))

    async def _stored(self, kind: type[StoredT], request: Request, retry: RetryPolicy | None = None) -> StoredT:
        """Send a request and return the stored object in the answer, with its entity tag."""
        response = await self._send(request, retry)
        return replace(parse(kind, response.content), etag=response.headers.get("etag"))

    async def _polled(
        self, kind: type[StoredT], path: str, is_done: Callable[[StoredT], bool], timeout_s: float
    ) -> tuple[StoredT, float]:
        """Request a stored object until it is done or the time is over; return it as it then is, and the time (s)."""
        begin_s, pause_s = monotonic(), _FIRST_POLL_S
        while True:
            left_s = max(timeout_s - (monotonic() - begin_s), 0.0)
            retry = replace(self._retry, total_s=min(self._retry.total_s, left_s))
            stored = await self._stored(kind, Request("GET", path), retry)
            spent_s = monotonic() - begin_s
            if is_done(stored) or spent_s >= timeout_s:
                return stored, spent_s
            # The last poll is at the timeout.
            await sleep(min(pause_s, timeout_s - spent_s))
            pause_s = min(1.5 * pause_s, _MAX_POLL_S)

    async def _listed(self, kind: type[RowT], path: str, **params: object) -> AsyncIterator[RowT]:
        """Yield what a listing has, page by page; the field of a page is called as the end of the path."""
        rows, cursor = path.rpartition("/")[2], None
        while True:
            request = Request("GET", path, text_values({**params, "cursor": cursor}))
            page = parse(page_of(kind, rows), await self.content(request))
            for row in getattr(page, rows):
                yield row
            cursor = page.next_cursor
            if cursor is None:
                return

    async def _lines(self, kind: type[LineT], request: Request) -> AsyncGenerator[LineT]:
        """Send a streamed request, and yield the lines of its answer as they arrive."""
        async with aclosing(await self._send(request)) as response:
            try:
                async for line in response.aiter_lines():
                    yield parse(kind, line, "line")
            except httpx.TransportError as error:
                raise ConnectionFailedError(
                    f"{request.method} {request.path} broke off: {type(error).__name__} {error}".rstrip()
                ) from error

    async def content(self, request: Request) -> bytes:
        """Send a request and return the answer's content."""
        return (await self._send(request)).content

    async def _send(self, request: Request, retry: RetryPolicy | None = None) -> httpx.Response:
        """Send a request, repeatedly if necessary and safe."""
        retry = retry or self._retry
        begin_s, attempt, maybe_done = monotonic(), 0, False
        while True:
            attempt += 1
            response, failure = None, None
            try:
                response = await self._send_once(request)
                if response.status_code in request.answers:
                    return response
            except httpx.TransportError as error:
                failure = error
            sent = not isinstance(failure, _UNSENT)
            status = None if response is None else response.status_code
            after_s = None if response is None else _retry_after_s(response)
            wait_s = None
            if may_retry(request.safety, status, sent=sent, has_retry_after=after_s is not None):
                wait_s = retry.wait_s(attempt, monotonic() - begin_s, after_s, random())
            if wait_s is not None:
                maybe_done = maybe_done or (response is None and sent)
                await sleep(wait_s)
            elif response is None:
                raise ConnectionFailedError(
                    f"{request.method} {request.path} had no answer after {attempt} attempts: "
                    f"{type(failure).__name__} {failure}".rstrip()
                ) from failure
            elif maybe_done and request.method == "DELETE" and status == httpx.codes.NOT_FOUND:
                # An earlier attempt, whose answer was lost, has deleted it.
                return response
            else:
                raise problem_of(response)

    async def _send_once(self, request: Request) -> httpx.Response:
        built = self._http.build_request(
            request.method, request.path, params=request.params, headers=request.headers, content=request.content
        )
        is_streamed = request.streamed or request.on_step is not None
        if is_streamed:
            timeout: dict[str, Any] = built.extensions["timeout"]
            timeout["read"] = max(timeout["read"], _STREAM_TIMEOUT_S)
        response = await self._http.send(built, stream=is_streamed)
        if request.on_step is not None:
            return await self._end_of(response, request.on_step)
        if request.streamed and response.status_code not in request.answers:
            await response.aread()
        return response

    async def _end_of(self, response: httpx.Response, on_step: Callable[[ImportStep], None]) -> httpx.Response:
        """Read the steps of an import, and return the answer in its last line as if it had come without them."""
        async with aclosing(response):
            if not response.headers.get("content-type", "").startswith(NDJSON):
                # A refusal before the import, or a service that tells no steps.
                await response.aread()
                return response
            async for line in response.aiter_lines():
                news = parse(dict[str, Any], line, "line")
                if "status" not in news:
                    on_step(parse(ImportStep, line, "line"))
                    continue
                headers = {"content-type": JSON, "etag": news.get("etag"), "retry-after": news.get("retry_after_s")}
                given = {name: str(value) for name, value in headers.items() if value is not None}
                content = json.dumps(news.get("answer", news.get("problem"))).encode()
                return httpx.Response(news["status"], headers=given, content=content, request=response.request)
        raise httpx.RemoteProtocolError("the lines end without an answer", request=response.request)


def _retry_after_s(response: httpx.Response) -> float | None:
    return retry_after_s(response.headers.get("retry-after"), response.headers.get("date"), datetime.now(UTC))
