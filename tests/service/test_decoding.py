"""Decoding of spheres in processes that can die."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.process import BaseProcess
from pathlib import Path

import httpx
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from sqlalchemy import select

from service.decoding import decoder as decoding
from service.storage.database import Database
from service.storage.tables import METADATA
from service.telemetry import LOGGER_NAME
from tests.painted import picture_file, png_file
from tests.service.conftest import DatabaseOf, StartApp, assert_problem, localise, metric, upload, wait_for
from tests.strategies import present

pytestmark = pytest.mark.one_replica

MIB = 2**20
RESTARTS = 'lalaloc_pool_restarts_total{pool="decode"}'
QUICK = {"refine": "none", "top_k": 1}
# Black pictures do not look like spheres.
BLACK = QUICK | {"projection": "equirectangular"}


def decoders() -> list[BaseProcess]:
    return [child for child in multiprocessing.active_children() if child.name.startswith("lalaloc-decode")]


def decoder() -> int:
    """Return the process id of the only decoding worker."""
    wait_for(lambda: len(decoders()) == 1 and decoders()[0].pid is not None)
    return present(decoders()[0].pid)


def most_memory(pid: int) -> int:
    """Return the peak resident memory (bytes) of a process."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    return 1024 * int(line.split()[1])


def ready(client: httpx.Client) -> None:
    wait_for(lambda: client.get("/readyz").json()["decode_pool"]["ready"] == 1)


def black_png(width: int, height: int) -> bytes:
    """Return a PNG of zeros, a thousandth of the size of its pixels."""
    packer = zlib.compressobj(9)
    rows = bytes(1 + 3 * width)
    data = b"".join([packer.compress(rows) for _ in range(height)]) + packer.flush()
    return png_file(width, height, data)


def black(width: int, height: int, kind: str, **options: object) -> bytes:
    return picture_file(Image.new("RGB", (width, height)), kind, **options)


@pytest.mark.slow
def test_query_survives_a_killed_decoder(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path) as client:
        plan_id = upload(client)
        for _ in range(3):
            ready(client)
            os.kill(decoder(), signal.SIGKILL)
            assert localise(client, plan_id, sphere, **QUICK).status_code == 200
        assert metric(client, RESTARTS) == 3.0
    assert decoders() == [], "the pool left a process behind"


