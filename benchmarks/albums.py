"""Albums over HTTP: seconds from the first byte of a folder until its last pin, and the memory that the service needs.

    python -m benchmarks.albums                                           # 50 photographs of 12 megapixels
    python -m benchmarks.albums --photographs 500 --pixels 640x480
    python -m benchmarks.albums --photographs 500 --pixels 640x480 --plans 100
    python -m benchmarks.albums --command                                 # by `lalaloc pin`, with all its files

Photographs of 70 degrees are cut from the example spheres at random headings, with times of a walk, before the time
begins. `--plans` pins them to a venue of so many copies of the example flat, each stretched differently. Seconds depend
on the other load of the machine, so that CPU seconds are printed beside them.
"""

from __future__ import annotations

import json
import math
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
from PIL import Image

from benchmarks import harness
from examples.launch import ROOT
from examples.truth import PLAN_PATH
from lalaloc_core.photograph.cameras import Perspective
from tests.core.taken import jpeg, sphere, take

_ROOMS = ("living_room", "kitchen", "bedroom", "study")
_HFOV = math.radians(70.0)
_WIDTH = 640
_PORTION_BYTES, _PORTION = 60_000_000, 50
_STRETCH = 0.004
_TIMEOUT_S = 3600.0


def main() -> int:
    """Measure and print a table."""
    parser = harness.argument_parser(__doc__)
    parser.add_argument("--photographs", type=int, default=50, help="photographs of the folder (default: %(default)s)")
    parser.add_argument("--pixels", default="4000x3000", help="size of each (default: %(default)s)")
    parser.add_argument("--plans", type=int, default=1, help="plans of the venue (default: one plan, no venue)")
    parser.add_argument("--command", action="store_true", help="measure `lalaloc pin` instead of the service")
    options = parser.parse_args()
    width, height = map(int, options.pixels.split("x"))
    with tempfile.TemporaryDirectory() as data:
        folder = Path(data) / "visit"
        folder.mkdir()
        for number, content in enumerate(_photographs(options.photographs, width, height)):
            (folder / f"{number:03}.jpg").write_bytes(content)
        measure = _command if options.command else _service
        row = measure(Path(data), sorted(folder.iterdir()), options.plans)
    harness.print_table_head(
        "photographs", "pixels", "plans", "read s", "all pins s", "correction s", "CPU s", "MB", "pins"
    )
    print(harness.table_row(options.photographs, options.pixels, options.plans, *row))
    return 0


