"""How the client for asyncio sends."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import httpx

from lalaloc_client import operations
from lalaloc_client.async_concurrency import AsyncConcurrencyLimit
from lalaloc_client.connection import checked_max_queries, http_options, request_to_send
from lalaloc_client.operations import Patience, Reply, Steps, Wait
from lalaloc_client.requests import Request
from lalaloc_client.retry import RetryPolicy

P = ParamSpec("P")
T = TypeVar("T")


class AsyncSender:
    """As `Sender`."""

    def __init__(
        self,
        base_url: str,
        *,
        api_key: str | None = None,
        timeout_s: float = 60.0,
        retry: RetryPolicy | None = None,
        max_queries: int | None = None,
    ) -> None:
        """See `Client`."""
        self._http = httpx.AsyncClient(**http_options(base_url, api_key, timeout_s))
        self._patience = Patience(retry or RetryPolicy())
        self._concurrency = AsyncConcurrencyLimit(
            checked_max_queries(max_queries), lambda: self._run(operations.queries_at_a_time(self._patience))
        )

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def _query(
        self,
        operation: Callable[[Request, Patience], Steps[T]],
        make: Callable[P, Request],
        *arguments: P.args,
        **options: P.kwargs,
    ) -> T:
        """See `Sender._query`."""
        async with self._concurrency.hold():
            # On a thread: reading and encoding a picture takes a while.
            request = await asyncio.to_thread(make, *arguments, **options)
            return await self._run(operation(request, self._patience))

    async def _run(self, steps: Steps[T]) -> T:
        try:
            step = next(steps)
            while True:
                reply = await self._do(step)
                step = steps.send(reply)
        except StopIteration as done:
            return done.value

    async def _do(self, step: Request | Wait) -> Reply:
        if isinstance(step, Wait):
            await asyncio.sleep(step.duration_s)
            return Reply()
        try:
            response = await self._http.send(request_to_send(self._http, step), stream=step.streamed)
            if step.streamed and response.status_code not in step.answers:
                await response.aread()
            return Reply(response)
        except httpx.TransportError as error:
            return Reply(failure=error)
