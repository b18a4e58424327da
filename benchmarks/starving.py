"""Fairness: one tenant keeps the service busy while another one localises.

    python -m benchmarks.starving --seconds 8

Without API keys a tenant is a client address, so the busy tenant connects from 127.0.0.2 (Linux). Prints a Markdown
table with a row for each attack: the other tenant's queries against alone, its refusals, and the slowest health check.
"""

from __future__ import annotations

import multiprocessing
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import httpx

from benchmarks import harness
from examples.truth import PLAN_PATH, read_poses

_MAX_P99_RATIO, _MAX_HEALTH_S = 3.0, 1.0
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
    parser.add_argument("--only", choices=_ATTACKS, help="run one attack")
    options = parser.parse_args()
    attacks = {options.only: _ATTACKS[options.only]} if options.only else _ATTACKS
    failed = False
    with harness.example_service() as service:
        harness.run_load(service.url, [service.plan_id], 1, 2.0)
        alone = harness.run_load(service.url, [service.plan_id], 1, options.seconds)
        alone_p99_ms = alone.answered.percentile_ms(99)
        harness.print_table_head(
            "attack", "queries", "p50, p95, p99 in ms", "p99 against alone", "refused", "slowest health check"
        )
        print(_row("none", alone, alone_p99_ms, 0.0), flush=True)
        for name, attack in attacks.items():
            with attack(service), harness.HealthWatch(service.url, 0.1) as health:
                time.sleep(_UNTIL_BUSY_S)
                result = harness.run_load(service.url, [service.plan_id], 1, options.seconds, pause_s=0.1)
            print(_row(name, result, alone_p99_ms, health.slowest_s), flush=True)
            failed |= result.failures + result.refused.count > 0 or health.slowest_s > _MAX_HEALTH_S
            failed |= not result.answered.percentile_ms(99) <= _MAX_P99_RATIO * alone_p99_ms
    return int(failed)


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
