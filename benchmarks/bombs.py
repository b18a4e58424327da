"""Uploads that are made to exhaust a service: each is refused, and memory stays where it was.

Two are answered: of an animation the first picture is looked at and no other, and the largest picture that is allowed.

    python -m benchmarks.bombs

Prints a Markdown table: what was sent, the answer, how long it took, and by how much the resident memory of the service
and of all its workers rose at most while it did.
"""

from __future__ import annotations

import io
import itertools
import json
import socket
import struct
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import httpx
import numpy as np
from PIL import Image

from benchmarks.load import upload_example_plan
from benchmarks.processes import descendants, resident_mb
from examples.launch import running_service
from service.settings import Settings

# Uploads of 40 MiB are allowed. A worker may hold the pixels of a picture that it is allowed to decode.
_MAX_MB = 100.0
_MAX_DECODING_MB = Settings.load().decode.memory_bytes / 2**20
# What buffers and allocators keep.
_LEFT_MB = 150.0
_GIGABYTE = 1 << 30
# The limit of 40 MiB, and what is on its way when the answer comes.
_MAX_SENT = 50 << 20
_ANIMATION = "WebP of 9,000 frames"
_LARGEST = "PNG of 14,140 x 7,070 pixels, which is allowed"
_ANSWERED = frozenset({_ANIMATION, _LARGEST})
_SLOW_S = 90.0
# How a form begins that the raw uploads below are the file of.
_PART = b'--b\r\nContent-Disposition: form-data; name="panorama"; filename="p"\r\n\r\n'


@dataclass(frozen=True)
class Outcome:
    """What an upload came to."""

    status: int
    detail: str


def main() -> int:
    """Run; 1 when something was taken, or memory rose too far."""
    failed, before = False, 0.0
    with tempfile.TemporaryDirectory() as data:
        settings = {"LALALOC_DATA_DIR": data, "LALALOC_LOG_LEVEL": "error"}
        with running_service(0, settings) as service:
            plan_id = upload_example_plan(service.url)
            print("| upload | bytes sent | answer | seconds | memory |\n|---|---|---|---|---|", flush=True)
            for name, send in _bombs(service.url, plan_id):
                watch = _Watch(service.process.pid)
                before = before or watch.before
                begin = time.perf_counter()
                sent, outcome = send()
                seconds, risen = time.perf_counter() - begin, watch.end()
                expected = outcome.status == 200 if name in _ANSWERED else 400 <= outcome.status < 500
                most = _MAX_DECODING_MB if name in _ANSWERED else _MAX_MB
                failed |= not expected or risen > most or sent > _MAX_SENT
                answer = f"{outcome.status} {outcome.detail[:120]}".strip()
                print(f"| {name} | {sent:,} | {answer} | {seconds:.1f} | +{risen:.0f} MB |", flush=True)
            failed |= httpx.get(f"{service.url}/healthz").status_code != httpx.codes.OK
            left = resident_of_all(service.process.pid) - before
            failed |= left > _LEFT_MB
            print(f"\nAfter all of them, memory is {left:+.0f} MB of what it was before the first.")
    return int(failed)


def resident_of_all(pid: int) -> float:
    """Resident memory of a service and its workers in MB."""
    return sum(resident_mb(one) for one in (pid, *descendants(pid)))


