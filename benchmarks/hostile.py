"""Hostile requests, which exhaust memory or keep the service busy, and hostile plan files.

    python -m benchmarks.hostile
    python -m benchmarks.hostile --files roomplan --bytes 100000

Prints a Markdown table: the request, its bytes, the statuses, the duration, the slowest health check meanwhile, and the
rise of the resident memory of the service and its workers. Every request must be answered soon and without an internal
error, health checks within a second, and memory must stay within its limit. The picture of the largest allowed size and
the first frame of an animation are answered; other pictures and bodies are refused.

`--files` imports small plan files that are made to take an import worker's time or memory: those whose "format,
content" match an expression, by default all, each in a process of its own with the service's limits. The exit status
is 1 when a request or a file takes longer or more than it may, or ends its process.
"""

from __future__ import annotations

import io
import itertools
import json
import math
import os
import re
import resource
import socket
import struct
import sys
import threading
import time
import urllib.request
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Literal

import httpx
import numpy as np
from PIL import Image

from benchmarks import harness
from benchmarks.hostile_drawings import HOSTILE_PLANS
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.importers import ImportLimits, import_plans
from service.settings import Settings
from service.workers.process import limit_memory

_HEALTH_TIMEOUT_S, _MAX_HEALTH_S, _MAX_ANSWER_S, _TIMEOUT_S, _SETTLE_TIMEOUT_S = 20.0, 1.0, 10.0, 90.0, 20.0
# Uploads have up to 40 MiB; parsed JSON takes some 30 times its bytes. A worker may hold the pixels that it decodes.
_MAX_MB, _MAX_DECODING_MB = 400.0, Settings.load().decode.memory_bytes / 2**20
# Kept by buffers and allocators after all requests.
_MAX_LEFT_MB = 400.0
# The upload limit of 40 MiB, and the bytes in flight when the answer comes.
_MAX_SENT_BYTES = 50 << 20
_GIGABYTE = 1 << 30
_CLIENTS = 60
# More connections than the default limit of file descriptors of a process.
_IDLE_CONNECTIONS = 1_044
# CPU time that a file may take: the libraries of its format, and its content.
_MAX_FILE_S, _MAX_S_PER_100_KB, _WALL_TIMEOUT_S = 4.0, 4.0, 300.0
_JSON = {"Content-Type": "application/json"}
_FORM = {"Content-Type": "multipart/form-data; boundary=b"}
_PART = b'--b\r\nContent-Disposition: form-data; name="photo"; filename="p"\r\n\r\n'

Point = list[float]


@dataclass(frozen=True)
class Attack:
    """Hostile request: `send` returns the statuses of all answers, 0 for a broken connection.

    "accepted" expects a localisation, "refused" a status in the 400s; `is_slow` if the client itself takes long.
    """

    name: str
    size_bytes: int
    send: Callable[[], list[int]]
    expected: Literal["accepted", "refused", "any"] = "any"
    is_slow: bool = False


def main() -> int:
    """Send or import everything; return 1 when a limit is exceeded or an attack succeeds."""
    parser = harness.argument_parser(__doc__)
    parser.add_argument("--files", nargs="?", const="", metavar="EXPRESSION", help="import plan files instead")
    parser.add_argument("--bytes", type=int, default=100_000, help="approximate size of a file")
    options = parser.parse_args()
    return int(send_requests() if options.files is None else import_files(options.files, options.bytes))


