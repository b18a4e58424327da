"""One tenant does its worst, another one asks: its answers come nearly as fast as alone, and health is told at once.

    python -m benchmarks.starving --seconds 8

Without API keys a tenant is a client address, so the one that does its worst comes from 127.0.0.2 (Linux). Prints a
Markdown table with a row for each attack: how long the other tenant's queries took against alone, what it was refused,
and the longest that health took.
"""

from __future__ import annotations

import argparse
import io
import multiprocessing
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import httpx
from PIL import Image

from benchmarks.load import Load, Reply, ask_for, faults, percentiles_ms, queries, upload_example_plan
from examples.launch import running_service
from examples.truth import PLAN_PATH

_MAX_TIMES_ALONE, _MAX_HEALTH_S = 3.0, 1.0
_FROM = "127.0.0.2"
_WIDTH, _HEIGHT = 14_000, 7_000
# Its latent grid takes minutes, during which its events go on.
_HALL = {"ceiling_height_m": 3.0, "rooms": [{"polygon": [[0, 0], [98, 0], [98, 98], [0, 98]]}]}
_UNTIL_BEGUN_S = 1.0


@dataclass(frozen=True)
class Target:
    """The service under attack, and plans that it has.

    Attributes:
        padded_id: of one whose file is larger than what a socket takes of an answer.
        hall_id: of one that is being prepared, empty before it is needed.
    """

    url: str
    plan_id: str
    padded_id: str
    hall_id: str = ""


