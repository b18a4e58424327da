"""What a client sends to keep a service busy: each is answered soon, and health within a second all the while.

    python -m benchmarks.hostile

Prints a Markdown table: what was sent, its bytes, the answers, how long they took in all, and the slowest answer of
`/healthz` meanwhile. `benchmarks.bombs` has what is sent to fill memory.
"""

from __future__ import annotations

import io
import json
import math
import socket
import struct
import sys
import tempfile
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import httpx
from PIL import Image

from benchmarks.load import upload_example_plan
from examples.launch import running_service

_HEALTH_S = 1.0
# What one request may take; the machine that this runs on has clients to run as well.
_ANSWER_S = 10.0
# A health check that takes longer is as good as none.
_GIVE_UP_S = 20.0
_CLIENTS = 60
# More than a process may have descriptors, by default.
_IDLE = 1_044

Point = list[float]


@dataclass(frozen=True)
class Attack:
    """Something to send.

    Attributes:
        sent: bytes of one request.
        send: sends it, however often, and gives the statuses of all answers.
    """

    name: str
    sent: int
    send: Callable[[], list[int]]


def main() -> int:
    """Run; 1 when health was slow, or an attack was answered late or by an error of the service."""
    failed = False
    with tempfile.TemporaryDirectory() as data:
        settings = {"LALALOC_DATA_DIR": data, "LALALOC_LOG_LEVEL": "error"}
        with running_service(0, settings) as service:
            plan_id = upload_example_plan(service.url)
            print("| sent | bytes | answers | seconds | slowest health |\n|---|---|---|---|---|", flush=True)
            for attack in _attacks(service.url, plan_id):
                health = _Health(service.url)
                begin = time.perf_counter()
                statuses = Counter(attack.send())
                seconds, slowest_s = time.perf_counter() - begin, health.end()
                # Refusals for now are as good as any, as long as they come soon.
                wrong = any(status == 0 or status in (500, 502, 504) for status in statuses)
                failed |= wrong or slowest_s > _HEALTH_S or seconds > _ANSWER_S
                told = ", ".join(f"{count} x {status}" for status, count in sorted(statuses.items()))
                row = (attack.name, f"{attack.sent:,}", told, f"{seconds:.1f}", f"{slowest_s:.2f} s")
                print(f"| {' | '.join(row)} |", flush=True)
    return int(failed)