class _Watch:
    """The highest resident memory of a service and its workers, against what it was."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self.before = self._highest = resident_of_all(self._pid)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def end(self) -> float:
        """By how many MB it rose at most."""
        self._end.set()
        self._thread.join()
        return self._highest - self.before

    def _run(self) -> None:
        while not self._end.wait(0.02):
            self._highest = max(self._highest, resident_of_all(self._pid))


def _bombs(url: str, plan_id: str) -> Iterator[tuple[str, Callable[[], tuple[int, Outcome]]]]:
    def panorama(content: bytes) -> Callable[[], tuple[int, Outcome]]:
        return lambda: (len(content), _posted(url, plan_id, content))

    def plan(content: bytes) -> Callable[[], tuple[int, Outcome]]:
        return lambda: (len(content), _posted_plan(url, content))

    yield "PNG of 60,000 x 30,000 pixels, all one colour", panorama(_png(60_000, 30_000, full=True))
    yield "PNG that says 2^31 x 2^30 pixels", panorama(_png(1 << 31, 1 << 30, full=False))
    yield "JPEG that says 65,500 x 32,750 pixels", panorama(_jpeg_saying(65_500, 32_750))
    yield "WebP of 16,383 x 8,191 pixels, all one colour", panorama(_webp(16_383, 8_191))
    yield _LARGEST, panorama(_encoded(14_140, 7_070, "PNG"))
    yield _ANIMATION, panorama(_animation(9_000))
    yield "PNG with 100 MB of compressed text", panorama(_png_with_text(100_000_000))
    yield "body of 1 GB, length stated", lambda: _gigabyte(url, stated=True)
    yield "body of 1 GB, in chunks", lambda: _gigabyte(url, stated=False)
    yield "body of one byte a second", lambda: _slow(url)
    ring = np.linspace(0.0, 2.0 * np.pi, 1_000_000, endpoint=False)
    corners = [[round(float(x), 2), round(float(y), 2)] for x, y in zip(np.cos(ring), np.sin(ring), strict=True)]
    rooms = {"ceiling_height_m": 2.5, "rooms": [{"polygon": corners}]}
    yield "plan of a million vertices", plan(json.dumps(rooms, separators=(",", ":")).encode())
    few = [[round(5 * float(np.cos(t)), 1), round(5 * float(np.sin(t)), 1)] for t in ring[::20]]
    rooms = {"ceiling_height_m": 2.5, "rooms": [{"polygon": few}]}
    yield "plan of 50,000 vertices", plan(json.dumps(rooms, separators=(",", ":")).encode())
    yield "JSON nested a million deep", plan(b"[" * 1_000_000)
    yield "JSON nested 900,000 deep, closed", plan(b"[" * 900_000 + b"]" * 900_000)
    yield "JSON number of a million digits", plan(b'{"ceiling_height_m": ' + b"9" * 1_000_000 + b"}")


def _posted(url: str, plan_id: str, content: bytes) -> Outcome:
    answer = httpx.post(
        f"{url}/localise", data={"floorplan_id": plan_id}, files={"panorama": ("p", content)}, timeout=_SLOW_S
    )
    return _told(answer)


def _posted_plan(url: str, content: bytes) -> Outcome:
    headers = {"Content-Type": "application/json"}
    return _told(httpx.post(f"{url}/floorplans", content=content, headers=headers, timeout=_SLOW_S))


def _told(answer: httpx.Response) -> Outcome:
    return Outcome(answer.status_code, str(answer.json().get("detail", "")))


def _png(width: int, height: int, *, full: bool) -> bytes:
    """A greyscale PNG whose pixels are nothing but zeros; without them where it is not to be full."""
    packer = zlib.compressobj(9)
    row = b"\0" * (width + 1)
    packed = b"".join(packer.compress(row) for _ in range(height)) + packer.flush() if full else packer.flush()
    head = struct.pack(">IIBBBBB", width & 0xFFFFFFFF, height & 0xFFFFFFFF, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", packed) + _chunk(b"IEND", b"")


def _png_with_text(size: int) -> bytes:
    text = b"Comment\0\0" + zlib.compress(b"a" * size, 9)
    plain = _encoded(256, 128, "PNG")
    # After the header, which is 8 + 25 bytes long.
    return plain[:33] + _chunk(b"zTXt", text) + plain[33:]


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def _jpeg_saying(width: int, height: int) -> bytes:
    """A small JPEG whose header was changed."""
    content = bytearray(_encoded(256, 128, "JPEG"))
    place = content.index(b"\xff\xc0") + 5
    content[place : place + 4] = struct.pack(">HH", height, width)
    return bytes(content)


def _webp(width: int, height: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (width, height)).save(buffer, "WEBP", lossless=True, method=0)
    return buffer.getvalue()


def _animation(frames: int) -> bytes:
    buffer = io.BytesIO()
    # Frames that are alike would be merged.
    shades = [Image.new("RGB", (128, 64), (k % 256, k // 256, 0)) for k in range(frames)]
    shades[0].save(buffer, "WEBP", save_all=True, append_images=shades[1:], duration=1, lossless=True, method=0)
    return buffer.getvalue()


def _encoded(width: int, height: int, name: str) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (width, height), (90, 90, 90)).save(buffer, name)
    return buffer.getvalue()


def _gigabyte(url: str, *, stated: bool) -> tuple[int, Outcome]:
    """A body of a gigabyte, sent for as long as the service takes it."""
    head = "Content-Length: 1073741824" if stated else "Transfer-Encoding: chunked"
    block = b"a" * (1 << 16)
    blocks = itertools.chain([_PART], itertools.repeat(block, _GIGABYTE // len(block)))
    return _raw(url, head, (part if stated else b"%x\r\n%s\r\n" % (len(part), part) for part in blocks))


def _slow(url: str) -> tuple[int, Outcome]:
    """A body that comes one byte a second."""

    def drops() -> Iterator[bytes]:
        yield _PART
        while True:
            time.sleep(1.0)
            yield b"a"

    return _raw(url, "Content-Length: 100000", drops())


def _raw(url: str, head: str, body: Iterator[bytes]) -> tuple[int, Outcome]:
    """Send a body bit by bit until there is an answer; gives the bytes sent and the answer."""
    host, _, port = url.removeprefix("http://").partition(":")
    sent, deadline = 0, time.monotonic() + _SLOW_S
    with socket.create_connection((host, int(port))) as connection:
        connection.settimeout(0.001)
        lines = ["POST /localise HTTP/1.1", f"Host: {host}", "Content-Type: multipart/form-data; boundary=b", head]
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        answer = b""
        for part in body:
            try:
                connection.settimeout(5.0)
                connection.sendall(part)
                sent += len(part)
                connection.settimeout(0.001)
                answer = connection.recv(1 << 16)
            except TimeoutError:
                if time.monotonic() < deadline:
                    continue
            except OSError:
                # The service hung up: its answer, if any, is read below.
                pass
            break
        connection.settimeout(5.0)
        while not answer.rpartition(b"}")[1]:
            try:
                more = connection.recv(1 << 16)
            except OSError:
                break
            if not more:
                break
            answer += more
    status = int(answer.split(b" ", 2)[1]) if answer.startswith(b"HTTP/") else 0
    text = answer.partition(b"\r\n\r\n")[2]
    detail = json.loads(text)["detail"] if text.startswith(b"{") else "the connection was closed"
    return sent, Outcome(status, detail)


if __name__ == "__main__":
    sys.exit(main())
