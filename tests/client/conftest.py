"""Fixtures of the client's tests: both clients with the same interface, the production app, and a failing server."""

from __future__ import annotations

import asyncio
import inspect
import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import httpx
import pytest

from lalaloc_client import AsyncClient, Client
from tests.local_servers import QuietHandler, http_server
from tests.service.conftest import (  # noqa: F401, fixtures
    _clean_environment,
    _forked_workers,
    app_settings,
    database_of,
    empty_database,
    postgres,
    sphere,
    start_app,
    upload,
)
from tests.service.conftest import client as app

__all__ = ["app"]

MakeClient = Callable[..., AbstractContextManager[Any]]


@dataclass(frozen=True)
class Planned:
    """One answer of the failing server; status None: it closes the connection without an answer."""

    status: int | None
    body: Any = None
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ReceivedRequest:
    """One request to the failing server."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes
    received_s: float


class FailingServer:
    """HTTP server that sends the planned answers in order and records the requests."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.plan: list[Planned] = []
        self.requests: list[ReceivedRequest] = []


@pytest.fixture
def failing() -> Iterator[FailingServer]:
    """Return a server on a free port; without a planned answer it closes the connection."""

    class Handler(QuietHandler):
        def _handle(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length", 0)))
            headers = {name.lower(): value for name, value in self.headers.items()}
            server.requests.append(ReceivedRequest(self.command, self.path, headers, body, monotonic()))
            planned = server.plan.pop(0) if server.plan else Planned(None)
            self.close_connection = planned.status is None
            if planned.status is None:
                return
            content = planned.body if isinstance(planned.body, bytes) else json.dumps(planned.body).encode()
            self.send_response(planned.status)
            for name, value in ({"Content-Length": str(len(content))} | planned.headers).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        do_GET = do_POST = do_PUT = do_DELETE = _handle

    with http_server(Handler) as url:
        server = FailingServer(url)
        yield server


class _BlockingAdapter:
    """An `AsyncClient` with the interface of a `Client`, so that each test runs with both."""

    def __init__(self, runner: asyncio.Runner, client: AsyncClient) -> None:
        self._runner = runner
        self._client = client

    def __getattr__(self, name: str) -> Callable[..., Any]:
        method = getattr(self._client, name)

        async def call(*args: Any, **kwargs: Any) -> Any:
            answer = method(*args, **kwargs)
            return [item async for item in answer] if inspect.isasyncgen(answer) else await answer

        return lambda *args, **kwargs: self._runner.run(call(*args, **kwargs))


@contextmanager
def _blocking(*arguments: Any, **options: Any) -> Iterator[_BlockingAdapter]:
    with asyncio.Runner() as runner:
        client = AsyncClient(*arguments, **options)
        yield _BlockingAdapter(runner, client)
        runner.run(client.close())


# The client that blocks is generated from the other one, so that a test with either runs the same lines.
@pytest.fixture(params=["sync", pytest.param("async", marks=pytest.mark.slow)])
def make_client(request: pytest.FixtureRequest) -> MakeClient:
    """Return a function that creates a client of either kind."""
    return Client if request.param == "sync" else _blocking


@pytest.fixture(scope="module")
def plan_id(app: httpx.Client) -> str:
    """Return the id of `FLAT` in the module's app."""
    return upload(app)


@pytest.fixture
def service(app: httpx.Client, make_client: MakeClient) -> Iterator[Any]:
    """Return a client of the module's app."""
    with make_client(str(app.base_url)) as client:
        yield client
