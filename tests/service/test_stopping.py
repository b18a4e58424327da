"""Stopping `python -m service`, also with slow clients: real processes, signals and sockets."""

from __future__ import annotations

import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep

import httpx
import pytest
from ezdxf.filemanagement import new as new_dxf

from tests.importers.conftest import dxf_file
from tests.service.conftest import FLAT, HALL, assert_problem, tiled_plan, upload, wait_for
from tests.service.test_process import ROOT, alive, children, environment_of


@dataclass(frozen=True)
class RunningService:
    """Process of a service, and a client of it."""

    process: subprocess.Popen[bytes]
    client: httpx.Client
    port: int

    def connect(self, sent: bytes) -> socket.socket:
        """Return a connection on which some bytes were sent already."""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=20.0)
        connection.sendall(sent)
        return connection


@contextmanager
def running_service(bundle: Path, data_dir: Path, **settings: str) -> Iterator[RunningService]:
    """Run `python -m service` with these settings; it is killed at the end."""
    environment = environment_of(bundle, data_dir, **{"WORKERS": "0"} | settings)
    command = [sys.executable, "-m", "service", "--port", "0"]
    with (data_dir.parent / "log").open("ab") as log:
        process = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=log)
    try:
        assert process.stdout is not None
        address = process.stdout.readline().decode().strip()
        with httpx.Client(base_url=address, timeout=60.0) as client:
            wait_for(lambda: client.get("/readyz").status_code == 200)
            yield RunningService(process, client, int(address.rpartition(":")[2]))
    finally:
        process.kill()
        process.wait(60.0)


def _upload_head(body: bytes, path: str = "/floorplans") -> bytes:
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    return f"{head}Content-Length: {len(body)}\r\n\r\n".encode()


def _in_flight(client: httpx.Client) -> bool:
    return "lalaloc_requests_in_flight 1.0" in client.get("/metrics").text


@pytest.mark.slow
def test_stop_finishes_requests_in_work(tiny_bundle: Path, tmp_path: Path) -> None:
    body = json.dumps(FLAT).encode()
    with running_service(tiny_bundle, tmp_path / "data") as service:
        workers = children(service.process.pid)
        assert workers
        with service.connect(_upload_head(body) + body[:10]) as upload:
            wait_for(lambda: _in_flight(service.client))
            service.process.send_signal(signal.SIGTERM)
            wait_for(lambda: service.client.get("/readyz").status_code == 503)
            refused = service.client.post("/floorplans", json=FLAT)
            assert_problem(refused, 503, "stopping")
            assert int(refused.headers["retry-after"]) >= 1
            assert_problem(service.client.get("/floorplans"), 503, "stopping")
            assert service.client.get("/healthz").status_code == 200
            upload.sendall(body[10:])
            assert upload.recv(4096).startswith(b"HTTP/1.1 201 ")
        assert service.process.wait(60.0) == 0
        assert not any(alive(worker) for worker in workers)


@pytest.mark.slow
@pytest.mark.parametrize("end", [os.close, lambda terminal: os.write(terminal, b"\x03")], ids=["closed", "Ctrl-C"])
def test_make_serve_ends_with_its_terminal(tiny_bundle: Path, tmp_path: Path, end: Callable[[int], object]) -> None:
    terminal, own_end = os.openpty()
    given = [f"BIN={Path(sys.executable).parent}", "PORT=0", "--old-file=.venv/.serving"]
    environment = environment_of(tiny_bundle, tmp_path / "data")
    command = ["setsid", "--ctty", "make", "serve", *given]
    process = subprocess.Popen(command, env=environment, cwd=ROOT, stdin=own_end, stdout=own_end, stderr=own_end)
    os.close(own_end)
    try:
        address = os.read(terminal, 100).decode().strip()
        wait_for(lambda: httpx.get(f"{address}/readyz", timeout=60.0).status_code == 200, 120.0)
        session = subprocess.run(["ps", "-o", "pid=", "-s", str(process.pid)], stdout=subprocess.PIPE, check=True)
        pids = [int(pid) for pid in session.stdout.split()]
        # Make, the service and its workers.
        assert len(pids) > 2
        end(terminal)
        wait_for(lambda: process.poll() is not None and not any(map(alive, pids)))
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.slow
def test_stop_ends_running_imports(tiny_bundle: Path, tmp_path: Path) -> None:
    document = new_dxf()
    document.modelspace().add_lwpolyline([(0, 0), (4, 0), (4, 3), (0, 3)], close=True, dxfattribs={"layer": "ROOM"})
    content = dxf_file(document)
    # Requests in progress could take a minute of this.
    with running_service(tiny_bundle, tmp_path / "data", STOP_DEADLINE_S="100") as service:
        others = children(service.process.pid)
        headers = {"Content-Type": "image/vnd.dxf"}
        assert service.client.post("/floorplans", content=content, headers=headers).status_code == 201
        importers = [worker for worker in children(service.process.pid) if worker not in others]
        assert importers
        for importer in importers:
            # As a library that does not return.
            os.kill(importer, signal.SIGSTOP)
        with ThreadPoolExecutor(1) as threads:
            running = threads.submit(service.client.post, "/floorplans", content=content, headers=headers)
            wait_for(lambda: _in_flight(service.client))
            service.process.send_signal(signal.SIGTERM)
            assert_problem(running.result(30.0), 503, "stopping")
        assert service.process.wait(30.0) == 0
        assert not any(alive(importer) for importer in importers)


