"""Slow and endless request bodies, the budget of those in progress, and files that are spooled to disk."""

from __future__ import annotations

import asyncio
import json
import pickle
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.requests import Request
from starlette.types import Message

from service.capacity.admission_control import BytesInFlight
from service.errors import BytesInFlightError, UploadTooLargeError
from service.http.uploads import UploadLimits, ending_request, read_body, read_parts
from service.uploaded_file import UploadedFile
from tests.service.conftest import FLAT, StartApp, assert_problem, connection_to, metric, wait_for

HEAD = (
    "POST /floorplans HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    "Content-Length: 100000\r\nConnection: close\r\n\r\n"
)


@contextmanager
def open_body(client: httpx.Client) -> Iterator[socket.socket]:
    """Open a connection on which a body has been announced."""
    with connection_to(client) as connection:
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


def test_large_form_needs_no_temporary_folder_and_can_state_utf_8(
    client: httpx.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "not there"))
    content = json.dumps(FLAT).encode() + b" " * 1_500_000
    headers = {"content-type": "multipart/form-data; boundary=BB"}
    assert client.post("/floorplans", content=_FORM % content, headers=headers).status_code == 201
    # A form can state its charset.
    content = _FORM % json.dumps(FLAT).encode()
    headers = {"content-type": 'multipart/form-data; boundary=BB; charset="UTF-8"'}
    assert client.post("/floorplans", content=content, headers=headers).status_code == 201


@pytest.mark.parametrize(
    ("path", "media", "name", "remedy"),
    [
        ("/floorplans", "application/json", "max_plan_bytes", "divide"),
        ("/floorplans", "multipart/form-data; boundary=x", "max_plan_bytes", "divide"),
        ("/localise", "multipart/form-data; boundary=x", "max_photograph_bytes", "send"),
    ],
)
def test_body_without_a_length_stops_at_the_limit(
    start_app: StartApp, tmp_path: Path, path: str, media: str, name: str, remedy: str
) -> None:
    def endless() -> Iterator[bytes]:
        begin = b'--x\r\nContent-Disposition: form-data; name="photo"; filename="p"\r\n\r\n'
        yield begin if "multipart" in media else b"["
        for _ in range(100):
            yield b" " * 50_000

    with start_app(tmp_path, **{name: 100_000}) as client:
        response = client.post(path, content=endless(), headers={"content-type": media})
        problem = assert_problem(response, 413, "upload-too-large")
        assert f"100000 bytes (LALALOC_{name.upper()}): {remedy} " in problem["detail"]


def test_boundary_that_occurs_in_a_part_is_refused(client: httpx.Client) -> None:
    body = b'--B\r\nContent-Disposition: form-data; name="photo"; filename="f"\r\n\r\n' + 200_000 * b"\r\n--BX"
    headers = {"Content-Type": "multipart/form-data; boundary=B"}
    problem = assert_problem(client.post("/localise", content=body, headers=headers), 400, "malformed-request")
    assert "the boundary occurs more than 40 times" in problem["detail"]


# Budget and spooled files


_LIMITS = UploadLimits(
    max_bytes=10**7, name="max_plan_bytes", deadline_s=60.0, idle_s=60.0, bytes_per_s=1.0, memory_bytes=100_000
)
_CLIENTS = st.sampled_from("abc")
IN_FLIGHT = 'lalaloc_tenant_bytes_in_flight{tenant="default"}'


@given(st.lists(st.tuples(_CLIENTS, st.integers(0, 60), st.booleans()), max_size=60))
def test_budget_is_never_exceeded(steps: list[tuple[str, int, bool]]) -> None:
    budget, held = BytesInFlight(100, lambda _client: 50), dict.fromkeys("abc", 0)
    for client, count, takes in steps:
        if takes:
            try:
                budget.take(client, count)
                held[client] += count
            except UploadTooLargeError:
                assert count > 50
            except BytesInFlightError:
                assert held[client] + sum(held.values()) > 0
        else:
            budget.give_back(client, held[client])
            held[client] = 0
        assert all(budget.held_by(name) == held[name] <= 50 for name in held)
        assert budget.in_use == sum(held.values()) <= 100