def send_requests() -> bool:
    """Send all requests; return whether one fails."""
    failed = False
    with harness.example_service() as service:
        memory_before = harness.service_memory_mb(service.process)
        harness.print_table_head("request", "bytes", "statuses", "seconds", "slowest health check", "memory")
        for attack in _attacks(service.url, service.plan_id):
            begin = time.perf_counter()
            with _watched(service) as seen:
                statuses = Counter(attack.send())
            seconds, risen_mb = time.perf_counter() - begin, seen.highest_mb - seen.before_mb
            failed |= any(status in (0, 500, 502, 504) for status in statuses) or seen.slowest_s > _MAX_HEALTH_S
            accepted = attack.expected == "accepted"
            failed |= accepted and set(statuses) != {200}
            failed |= attack.expected == "refused" and any(not 400 <= status < 500 for status in statuses)
            failed |= seconds > _MAX_ANSWER_S and not (attack.is_slow or accepted)
            failed |= risen_mb > (_MAX_DECODING_MB if accepted else _MAX_MB)
            shown = ", ".join(f"{count} x {status}" for status, count in sorted(statuses.items()))
            times = f"{seconds:.1f}", f"{seen.slowest_s:.2f} s", f"{risen_mb:+.0f} MB"
            print(harness.table_row(attack.name, f"{attack.size_bytes:,}", shown, *times), flush=True)
        left_mb = harness.service_memory_mb(service.process) - memory_before
        failed |= left_mb > _MAX_LEFT_MB
        print(f"\nMemory after all requests: {left_mb:+.0f} MB against before.")
    return failed


@dataclass
class _Seen:
    """Slowest health check (s), infinite if one failed, and resident memory (MB) of a service and its workers."""

    before_mb: float
    highest_mb: float = 0.0
    slowest_s: float = 0.0


@contextmanager
def _watched(service: harness.Service) -> Iterator[_Seen]:
    """Check health on new connections, as a load balancer does, and memory until the block ends."""
    seen, end = _Seen(harness.service_memory_mb(service.process)), threading.Event()

    def check_health() -> None:
        begin = time.perf_counter()
        try:
            with urllib.request.urlopen(f"{service.url}/healthz", timeout=_HEALTH_TIMEOUT_S) as response:
                response.read()
        except OSError:
            seen.slowest_s = math.inf
        seen.slowest_s = max(seen.slowest_s, time.perf_counter() - begin)

    def check_memory() -> None:
        seen.highest_mb = max(seen.highest_mb, harness.service_memory_mb(service.process))

    def repeat(check: Callable[[], None], pause_s: float) -> None:
        check()
        while not end.wait(pause_s):
            check()

    with ThreadPoolExecutor(2) as threads:
        threads.submit(repeat, check_health, 0.05)
        threads.submit(repeat, check_memory, 0.02)
        try:
            yield seen
        finally:
            end.set()


