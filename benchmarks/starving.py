"""Fairness: one tenant keeps the service busy while another one localises.

    python -m benchmarks.starving --seconds 8

Without API keys a tenant is a client address, so the busy tenant connects from 127.0.0.2 (Linux). Prints a Markdown
table with a row for each attack: the other tenant's queries against alone, its refusals, and the slowest health check.
The second table has concurrent sessions in a venue: their answers by status, and the waits for each.
"""

from __future__ import annotations

import multiprocessing
import socket
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import httpx

from benchmarks import harness
from benchmarks.large_venue import random_home, upload_files, wait_until_ready
from examples.truth import PLAN_PATH, read_poses

_MAX_P99_RATIO, _MAX_HEALTH_S = 3.0, 1.0
# A refused photograph of a session is told so early; its deadline is 10 s.
_MAX_REFUSAL_S = 5.0
_VENUE_PLANS, _PHOTOGRAPHS = 62, 3
_BUSY_ADDRESS = "127.0.0.2"
_WIDTH, _HEIGHT = 14_000, 7_000
# A plan whose pose grid takes minutes, so that its event streams stay open.
_HALL = {"ceiling_height_m": 3.0, "rooms": [{"polygon": [[0, 0], [98, 0], [98, 98], [0, 98]]}]}
_UNTIL_BUSY_S = 3.0
_Attack = Callable[[harness.Service], AbstractContextManager[None]]
_BODY = "POST /localise HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=b\r\n"


def main() -> int:
    """Measure; return 1 when the other tenant is refused, slowed down too much, or answered wrongly."""
    parser = harness.argument_parser(__doc__)
    parser.add_argument("--seconds", type=float, default=8.0, help="duration of each attack")
    parser.add_argument("--sessions", type=int, default=12, help="sessions at the same time")
    parser.add_argument("--only", choices=[*_ATTACKS, "sessions"], help="run one attack, or the sessions")
    options = parser.parse_args()
    attacks = {name: attack for name, attack in _ATTACKS.items() if options.only in (None, name)}
    failed = bool(attacks) and _is_starved(attacks, options.seconds)
    if options.only in (None, "sessions"):
        failed |= _sessions_wait_in_vain(options.sessions)
    return int(failed)


def _is_starved(attacks: Mapping[str, _Attack], seconds: float) -> bool:
    """Print the row of each attack; return whether one of them starves the other tenant."""
    failed = False
    with harness.example_service() as service:
        harness.run_load(service.url, [service.plan_id], 1, 2.0)
        alone = harness.run_load(service.url, [service.plan_id], 1, seconds)
        alone_p99_ms = alone.answered.percentile_ms(99)
        harness.print_table_head(
            "attack", "queries", "p50, p95, p99 in ms", "p99 against alone", "refused", "slowest health check"
        )
        print(_row("none", alone, alone_p99_ms, 0.0), flush=True)
        for name, attack in attacks.items():
            with attack(service), harness.HealthWatch(service.url, 0.1) as health:
                time.sleep(_UNTIL_BUSY_S)
                result = harness.run_load(service.url, [service.plan_id], 1, seconds, pause_s=0.1)
            print(_row(name, result, alone_p99_ms, health.slowest_s), flush=True)
            failed |= result.failures + result.refused.count > 0 or health.slowest_s > _MAX_HEALTH_S
            failed |= not result.answered.percentile_ms(99) <= _MAX_P99_RATIO * alone_p99_ms
    return failed


def _sessions_wait_in_vain(sessions: int) -> bool:
    """Print the answers of concurrent sessions in a venue; return whether one came too late."""
    waits: dict[int, list[float]] = defaultdict(list)
    with harness.example_service() as service, httpx.Client(base_url=service.url, timeout=60.0) as client:
        homes = [random_home(number) for number in range(_VENUE_PLANS - 1)]
        venue_id = upload_files(service, service.plan_id, homes)
        wait_until_ready(client, venue_id)
        begun = [client.post("/sessions", json={"venue_id": venue_id}).raise_for_status() for _ in range(sessions)]

        def follow(session: str) -> None:
            for pose in read_poses()[:_PHOTOGRAPHS]:
                begin = time.perf_counter()
                files = {"photo": pose.picture.read_bytes()}
                answer = client.post(f"/sessions/{session}/photographs", files=files)
                waits[answer.status_code].append(time.perf_counter() - begin)
                if answer.status_code == httpx.codes.SERVICE_UNAVAILABLE:
                    time.sleep(float(answer.headers["Retry-After"]))

        with ThreadPoolExecutor(sessions) as threads:
            list(threads.map(follow, [answer.json()["id"] for answer in begun]))
    harness.print_table_head(f"{sessions} sessions, status", "photographs", "median wait", "longest wait")
    for status, waited in sorted(waits.items()):
        row = harness.table_row(status, len(waited), f"{statistics.median(waited):.1f} s", f"{max(waited):.1f} s")
        print(row, flush=True)
    return not waits.keys() <= {200, 503} or max(waits[503], default=0.0) > _MAX_REFUSAL_S


