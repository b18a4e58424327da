"""Random camera settings: exposure, colour, lenses, stitching, patch over the stand, compression."""

from __future__ import annotations

import math

import numpy as np

from lalaloc_core.learn.synth.records import Records, columns

DISC, BLURRED, LOGO, MIRROR_BALL, TRIPOD, PERSON = range(6)
_NADIR_SHARES = (0.4, 0.15, 0.15, 0.08, 0.12, 0.1)
_NADIR_REACH_DEG = {TRIPOD: (25.0, 55.0), PERSON: (35.0, 65.0)}
_NADIR_RADIUS_DEG = (6.0, 30.0)
_MAX_TILT_DEG = 2.0


class Exposure(Records):
    """Settings that turn light into a picture.

    Attributes:
        target: mean brightness of the exposed picture.
        red_gain, tint, blue_gain: white balance, factors on the three channels.
        contrast, saturation: factors.
        noise: standard deviation.
        blur: standard deviation of the lens blur, pixels.
        nadir, nadir_tone, nadir_kind, nadir_turn: radius (radians, 0 for none), tone, kind and rotation of the patch
            over the nadir.
        noise_seed: part of the noise that is used.
        shoulder: softness of the roll-off of highlights.
        flatness: compression of the range of brightness.
        vignette: darkening towards the rims of the two lenses.
        seam, seam_step, seam_shift: azimuth of the seam between the lenses relative to the picture's centre, the step
            in brightness and the shift in elevation (radians) across it.
        roll, pitch: tilt about the forward axis and about the axis to the right, radians.
        jpeg: quality of compression, 0 for none.
        zenith, zenith_tone: radius (radians, 0 for none) and tone of the patch over the zenith.
    """

    target, red_gain, blue_gain, contrast, saturation, noise, blur = columns(7)
    nadir, nadir_tone, noise_seed, shoulder, tint, flatness, vignette = columns(7)
    seam, seam_step, seam_shift, roll, pitch, jpeg = columns(6)
    nadir_kind, nadir_turn, zenith, zenith_tone = columns(4)


def sample_exposure(rng: np.random.Generator, *, bright: bool = False) -> Exposure:
    """Sample camera settings.

    `bright` exposes like pictures of homes for sale: light, with compressed contrasts.
    """
    exposure = Exposure(np.zeros(Exposure.WIDTH))
    exposure.target = math.exp(rng.normal(math.log(0.42), 0.42))
    if bright:
        exposure.target = math.exp(rng.normal(math.log(0.7), 0.3))
    exposure.red_gain, exposure.blue_gain = np.exp(rng.normal(0.0, 0.09, 2))
    exposure.tint = math.exp(rng.normal(0.0, 0.02))
    exposure.contrast = rng.uniform(0.85, 1.25)
    exposure.saturation = rng.uniform(0.5, 1.25)
    exposure.noise = 0.03 * rng.random() ** 3
    exposure.blur = rng.uniform(0.0, 0.9)
    exposure.noise_seed = rng.integers(1 << 20)
    exposure.shoulder = rng.uniform(0.2, 1.0)
    if rng.random() < (0.6 if bright else 0.3):
        exposure.flatness = rng.uniform(0.1, 0.5)
    _sample_lenses(exposure, rng)
    _sample_stand(exposure, rng)
    return exposure


def sample_staged_exposure(rng: np.random.Generator) -> Exposure:
    """Sample settings for rendered pictures of one data set: similar, level, without seams and tripods."""
    exposure = sample_exposure(rng)
    exposure.target = math.sqrt(0.5 * exposure.target)
    exposure.saturation = 0.5 + 0.5 * exposure.saturation
    exposure.nadir = exposure.zenith = exposure.roll = exposure.pitch = exposure.jpeg = 0.0
    exposure.seam_step = exposure.seam_shift = exposure.vignette = exposure.flatness = 0.0
    return exposure


def without_stitching(exposure: Exposure) -> Exposure:
    """Return settings (torch) without what stitched spheres have: seams, rims of two lenses, tilt, covered poles."""
    changed = Exposure(exposure.rows.clone())
    for name in ("nadir", "zenith", "roll", "pitch", "seam_step", "seam_shift", "vignette"):
        setattr(changed, name, 0.0)
    return changed


def _sample_lenses(exposure: Exposure, rng: np.random.Generator) -> None:
    exposure.seam = rng.uniform(-math.pi, math.pi)
    if rng.random() < 0.5:
        exposure.vignette = rng.uniform(0.03, 0.4)
    if rng.random() < 0.3:
        exposure.seam_step = rng.normal(0.0, 0.06)
        exposure.seam_shift = math.radians(float(np.clip(rng.normal(0.0, 0.4), -1.2, 1.2)))
    if rng.random() < 0.5:
        tilt = np.clip(rng.normal(0.0, 0.8, 2), -_MAX_TILT_DEG, _MAX_TILT_DEG)
        exposure.roll, exposure.pitch = np.radians(tilt)
    if rng.random() < 0.4:
        exposure.jpeg = rng.uniform(50.0, 95.0)


def _sample_stand(exposure: Exposure, rng: np.random.Generator) -> None:
    if rng.random() < 0.38:
        kind = int(rng.choice(len(_NADIR_SHARES), p=_NADIR_SHARES))
        exposure.nadir_kind = kind
        exposure.nadir = math.radians(rng.uniform(*_NADIR_REACH_DEG.get(kind, _NADIR_RADIUS_DEG)))
        exposure.nadir_tone = rng.uniform(0.0, 0.08) if rng.random() < 0.6 else rng.uniform(0.0, 0.95)
        exposure.nadir_turn = rng.uniform(-math.pi, math.pi)
    if rng.random() < 0.06:
        exposure.zenith = math.radians(rng.uniform(5.0, 20.0))
        exposure.zenith_tone = rng.uniform(0.0, 0.9)