def _photographs(count: int, width: int, height: int) -> Any:
    rng = random.Random(0)
    # The spheres have no more detail than this.
    camera = Perspective.of_hfov(_WIDTH, _WIDTH * height // width, _HFOV)
    for number in range(count):
        room = _ROOMS[number * len(_ROOMS) // count]
        pixels = take(sphere(room), camera, heading_deg=rng.uniform(0.0, 360.0))
        pixels = np.asarray(Image.fromarray(pixels).resize((width, height)))
        minutes, seconds = divmod(7 * number, 60)
        taken = {0x9003: f"2026:05:01 {10 + minutes // 60:02}:{minutes % 60:02}:{seconds:02}"}
        yield jpeg(pixels, taken, maker="Maker", model="Model")


def _service(data: Path, files: list[Path], plans: int) -> tuple[object, ...]:
    """Return seconds until all are read, and pinned, and solved after a correction; CPU seconds, memory and pins."""
    with (
        harness.example_service(harness.UNLIMITED) as service,
        httpx.Client(base_url=service.url, timeout=600.0) as client,
    ):
        place = {"floorplan_id": service.plan_id} if plans == 1 else {"venue_id": _venue(client, plans)}
        album = f"/albums/{client.post('/albums', json=place).raise_for_status().json()['id']}"
        before_s, begin_s = harness.cpu_s(service.process), time.monotonic()
        with harness.MemoryWatch(service.process) as memory:
            left = files
            while left:
                left = [path for portion in _portions(left) for path in _send(client, album, portion)]
            read_s = time.monotonic() - begin_s
            _wait(client, album)
            pinned_s, spent_s = time.monotonic() - begin_s, harness.cpu_s(service.process) - before_s
        solved = client.get(album).json()
        (first,) = client.get(f"{album}/photographs", params={"limit": 1}).json()["photographs"]
        begin_s = time.monotonic()
        client.patch(f"{album}/photographs/{first['id']}", json={"correction": {"elsewhere": True}}).raise_for_status()
        _wait(client, album)
        corrected_s = time.monotonic() - begin_s
    counts = solved["solution"]["pins"] if solved["solution"] else {solved["reason"]: solved["photographs"]}
    return (*_seconds(read_s, pinned_s, corrected_s, spent_s), f"{memory.highest:.0f}", _words(counts))


def _send(client: httpx.Client, album: str, files: list[Path]) -> list[Path]:
    """Add photographs; return those that the service is too busy for, to be sent again."""
    parts = [("photo", (path.name, path.read_bytes(), "image/jpeg")) for path in files]
    answer = client.post(f"{album}/photographs", files=parts).raise_for_status()
    lines = [json.loads(line) for line in answer.text.splitlines()]
    refused = [line["problem"] for line in lines if line["status"] >= 400 and line["status"] not in (503, 504)]
    assert not refused, refused[0]
    busy = [files[line["index"]] for line in lines if line["status"] >= 400]
    if busy:
        print(f"busy: {len(busy)} photographs are sent again", file=sys.stderr)
    return busy


def _command(data: Path, files: list[Path], _plans: int) -> tuple[object, ...]:
    """Return the same of the command line, which has no correction."""
    program = "import sys; from lalaloc_core.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, "pin", str(PLAN_PATH), str(files[0].parent), "--out", str(data / "out")]
    begin_s = time.monotonic()
    process = psutil.Popen(command, stdout=subprocess.PIPE, cwd=ROOT, text=True)
    with harness.MemoryWatch(process) as memory:
        assert process.stdout is not None
        printed = process.stdout.read()
        spent = process.cpu_times()
        assert process.wait() == 0
    pinned_s = time.monotonic() - begin_s
    summary = printed.splitlines()[-1].partition(";")[0]
    row = _seconds(pinned_s, spent.user + spent.system)
    return "–", row[0], "–", row[1], f"{memory.highest:.0f}", summary


def _venue(client: httpx.Client, plans: int) -> str:
    plan = httpx.Response(200, content=PLAN_PATH.read_bytes()).json()
    ids = []
    for number in range(plans):
        factor = 1.0 + _STRETCH * number
        scaled = plan | {
            "name": f"Flat {number}",
            "rooms": [room | {"polygon": [[factor * x, y] for x, y in room["polygon"]]} for room in plan["rooms"]],
            "openings": [row | {"line": [[factor * x, y] for x, y in row["line"]]} for row in plan["openings"]],
        }
        scaled.pop("fixtures", None)
        ids.append(client.post("/floorplans", json=scaled).raise_for_status().json()["id"])
    entries = [{"floorplan_id": plan_id, "level": number} for number, plan_id in enumerate(ids)]
    venue = client.post("/venues", json={"name": "Street", "plans": entries}).raise_for_status().json()["id"]
    harness.wait_until(lambda: client.get("/readyz").json()["plans_preparing"] == 0, "all plans are ready", _TIMEOUT_S)
    return venue


def _portions(files: list[Path]) -> Any:
    portion, size = list[Path](), 0
    for path in files:
        if portion and (len(portion) == _PORTION or size + path.stat().st_size > _PORTION_BYTES):
            yield portion
            portion, size = [], 0
        portion.append(path)
        size += path.stat().st_size
    yield portion


def _wait(client: httpx.Client, album: str) -> None:
    harness.wait_until(lambda: client.get(album).json()["state"] != "solving", "the album is solved", _TIMEOUT_S)


def _seconds(*values: float) -> tuple[str, ...]:
    return tuple(f"{value:.1f}" for value in values)


def _words(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {state}" for state, count in Counter(counts).items() if count)


if __name__ == "__main__":
    sys.exit(main())
