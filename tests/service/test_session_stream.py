"""WebSockets of sessions: photographs in order, refusals, limits of messages, and a clean end."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep
from typing import Any
from urllib.parse import quote

import httpx
import psutil
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from service.storage.store import Store
from tests.service.conftest import DatabaseOf, StartApp, upload, wait_for
from tests.service.test_process import children
from tests.service.test_security import bearer, make_key
from tests.service.test_sessions import begin, send
from tests.service.test_stopping import running_service

MIB = 2**20


@pytest.fixture(scope="module")
def plan_id(client: httpx.Client) -> str:
    return upload(client)


def address_of(client: httpx.Client, session_id: str) -> str:
    return f"{client.base_url}".rstrip("/").replace("http", "ws", 1) + f"/sessions/{session_id}/stream"


@contextmanager
def stream(client: httpx.Client, session_id: str, **options: Any) -> Iterator[ClientConnection]:
    """Open the WebSocket of a session; its first message is the session."""
    with connect(address_of(client, session_id), open_timeout=60.0, **options) as connection:
        assert received(connection)["session"]["id"] == session_id
        yield connection


def received(connection: ClientConnection) -> dict[str, Any]:
    return json.loads(connection.recv(60.0))


def put(connection: ClientConnection, picture: bytes, piece_bytes: int = MIB, **fields: Any) -> None:
    connection.send(json.dumps({"bytes": len(picture)} | fields))
    for first in range(0, len(picture), piece_bytes):
        connection.send(picture[first : first + piece_bytes])


def refusal(client: httpx.Client, session_id: str, **options: Any) -> httpx.Response:
    """Return the HTTP answer to a refused handshake."""
    with pytest.raises(InvalidStatus) as caught, stream(client, session_id, **options):
        pass
    answer = caught.value.response
    assert answer.headers["content-type"] == "application/problem+json"
    return httpx.Response(answer.status_code, content=bytes(answer.body or b""))


def closing(connection: ClientConnection) -> tuple[int, str]:
    """Return code and reason with which the service closes a connection."""
    with pytest.raises(ConnectionClosed) as caught:
        connection.recv(60.0)
    assert caught.value.rcvd is not None
    return caught.value.rcvd.code, caught.value.rcvd.reason


def test_answers_are_those_of_the_http_route(client: httpx.Client, plan_id: str, panorama: bytes) -> None:
    session_id = begin(client, plan_id, camera_height_m=1.5)
    with stream(client, session_id) as connection:
        put(connection, panorama, number=1)
        first = received(connection)
        assert (first["status"], first["session"]["photographs"]) == (200, 1)
        covariance = [[0.01, 0, 0], [0, 0.01, 0], [0, 0, 4]]
        put(connection, panorama, 999, number=2, forward_m=0, turn_deg=0, covariance=covariance, hfov_deg=None)
        second = received(connection)
        assert second["session"] == client.get(f"/sessions/{session_id}").json()
        # HTTP and WebSocket share the session.
        third = send(client, session_id, panorama, number=3, forward_m=0, turn_deg=0).json()
        put(connection, panorama, number=4)
        fourth = received(connection)["session"]
        assert (third["photographs"], fourth["photographs"]) == (3, 4)
        assert [point["number"] for point in fourth["path"]] == [1, 2, 3, 4]


def test_refused_photographs_leave_the_connection_open(client: httpx.Client, plan_id: str, panorama: bytes) -> None:
    session_id = begin(client, plan_id)
    with stream(client, session_id) as connection:
        refused: list[tuple[dict[str, Any], int, str]] = [
            ({"number": 2}, 409, "photograph-out-of-order"),
            ({"forward_m": 1000, "turn_deg": 0}, 422, "invalid-motion"),
            ({"colour": "red"}, 422, "invalid-request"),
            ({"number": "first"}, 422, "invalid-request"),
        ]
        for fields, status, slug in refused:
            put(connection, panorama, **fields)
            answer = received(connection)
            assert (answer["status"], answer["problem"]["type"]) == (status, f"urn:lalaloc:problem:{slug}")
            assert "session" not in answer
        put(connection, b"no picture")
        assert received(connection)["problem"]["type"] == "urn:lalaloc:problem:invalid-panorama"
        put(connection, panorama, number=1)
        assert received(connection)["session"]["photographs"] == 1


def test_photograph_over_the_limit_is_refused_before_it_is_read(
    start_app: StartApp, tmp_path: Path, panorama: bytes
) -> None:
    with start_app(tmp_path, max_photograph_bytes=64 * 1024) as client:
        session_id = begin(client, upload(client))
        with stream(client, session_id) as connection:
            for kib in (65, 200):
                put(connection, bytes(kib * 1024))
                assert received(connection)["problem"]["type"] == "urn:lalaloc:problem:upload-too-large"
            # More than it would read only to drop it.
            assert closing(connection) == (1009, "the photograph is too large to skip it")
        with stream(client, session_id) as connection:
            put(connection, panorama, number=1)
            assert received(connection)["status"] == 200


@pytest.mark.parametrize(
    ("messages", "reason"),
    [
        ([b"photograph"], "bytes came without a text message that states their number"),
        (["photograph"], "a text message is not JSON; send an object with bytes and fields"),
        (["[" * 10_000], "a text message is not JSON"),
        (["[1]"], "bytes is None; send the size of the photograph's file"),
        (['{"bytes": -1}'], "bytes is -1; send the size"),
        (['{"bytes": true}'], "bytes is True; send the size"),
        (['{"bytes": 5, "a b": 1}'], "'a b' is no name of a field"),
        (['{"bytes": 5, "number": "' + "1" * 20_000 + '"}'], "characters; the limit is 16384"),
        (['{"bytes": 5}', b"123456"], "the photograph has 1 bytes more than stated"),
        (['{"bytes": 5}', '{"bytes": 5}'], "a text message came before the last 5 bytes of a photograph"),
    ],
)
def test_other_messages_close_the_connection(
    client: httpx.Client, plan_id: str, messages: list[str | bytes], reason: str
) -> None:
    session_id = begin(client, plan_id)
    with stream(client, session_id) as connection:
        for message in messages:
            connection.send(message)
        code, stated = closing(connection)
        assert code == 1003
        assert reason in stated
    # The photograph did not count.
    assert client.get(f"/sessions/{session_id}").json()["photographs"] == 0


def test_client_that_leaves_within_a_photograph_moves_nothing(
    client: httpx.Client, plan_id: str, panorama: bytes
) -> None:
    session_id = begin(client, plan_id)
    with stream(client, session_id) as connection:
        connection.send(json.dumps({"bytes": len(panorama), "number": 1}))
        connection.send(panorama[:100])
    wait_for(lambda: "lalaloc_streams 0.0" in client.get("/metrics").text)
    assert send(client, session_id, panorama, number=1).status_code == 200


def test_handshakes_are_refused_like_requests(start_app: StartApp, database_of: DatabaseOf, tmp_path: Path) -> None:
    with start_app(tmp_path) as client:
        unknown = refusal(client, "0" * 32)
        assert (unknown.status_code, unknown.json()["type"]) == (404, "urn:lalaloc:problem:unknown-session")
        session_id = begin(client, upload(client))
        foreign = refusal(client, session_id, origin="https://evil.example")
        assert (foreign.status_code, foreign.json()["type"]) == (403, "urn:lalaloc:problem:exposed-without-keys")
        with stream(client, session_id, origin=f"http://127.0.0.1:{client.base_url.port}"):
            pass
    store = Store(database_of(tmp_path))
    results = [entry.result for entry in store.audit_log.export()]
    store.close()
    assert "exposed-without-keys" in results


def test_connections_are_limited(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, max_streams=1) as client:
        session_id = begin(client, upload(client))
        with stream(client, session_id):
            full = refusal(client, session_id)
            assert (full.status_code, full.json()["type"]) == (503, "urn:lalaloc:problem:overloaded")
        wait_for(lambda: "lalaloc_streams 0.0" in client.get("/metrics").text)
        with stream(client, session_id):
            pass


@pytest.mark.slow
def test_idle_connection_is_closed(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, session_ttl_s=10.0) as client:
        session_id = begin(client, upload(client))
        with stream(client, session_id) as connection:
            assert closing(connection) == (1000, "no photograph for 10 s (session_ttl_s)")


def test_key_is_checked_for_every_photograph(
    start_app: StartApp, database_of: DatabaseOf, tmp_path: Path, panorama: bytes
) -> None:
    with start_app(tmp_path, api_keys=True, key_cache_s=0.1) as client:
        store = Store(database_of(tmp_path))
        key, foreign = make_key(store), make_key(store, tenant="theirs")
        client.headers.update(bearer(key))
        session_id = begin(client, upload(client))
        missing = refusal(client, session_id)
        assert (missing.status_code, missing.json()["type"]) == (401, "urn:lalaloc:problem:unauthenticated")
        assert refusal(client, session_id, additional_headers=bearer(foreign)).status_code == 404
        with stream(client, session_id, additional_headers=bearer(key)) as connection:
            put(connection, panorama)
            assert received(connection)["status"] == 200
            store.keys.revoke(key.split("_")[1])
            sleep(0.2)
            put(connection, panorama)
            answer = received(connection)
            assert (answer["status"], answer["problem"]["type"]) == (401, "urn:lalaloc:problem:unauthenticated")
        store.close()


def assert_too_large(error: ConnectionClosed) -> None:
    # A client that still sends can lose the last message to the reset of the connection.
    assert error.rcvd is None or error.rcvd.code == 1009


class TestProcess:
    """`python -m service`, whose server bounds connections and messages."""

    @pytest.mark.slow
    def test_fast_client_is_slowed_down(self, tiny_bundle: Path, tmp_path: Path, panorama: bytes) -> None:
        limits = {"DECODE_STALL_S": "300", "REQUEST_DEADLINE_S": "300", "DECODE_WORKERS": "1"}
        with running_service(tiny_bundle, tmp_path / "data", **limits) as service:
            session_id = begin(service.client, upload(service.client))
            with stream(service.client, session_id) as connection:
                put(connection, panorama)
                assert received(connection)["status"] == 200
                decoders, process = children(service.process.pid), psutil.Process(service.process.pid)
                assert decoders
                for decoder in decoders:
                    # As a photograph that takes long.
                    os.kill(decoder, signal.SIGSTOP)
                put(connection, panorama)
                before, sent = process.memory_info().rss, 0
                large = bytes(8 * MIB)

                def flood() -> None:
                    nonlocal sent
                    for _ in range(32):
                        connection.send(json.dumps({"bytes": len(large)}))
                        for first in range(0, len(large), MIB):
                            connection.send(large[first : first + MIB])
                            sent += 1

                sender = threading.Thread(target=flood, daemon=True)
                sender.start()
                seen, since = -1, monotonic()
                while monotonic() - since < 3.0:
                    if sent != seen:
                        seen, since = sent, monotonic()
                    sleep(0.1)
                # Less than what the buffers of the system and one message hold, of 256 in total.
                assert sent < 64
                assert process.memory_info().rss - before < 32 * MIB
                for decoder in decoders:
                    os.kill(decoder, signal.SIGCONT)
                assert received(connection)["session"]["photographs"] == 2
                for _ in range(32):
                    assert received(connection)["problem"]["type"] == "urn:lalaloc:problem:invalid-panorama"
                sender.join(60.0)
                put(connection, panorama)
                assert received(connection)["session"]["photographs"] == 3

    @pytest.mark.slow
    def test_messages_and_fragments_are_bounded(self, tiny_bundle: Path, tmp_path: Path) -> None:
        with running_service(tiny_bundle, tmp_path / "data") as service:
            session_id = begin(service.client, upload(service.client))
            with stream(service.client, session_id) as connection:
                connection.send(bytes(MIB + 1))
                with pytest.raises(ConnectionClosed) as caught:
                    connection.recv(60.0)
                assert_too_large(caught.value)
            with stream(service.client, session_id) as connection:
                with pytest.raises(ConnectionClosed) as caught:
                    connection.send(b"" for _ in range(100_000))
                assert_too_large(caught.value)

    @pytest.mark.slow
    def test_stop_answers_the_photograph_in_work(self, tiny_bundle: Path, tmp_path: Path, panorama: bytes) -> None:
        limits = {"DECODE_STALL_S": "100", "REQUEST_DEADLINE_S": "100", "STOP_DEADLINE_S": "100", "DECODE_WORKERS": "1"}
        with running_service(tiny_bundle, tmp_path / "data", **limits) as service:
            plan_id = upload(service.client)
            busy, idle = (begin(service.client, plan_id) for _ in range(2))
            with stream(service.client, busy) as working, stream(service.client, idle) as waiting:
                put(working, panorama)
                assert received(working)["status"] == 200
                decoders = children(service.process.pid)
                for decoder in decoders:
                    os.kill(decoder, signal.SIGSTOP)
                put(working, panorama)
                wait_for(lambda: "lalaloc_queries_in_work 1.0" in service.client.get("/metrics").text)
                service.process.send_signal(signal.SIGTERM)
                assert closing(waiting)[0] == 1012
                for decoder in decoders:
                    os.kill(decoder, signal.SIGCONT)
                assert received(working)["session"]["photographs"] == 2
                assert closing(working)[0] == 1012
            assert service.process.wait(60.0) == 0

    @pytest.mark.slow
    def test_connection_outlives_the_limits_of_idle_http(
        self, tiny_bundle: Path, tmp_path: Path, panorama: bytes
    ) -> None:
        with running_service(tiny_bundle, tmp_path / "data", KEEP_ALIVE_S="1") as service:
            session_id = begin(service.client, upload(service.client))
            with stream(service.client, session_id) as connection:
                # Beyond the limit for a request's head; no answer can show that nothing happens.
                sleep(15.0)
                put(connection, panorama)
                assert received(connection)["status"] == 200

    @pytest.mark.slow
    def test_other_paths_have_no_websocket(self, tiny_bundle: Path, tmp_path: Path) -> None:
        with running_service(tiny_bundle, tmp_path / "data") as service:
            for path in ("/localise", "/floorplans", "/"):
                with pytest.raises(InvalidStatus) as caught, connect(f"ws://127.0.0.1:{service.port}{path}"):
                    pass
                assert caught.value.response.status_code == 403
            with socket.create_connection(("127.0.0.1", service.port), timeout=20.0) as plain:
                plain.sendall(f"GET /sessions/{'0' * 32}/stream HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
                assert plain.recv(4096).startswith(b"HTTP/1.1 404 ")


@pytest.mark.parametrize("session_id", ["\u00e9", "%C3%A9", "%00", "a b", "%F0%9F%98%80"])
def test_session_of_any_name_is_unknown(client: httpx.Client, session_id: str) -> None:
    problem = refusal(client, quote(session_id, safe="%")).json()
    assert (problem["status"], problem["type"]) == (404, "urn:lalaloc:problem:unknown-session")


@pytest.mark.parametrize("size", ["9" * 4300, "9" * 5000, "-1", "1e3", "1e999", "true", str(2**60)])
def test_size_that_is_none_ends_the_connection(client: httpx.Client, plan_id: str, size: str) -> None:
    with stream(client, begin(client, plan_id)) as connection:
        connection.send(f'{{"bytes": {size}}}')
        code, reason = closing(connection)
    assert code == 1003
    assert "send" in reason