@pytest.mark.slow
def test_readiness_ends_before_the_service_stops(tiny_bundle: Path, tmp_path: Path) -> None:
    with running_service(tiny_bundle, tmp_path / "data", STOP_NOTICE_S="5") as service:
        begin = monotonic()
        service.process.send_signal(signal.SIGTERM)
        wait_for(lambda: service.client.get("/readyz").status_code == 503)
        # Requests are still answered during the notice.
        assert service.client.post("/floorplans", json=FLAT).status_code == 201
        assert service.process.wait(60.0) == 0
        assert monotonic() - begin > 5.0


@pytest.mark.slow
def test_stop_respects_its_deadline(tiny_bundle: Path, tmp_path: Path) -> None:
    with running_service(tiny_bundle, tmp_path / "data", STOP_DEADLINE_S="3") as service:
        workers = children(service.process.pid)
        with service.connect(_upload_head(b"x" * 100)) as upload:
            wait_for(lambda: _in_flight(service.client))
            service.process.send_signal(signal.SIGTERM)
            upload.settimeout(30.0)
            assert upload.recv(4096).startswith(b"HTTP/1.1 503 ")
            # An upload may take a minute.
            service.process.wait(30.0)
        wait_for(lambda: not any(alive(worker) for worker in workers))


@pytest.mark.slow
def test_stop_succeeds_despite_a_stuck_thread(tiny_bundle: Path, tmp_path: Path) -> None:
    with running_service(tiny_bundle, tmp_path / "data", STOP_DEADLINE_S="1") as service:
        workers = children(service.process.pid)
        body = json.dumps(FLAT).encode()
        # A writer that does not finish: SQLite lets the upload's thread wait for 5 s.
        lock = sqlite3.connect(tmp_path / "data" / "lalaloc.sqlite3", isolation_level=None)
        lock.execute("BEGIN IMMEDIATE")
        with service.connect(_upload_head(body) + body):
            wait_for(lambda: _in_flight(service.client))
            service.process.send_signal(signal.SIGTERM)
            assert service.process.wait(30.0) == 0
        lock.close()
        wait_for(lambda: not any(alive(worker) for worker in workers))


@pytest.mark.slow
def test_stop_succeeds_after_hung_up_reads(tiny_bundle: Path, tmp_path: Path) -> None:
    with running_service(tiny_bundle, tmp_path / "data", STOP_DEADLINE_S="3") as service:
        plan_id = upload(service.client, tiled_plan(60, openings=True), wait=False)
        with ExitStack() as connections:
            for path in ("/layout", "/layout", "/layout", "/mesh.glb"):
                head = f"GET /floorplans/{plan_id}{path} HTTP/1.1\r\nHost: localhost\r\n\r\n"
                connections.enter_context(service.connect(head.encode()))
            # They have begun, most likely.
            sleep(1.0)
        service.process.send_signal(signal.SIGTERM)
        assert service.process.wait(30.0) == 0


@pytest.mark.slow
def test_event_streams_do_not_delay_the_stop(tiny_bundle: Path, tmp_path: Path) -> None:
    settings = {"GRID_STEP_M": "0.1", "MAX_GRID_POSES": "1000000"}
    with running_service(tiny_bundle, tmp_path / "data", **settings) as service:
        plan_id = upload(service.client, HALL, wait=False)
        with service.client.stream("GET", f"/floorplans/{plan_id}/events") as response:
            lines = response.iter_lines()
            assert "event: progress" in lines
            service.process.send_signal(signal.SIGTERM)
            # It ends as a whole answer does, and not with the connection.
            assert "event: ready" not in lines
        assert service.process.wait(60.0) == 0


@pytest.mark.slow
def test_second_signal_ends_at_once(tiny_bundle: Path, tmp_path: Path) -> None:
    with running_service(tiny_bundle, tmp_path / "data") as service:
        workers = children(service.process.pid)
        with service.connect(_upload_head(b"x" * 100)):
            wait_for(lambda: _in_flight(service.client))
            service.process.send_signal(signal.SIGTERM)
            wait_for(lambda: service.client.get("/readyz").status_code == 503)
            service.process.send_signal(signal.SIGTERM)
            assert service.process.wait(60.0) == 1
        wait_for(lambda: not any(alive(worker) for worker in workers))


@pytest.mark.slow  # 40 s: waits for the service's own time limits
def test_slow_clients_do_not_delay_the_stop(tiny_bundle: Path, tmp_path: Path) -> None:
    limits = {"KEEP_ALIVE_S": "1", "MAX_PENDING_REQUESTS": "1"}
    with running_service(tiny_bundle, tmp_path / "data", **limits) as service:
        with service.connect(b"GET /healthz HTTP/1.1\r\nX-Slow: ") as slow_head:
            assert _dribble_until_closed(slow_head) < 15.0
        with service.connect(b"") as silent:
            assert silent.recv(1) == b""
        with service.connect(_upload_head(b"x" * 100)), service.connect(_upload_head(b"x" * 10_000)) as refused:
            assert refused.recv(4096).startswith(b"HTTP/1.1 503 ")
            assert _dribble_until_closed(refused) < 15.0
        assert service.client.get("/healthz").status_code == 200


def _dribble_until_closed(connection: socket.socket) -> float:
    """Send a byte now and then; returns after how many seconds the other side had enough."""
    begin = monotonic()
    connection.settimeout(0.2)
    while monotonic() - begin < 20.0:
        try:
            connection.sendall(b"x")
            if connection.recv(4096) == b"":
                break
        except TimeoutError:
            sleep(0.1)
        except ConnectionError:
            break
    return monotonic() - begin