class _Health:
    """Asks for health over and over, each time on a new connection, as a load balancer does."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._slowest_s = 0.0
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def end(self) -> float:
        """How long the slowest answer took."""
        self._end.set()
        self._thread.join()
        return self._slowest_s

    def _run(self) -> None:
        while True:
            begin = time.perf_counter()
            try:
                with urllib.request.urlopen(f"{self._url}/healthz", timeout=_GIVE_UP_S) as answer:
                    answer.read()
            except OSError:
                self._slowest_s = math.inf
            self._slowest_s = max(self._slowest_s, time.perf_counter() - begin)
            if self._end.wait(0.05):
                return


def _attacks(url: str, plan_id: str) -> Iterator[Attack]:
    for size in (30_000, 200_000, 2_000_000):
        text = b'"' + b'\\"' * (size // 2)
        yield Attack("JSON that is one string without an end", len(text), lambda text=text: [_plan(url, text)])
    combs = _document([_comb(k) for k in range(24)])
    yield Attack("24 rooms that are crossing combs", len(combs), lambda: [_plan(url, combs)])
    yield Attack("... looked at ten times at once", 0, lambda: _together(url, _newest(url), "", 10))
    for side_m in (290.0, 19.9):
        slivers = _document([_sliver(k, side_m) for k in range(500)])
        name = f"500 slivers across squares of {side_m:g} m"
        yield Attack(name, len(slivers), lambda slivers=slivers: [_plan(url, slivers), _settled(url)])
    spirals = _document([_spiral(k) for k in range(6)])
    yield Attack("6 rooms that are spirals", len(spirals), lambda: [_plan(url, spirals)])
    yield Attack(
        f"... drawn for {_CLIENTS} clients at once", 0, lambda: _together(url, _newest(url), "/preview.svg", _CLIENTS)
    )
    yield Attack(
        f"... as a mesh for {_CLIENTS} clients at once", 0, lambda: _together(url, _newest(url), "/mesh.glb", _CLIENTS)
    )
    for name, picture in _pictures():
        yield Attack(name, len(picture), lambda picture=picture: [_localise(url, plan_id, picture)])
    form = b'--b\r\nContent-Disposition: form-data; name="file"; filename="p"\r\n\r\n' + b"\r\n--" * 500_000
    yield Attack("form of 500,000 lines that nearly end it", len(form), lambda: [_form(url, form)])
    yield Attack(f"{_IDLE:,} connections that say nothing", 0, lambda: _idle(url))


def _document(polygons: list[list[Point]]) -> bytes:
    rooms = [{"polygon": [[round(x, 3), round(y, 3)] for x, y in polygon]} for polygon in polygons]
    return json.dumps({"ceiling_height_m": 2.5, "rooms": rooms}, separators=(",", ":")).encode()


def _comb(number: int) -> list[Point]:
    """A comb of 48 teeth, every other one turned, so that the teeth of each cross those of half the others."""
    teeth: list[Point] = []
    for k in range(48):
        teeth += [[k + 0.01, 0.1], [k + 0.01, 48.0], [k + 0.02, 48.0], [k + 0.02, 0.1]]
    comb = [[0.0, 0.0], [0.0, 0.1], *teeth, [48.0, 0.1], [48.0, 0.0]]
    shift = 0.03 * number
    return [[y + shift, x + shift] if number % 2 else [x + shift, y + shift] for x, y in comb]


def _sliver(number: int, side_m: float) -> list[Point]:
    """A corridor of a few millimetres across a square, whose poses are looked for in all of the square."""
    x, width_m = 0.05 * number, 0.25 / side_m
    return [[x, 0.0], [x + width_m, 0.0], [x + side_m, side_m], [x + side_m - width_m, side_m]]


def _spiral(number: int) -> list[Point]:
    angles = [0.6 + k * (10.0 * math.pi - 0.6) / 99.0 for k in range(100)]
    arms = []
    for offset_m in (0.3, 0.0):
        radii = [angle / (2.0 * math.pi) + offset_m for angle in angles]
        arms.append([[14.0 * number + r * math.cos(a), r * math.sin(a)] for r, a in zip(radii, angles, strict=True)])
    return [*arms[0], *reversed(arms[1])]


def _pictures() -> Iterator[tuple[str, bytes]]:
    buffer = io.BytesIO()
    Image.new("RGB", (256, 128), (90, 90, 90)).save(buffer, "JPEG")
    plain = buffer.getvalue()

    def segment(marker: int, content: bytes) -> bytes:
        return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content

    yield "JPEG of 5 million empty comments", plain[:2] + segment(0xFE, b"") * 5_000_000 + plain[2:]
    yield "JPEG of 640 segments of Exif", plain[:2] + segment(0xE1, b"Exif\0\0" + bytes(60_000)) * 640 + plain[2:]


def _plan(url: str, content: bytes) -> int:
    headers = {"Content-Type": "application/json"}
    return _status(lambda: httpx.post(f"{url}/floorplans", content=content, headers=headers, timeout=60.0))


def _form(url: str, content: bytes) -> int:
    headers = {"Content-Type": "multipart/form-data; boundary=b"}
    return _status(lambda: httpx.post(f"{url}/floorplans", content=content, headers=headers, timeout=60.0))


def _localise(url: str, plan_id: str, picture: bytes) -> int:
    data, files = {"floorplan_id": plan_id}, {"panorama": ("p", picture)}
    return _status(lambda: httpx.post(f"{url}/localise", data=data, files=files, timeout=60.0))


def _status(send: Callable[[], httpx.Response]) -> int:
    """The status of an answer, 0 for none."""
    try:
        return send().status_code
    except httpx.HTTPError:
        return 0


def _listed(url: str) -> list[dict[str, Any]]:
    return httpx.get(f"{url}/floorplans", timeout=60.0).json()["floorplans"]


def _newest(url: str) -> str:
    return _listed(url)[0]["id"]


def _settled(url: str) -> int:
    """Wait until no plan is preparing; 0 when that takes too long."""
    deadline = time.monotonic() + _GIVE_UP_S
    while any(plan["status"] == "preparing" for plan in _listed(url)):
        if time.monotonic() > deadline:
            return 0
        time.sleep(0.1)
    return httpx.codes.OK


def _together(url: str, plan_id: str, path: str, clients: int) -> list[int]:
    """The same answer for many clients at once."""
    address = f"{url}/floorplans/{plan_id}{path}"
    with httpx.Client(timeout=60.0) as client, ThreadPoolExecutor(clients) as threads:
        return list(threads.map(lambda _: _status(lambda: client.get(address)), range(clients)))


def _idle(url: str) -> list[int]:
    """Connections that are opened, and after which somebody asks for the limits."""
    host, _, port = url.removeprefix("http://").partition(":")
    with ExitStack() as stack:
        for _ in range(_IDLE):
            stack.enter_context(socket.create_connection((host, int(port)), timeout=10.0))
        return [_status(lambda: httpx.get(f"{url}/limits", timeout=60.0))]


if __name__ == "__main__":
    sys.exit(main())