def _row(name: str, result: harness.LoadResult, alone_p99_ms: float, health_s: float) -> str:
    answered = result.answered
    times = ", ".join(f"{milliseconds:.0f}" for milliseconds in answered.percentiles_ms().values())
    ratio = f"{answered.percentile_ms(99) / alone_p99_ms:.1f} times"
    return harness.table_row(
        name, answered.count, times, ratio, result.refused.count + result.failures, f"{1e3 * health_s:.0f} ms"
    )


def _picture(content: Callable[[], bytes], clients: int) -> _Attack:
    """Return an attack with clients that send one picture over and over."""

    @contextmanager
    def attack(service: harness.Service) -> Iterator[None]:
        with tempfile.TemporaryDirectory() as folder:
            picture = Path(folder) / "picture"
            picture.write_bytes(content())
            with harness.busy_tenant(service.url, service.plan_id, picture, clients, _BUSY_ADDRESS):
                yield

    return attack


def _connections(request: Callable[[harness.Service], str], count: int) -> _Attack:
    """Return an attack with requests that are never completed or read."""

    @contextmanager
    def attack(service: harness.Service) -> Iterator[None]:
        arguments = (service.url, request(service).encode("ascii"), count)
        process = multiprocessing.get_context("spawn").Process(target=_hold, args=arguments, daemon=True)
        process.start()
        try:
            yield
        finally:
            process.kill()
            process.join()

    return attack


def _hold(url: str, request: bytes, count: int) -> None:
    host, _, port = url.removeprefix("http://").partition(":")
    while True:
        connections: list[socket.socket] = []
        for _ in range(count):
            connection = socket.socket()
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            connection.bind((_BUSY_ADDRESS, 0))
            connection.connect((host, int(port)))
            connection.sendall(request)
            connections.append(connection)
        time.sleep(5.0)
        for connection in connections:
            connection.close()


def _upload(service: harness.Service, content: bytes) -> str:
    headers = {"Content-Type": "application/json"}
    response = httpx.post(f"{service.url}/floorplans", content=content, headers=headers, timeout=30.0)
    return response.raise_for_status().json()["id"]


def _get_padded_original(service: harness.Service) -> str:
    """Return a request for a file that is larger than a socket's buffers."""
    content = PLAN_PATH.read_bytes()
    plan_id = _upload(service, content + b" " * (2 * 2**20 - len(content)))
    return f"GET /floorplans/{plan_id}/original HTTP/1.1\r\nHost: localhost\r\n\r\n"


def _get_events(service: harness.Service) -> str:
    """Return a request for the events of a plan that is being prepared."""
    plan_id = httpx.post(f"{service.url}/floorplans", json=_HALL).raise_for_status().json()["id"]
    return f"GET /floorplans/{plan_id}/events HTTP/1.1\r\nHost: localhost\r\n\r\n"


def _scans(count: int) -> bytes:
    """Return a grey progressive JPEG of 98 megapixels with a number of scans."""
    content = harness.plain_picture(_WIDTH, _HEIGHT, "JPEG", "L", progressive=True)
    begin = content.rindex(b"\xff\xc4", 0, content.rindex(b"\xff\xda"))
    return content[:-2] + (count - 6) * content[begin:-2] + content[-2:]


_ATTACKS: dict[str, _Attack] = {
    "8 clients with a JPEG of 400 scans": _picture(lambda: _scans(400), 8),
    "8 clients with a JPEG of 98 megapixels and 20 scans": _picture(lambda: _scans(20), 8),
    "8 clients with a PNG of 98 megapixels": _picture(lambda: harness.plain_picture(_WIDTH, _HEIGHT, "PNG"), 8),
    "16 clients without a heading": _picture(lambda: read_poses()[0].picture.read_bytes(), 16),
    "80 connections that do not read": _connections(_get_padded_original, 80),
    "60 bodies that do not arrive": _connections(lambda _: f"{_BODY}Content-Length: 100000\r\n\r\n--b", 60),
    # Last: preparing its plan goes on for minutes.
    "80 event streams": _connections(_get_events, 80),
}


if __name__ == "__main__":
    sys.exit(main())