@pytest.mark.slow
def test_stalling_picture_is_rejected(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    slow = black_png(10_000, 5_000)
    with start_app(tmp_path, decode_stall_s=0.2) as client:
        plan_id = upload(client)
        ready(client)
        problem = assert_problem(localise(client, plan_id, slow, **BLACK), 422, "invalid-photograph")
        assert "more than 0.2 s of CPU time (decode_stall_s)" in problem["detail"]
        wait_for(lambda: metric(client, RESTARTS) == 1.0)
        ready(client)
        assert_problem(localise(client, plan_id, slow, **BLACK), 422, "invalid-photograph")
        wait_for(lambda: metric(client, RESTARTS) == 2.0)
        assert localise(client, plan_id, sphere, **QUICK).status_code == 200


def test_full_decode_queue_rejects_at_once(
    start_app: StartApp, tmp_path: Path, sphere: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decoding, "_QUEUE", 1)
    # With few cores, the others would wait for a permit to compute instead.
    with start_app(tmp_path, decode_stall_s=600.0, compute_threads=4) as client, ThreadPoolExecutor(4) as threads:
        plan_id = upload(client)
        ready(client)
        os.kill(decoder(), signal.SIGSTOP)
        pictures = [sphere + bytes([i]) for i in range(4)]
        answers = [threads.submit(localise, client, plan_id, picture, **QUICK) for picture in pictures]
        wait_for(lambda: sum(answer.done() for answer in answers) >= 2)
        os.kill(decoder(), signal.SIGCONT)
        statuses = sorted(answer.result().status_code for answer in answers)
        # On a busy machine the first can still be in the queue when the others come.
        assert statuses in ([200, 200, 503, 503], [200, 503, 503, 503])
        refused = next(answer.result() for answer in answers if answer.result().status_code == 503)
        assert_problem(refused, 503, "overloaded")
        assert "retry-after" in refused.headers


class TestBombs:
    """Small files with many pixels; memory is measured in the decoder's process."""

    CAP = 96 * MIB
    # Pages that were mapped before the limit, but not yet resident. Without a limit the pictures take at least 140 MiB.
    MAPPED = 16 * MIB

    def test_memory_limit_rejects_the_pictures_only(self, start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
        webp, jpeg = {"lossless": True, "method": 0}, {"progressive": True, "subsampling": 0}
        bombs = [black_png(7_000, 3_500), black(7_000, 3_500, "WEBP", **webp), black(7_000, 3_500, "JPEG", **jpeg)]
        with start_app(tmp_path, decode_memory_bytes=self.CAP) as client:
            plan_id = upload(client)
            ready(client)
            pid, before = decoder(), most_memory(decoder())
            for bomb in bombs:
                assert len(bomb) < MIB
                assert_problem(localise(client, plan_id, bomb, **BLACK), 422, "invalid-photograph")
                assert localise(client, plan_id, sphere, **QUICK).status_code == 200
                assert decoder() == pid, "it did not have to die for that"
                assert most_memory(pid) < before + self.CAP + self.MAPPED

    def test_pixel_limit_is_checked_on_the_header(self, start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
        bombs = {kind: black(4_000, 2_000, kind) for kind in ("PNG", "WEBP", "JPEG")}
        with start_app(tmp_path, max_pixels=1_000_000) as client:
            plan_id = upload(client)
            assert localise(client, plan_id, sphere, **QUICK).status_code == 200
            before = most_memory(decoder())
            for kind, bomb in bombs.items():
                problem = assert_problem(localise(client, plan_id, bomb, **QUICK), 422, "invalid-photograph")
                assert "4000 x 2000 = 8000000 pixels; the limit is 1000000 (max_pixels)" in problem["detail"], kind
            assert most_memory(decoder()) < before + 12 * MIB

    def test_large_sphere_needs_little_memory(self, start_app: StartApp, tmp_path: Path) -> None:
        with start_app(tmp_path, decode_memory_bytes=64 * MIB) as client:
            assert localise(client, upload(client), black(10_000, 5_000, "JPEG"), **BLACK).status_code == 200


def test_gps_metadata_is_neither_stored_nor_logged(
    start_app: StartApp,
    database_of: DatabaseOf,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8825).update({1: "N", 2: tuple(IFDRational(n, 9973) for n in (479_111, 81_003, 7_177))})
    exif[0x010E] = "at home, Ringelnatterweg 7"
    picture, portrait = black(512, 256, "JPEG", exif=exif), black(256, 512, "JPEG", exif=exif)
    with start_app(tmp_path, log_level="debug") as client:
        # After the start of the app, which configures logging.
        monkeypatch.setattr(logging.getLogger(LOGGER_NAME), "propagate", True)
        plan_id = upload(client)
        assert localise(client, plan_id, picture, **BLACK).status_code == 200
        assert localise(client, plan_id, portrait, **QUICK).status_code == 422
    assert any("localise" in str(vars(record)) for record in caplog.records)
    assert b"Ringelnatterweg" in picture
    logged = "".join(str(vars(record)) for record in caplog.records).encode()
    stored = b"".join(file.read_bytes() for file in tmp_path.rglob("*") if file.is_file())
    with Database(database_of(tmp_path)).reading() as connection:
        rows = [row for table in METADATA.sorted_tables for row in connection.execute(select(table))]
    stored += b"".join(value if isinstance(value, bytes) else str(value).encode() for row in rows for value in row)
    assert b"kitchen" in stored
    for trace in (b"Ringelnatterweg", b"479111", struct.pack(">II", 479_111, 9973)):
        assert trace not in stored + logged
