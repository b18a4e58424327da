"""Connections that send many events in few bytes: chunks, header lines, pipelined requests."""

from __future__ import annotations

import asyncio
import itertools
import logging
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import httpx
import pytest
from fastapi import FastAPI, Request

from service.capacity.cpu_accounts import CpuAccounts
from service.http import http_protocol
from service.http.http_protocol import EVENTS_PER_TURN, MAX_HEAD_BYTES, PacedParser
from service.security.permissions import Caller, put_caller
from service.settings import Settings
from tests.service.test_server import served

HOST = b"Host: localhost\r\n"
LAST_REQUEST = b"GET /who HTTP/1.1\r\nConnection: close\r\n" + HOST


def _app() -> FastAPI:
    app = FastAPI()

    @app.get("/who")
    def who() -> str:
        return "me"

    @app.post("/body")
    async def body(request: Request) -> int:
        return len(await request.body())

    @app.post("/refused", status_code=401)
    async def refused() -> str:
        return "no"

    return app


@pytest.fixture
def port() -> Iterator[int]:
    with served(_app(), Settings()) as port:
        yield port


@contextmanager
def _connected(port: int) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", port), timeout=30.0) as connection:
        yield connection


def _read_all(connection: socket.socket) -> bytes:
    content = b""
    try:
        while part := connection.recv(65536):
            content += part
    except ConnectionResetError:
        pass
    return content


def _answer_to(port: int, *pieces: bytes) -> bytes:
    """Return all that is answered to bytes on a connection of their own."""
    with _connected(port) as connection:
        for piece in pieces:
            connection.sendall(piece)
        return _read_all(connection)


def _chunked(path: str, chunk: bytes, count: int) -> bytes:
    head = f"POST {path} HTTP/1.1\r\n".encode() + HOST + b"Transfer-Encoding: chunked\r\n\r\n"
    return head + count * (f"{len(chunk):x}\r\n".encode() + chunk + b"\r\n")


class _Transport(asyncio.Transport):
    def __init__(self) -> None:
        super().__init__()
        self.reading = True

    def pause_reading(self) -> None:
        self.reading = False

    def resume_reading(self) -> None:
        self.reading = True

    def is_closing(self) -> bool:
        return False


def test_turn_of_the_loop_handles_a_bounded_number_of_events(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_protocol, "EVENTS", http_protocol.Pace(0.0))

    async def parse_all() -> list[bytes]:
        turns: list[bytes] = [b""]

        def parse(piece: bytes) -> None:
            turns[-1] += piece
            parser.events_left -= len(piece)

        transport = _Transport()
        parser = PacedParser(transport, parse, 1, lambda: True, lambda _cpu_s: None)
        parser.feed(bytes(1000))
        assert not transport.reading
        while parser.held:
            turns.append(b"")
            await asyncio.sleep(0)
        assert transport.reading
        return turns

    turns = asyncio.run(parse_all())
    assert sum(map(len, turns)) == 1000
    assert max(map(len, turns)) == EVENTS_PER_TURN


@pytest.mark.parametrize("path", [pytest.param("/body", marks=pytest.mark.slow), "/refused"])
def test_body_in_tiny_chunks_is_refused(port: int, path: str) -> None:
    with _connected(port) as flood:
        sending = threading.Thread(target=_send_quietly, args=(flood, _chunked(path, b"x", 200_000)))
        sending.start()
        answer = _read_all(flood)
        sending.join()
    if path == "/body":
        assert answer.startswith(b"HTTP/1.1 400 ")
        assert b"the body has 1025 chunks of 1 bytes on average; the minimum is 64" in answer
    else:
        # The refusal was sent; then the connection is closed.
        assert answer.startswith(b"HTTP/1.1 401 ")


def test_answer_ends_the_connection_of_a_body_in_small_chunks(port: int) -> None:
    # Fewer than a turn handles, so that no turn after the answer sees them.
    with _connected(port) as connection:
        connection.sendall(_chunked("/refused", b"x", 6))
        connection.settimeout(3.0)
        assert _read_all(connection).startswith(b"HTTP/1.1 401 ")


def test_connections_after_a_body_in_small_chunks_are_read_later(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_protocol, "_PENALTY_S", 60.0)
    _answer_to(port, _chunked("/refused", b"x", 6))
    begin = time.monotonic()
    assert _answer_to(port, LAST_REQUEST + b"\r\n").endswith(b'"me"')
    assert time.monotonic() - begin > 0.4