def main() -> int:
    """Run; 1 when the other tenant notices too much."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each attack")
    parser.add_argument("--only", choices=_ATTACKS, help="one attack")
    options = parser.parse_args()
    attacks = [options.only] if options.only else list(_ATTACKS)
    failed = False
    with tempfile.TemporaryDirectory() as data:
        settings = {"LALALOC_DATA_DIR": data, "LALALOC_LOG_LEVEL": "error"}
        with running_service(0, settings) as service:
            plan_id = upload_example_plan(service.url)
            target = Target(service.url, plan_id, _upload_padded(service.url))
            ask_for(service.url, plan_id, Load(1, 2.0))
            alone = ask_for(service.url, plan_id, Load(1, options.seconds))
            p99_ms = percentiles_ms(alone)["p99"]
            print("| attack | queries | p50, p95, p99 in ms | p99 against alone | refused | health, at most |")
            print("|---|---|---|---|---|---|")
            print(_row("none", alone, p99_ms, 0.0), flush=True)
            for name in attacks:
                if name == _EVENTS:
                    hall = httpx.post(f"{service.url}/floorplans", json=_HALL).raise_for_status()
                    target = replace(target, hall_id=hall.json()["id"])
                with _under(name, target), _Health(service.url) as health:
                    time.sleep(_UNTIL_BEGUN_S)
                    replies = ask_for(service.url, plan_id, Load(1, options.seconds, after_refusal_s=0.1))
                print(_row(name, replies, p99_ms, health.longest_s), flush=True)
                for fault, times in faults(replies).items():
                    print(f"{times} times: {fault}", file=sys.stderr)
                failed |= bool(faults(replies)) or not all(reply.answered for reply in replies)
                failed |= percentiles_ms(replies)["p99"] > _MAX_TIMES_ALONE * p99_ms
                failed |= health.longest_s > _MAX_HEALTH_S
    return int(failed)


def _row(name: str, replies: list[Reply], alone_ms: float, health_s: float) -> str:
    answered = [reply for reply in replies if reply.answered]
    took = percentiles_ms(answered)
    shown = ", ".join(f"{took[q]:.0f}" for q in ("p50", "p95", "p99")) if took else "none"
    times = f"{took['p99'] / alone_ms:.1f} times" if took else "none"
    refused = len(replies) - len(answered)
    return f"| {name} | {len(answered)} | {shown} | {times} | {refused} | {1e3 * health_s:.0f} ms |"


def _upload_padded(url: str) -> str:
    content = PLAN_PATH.read_bytes()
    padding = b" " * (2 * 2**20 - len(content))
    headers = {"Content-Type": "application/json"}
    answer = httpx.post(f"{url}/floorplans", content=content + padding, headers=headers, timeout=30.0)
    return answer.raise_for_status().json()["id"]


class _Health:
    """Asks for health ten times a second."""

    def __init__(self, url: str) -> None:
        self.longest_s = 0.0
        self._url = url
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> _Health:
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._end.wait(0.1):
            begin = time.perf_counter()
            # On a new connection each time, as a load balancer may.
            httpx.get(f"{self._url}/healthz", timeout=30.0).raise_for_status()
            self.longest_s = max(self.longest_s, time.perf_counter() - begin)


@contextmanager
def _under(name: str, target: Target) -> Iterator[None]:
    """An attack, from a process of its own that it cannot slow down anybody's clock from."""
    process = multiprocessing.get_context("spawn").Process(target=_attack, args=(name, target), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()


def _attack(name: str, target: Target) -> None:
    _ATTACKS[name](target)


def _pictures(content: Callable[[], bytes], clients: int) -> Callable[[Target], None]:
    """Queries with the same picture, all the time."""

    def attack(target: Target) -> None:
        picture = content()

        def ask() -> None:
            transport = httpx.HTTPTransport(local_address=_FROM)
            with httpx.Client(base_url=target.url, transport=transport, timeout=60.0) as client:
                while True:
                    form = {"floorplan_id": target.plan_id}
                    answer = client.post("/localise", data=form, files={"panorama": ("p", picture)})
                    if answer.status_code == httpx.codes.SERVICE_UNAVAILABLE:
                        # Sooner than it is told to.
                        time.sleep(0.05)

        threads = [threading.Thread(target=ask, daemon=True) for _ in range(clients)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    return attack


def _connections(request: Callable[[Target], str], count: int) -> Callable[[Target], None]:
    """Requests that are begun, and whose answers are not read; again when the service ends them."""

    def attack(target: Target) -> None:
        host, _, port = target.url.removeprefix("http://").partition(":")
        while True:
            held: list[socket.socket] = []
            for _ in range(count):
                connection = socket.socket()
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                connection.bind((_FROM, 0))
                connection.connect((host, int(port)))
                connection.sendall(request(target).encode("ascii"))
                held.append(connection)
            time.sleep(5.0)
            for connection in held:
                connection.close()

    return attack


def _scans(count: int) -> bytes:
    """A grey progressive JPEG of 98 megapixels and so many scans."""
    buffer = io.BytesIO()
    Image.new("L", (_WIDTH, _HEIGHT), 90).save(buffer, "JPEG", progressive=True)
    content = buffer.getvalue()
    begin = content.rindex(b"\xff\xc4", 0, content.rindex(b"\xff\xda"))
    return content[:-2] + (count - 6) * content[begin:-2] + content[-2:]


def _largest_png() -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (_WIDTH, _HEIGHT), (90, 90, 90)).save(buffer, "PNG")
    return buffer.getvalue()


_BODY = "POST /localise HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=b\r\n"
_EVENTS = "80 event streams"
_ATTACKS: dict[str, Callable[[Target], None]] = {
    "8 clients with a JPEG of 400 scans": _pictures(lambda: _scans(400), 8),
    "8 clients with a JPEG of 98 megapixels and 20 scans": _pictures(lambda: _scans(20), 8),
    "8 clients with a PNG of 98 megapixels": _pictures(_largest_png, 8),
    "16 clients without a heading": _pictures(lambda: queries()[0].picture, 16),
    "80 connections that do not read": _connections(
        lambda target: f"GET /floorplans/{target.padded_id}/original HTTP/1.1\r\nHost: localhost\r\n\r\n", 80
    ),
    "60 bodies that do not come": _connections(lambda _: f"{_BODY}Content-Length: 100000\r\n\r\n--b", 60),
    _EVENTS: _connections(
        lambda target: f"GET /floorplans/{target.hall_id}/events HTTP/1.1\r\nHost: localhost\r\n\r\n", 80
    ),
}


if __name__ == "__main__":
    sys.exit(main())
