"""Films of a turn on one spot, cut from an example sphere and encoded by Debian's FFmpeg."""

from __future__ import annotations

import math
import shutil
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from lalaloc_core.photograph.cameras import Perspective
from tests.core.taken import sphere, take

needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs FFmpeg: apt-get install ffmpeg")
PHONE = Perspective.of_hfov(270, 480, math.radians(53.0))
RATE, STEP_DEG = 10, 6.0
H264 = ("-c:v", "libx264", "-preset", "ultrafast")
HEVC = ("-c:v", "libx265", "-preset", "ultrafast", "-x265-params", "log-level=error:pools=1", "-tag:v", "hvc1")
VP9 = ("-c:v", "libvpx-vp9", "-deadline", "realtime", "-cpu-used", "8")


@cache
def turn(count: int = 61, step_deg: float = STEP_DEG) -> tuple[np.ndarray, ...]:
    """Return frames once around, or further, with nods of a hand."""
    room = sphere("living_room")
    nods = 2.0 * np.sin(np.arange(count) / 9.0)
    return tuple(
        take(room, PHONE, heading_deg=step_deg * index, pitch_deg=float(nod)) for index, nod in enumerate(nods)
    )


def encode(frames: Sequence[np.ndarray], path: Path, *options: str) -> bytes:
    """Return frames as a film; options are FFmpeg's, by default for H.264."""
    height, width = frames[0].shape[:2]
    source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(RATE), "-i", "-")
    content = b"".join(frame.tobytes() for frame in frames)
    run(*source, *(options or H264), "-pix_fmt", "yuv420p", "-threads", "1", str(path), content=content)
    return path.read_bytes()


def run(*arguments: str, content: bytes | None = None) -> None:
    subprocess.run(["ffmpeg", "-v", "error", "-y", *arguments], input=content, check=True, timeout=120)
