"""Budget of request bodies in progress, and files that are spooled to disk."""

from __future__ import annotations

import asyncio
import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.requests import Request
from starlette.types import Message

from service.capacity.admission_control import BytesInFlight
from service.errors import BytesInFlightError, UploadTooLargeError
from service.http.uploads import UploadLimits, ending_request, read_body, read_parts
from service.uploaded_file import UploadedFile
from tests.service.conftest import FLAT, StartApp, assert_problem, metric, wait_for
from tests.service.test_uploads import open_body

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
    limits = {"upload_tenant_bytes": 150_000, "upload_total_bytes": 10**6}
    with start_app(tmp_path, **limits) as client:
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
    def endless() -> Iterator[bytes]:
        for _ in range(100):
            yield b" " * 50_000

    with start_app(tmp_path, upload_tenant_bytes=2 * 2**20) as client:
        for path in ("/floorplans", "/venues"):
            response = client.post(path, content=endless(), headers={"content-type": "application/json"})
            assert_problem(response, 503, "overloaded")
        wait_for(lambda: metric(client, IN_FLIGHT) == 0)


def test_bodies_beyond_the_memory_limit_are_on_disk_until_the_request_ends() -> None:
    small, large = b"s" * 1000, b"l" * 300_000
    form = b"".join(
        b'--b\r\nContent-Disposition: form-data; name="%s"; filename="f"\r\n\r\n%s\r\n' % part
        for part in ((b"small", small), (b"large", large))
    )

    async def scenario() -> None:
        scope, receive = _request(form + b"--b--\r\n", "multipart/form-data; boundary=b")
        with ending_request(scope):
            parts = await read_parts(Request(scope, receive), _LIMITS, files={"small", "large"}, fields=set())
            assert [_is_on_disk(parts.files[name]) for name in ("small", "large")] == [False, True]
            assert [parts.files[name].read() for name in ("small", "large")] == [small, large]
            # Workers and other machines get the content.
            assert pickle.loads(pickle.dumps(parts.files["large"])) == large
            scope_of_body, receive_body = _request(large, "application/json")
            body = await read_body(Request(scope | scope_of_body, receive_body), _LIMITS)
            assert _is_on_disk(body)
            assert (len(body), b"".join(body.chunks())) == (len(large), large)
        for file in (parts.files["large"], body):
            with pytest.raises(ValueError, match="closed"):
                file.read()

    asyncio.run(scenario())


def _request(content: bytes, media: str) -> tuple[dict[str, Any], Any]:
    pieces = iter([content[first : first + 65_536] for first in range(0, len(content), 65_536)])

    async def receive() -> Message:
        piece = next(pieces, None)
        return {"type": "http.request", "body": piece or b"", "more_body": piece is not None}

    headers = [(b"content-type", media.encode())]
    return {"type": "http", "method": "POST", "path": "/", "query_string": b"", "headers": headers}, receive


def _is_on_disk(file: UploadedFile) -> bool:
    return file._file._rolled  # pyright: ignore[reportAttributeAccessIssue]


def test_cpu_time_is_in_metrics_and_usage(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path) as client:
        assert client.post("/floorplans", content=json.dumps(FLAT), headers={"content-type": "application/json"})
        name = 'lalaloc_tenant_cpu_seconds_total{tenant="default"} '
        (line,) = [line for line in client.get("/metrics").text.splitlines() if line.startswith(name)]
        assert float(line.removeprefix(name)) > 0.0
        usage = client.get("/usage").json()
        assert usage["cpu_seconds"] > 0.0
        assert usage["bytes_in_flight"] == {"used": 0, "limit": 256 * 2**20}