def test_one_client_leaves_room_for_others() -> None:
    budget = BytesInFlight(400, {"a": 1000, "b": 100}.__getitem__)
    for _ in range(30):
        budget.take("a", 10)
    with pytest.raises(BytesInFlightError, match=r"all uploads in progress have 300 of 400 .*TOTAL_BYTES"):
        budget.take("a", 10)
    budget.take("b", 100)
    with pytest.raises(BytesInFlightError, match=r"your uploads in progress have 100 of 100 .*TENANT_BYTES"):
        budget.take("b", 1)
    with pytest.raises(UploadTooLargeError, match=r"101 bytes; the limit is 100 bytes .*TENANT_BYTES"):
        budget.take("b", 101)


def test_announced_body_takes_its_length_before_it_is_read(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, upload_tenant_bytes=150_000, upload_total_bytes=10**6) as client:
        with open_body(client):
            wait_for(lambda: metric(client, IN_FLIGHT) == 100_000)
            response = client.post("/floorplans", json=FLAT | {"name": "n" * 60_000})
            problem = assert_problem(response, 503, "overloaded")
            assert "have 100000 of 150000 bytes (LALALOC_UPLOAD_TENANT_BYTES)" in problem["detail"]
            assert response.headers["Retry-After"] == "2"
            # A body that fits is stored.
            assert client.post("/floorplans", json=FLAT).status_code == 201
        wait_for(lambda: metric(client, IN_FLIGHT) == 0)


def test_body_without_a_length_takes_steps(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, upload_tenant_bytes=2 * 2**20) as client:
        for path in ("/floorplans", "/venues"):
            blanks = (b" " * 50_000 for _ in range(100))
            response = client.post(path, content=blanks, headers={"content-type": "application/json"})
            assert_problem(response, 503, "overloaded")
        wait_for(lambda: metric(client, IN_FLIGHT) == 0)


def test_bodies_beyond_the_memory_limit_are_on_disk_until_the_request_ends() -> None:
    small, large = b"s" * 1000, b"l" * 300_000
    form = b"".join(
        b'--b\r\nContent-Disposition: form-data; name="%s"; filename="f"\r\n\r\n%s\r\n' % part
        for part in ((b"small", small), (b"large", large))
    )

    async def scenario() -> None:
        scope, receive = request_of(form + b"--b--\r\n", "multipart/form-data; boundary=b")
        with ending_request(scope):
            parts = await read_parts(Request(scope, receive), _LIMITS, files={"small", "large"}, fields=set())
            assert [_is_on_disk(parts.files[name]) for name in ("small", "large")] == [False, True]
            assert [parts.files[name].read() for name in ("small", "large")] == [small, large]
            # Workers and other machines get the content.
            assert pickle.loads(pickle.dumps(parts.files["large"])) == large
            scope_of_body, receive_body = request_of(large, "application/json")
            body = await read_body(Request(scope | scope_of_body, receive_body), _LIMITS)
            assert _is_on_disk(body)
            assert (len(body), b"".join(body.chunks())) == (len(large), large)
        for file in (parts.files["large"], body):
            with pytest.raises(ValueError, match="closed"):
                file.read()

    asyncio.run(scenario())


def request_of(content: bytes, media: str, chunk: int = 65_536) -> tuple[dict[str, Any], Any]:
    """Return the scope of a request, and the function that receives its body in pieces."""
    pieces = iter([content[first : first + chunk] for first in range(0, len(content), chunk)])

    async def receive() -> Message:
        piece = next(pieces, None)
        return {"type": "http.request", "body": piece or b"", "more_body": piece is not None}

    headers = [(b"content-type", media.encode())]
    return {"type": "http", "method": "POST", "path": "/", "query_string": b"", "headers": headers}, receive


def _is_on_disk(file: UploadedFile) -> bool:
    return file._file._rolled  # pyright: ignore[reportAttributeAccessIssue]


def test_cpu_time_is_in_metrics_and_usage(client: httpx.Client) -> None:
    assert client.post("/floorplans", json=FLAT).status_code == 201
    assert metric(client, 'lalaloc_tenant_cpu_seconds_total{tenant="default"}') > 0.0
    usage = client.get("/usage").json()
    assert usage["cpu_seconds"] > 0.0
    assert usage["bytes_in_flight"] == {"used": 0, "limit": 256 * 2**20}
