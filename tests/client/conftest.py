"""Fixtures of the client's tests: both clients behind one face, the production app, and a server that fails."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from time import monotonic
from typing import Any

import pytest

from lalaloc_client import AsyncClient, Client

# The app's fixtures serve here too.
from tests.service.conftest import _no_settings_from_outside, database_of, panorama, postgres, start_app

__all__ = ["_no_settings_from_outside", "database_of", "panorama", "postgres", "start_app"]

MakeClient = Callable[..., AbstractContextManager[Any]]


@dataclass(frozen=True)
class Planned:
    """One answer of the failing server; status None: it hangs up without one."""

    status: int | None
    body: Any = None
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Seen:
    """One request that it got."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes
    at_s: float


class FailingServer:
    """Answers over real HTTP what was planned, in order, and remembers what it was asked."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.plan: list[Planned] = []
        self.seen: list[Seen] = []


@pytest.fixture
def failing() -> Iterator[FailingServer]:
    """A server on a free port; it hangs up on requests that nothing is planned for."""

    class Handler(BaseHTTPRequestHandler):
        def _handle(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length", 0)))
            headers = {name.lower(): value for name, value in self.headers.items()}
            server.seen.append(Seen(self.command, self.path, headers, body, monotonic()))
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

        def log_message(self, format: str, *args: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        server = FailingServer(f"http://127.0.0.1:{http.server_address[1]}")
        thread = threading.Thread(target=http.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            http.shutdown()
            thread.join(10.0)


class _Blocking:
    """An `AsyncClient` with the face of a `Client`, so that each test runs with both."""

    def __init__(self, runner: asyncio.Runner, client: AsyncClient) -> None:
        self._runner = runner
        self._client = client

    def floorplans(self, *arguments: Any, **options: Any) -> list[Any]:
        async def collect() -> list[Any]:
            return [summary async for summary in self._client.floorplans(*arguments, **options)]

        return self._runner.run(collect())

    def venues(self, *arguments: Any, **options: Any) -> list[Any]:
        async def collect() -> list[Any]:
            return [venue async for venue in self._client.venues(*arguments, **options)]

        return self._runner.run(collect())

    def venue_plans(self, *arguments: Any, **options: Any) -> list[Any]:
        async def collect() -> list[Any]:
            return [plan async for plan in self._client.venue_plans(*arguments, **options)]

        return self._runner.run(collect())

    def events(self, *arguments: Any, **options: Any) -> list[Any]:
        async def collect() -> list[Any]:
            return [event async for event in self._client.events(*arguments, **options)]

        return self._runner.run(collect())

    def __getattr__(self, name: str) -> Callable[..., Any]:
        method = getattr(self._client, name)
        return lambda *arguments, **options: self._runner.run(method(*arguments, **options))


@contextmanager
def _blocking(*arguments: Any, **options: Any) -> Iterator[_Blocking]:
    with asyncio.Runner() as runner:
        client = AsyncClient(*arguments, **options)
        yield _Blocking(runner, client)
        runner.run(client.close())


@pytest.fixture(params=["sync", "async"])
def make_client(request: pytest.FixtureRequest) -> MakeClient:
    """Makes a client of either kind."""
    return Client if request.param == "sync" else _blocking
