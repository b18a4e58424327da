"""HTTP server of the app."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

import httpx
import pytest
from fastapi import FastAPI, Request

from service.http import http_protocol
from service.http.http_protocol import bounded_protocol
from service.http.server import Server, server_config
from service.settings import Settings
from tests.service.conftest import constants, wait_for


def test_answer_body_is_not_delayed() -> None:
    no_delay: list[int] = []

    class Watched(bounded_protocol(5.0, 100)):
        def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
            super().connection_made(transport)
            connection = transport.get_extra_info("socket")
            no_delay.append(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))

    with served(FastAPI(), Settings(), Watched) as port:
        httpx.get(f"http://127.0.0.1:{port}/openapi.json").raise_for_status()
    assert no_delay == [1]


@contextmanager
def served(app: FastAPI, settings: Settings, protocol: type[asyncio.Protocol] | None = None) -> Iterator[int]:
    """Run an app as the command line does, by default with its own protocol; gives its port."""
    config = server_config(app, settings)
    config.http = protocol or config.http
    # Of a socket made like this, asyncio does not see that it is one of TCP.
    with socket.create_server(("127.0.0.1", 0)) as listener:
        running = Server(config, app, settings)
        thread = threading.Thread(target=running.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            wait_for(lambda: running.started)
            yield listener.getsockname()[1]
        finally:
            running.should_exit = True
            thread.join(30.0)


def _app() -> FastAPI:
    app = FastAPI()

    @app.get("/who")
    def who(request: Request) -> str:
        return "" if request.client is None else request.client.host

    return app


def test_idle_connections_make_room() -> None:
    settings, few = Settings(max_pending_requests=11), {"max_connections": 1, "max_reads": 4, "max_streams": 4}
    # One more than all slots.
    most = 4 + 4 + 11 + 1
    with constants(few), served(_app(), settings) as port, ExitStack() as stack:
        address = ("127.0.0.1", port)
        idle = [stack.enter_context(socket.create_connection(address, timeout=10.0)) for _ in range(3 * most)]
        for _ in range(3):
            assert httpx.get(f"http://127.0.0.1:{port}/who", timeout=60.0).status_code == 200
        # The connections that were idle the longest are closed.
        assert idle[0].recv(1) == b""
        idle[-1].setblocking(False)
        with pytest.raises(BlockingIOError):
            idle[-1].recv(1)


def test_busy_connection_is_not_closed() -> None:
    app, go_on = _app(), threading.Event()

    @app.get("/slow")
    def slow() -> str:
        assert go_on.wait(30.0)
        return "done"

    few = {"max_connections": 1, "max_reads": 1, "max_streams": 1}
    settings = Settings(max_pending_requests=1)
    with constants(few), served(app, settings) as port, ExitStack() as stack, ThreadPoolExecutor(1) as threads:
        answer = threads.submit(httpx.get, f"http://127.0.0.1:{port}/slow", timeout=30.0)
        time.sleep(0.3)
        for _ in range(20):
            stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10.0))
        assert httpx.get(f"http://127.0.0.1:{port}/who", timeout=60.0).status_code == 200
        go_on.set()
        assert answer.result(30.0).json() == "done"


@pytest.mark.slow
def test_refused_bodies_are_read_slowly_to_their_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_protocol, "_DROPPING_S", 5e-8)
    body, clients = b"x" * (20 * 2**20), 3
    with served(_app(), Settings()) as port, httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60.0) as client:
        begin = time.monotonic()
        with ThreadPoolExecutor(clients) as threads:
            answers = list(threads.map(lambda _: client.post("/who", content=body), range(clients)))
        # All but what the buffers of the sockets hold.
        assert time.monotonic() - begin > 0.5 * clients * len(body) * 5e-8
        assert [answer.status_code for answer in answers] == [405] * clients
        # Their connections are in use again.
        assert [client.get("/who").status_code for _ in range(clients)] == [200] * clients


@pytest.mark.parametrize(("proxies", "client_host"), [(None, "127.0.0.1"), ("127.0.0.1", "203.0.113.7")])
def test_only_named_proxies_are_trusted(monkeypatch: pytest.MonkeyPatch, proxies: str | None, client_host: str) -> None:
    monkeypatch.delenv("FORWARDED_ALLOW_IPS", raising=False)
    if proxies is not None:
        monkeypatch.setenv("FORWARDED_ALLOW_IPS", proxies)
    with served(_app(), Settings()) as port:
        answer = httpx.get(f"http://127.0.0.1:{port}/who", headers={"x-forwarded-for": "203.0.113.7"})
    assert answer.json() == client_host


@pytest.mark.slow
def test_descriptor_limit_bounds_connections() -> None:
    code = (
        "import resource, sys\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv[1]), int(sys.argv[2])))\n"
        "from lalaloc_core.errors import ConfigError\n"
        "from service.http.server import max_connections_of\n"
        "from service.settings import Settings\n"
        "try:\n"
        "    print(max_connections_of(1024, Settings()), resource.getrlimit(resource.RLIMIT_NOFILE)[0])\n"
        "except ConfigError as error:\n"
        "    print(error)\n"
    )

    def output(soft: int, hard: int) -> str:
        command = [sys.executable, "-c", code, str(soft), str(hard)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    assert output(256, 4096) == "1024 1240"
    assert output(256, 1024) == "808 1024"
    assert output(2048, 4096) == "1024 2048"
    assert "128 file descriptors; at least 232 are needed" in output(128, 128)
