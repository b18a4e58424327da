"""Two replicas on one PostgreSQL behind the nginx of docker/."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from lalaloc_core.bundle import default_bundle
from tests.local_servers import free_port
from tests.service import test_albums as albums
from tests.service.conftest import StartApp, assert_problem, connection_to, localise, upload, wait_for
from tests.service.postgres import PostgresServer
from tests.service.test_process import is_up

CONFIGURATION = Path(__file__).parents[2] / "docker" / "nginx.conf"


@contextmanager
def nginx(
    folder: Path, replicas: list[httpx.Client], *, read_timeout: str = "30s", status: int = 200
) -> Iterator[httpx.Client]:
    """Run nginx as configured, but for names, ports, and how long it waits; ready when health is told with a status."""
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
    if program is None:
        pytest.skip("nginx is not installed; on Debian and Ubuntu the package is nginx-light")
    port = free_port()
    text = CONFIGURATION.read_text(encoding="utf-8")
    for number, replica in enumerate(replicas, start=1):
        assert text.count(f"replica-{number}:8000") == 1
        text = text.replace(f"replica-{number}:8000", urlsplit(str(replica.base_url)).netloc)
    assert "proxy_read_timeout 30s;" in text
    text = text.replace("proxy_read_timeout 30s;", f"proxy_read_timeout {read_timeout};")
    text = text.replace("listen 8080;", f"listen 127.0.0.1:{port};").replace("/tmp/", f"{folder}/")
    path = folder / "nginx.conf"
    path.write_text(text, encoding="utf-8")
    # As root, nginx would switch to another user, who cannot write to this folder.
    options = "daemon off; user root;" if os.geteuid() == 0 else "daemon off;"
    process = subprocess.Popen([program, "-c", str(path), "-g", options])
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30.0) as client:
            wait_for(lambda: is_up(client, status))
            yield client
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(10.0)


def test_two_replicas_act_as_one_service(
    start_app: StartApp, postgres: PostgresServer, sphere: bytes, tmp_path: Path
) -> None:
    url = postgres.new_database()
    with ExitStack() as second, start_app(tmp_path / "a", database_url=url) as a:
        b = second.enter_context(start_app(tmp_path / "b", database_url=url))
        with nginx(tmp_path, [a, b]) as proxy:
            plan_id = upload(proxy)
            # Either replica alone knows what came through the proxy.
            for replica in (a, b):
                assert replica.get(f"/floorplans/{plan_id}").json()["status"] == "ready"
                assert localise(replica, plan_id, sphere, heading_deg=0).status_code == 200
            answers = [localise(proxy, plan_id, sphere, heading_deg=0) for _ in range(4)]
            assert {answer.status_code for answer in answers} == {200}
            assert len({answer.json()["position"]["x_m"] for answer in answers}) == 1
            named = proxy.get(f"/floorplans/{plan_id}", headers={"X-Request-ID": "mine-1"})
            assert named.headers["x-request-id"] == "mine-1"
            assert proxy.get("/metrics").status_code == 404
            # One replica goes: what it would have answered, the other one does.
            second.close()
            answers = [localise(proxy, plan_id, sphere, heading_deg=0) for _ in range(4)]
            assert {answer.status_code for answer in answers} == {200}
            assert proxy.delete(f"/floorplans/{plan_id}").status_code == 204
            assert localise(a, plan_id, sphere, heading_deg=0).status_code == 404


@pytest.mark.slow
def test_replicas_answer_the_same_album(start_app: StartApp, postgres: PostgresServer, tmp_path: Path) -> None:
    shared: dict[str, Any] = {"bundle": default_bundle(), "request_deadline_s": 90.0, "sweep_s": 0.2}
    shared["database_url"] = postgres.new_database()
    pictures = [(albums.EXAMPLES / name).read_bytes() for name in albums.NAMES[:3]]
    with ExitStack() as second, start_app(tmp_path / "a", **shared) as a:
        b = second.enter_context(start_app(tmp_path / "b", **shared))
        album_id = albums.create(a, upload(a, albums.HOME))
        # Both replicas at once: each picture is stored once.
        with ThreadPoolExecutor(2) as senders:
            lines = list(senders.map(lambda replica: albums.add(replica, album_id, pictures), (a, b)))
        assert [sorted(pair) for pair in zip(*([row["status"] for row in part] for part in lines), strict=True)] == [
            [200, 201]
        ] * 3
        for replica in (a, b):
            albums.wait_until_solved(replica, album_id)
        assert a.get(f"/albums/{album_id}").json() == b.get(f"/albums/{album_id}").json()
        for media in ("application/json", "text/csv", "image/svg+xml"):
            texts = {client.get(f"/albums/{album_id}/photographs", headers={"Accept": media}).text for client in (a, b)}
            assert len(texts) == 1, media
        row = albums.photographs(b, album_id)[0]
        assert albums.correct(b, album_id, row["id"], {"elsewhere": True}).status_code == 200
        second.close()
        # One replica goes: the other one answers, and solves what is due.
        albums.wait_until_solved(a, album_id)
        assert albums.photographs(a, album_id)[0]["pin"]["place"] is None


def test_refusals_do_not_disable_a_replica(start_app: StartApp, postgres: PostgresServer, tmp_path: Path) -> None:
    shared: dict[str, Any] = {"database_url": postgres.new_database(), "max_reads": 1}
    with start_app(tmp_path / "a", **shared) as a, start_app(tmp_path / "b", **shared) as b, ExitStack() as readers:
        waiting = readers.enter_context(ThreadPoolExecutor(2))
        readers.enter_context(postgres.locked(shared["database_url"], "floorplans"))
        for replica in (a, b):
            waiting.submit(replica.get, "/floorplans")
        for replica in (a, b):
            wait_for(lambda replica=replica: "lalaloc_reads_in_flight 1.0" in replica.get("/metrics").text)
        with nginx(tmp_path, [a, b]) as proxy:
            for _ in range(8):
                assert_problem(proxy.get("/floorplans"), 503, "overloaded")
                assert proxy.get("/healthz").status_code == 200


def test_proxy_accepts_the_largest_uploads(start_app: StartApp, postgres: PostgresServer, tmp_path: Path) -> None:
    url = postgres.new_database()
    with start_app(tmp_path / "a", database_url=url) as a, nginx(tmp_path, [a, a]) as proxy:
        limit = a.get("/limits").json()["max_photograph_bytes"]
        # The service's own refusal, a problem document, and not the proxy's page.
        answer = proxy.post("/localise", files={"photo": ("p.jpg", bytes(limit - 1))})
        assert answer.status_code == 422, answer.text
        assert answer.headers["content-type"] == "application/problem+json"


def _assert_refused(head: bytes, body: bytes, status: int, slug: str) -> None:
    """Check that an answer of nginx's own is a complete problem document."""
    lines = head.decode("ascii").split("\r\n")
    headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines[1:])}
    problem = json.loads(body)
    assert int(lines[0].split()[1]) == problem["status"] == status
    assert headers["content-type"] == "application/problem+json"
    assert problem["type"] == f"urn:lalaloc:problem:{slug}"
    assert problem["title"]
    assert problem["detail"]
    assert problem["request_id"] == headers["x-request-id"]
    assert ("retry-after" in headers) == (status in (502, 503, 504))