def _attacks(url: str, plan_id: str) -> Iterator[Attack]:
    def picture(name: str, content: bytes, *, accepted: bool = False) -> Attack:
        data = {"floorplan_id": plan_id, "projection": "equirectangular"}
        files = {"photo": ("p", content)}
        send = lambda: [_post(f"{url}/localise", data=data, files=files)]  # noqa: E731
        return Attack(name, len(content), send, "accepted" if accepted else "refused")

    def plan(name: str, content: bytes, *, prepare: bool = False, refused: bool = False) -> Attack:
        def send() -> list[int]:
            statuses = [_post(f"{url}/floorplans", content=content, headers=_JSON)]
            return [*statuses, _wait_until_prepared(url)] if prepare else statuses

        return Attack(name, len(content), send, "refused" if refused else "any")

    yield picture("PNG of 60,000 x 30,000 pixels of one colour", _png(60_000, 30_000, full=True))
    yield picture("PNG with a header of 2^31 x 2^30 pixels", _png(1 << 31, 1 << 30, full=False))
    largest = harness.plain_picture(14_140, 7_070, "PNG")
    yield picture("PNG of 14,140 x 7,070 pixels, the largest allowed", largest, accepted=True)
    yield picture("WebP of 9,000 frames", _animation(9_000), accepted=True)
    yield picture("PNG with 100 MB of compressed text", _png_with_text(100_000_000))
    jpeg = harness.plain_picture(256, 128, "JPEG")
    yield picture("JPEG of 5 million empty comments", jpeg[:2] + _segment(0xFE, b"") * 5_000_000 + jpeg[2:])
    exif = _segment(0xE1, b"Exif\0\0" + bytes(60_000))
    yield picture("JPEG of 640 segments of Exif", jpeg[:2] + exif * 640 + jpeg[2:])
    yield Attack("body of 1 GB with its length", _GIGABYTE, lambda: _send_gigabyte(url, has_length=True), "refused")
    yield Attack("body of 1 GB in chunks", _GIGABYTE, lambda: _send_gigabyte(url, has_length=False), "refused")
    yield Attack("body of one byte a second", 100_000, lambda: _send_slowly(url), "refused", is_slow=True)

    ring = np.linspace(0.0, 2.0 * np.pi, 1_000_000, endpoint=False)
    circle = _document([np.stack([np.cos(ring), np.sin(ring)], axis=1).tolist()], 2)
    yield plan("plan of a million vertices", circle, refused=True)
    yield plan("JSON nested a million deep", b"[" * 1_000_000, refused=True)
    yield plan("JSON number of a million digits", b'{"ceiling_height_m": ' + b"9" * 1_000_000 + b"}", refused=True)
    for size in (30_000, 200_000, 2_000_000):
        yield plan("JSON that is one string without an end", b'"' + b'\\"' * (size // 2))
    yield plan("24 rooms that are crossing combs", _document([_comb(number) for number in range(24)]))
    yield Attack("... fetched 10 times at once", 0, lambda: _fetch_newest(url, "", 10))
    for side_m in (290.0, 19.9):
        slivers = _document([_sliver(number, side_m) for number in range(500)])
        yield plan(f"500 slivers across squares of {side_m:g} m", slivers, prepare=True)
    yield plan("6 rooms that are spirals", _document([_spiral(number) for number in range(6)]))
    for path, action in (("/preview.svg", "drawn"), ("/mesh.glb", "as a mesh")):
        name = f"... {action} for {_CLIENTS} clients at once"
        yield Attack(name, 0, lambda path=path: _fetch_newest(url, path, _CLIENTS))
    form = b'--b\r\nContent-Disposition: form-data; name="file"; filename="p"\r\n\r\n' + b"\r\n--" * 500_000
    send_form = lambda: [_post(f"{url}/floorplans", content=form, headers=_FORM)]  # noqa: E731
    yield Attack("form of 500,000 lines that nearly end it", len(form), send_form)
    yield Attack(f"{_IDLE_CONNECTIONS:,} idle connections", 0, lambda: _hold_connections(url))


def _png(width: int, height: int, *, full: bool) -> bytes:
    """Return a greyscale PNG of zeros; without the pixels if it is not `full`."""
    packer = zlib.compressobj(9)
    row = b"\0" * (width + 1)
    packed = b"".join(packer.compress(row) for _ in range(height)) + packer.flush() if full else packer.flush()
    head = struct.pack(">IIBBBBB", width & 0xFFFFFFFF, height & 0xFFFFFFFF, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", packed) + _chunk(b"IEND", b"")


def _png_with_text(size: int) -> bytes:
    plain = harness.plain_picture(256, 128, "PNG")
    # The header has 8 + 25 bytes.
    return plain[:33] + _chunk(b"zTXt", b"Comment\0\0" + zlib.compress(b"a" * size, 9)) + plain[33:]


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def _segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content


def _animation(frames: int) -> bytes:
    buffer = io.BytesIO()
    # Equal frames would be merged.
    shades = [Image.new("RGB", (128, 64), (k % 256, k // 256, 0)) for k in range(frames)]
    shades[0].save(buffer, "WEBP", save_all=True, append_images=shades[1:], duration=1, lossless=True, method=0)
    return buffer.getvalue()


def _document(polygons: list[list[Point]], digits: int = 3) -> bytes:
    rooms = [{"polygon": [[round(x, digits), round(y, digits)] for x, y in polygon]} for polygon in polygons]
    return json.dumps({"ceiling_height_m": 2.5, "rooms": rooms}, separators=(",", ":")).encode()


def _comb(number: int) -> list[Point]:
    """Return a comb of 48 teeth; every other comb is transposed, so that its teeth cross those of its neighbours."""
    teeth: list[Point] = []
    for k in range(48):
        teeth += [[k + 0.01, 0.1], [k + 0.01, 48.0], [k + 0.02, 48.0], [k + 0.02, 0.1]]
    comb = [[0.0, 0.0], [0.0, 0.1], *teeth, [48.0, 0.1], [48.0, 0.0]]
    shift = 0.03 * number
    return [[y + shift, x + shift] if number % 2 else [x + shift, y + shift] for x, y in comb]


def _sliver(number: int, side_m: float) -> list[Point]:
    """Return a corridor of a few millimetres across a square; its bounding box, searched for poses, is the square."""
    x, width_m = 0.05 * number, 0.25 / side_m
    return [[x, 0.0], [x + width_m, 0.0], [x + side_m, side_m], [x + side_m - width_m, side_m]]


def _spiral(number: int) -> list[Point]:
    angles = [0.6 + k * (10.0 * math.pi - 0.6) / 99.0 for k in range(100)]
    arms = []
    for offset_m in (0.3, 0.0):
        radii = [angle / (2.0 * math.pi) + offset_m for angle in angles]
        arms.append([[14.0 * number + r * math.cos(a), r * math.sin(a)] for r, a in zip(radii, angles, strict=True)])
    return [*arms[0], *reversed(arms[1])]


def _post(address: str, **request: Any) -> int:
    return _status(lambda: httpx.post(address, timeout=_TIMEOUT_S, **request))


def _status(send: Callable[[], httpx.Response]) -> int:
    """Return the status of an answer; 0 without one."""
    try:
        return send().status_code
    except httpx.HTTPError:
        return 0


def _stored_plans(url: str) -> list[dict[str, Any]]:
    return httpx.get(f"{url}/floorplans", timeout=60.0).json()["floorplans"]


def _wait_until_prepared(url: str) -> int:
    """Return 200 when no plan is preparing any more, 0 after the timeout."""
    with suppress(TimeoutError):
        is_prepared = lambda: all(plan["status"] != "preparing" for plan in _stored_plans(url))  # noqa: E731
        harness.wait_until(is_prepared, "all plans are prepared", _SETTLE_TIMEOUT_S, 0.1)
        return httpx.codes.OK
    return 0


def _fetch_newest(url: str, path: str, clients: int) -> list[int]:
    """Fetch a resource of the newest plan with many clients at once."""
    address = f"{url}/floorplans/{_stored_plans(url)[0]['id']}{path}"
    with httpx.Client(timeout=60.0) as client, ThreadPoolExecutor(clients) as threads:
        return list(threads.map(lambda _: _status(lambda: client.get(address)), range(clients)))


def _hold_connections(url: str) -> list[int]:
    """Open idle connections, then ask for the limits."""
    host, _, port = url.removeprefix("http://").partition(":")
    with ExitStack() as stack:
        for _ in range(_IDLE_CONNECTIONS):
            stack.enter_context(socket.create_connection((host, int(port)), timeout=10.0))
        return [_status(lambda: httpx.get(f"{url}/limits", timeout=60.0))]


def _send_gigabyte(url: str, *, has_length: bool) -> list[int]:
    head = f"Content-Length: {_GIGABYTE}" if has_length else "Transfer-Encoding: chunked"
    block = b"a" * (1 << 16)
    blocks = itertools.chain([_PART], itertools.repeat(block, _GIGABYTE // len(block)))
    return _send_parts(url, head, (part if has_length else b"%x\r\n%s\r\n" % (len(part), part) for part in blocks))


def _send_slowly(url: str) -> list[int]:
    def drops() -> Iterator[bytes]:
        yield _PART
        while True:
            time.sleep(1.0)
            yield b"a"

    return _send_parts(url, "Content-Length: 100000", drops())


def _send_parts(url: str, head: str, body: Iterator[bytes]) -> list[int]:
    """Send a body in parts until the service answers; return its status, 0 for none or too many bytes."""
    host, _, port = url.removeprefix("http://").partition(":")
    sent, answer, deadline = 0, b"", time.monotonic() + _TIMEOUT_S
    with socket.create_connection((host, int(port))) as connection:
        lines = ["POST /localise HTTP/1.1", f"Host: {host}", "Content-Type: multipart/form-data; boundary=b", head]
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        for part in body:
            try:
                connection.settimeout(5.0)
                connection.sendall(part)
                sent += len(part)
                connection.settimeout(0.001)
                answer = connection.recv(1 << 16)
            except TimeoutError:
                if time.monotonic() < deadline and sent <= _MAX_SENT_BYTES:
                    continue
            except OSError:
                # The service closed the connection; its answer, if any, is read below.
                pass
            break
        connection.settimeout(5.0)
        while b"\r\n" not in answer:
            try:
                answer += connection.recv(1 << 16) or b" 0 \r\n"
            except OSError:
                break
    return [int(answer.split(b" ", 2)[1]) if answer.startswith(b"HTTP/") and sent <= _MAX_SENT_BYTES else 0]


def _import_here(number: int, size: int, pipe: Connection) -> None:
    plan, settings = HOSTILE_PLANS[number], Settings()
    content = plan.make(size)
    resource.setrlimit(resource.RLIMIT_CPU, (120, 121))
    os.environ["OPENCV_FOR_THREADS_NUM"] = "1"
    begin_s = time.process_time()
    limit_memory(settings.imports.memory_bytes)
    pipe.send(len(content))
    try:
        plans = import_plans(content, plan.options, ImportLimits())
        outcome = f"{sum(len(plan.document['rooms']) for plan in plans)} rooms"
    except InvalidInputError as error:
        outcome = str(error)
    except MemoryError:
        outcome = "MemoryError"
    except Exception as error:
        outcome = f"FAULT {type(error).__name__}: {error}"
    used_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    pipe.send((time.process_time() - begin_s, used_mb, outcome))


def _import(number: int, size: int) -> tuple[int, float, float, str]:
    """Import a file in a process of its own; return its bytes, CPU time (s), memory (MB) and the result in words."""
    begin_s, bytes_sent = time.monotonic(), 0
    with harness.child_process(_import_here, number, size) as pipe:
        try:
            bytes_sent = pipe.recv()
            if pipe.poll(_WALL_TIMEOUT_S):
                return bytes_sent, *pipe.recv()
            outcome = f"process was killed after {_WALL_TIMEOUT_S:g} s"
        except EOFError:
            outcome = "process ended"
    return bytes_sent, time.monotonic() - begin_s, math.nan, outcome


def import_files(expression: str, size: int) -> bool:
    """Import the files whose "format, content" match an expression; return whether one takes too much."""
    harness.print_table_head("format", "content", "bytes", "CPU", "memory", "result")
    failed = False
    for number, plan in enumerate(HOSTILE_PLANS):
        if not re.search(expression, f"{plan.format}, {plan.title}"):
            continue
        count, seconds, memory_mb, outcome = _import(number, size)
        is_slow = seconds > _MAX_FILE_S + _MAX_S_PER_100_KB * count / 1e5
        failed |= is_slow or outcome.startswith(("FAULT", "process"))
        figures = f"{count:,}", f"{seconds:.1f} s", f"{memory_mb:.0f} MB", f"{'SLOW ' * is_slow}{outcome[:150]}"
        print(harness.table_row(plan.format, plan.title, *figures), flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
