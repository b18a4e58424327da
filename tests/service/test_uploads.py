"""Slow and endless request bodies."""

from __future__ import annotations

import json
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from tests.service.conftest import FLAT, StartApp, assert_problem

HEAD = (
    "POST /floorplans HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    "Content-Length: 100000\r\nConnection: close\r\n\r\n"
)


@contextmanager
def open_body(client: httpx.Client) -> Iterator[socket.socket]:
    """Open a connection on which a body has been announced."""
    port = client.base_url.port
    assert port is not None
    with socket.create_connection(("127.0.0.1", port), timeout=20.0) as connection:
        connection.sendall(HEAD.encode("ascii"))
        yield connection


def answer_to(connection: socket.socket, send: Callable[[socket.socket], None]) -> str:
    """Return the answer that arrives while `send` is sending."""
    connection.setblocking(False)
    received, begin = b"", time.monotonic()
    while b"}" not in received:
        assert time.monotonic() - begin < 60.0, "no answer"
        try:
            send(connection)
            received += connection.recv(65536)
        except BlockingIOError:
            time.sleep(0.05)
    return received.decode("utf-8")


@pytest.mark.parametrize(
    ("limits", "sent", "reason"),
    [
        ({"upload_idle_s": 0.5}, b"", "stopped for 0.5 s (upload_idle_s)"),
        ({"upload_idle_s": 0.5, "upload_bytes_per_s": 1000.0}, b"[", "behind 1000 bytes/s (upload_bytes_per_s)"),
        ({"upload_deadline_s": 0.3}, b"", "took longer than 0.3 s (upload_deadline_s)"),
    ],
    ids=["stalled", "trickling", "deadline"],
)
def test_slow_body_times_out(
    start_app: StartApp, tmp_path: Path, limits: dict[str, float], sent: bytes, reason: str
) -> None:
    with start_app(tmp_path, **limits) as client, open_body(client) as connection:
        answer = answer_to(connection, lambda connection: connection.sendall(sent))
    assert "408" in answer.splitlines()[0]
    assert reason in answer


def test_slow_body_above_the_minimum_rate_arrives(start_app: StartApp, tmp_path: Path) -> None:
    def trickle() -> Iterator[bytes]:
        for _ in range(10):
            time.sleep(0.1)
            yield b" " * 500

    with start_app(tmp_path, upload_idle_s=0.5, upload_bytes_per_s=1000.0) as client:
        response = client.post("/floorplans", content=trickle(), headers={"content-type": "application/json"})
        assert_problem(response, 422, "invalid-floorplan")


_FORM = b'--BB\r\nContent-Disposition: form-data; name="file"; filename="p"\r\n\r\n%s\r\n--BB--\r\n'


@pytest.mark.parametrize("charset", ["punycode", "undefined", "utf-16", "no-such", ""])
def test_form_in_another_charset_is_refused(client: httpx.Client, charset: str) -> None:
    media = f"multipart/form-data; boundary=BB; charset={charset}"
    response = client.post("/floorplans", content=_FORM % b"{}", headers={"content-type": media})
    problem = assert_problem(response, 415, "unsupported-media")
    assert "send multipart/form-data; charset=utf-8" in problem["detail"]


def test_form_can_state_utf_8(client: httpx.Client) -> None:
    content = _FORM % json.dumps(FLAT).encode()
    headers = {"content-type": 'multipart/form-data; boundary=BB; charset="UTF-8"'}
    assert client.post("/floorplans", content=content, headers=headers).status_code == 201


def test_large_form_needs_no_temporary_folder(
    client: httpx.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "not there"))
    content = json.dumps(FLAT).encode() + b" " * 1_500_000
    headers = {"content-type": "multipart/form-data; boundary=BB"}
    assert client.post("/floorplans", content=_FORM % content, headers=headers).status_code == 201


@pytest.mark.parametrize(
    ("path", "media", "name"),
    [
        ("/floorplans", "application/json", "max_plan_bytes"),
        ("/floorplans", "multipart/form-data; boundary=x", "max_plan_bytes"),
        ("/localise", "multipart/form-data; boundary=x", "max_photograph_bytes"),
    ],
)
def test_body_without_a_length_stops_at_the_limit(
    start_app: StartApp, tmp_path: Path, path: str, media: str, name: str
) -> None:
    def endless() -> Iterator[bytes]:
        begin = b'--x\r\nContent-Disposition: form-data; name="photo"; filename="p"\r\n\r\n'
        yield begin if "multipart" in media else b"["
        for _ in range(100):
            yield b" " * 50_000

    with start_app(tmp_path, **{name: 100_000}) as client:
        response = client.post(path, content=endless(), headers={"content-type": media})
        problem = assert_problem(response, 413, "upload-too-large")
        assert f"the limit is 100000 bytes (LALALOC_{name.upper()})" in problem["detail"]


def test_boundary_that_occurs_in_a_part_is_refused(client: httpx.Client) -> None:
    body = b'--B\r\nContent-Disposition: form-data; name="photo"; filename="f"\r\n\r\n' + 200_000 * b"\r\n--BX"
    headers = {"Content-Type": "multipart/form-data; boundary=B"}
    problem = assert_problem(client.post("/localise", content=body, headers=headers), 400, "malformed-request")
    assert "the boundary occurs more than 40 times" in problem["detail"]
