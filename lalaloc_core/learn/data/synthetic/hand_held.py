"""Films of a phone that is turned by hand: uneven speed, shake, rolling shutter, blur and changes of exposure."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.learn.data.views import cut_view, tilt_by_hand
from lalaloc_core.photograph.cameras import Perspective

# Length of a film and its rate; times (s) of the rolling shutter, from the first row to the last, and of an exposure.
FILM_S, _RATE = 8.0, 10.0
_READOUT_S, _EXPOSURE_S = 0.02, 0.015
# Spreads: of the speed (as a share), of slow sway and of fast tremor (radians), and of the log exposure.
_SPEED, _SWAY, _TREMOR, _EXPOSURES = 0.2, math.radians(2.0), math.radians(0.25), 0.25
# Frequencies (Hz) of sway, which speed and exposure share, and of tremor.
_SLOW_HZ, _FAST_HZ = (0.1, 0.7), (3.0, 8.0)
_WAVES = 6


class Instant(NamedTuple):
    """Camera at the time of a frame.

    Attributes:
        time_s: since the first frame.
        turn: heading minus that of the first frame, radians.
        rate: turn per second.
        pitch, roll: tilt, radians.
        gain: exposure over the usual one.
    """

    time_s: float
    turn: float
    rate: float
    pitch: float
    roll: float
    gain: float


def turn_by_hand(rng: np.random.Generator) -> list[Instant]:
    """Draw the motion of a film of one turn."""
    time_s = np.arange(round(FILM_S * _RATE) + 1) / _RATE
    speed = np.maximum(1.0 + _waves(time_s, _SPEED, _SLOW_HZ, rng), 0.3)
    turn = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])
    turn = turn * (TWO_PI / turn[-1]) + _waves(time_s, _TREMOR, _FAST_HZ, rng)
    turn -= turn[0]
    pitch, roll = tilt_by_hand(rng)
    tilt = [
        mean + share * (_waves(time_s, _SWAY, _SLOW_HZ, rng) + _waves(time_s, _TREMOR, _FAST_HZ, rng))
        for mean, share in ((0.5 * pitch, 1.0), (0.5 * roll, 0.5))
    ]
    gain = np.exp(_waves(time_s, _EXPOSURES, _SLOW_HZ, rng))
    rate = np.gradient(turn, time_s)
    return [Instant(*map(float, values)) for values in zip(time_s, turn, rate, *tilt, gain, strict=True)]


def _waves(
    time_s: Float[np.ndarray, "n"], spread: float, hertz: tuple[float, float], rng: np.random.Generator
) -> Float[np.ndarray, "n"]:
    """Return a sum of waves of random frequencies and phases, with a standard deviation of `spread`."""
    phase = TWO_PI * (rng.uniform(*hertz, _WAVES)[:, None] * time_s + rng.random((_WAVES, 1)))
    return spread * math.sqrt(2.0 / _WAVES) * np.sin(phase).sum(axis=0)


def exposed(
    sphere: UInt8[np.ndarray, "h w 3"], camera: Perspective, instant: Instant, *, azimuth: float
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Return the frame of an instant whose camera looks along an azimuth (radians) of a sphere."""
    rows = (np.arange(camera.height) + 0.5) / camera.height - 0.5
    skewed = azimuth + instant.rate * _READOUT_S * rows[:, None]
    picture = cut_view(sphere, camera, azimuth=skewed, pitch=instant.pitch, roll=instant.roll)
    blur = max(round(abs(instant.rate) * _EXPOSURE_S * camera.fx), 1)
    picture = cv2.blur(picture, (blur, 1)).astype(np.float32) * instant.gain
    return np.clip(np.rint(picture), 0.0, 255.0).astype(np.uint8)


def encode_film(frames: Iterable[UInt8[np.ndarray, "h w 3"]]) -> bytes:
    """Return frames as a WebM file (VP8, which OpenCV's wheels can write)."""
    with tempfile.TemporaryDirectory(prefix="lalaloc-film-") as folder:
        path, writer = Path(folder) / "turn.webm", cv2.VideoWriter()
        for frame in frames:
            if not writer.isOpened():
                height, width = frame.shape[:2]
                writer.open(str(path), cv2.VideoWriter.fourcc(*"VP80"), _RATE, (width, height))
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        writer.release()
        return path.read_bytes()