def _send_quietly(connection: socket.socket, content: bytes) -> None:
    # The server may close the connection.
    with suppress(OSError):
        connection.sendall(content)


def test_body_in_many_chunks_arrives_as_a_whole(port: int) -> None:
    answers = _answer_to(port, _chunked("/body", b"y" * 100, 3000) + b"0\r\n\r\n" + LAST_REQUEST, b"\r\n")
    assert b"\r\n\r\n300000" in answers
    assert answers.endswith(b'"me"')


def test_pipelined_requests_are_all_answered_and_other_versions_refused(port: int) -> None:
    request = b"GET /who HTTP/1.1\r\n" + HOST
    assert _answer_to(port, 199 * (request + b"\r\n") + LAST_REQUEST + b"\r\n").count(b"HTTP/1.1 200 OK") == 200
    assert _answer_to(port, b"GET /who HTTP/9.9\r\n" + HOST + b"\r\n").startswith(b"HTTP/1.1 505 ")


@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("size", [20_000, 108_000])
def test_large_head_is_refused_in_any_number_of_segments(port: int, size: int, parts: int) -> None:
    head = b"GET /who HTTP/1.1\r\n" + HOST + b"X-Large: " + size * b"x" + b"\r\n\r\n"
    cuts = [part * len(head) // parts for part in range(parts + 1)]
    answer = _answer_to(port, *(head[begin:end] for begin, end in itertools.pairwise(cuts)))
    assert answer.startswith(b"HTTP/1.1 431 ")
    assert str(MAX_HEAD_BYTES).encode() in answer


def test_head_within_the_limits_passes(port: int) -> None:
    headers = {"x-large": "x" * (MAX_HEAD_BYTES - 1000)} | {f"x-{number}": "" for number in range(50)}
    assert httpx.get(f"http://127.0.0.1:{port}/who", headers=headers).status_code == 200
    headers = {f"x-{number}": "" for number in range(200)}
    assert httpx.get(f"http://127.0.0.1:{port}/who", headers=headers).status_code == 431


def test_upgrade_to_a_websocket_is_ignored_without_a_line_of_log(port: int, caplog: pytest.LogCaptureFixture) -> None:
    upgrade = b"Connection: Upgrade, close\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    with caplog.at_level(logging.WARNING):
        answer = _answer_to(port, b"GET /who HTTP/1.1\r\n" + HOST + upgrade + b"\r\n")
    assert answer.startswith(b"HTTP/1.1 200 OK")
    assert not caplog.records


class _Admission:
    """Accounts of an app that runs, without its other parts."""

    def __init__(self) -> None:
        self.cpu_accounts = CpuAccounts()


@pytest.fixture
def charged(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, CpuAccounts]]:
    """Port and accounts of an app whose path `/keyed` is of a tenant; every reading of the clock takes a second."""
    app, admission = _app(), _Admission()
    app.state.admission = admission
    clock = itertools.count()
    monkeypatch.setattr(http_protocol, "thread_time", lambda: float(next(clock)))

    @app.post("/keyed")
    async def keyed(request: Request) -> int:
        put_caller(request.scope, Caller("acme", None, "acme"))
        return len(await request.body())

    with served(app, Settings()) as port:
        yield port, admission.cpu_accounts


def test_parsing_is_charged_to_the_client(charged: tuple[int, CpuAccounts]) -> None:
    port, accounts = charged
    with _connected(port) as client:
        head = b"POST /keyed HTTP/1.1\r\n" + HOST + b"Content-Length: 100000\r\n\r\n"
        for piece in (head, bytes(50_000), bytes(50_000)):
            client.sendall(piece)
            time.sleep(0.1)
        assert b"100000" in client.recv(4096)
    # The head came before the key was known.
    assert accounts.total_s("127.0.0.1") == 1.0
    assert accounts.total_s("acme") >= 2.0


@pytest.mark.parametrize("path", ["/body", "/refused"])
def test_parsing_without_a_key_is_charged_to_the_address(charged: tuple[int, CpuAccounts], path: str) -> None:
    port, accounts = charged
    with _connected(port) as flood:
        _send_quietly(flood, _chunked(path, b"x", 2000))
        _read_all(flood)
    # A turn of the loop handles a bounded number of events; a refused body is not parsed.
    assert accounts.total_s("127.0.0.1") >= (1000 // EVENTS_PER_TURN if path == "/body" else 1)
