"""How the client that blocks sends."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import httpx

from lalaloc_client import operations
from lalaloc_client.concurrency import ConcurrencyLimit
from lalaloc_client.connection import checked_max_queries, http_options, request_to_send
from lalaloc_client.operations import Patience, Reply, Steps, Wait
from lalaloc_client.requests import Request
from lalaloc_client.retry import RetryPolicy

P = ParamSpec("P")
T = TypeVar("T")


class Sender:
    """Runs what `operations` yields; what methods of the client have in common."""

    def __init__(
        self,
        base_url: str,
        *,
        api_key: str | None = None,
        timeout_s: float = 60.0,
        retry: RetryPolicy | None = None,
        max_queries: int | None = None,
    ) -> None:
        """Args:
        base_url: address of the service, with `http://` or `https://`.
        api_key: sent as `Authorization: Bearer`.
        timeout_s: longest that connecting, sending or waiting for a part of an answer may take.
        retry: how often requests are sent again when the service is overloaded or does not answer.
        max_queries: how many queries are sent at a time, others wait for one of them to be answered; None: as many
            as the service has room for, by its `/limits`.
        """
        self._http = httpx.Client(**http_options(base_url, api_key, timeout_s))
        self._patience = Patience(retry or RetryPolicy())
        self._concurrency = ConcurrencyLimit(
            checked_max_queries(max_queries), lambda: self._run(operations.queries_at_a_time(self._patience))
        )

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def _query(
        self,
        operation: Callable[[Request, Patience], Steps[T]],
        make: Callable[P, Request],
        *arguments: P.args,
        **options: P.kwargs,
    ) -> T:
        """Make a request that the service computes for, and send it, both as soon as it is its turn."""
        with self._concurrency.hold():
            return self._run(operation(make(*arguments, **options), self._patience))

    def _run(self, steps: Steps[T]) -> T:
        try:
            step = next(steps)
            while True:
                step = steps.send(self._do(step))
        except StopIteration as done:
            return done.value

    def _do(self, step: Request | Wait) -> Reply:
        if isinstance(step, Wait):
            time.sleep(step.duration_s)
            return Reply()
        try:
            response = self._http.send(request_to_send(self._http, step), stream=step.streamed)
            if step.streamed and response.status_code not in step.answers:
                response.read()
            return Reply(response)
        except httpx.TransportError as error:
            return Reply(failure=error)
