"""Drawing the settings of the camera: exposure, colour, lenses, stitching, what hides its stand, compression."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

# Columns of an exposure row.
TARGET, RED_GAIN, BLUE_GAIN, CONTRAST, SATURATION, NOISE, BLUR, NADIR, NADIR_TONE, NOISE_SEED, SHOULDER, TINT = range(
    12
)
# How far the range of brightness is compressed; darkening towards the rims of the two lenses; azimuth of the seam
# between them relative to the picture's centre, the step in brightness and the shift in elevation across it.
FLAT, VIGNETTE, SEAM, SEAM_STEP, SEAM_SHIFT = range(12, 17)
# Tilt about the axis ahead and about the axis to the right (radians); quality of JPEG compression, 0 for none.
ROLL, PITCH, JPEG = range(17, 20)
# What covers the nadir and how it is turned; radius (radians) and tone of what covers the zenith.
NADIR_KIND, NADIR_TURN, ZENITH, ZENITH_TONE = range(20, 24)
EXPOSURE_COLUMNS = 24

DISC, BLURRED, LOGO, MIRROR_BALL, TRIPOD, PERSON = range(6)
_NADIR_SHARES = (0.4, 0.15, 0.15, 0.08, 0.12, 0.1)
_NADIR_REACH_DEG = {TRIPOD: (25.0, 55.0), PERSON: (35.0, 65.0)}
_NADIR_RADIUS_DEG = (6.0, 30.0)
_LARGEST_TILT_DEG = 2.0

Row = Float[np.ndarray, "24"]


def draw_exposure(rng: np.random.Generator, *, bright: bool = False) -> Row:
    """How the camera turns light into a picture; see the column names above.

    Args:
        rng: source of randomness.
        bright: exposed as pictures of homes for sale are: light, and with compressed contrasts.
    """
    row = np.zeros(EXPOSURE_COLUMNS)
    row[TARGET] = math.exp(rng.normal(math.log(0.42), 0.42))
    if bright:
        row[TARGET] = math.exp(rng.normal(math.log(0.7), 0.3))
    row[RED_GAIN], row[BLUE_GAIN] = np.exp(rng.normal(0.0, 0.09, 2))
    row[TINT] = math.exp(rng.normal(0.0, 0.02))
    row[CONTRAST] = rng.uniform(0.85, 1.25)
    row[SATURATION] = rng.uniform(0.5, 1.25)
    row[NOISE] = 0.03 * rng.random() ** 3
    row[BLUR] = rng.uniform(0.0, 0.9)
    row[NOISE_SEED] = rng.integers(1 << 20)
    row[SHOULDER] = rng.uniform(0.2, 1.0)
    if rng.random() < (0.6 if bright else 0.3):
        row[FLAT] = rng.uniform(0.1, 0.5)
    _draw_lenses(row, rng)
    _draw_stand(row, rng)
    return row


def draw_staged_exposure(rng: np.random.Generator) -> Row:
    """As `draw_exposure`, for the rendered pictures of one data set: alike, level, without seams and tripods."""
    row = draw_exposure(rng)
    row[TARGET] = math.sqrt(0.5 * row[TARGET])
    row[SATURATION] = 0.5 + 0.5 * row[SATURATION]
    row[[NADIR, ZENITH, ROLL, PITCH, SEAM_STEP, SEAM_SHIFT, VIGNETTE, FLAT, JPEG]] = 0.0
    return row


def _draw_lenses(row: Row, rng: np.random.Generator) -> None:
    row[SEAM] = rng.uniform(-math.pi, math.pi)
    if rng.random() < 0.5:
        row[VIGNETTE] = rng.uniform(0.03, 0.4)
    if rng.random() < 0.3:
        row[SEAM_STEP] = rng.normal(0.0, 0.06)
        row[SEAM_SHIFT] = math.radians(float(np.clip(rng.normal(0.0, 0.4), -1.2, 1.2)))
    if rng.random() < 0.5:
        tilt = np.clip(rng.normal(0.0, 0.8, 2), -_LARGEST_TILT_DEG, _LARGEST_TILT_DEG)
        row[ROLL], row[PITCH] = np.radians(tilt)
    if rng.random() < 0.4:
        row[JPEG] = rng.uniform(50.0, 95.0)


def _draw_stand(row: Row, rng: np.random.Generator) -> None:
    if rng.random() < 0.38:
        kind = int(rng.choice(len(_NADIR_SHARES), p=_NADIR_SHARES))
        row[NADIR_KIND] = kind
        row[NADIR] = math.radians(rng.uniform(*_NADIR_REACH_DEG.get(kind, _NADIR_RADIUS_DEG)))
        row[NADIR_TONE] = rng.uniform(0.0, 0.08) if rng.random() < 0.6 else rng.uniform(0.0, 0.95)
        row[NADIR_TURN] = rng.uniform(-math.pi, math.pi)
    if rng.random() < 0.06:
        row[ZENITH] = math.radians(rng.uniform(5.0, 20.0))
        row[ZENITH_TONE] = rng.uniform(0.0, 0.9)