def _answer_to(proxy: httpx.Client, request: bytes) -> tuple[bytes, bytes]:
    with connection_to(proxy) as connection:
        connection.sendall(request)
        received = b""
        while not received.rstrip().endswith((b"}", b"</html>")):
            received += (more := connection.recv(65536))
            assert more, received
    head, _, body = received.partition(b"\r\n\r\n")
    return head, body


OF_THE_PROXY = {
    "no request": (b"NONSENSE\r\n\r\n", 400, "malformed-request"),
    "no host": (b"GET /floorplans HTTP/1.1\r\n\r\n", 400, "malformed-request"),
    "a long head": (b"GET / HTTP/1.1\r\nHost: x\r\nA: " + b"a" * 40_000 + b"\r\n\r\n", 400, "malformed-request"),
    "a long address": (b"GET /" + b"a" * 40_000 + b" HTTP/1.1\r\nHost: x\r\n\r\n", 414, "malformed-request"),
    "a large body": (
        b"POST /localise HTTP/1.1\r\nHost: x\r\nContent-Length: 199999999\r\n\r\n",
        413,
        "upload-too-large",
    ),
    "metrics": (b'GET /metrics HTTP/1.1\r\nHost: x\r\nX-Request-ID: a"b\r\n\r\n', 404, "not-found"),
    "its own page": (b"GET /.problem HTTP/1.1\r\nHost: x\r\n\r\n", 404, "not-found"),
    "no replica": (b"GET /floorplans HTTP/1.1\r\nHost: x\r\n\r\n", 502, "no-replica"),
}


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Yield the proxy without any replica that answers."""
    with ExitStack() as stack:
        nobody = [stack.enter_context(httpx.Client(base_url=f"http://127.0.0.1:{port}")) for port in (9, 19)]
        yield stack.enter_context(nginx(tmp_path_factory.mktemp("nginx"), nobody, status=502))


@pytest.mark.parametrize(("request_", "status", "slug"), OF_THE_PROXY.values(), ids=OF_THE_PROXY.keys())
def test_proxy_errors_are_problem_documents(alone: httpx.Client, request_: bytes, status: int, slug: str) -> None:
    _assert_refused(*_answer_to(alone, request_), status, slug)


def test_silent_replica_becomes_a_problem_document(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent, ExitStack() as stack:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        replicas = [stack.enter_context(httpx.Client(base_url=url)) for _ in range(2)]
        proxy = stack.enter_context(nginx(tmp_path, replicas, read_timeout="200ms", status=504))
        _assert_refused(*_answer_to(proxy, b"GET /floorplans HTTP/1.1\r\nHost: x\r\n\r\n"), 504, "deadline-exceeded")
