"""Latency of the running service over HTTP, and its memory."""

from __future__ import annotations

import math
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from lalaloc_core.evaluate.bench.measured import Setting
from lalaloc_core.evaluate.bench.speed import home_of_area
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic.foreign import without_openings
from lalaloc_core.learn.data.views import cut_view, encode_jpeg
from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.photograph.cameras import Perspective

_REQUESTS = 40
_STARTUP_SECONDS = 60.0
_SMALL_PROCESS_MB = 50.0
# Width and height (pixels) and horizontal field of view (degrees) of a phone's photographs, and how many are made.
_PHONE_SIZE, PHONE_FIELD_DEG, _PHONE_PHOTOGRAPHS = (4032, 3024), 80.0, 4


def bench_service(setting: Setting) -> dict[str, Any]:
    """Measure the latency of `POST /localise` from one client, and the memory of the service's processes."""
    home = home_of_area(100.0)
    shots = sample_shots(home, _REQUESTS, np.random.default_rng(1), "full")
    materials = MaterialLibrary.create(np.random.default_rng(1), setting.textures)
    images = SphereRenderer(materials, height=512, width=1024).render(shots).numpy()
    pictures = [encode_jpeg(image) for image in images]
    with running_service(setting.bundle.folder) as (client, process):
        plan_id, bare_id = _upload(client, home.plan), _upload(client, without_openings(home.plan))
        report: dict[str, Any] = {"requests": _REQUESTS, "sphere": "1024x512 JPEG"}
        heights = [{"camera_height_m": f"{shot.home.plan.camera_height_m}"} for shot in shots]
        headings = [{"heading_deg": f"{np.degrees(shot.heading):.3f}"} for shot in shots]
        rows = {
            "known_heading": [
                (file, {**height, **heading}) for file, height, heading in zip(pictures, heights, headings, strict=True)
            ],
            "unknown_heading": list(zip(pictures, heights, strict=True)),
        }
        rows["without_openings"] = rows["unknown_heading"]
        if setting.bundle.manifest.view is not None:
            views = [phone_photograph(image) for image in images[:_PHONE_PHOTOGRAPHS]]
            lens = {"hfov_deg": f"{PHONE_FIELD_DEG:g}"}
            rows["phone"] = [(views[k % len(views)], {**height, **lens}) for k, height in enumerate(heights)]
        for name, requests in rows.items():
            report[name] = _latency(client, bare_id if name == "without_openings" else plan_id, requests)
        report["service_resident_mb"] = resident_mb(process.pid)
        sizes = [resident_mb(pid) for pid in children_of(process.pid)]
        # The smaller child is Python's resource tracker.
        report["workers_resident_mb"] = [size for size in sizes if size > _SMALL_PROCESS_MB]
    return report


def _latency(client: httpx.Client, plan_id: str, requests: list[tuple[bytes, dict[str, str]]]) -> dict[str, Any]:
    """Send photographs with their fields one after another; the first is sent twice, as a warm-up."""
    responses = []
    for index, (photograph, fields) in enumerate([requests[0], *requests]):
        begin = time.perf_counter()
        data, files = {"floorplan_id": plan_id, **fields}, {"photo": ("p.jpg", photograph, "image/jpeg")}
        response = client.post("/localise", data=data, files=files).raise_for_status()
        if index:
            responses.append(((time.perf_counter() - begin) * 1e3, response.json()))
    times = [milliseconds for milliseconds, _ in responses]
    return {
        "p50_ms": statistics.median(times),
        "p95_ms": float(np.quantile(times, 0.95)),
        "stages": sorted({answer["stage"] for _, answer in responses}),
        "median_stage_ms": {
            stage: statistics.median(answer["timings_ms"][stage] for _, answer in responses)
            for stage in responses[0][1]["timings_ms"]
        },
    }


def phone_photograph(sphere: np.ndarray) -> bytes:
    """Return a part of a sphere as a JPEG of 12 megapixels, with the noise that makes such files 4 MB."""
    camera = Perspective.of_hfov(*_PHONE_SIZE, math.radians(PHONE_FIELD_DEG))
    view = cut_view(sphere, camera, azimuth=0.0, pitch=0.0, roll=0.0)
    noise = np.random.default_rng(0).normal(0.0, 4.0, view.shape)
    return encode_jpeg((view + noise).clip(0.0, 255.0).astype(np.uint8))


@contextmanager
def running_service(bundle_folder: Path) -> Iterator[tuple[httpx.Client, subprocess.Popen[bytes]]]:
    """Run the production service on a free port with a temporary data folder."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "uvicorn", "service.app:app", "--port", str(port), "--log-level", "warning"]
    with tempfile.TemporaryDirectory(prefix="lalaloc-bench-") as data:
        environment = {**os.environ, "LALALOC_DATA_DIR": data, "LALALOC_BUNDLE": str(bundle_folder.resolve())}
        environment["LALALOC_LOG_LEVEL"] = "warning"
        process = subprocess.Popen(command, env=environment)
        try:
            with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60.0) as client:
                _wait_until(lambda: _is_ready(client), f"the service is not ready after {_STARTUP_SECONDS:g} s")
                yield client, process
        finally:
            process.terminate()
            process.wait(timeout=30)


def resident_mb(pid: int) -> float:
    """Return the resident memory (MB) of a process (Linux)."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024.0
    return float("nan")


def children_of(pid: int) -> list[int]:
    """Return the ids of the direct children of a process (Linux)."""
    listings = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    return [int(child) for listing in listings for child in listing.split()]


def _upload(client: httpx.Client, plan: FloorPlan) -> str:
    response = client.post("/floorplans", json=plan.to_dict())
    plan_id = response.raise_for_status().json()["id"]
    _wait_until(
        lambda: client.get(f"/floorplans/{plan_id}").json()["status"] == "ready",
        f"the plan is not ready after {_STARTUP_SECONDS:g} s",
    )
    return plan_id


def _is_ready(client: httpx.Client) -> bool:
    try:
        return client.get("/readyz").status_code == 200
    except httpx.TransportError:
        return False


def _wait_until(condition: Callable[[], bool], message: str) -> None:
    deadline = time.monotonic() + _STARTUP_SECONDS
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(message)
        time.sleep(0.1)
