"""Inputs of the comparison of two checkouts: photographs, a film and plans, made of the example flat or generated."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from examples.truth import PLAN_PATH, read_poses
from lalaloc_core.evaluate.bench.service_latency import PHONE_FIELD_DEG, phone_photograph
from lalaloc_core.learn.data.views import cut_view, encode_jpeg
from lalaloc_core.learn.synth.homes.buildings import building_of
from lalaloc_core.learn.synth.homes.plans import VALIDATION
from lalaloc_core.photograph.cameras import Perspective
from lalaloc_core.photograph.photograph import open_picture

_TURN, _FIELD_DEG = 12, 53.0
# Frames of the film as they are drawn, at half of its size; FFmpeg repeats and enlarges them to 30 a second in 1080p.
_FRAMES, _FRAMES_PER_S = 100, 10
_OFFICE_M2 = 2000.0


def _sphere() -> np.ndarray:
    (living_room,) = (pose for pose in read_poses() if pose.file == "living_room.jpg")
    return open_picture(living_room.picture.read_bytes(), max_size=(1024, 512))


@cache
def photograph() -> tuple[bytes, dict[str, str]]:
    """Return a photograph of 12 megapixels, and the fields of its query."""
    return phone_photograph(_sphere()), {"hfov_deg": f"{PHONE_FIELD_DEG:g}"}


@cache
def turn() -> list[bytes]:
    """Return twelve photographs of a turn, of 1440 x 1080 pixels."""
    camera, sphere = Perspective.of_hfov(1080, 1440, math.radians(_FIELD_DEG)), _sphere()
    angles = 2.0 * math.pi * np.arange(_TURN) / _TURN
    return [encode_jpeg(cut_view(sphere, camera, azimuth=float(a), pitch=0.0, roll=0.0)) for a in angles]


def can_film() -> bool:
    """Return whether FFmpeg is installed."""
    return shutil.which("ffmpeg") is not None


@cache
def film() -> bytes:
    """Return a film of 10 s in 1080p of a turn once around; needs FFmpeg (`can_film`)."""
    camera, sphere = Perspective.of_hfov(540, 960, math.radians(_FIELD_DEG)), _sphere()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "turn.mp4"
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", "540x960", "-r", f"{_FRAMES_PER_S}", "-i", "-"]
        coded = [
            "-vf",
            "fps=30,scale=1080:1920",
            "-c:v",
            "libx264",
            "-preset",
            "ultrafast",
            "-pix_fmt",
            "yuv420p",
            "-threads",
            "1",
        ]
        command = ["ffmpeg", "-v", "error", "-y", *source, *coded, str(path)]
        with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
            assert process.stdin is not None
            for index in range(_FRAMES):
                azimuth = 2.0 * math.pi * index / _FRAMES
                process.stdin.write(cut_view(sphere, camera, azimuth=azimuth, pitch=0.0, roll=0.0).tobytes())
            process.stdin.close()
        return path.read_bytes()


@cache
def plan(name: str) -> bytes:
    """Return the example flat, or a generated office of 2,000 m²."""
    if name == "flat":
        return PLAN_PATH.read_bytes()
    return json.dumps(building_of(VALIDATION, 3, _OFFICE_M2).plan.to_dict()).encode()
