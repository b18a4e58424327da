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
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from jaxtyping import UInt8

from lalaloc_core.evaluate.bench.measured import Setting
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic.altered_homes import without_openings
from lalaloc_core.learn.data.synthetic.generated import RendererCache
from lalaloc_core.learn.data.views import cut_view, encode_jpeg
from lalaloc_core.learn.synth.homes.plans import TEST, home_of
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots
from lalaloc_core.photograph.cameras import Perspective

_REQUESTS = 40
_STARTUP_SECONDS = 60.0
_SMALL_PROCESS_MB = 50.0
# Width and height (pixels) and horizontal field of view (degrees) of a phone's photographs, and how many are made.
_PHONE_SIZE, PHONE_FIELD_DEG, _PHONE_PHOTOGRAPHS = (4032, 3024), 80.0, 4


def bench_service(setting: Setting) -> dict[str, Any]:
    """Measure the latency of `POST /localise` from one client, and the memory of the service's processes."""
    shots, images = _spheres(setting.textures)
    plan, pictures = shots[0].home.plan, [encode_jpeg(image) for image in images]
    heights = [{"camera_height_m": f"{plan.camera_height_m}"}] * _REQUESTS
    # Stated, because a plain sphere of procedural materials can look like none.
    spheres = [{**height, "projection": "equirectangular"} for height in heights]
    known = [
        {**sphere, "heading_deg": f"{np.degrees(shot.heading):.3f}"}
        for sphere, shot in zip(spheres, shots, strict=True)
    ]
    rows = {
        "known_heading": list(zip(pictures, known, strict=True)),
        "unknown_heading": list(zip(pictures, spheres, strict=True)),
    }
    rows["without_openings"] = rows["unknown_heading"]
    if setting.bundle.manifest.view is not None:
        views = [phone_photograph(image) for image in images[:_PHONE_PHOTOGRAPHS]]
        lens = {"hfov_deg": f"{PHONE_FIELD_DEG:g}"}
        rows["phone"] = [(views[k % len(views)], {**height, **lens}) for k, height in enumerate(heights)]
    with running_service(setting.bundle.folder) as (client, process):
        plan_id, bare_id = _upload(client, plan), _upload(client, without_openings(plan))
        report: dict[str, Any] = {"requests": _REQUESTS, "sphere": "1024x512 JPEG"}
        for name, requests in rows.items():
            report[name] = _latency(client, bare_id if name == "without_openings" else plan_id, requests)
        report["service_resident_mb"] = _resident_mb(process.pid)
        # The smaller child is Python's resource tracker.
        report["workers_resident_mb"] = [size for size in _children_mb(process.pid) if size > _SMALL_PROCESS_MB]
    return report


def _spheres(textures: Path | None) -> tuple[list[Shot], UInt8[np.ndarray, "n h w 3"]]:
    """Return shots of the furnished test home closest to 100 m², of the first hundred, and their spheres."""
    homes = (home_of(TEST, 0, index)[0] for index in range(100))
    home = min(homes, key=lambda home: abs(home.plan.area_m2 - 100.0))
    shots = sample_shots(home, _REQUESTS, np.random.default_rng(1), "full")
    renderers = RendererCache(MaterialLibrary.create(np.random.default_rng(1), textures))
    return shots, renderers.renderer(512, 1024).render(shots).cpu().numpy()


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
    settings = {"LALALOC_BUNDLE": str(bundle_folder.resolve()), "LALALOC_LOG_LEVEL": "warning"}
    with tempfile.TemporaryDirectory(prefix="lalaloc-bench-") as data:
        process = subprocess.Popen(command, env={**os.environ, **settings, "LALALOC_DATA_DIR": data})
        try:
            with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60.0) as client:
                _wait_until(lambda: client.get("/readyz").status_code == 200, "the service is ready")
                yield client, process
        finally:
            process.terminate()
            process.wait(timeout=30)


def _resident_mb(pid: int) -> float:
    """Return the resident memory (MB) of a process (Linux)."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024.0


def _children_mb(pid: int) -> list[float]:
    """Return the resident memory (MB) of the direct children of a process (Linux)."""
    listings = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    return [_resident_mb(int(child)) for listing in listings for child in listing.split()]


def _upload(client: httpx.Client, plan: FloorPlan) -> str:
    plan_id: str = client.post("/floorplans", json=plan.to_dict()).raise_for_status().json()["id"]
    _wait_until(lambda: client.get(f"/floorplans/{plan_id}").json()["status"] == "ready", "the plan is ready")
    return plan_id


def _wait_until(is_true: Callable[[], bool], condition: str) -> None:
    deadline = time.monotonic() + _STARTUP_SECONDS
    while time.monotonic() < deadline:
        with suppress(httpx.TransportError):
            if is_true():
                return
        time.sleep(0.1)
    raise TimeoutError(f"it does not hold after {_STARTUP_SECONDS:g} s that {condition}")
