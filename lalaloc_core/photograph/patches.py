"""Gravity-aligned patches of photographs, and thumbnails, as the networks for photographs expect them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.conventions import TWO_PI, unit_rays
from lalaloc_core.photograph.cameras import HALF_PIXEL, Camera, camera_axes

# Colour of pixels that the photograph does not show.
UNSEEN = 127
# Resolution of the photograph that patches are sampled from, relative to theirs: less blurs, more aliases.
FINER = 1.4
# A field of view that is wider than a patch by less than this factor gets one patch.
_SLACK = 1.03
# Least overlap of neighbouring patches, as a share of their width.
_OVERLAP = 0.2
# Joined patches once around: so many that each wall is also read with much of the room on both sides. Share of the
# horizon that photographs show together which go around.
_JOINED, _AROUND = 8, 0.97
# Seen azimuths: samples of the left and right border, and the largest elevation that counts.
_SAMPLES, _MAX_ELEVATION = 33, math.radians(45.0)
# Thumbnails have about so many pixels, and sides that are multiples of the step.
_THUMBNAIL_PIXELS, _THUMBNAIL_STEP, _MAX_ASPECT = 320 * 256, 32, 8.0


@dataclass(frozen=True, kw_only=True)
class PatchSize:
    """Size of a patch: equirectangular, with as many pixels per degree of azimuth as of elevation.

    Attributes:
        step_deg: azimuths of patches are multiples of this, a column of the network's predictions.
    """

    height: int = 192
    width: int = 256
    hfov_deg: float = 112.5
    top_deg: float = 39.375
    step_deg: float = 1.40625

    @property
    def bottom_deg(self) -> float:
        """Elevation of the lower border."""
        return self.top_deg - self.hfov_deg * self.height / self.width

    @property
    def hfov(self) -> float:
        """Range of azimuths, radians."""
        return math.radians(self.hfov_deg)

    @property
    def resolution(self) -> float:
        """Pixels per radian."""
        return self.width / self.hfov


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """Part of the level sphere around a camera.

    Attributes:
        pixels: (h, w, 3) RGB; `UNSEEN` where the photograph shows nothing.
        azimuth_rad: azimuth of the centre column relative to the photograph's centre, clockwise.
    """

    pixels: UInt8[np.ndarray, "h w 3"]
    seen: Bool[np.ndarray, "h w"]
    azimuth_rad: float

    @property
    def rgba(self) -> UInt8[np.ndarray, "h w 4"]:
        """Pixels with an opacity of 255 where they are seen, as the encoder of views expects them."""
        return np.dstack([self.pixels, np.where(self.seen, 255, 0).astype(np.uint8)])


def cut_patches(
    picture: UInt8[np.ndarray, "h w 3"], camera: Camera, *, pitch: float, roll: float, size: PatchSize
) -> tuple[Patch, ...]:
    """Cut the patches that cover a photograph, from left to right; angles in radians."""
    picture, camera = reduced(picture, camera, size)
    axes = camera_axes(pitch=pitch, roll=roll).astype(np.float32)
    return tuple(_patch(picture, camera, axes, azimuth, size) for azimuth in patch_azimuths(camera.hfov, size))


def patch_azimuths(hfov: float, size: PatchSize) -> list[float]:
    """Return the azimuths of the patches that cover a horizontal field of view, relative to its centre."""
    if hfov <= _SLACK * size.hfov:
        return [0.0]
    apart = (1.0 - _OVERLAP) * size.hfov
    if hfov > TWO_PI - 0.5 * size.hfov:
        count = math.ceil(TWO_PI / apart)
        azimuths = ((np.arange(count) + 0.5) / count - 0.5) * TWO_PI
    else:
        azimuths = np.linspace(-0.5, 0.5, 1 + math.ceil((hfov - size.hfov) / apart)) * (hfov - size.hfov)
    step = math.radians(size.step_deg)
    return [float(azimuth) for azimuth in np.round(azimuths / step) * step]


def joined_patches(placed: Sequence[tuple[Patch, float]], size: PatchSize) -> list[Patch]:
    """Return patches of what photographs show together once around; none if they leave a part of the horizon unseen.

    `placed` are patches of the photographs, with the azimuths (radians) of their centres relative to the first
    photograph; where they overlap, the nearer centre counts.
    """
    columns = round(TWO_PI * size.resolution)
    ring = np.full((size.height, columns, 3), UNSEEN, np.uint8)
    nearest = np.full((size.height, columns), np.inf, np.float32)
    distance = np.abs(np.arange(size.width) - 0.5 * (size.width - 1)).astype(np.float32)
    for patch, azimuth in placed:
        rows, own = np.nonzero(patch.seen)
        place = _ring_columns(azimuth, size)[own]
        nearer = distance[own] < nearest[rows, place]
        rows, own, place = rows[nearer], own[nearer], place[nearer]
        ring[rows, place], nearest[rows, place] = patch.pixels[rows, own], distance[own]
    seen = np.isfinite(nearest)
    if seen.any(axis=0).mean() < _AROUND:
        return []
    joined = []
    for azimuth in (np.arange(_JOINED) * (TWO_PI / _JOINED)).tolist():
        place = _ring_columns(azimuth, size)
        joined.append(Patch(pixels=ring[:, place], seen=seen[:, place], azimuth_rad=azimuth))
    return joined


def _ring_columns(azimuth: float, size: PatchSize) -> Int[np.ndarray, "w"]:
    """Return the columns of a ring, whose first is at the azimuth 0, of a patch's columns."""
    first = round(azimuth * size.resolution) - size.width // 2
    return (first + np.arange(size.width)) % round(TWO_PI * size.resolution)


def _patch(picture: np.ndarray, camera: Camera, axes: np.ndarray, azimuth: float, size: PatchSize) -> Patch:
    cosine, sine = math.cos(azimuth), math.sin(azimuth)
    turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]], np.float32)
    rays = _level_rays(size) @ (axes @ turn).T
    pixels, seen = camera.pixels(rays)
    where = (np.where(seen[..., None], pixels, 0.0) - HALF_PIXEL).astype(np.float32)
    colours = cv2.remap(picture, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    colours[~seen] = UNSEEN
    return Patch(pixels=colours, seen=seen, azimuth_rad=azimuth)


@lru_cache(maxsize=4)
def _level_rays(size: PatchSize) -> Float[np.ndarray, "h w 3"]:
    """Return the rays (right, forward, up) of a patch's pixels."""
    azimuth = ((np.arange(size.width) + 0.5) / size.width - 0.5) * size.hfov
    share = (np.arange(size.height) + 0.5) / size.height
    elevation = np.radians(size.top_deg + (size.bottom_deg - size.top_deg) * share)[:, None]
    return unit_rays(azimuth, elevation).astype(np.float32)


def reduced(
    picture: UInt8[np.ndarray, "h w 3"], camera: Camera, size: PatchSize
) -> tuple[UInt8[np.ndarray, "k l 3"], Camera]:
    """Scale a photograph down to the resolution that patches are sampled from, so that sampling does not alias."""
    share = FINER * size.resolution / camera.resolution
    if share > 0.85:
        return picture, camera
    width, height = max(1, round(share * camera.width)), max(1, round(share * camera.height))
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), camera.scaled(width, height)


def seen_azimuths(camera: Camera, pitch: float, roll: float) -> tuple[float, float]:
    """Return the azimuths of the picture's leftmost and rightmost ray that a patch can show."""
    half = 0.5 * camera.hfov
    if half > 0.5 * math.pi:
        return -half, half
    y = np.linspace(0.0, camera.height, _SAMPLES)
    border = np.concatenate([np.stack([np.full_like(y, x), y], axis=-1) for x in (0.0, float(camera.width))])
    rays = camera.rays(border) @ camera_axes(pitch=pitch, roll=roll)
    usable = np.abs(rays[:, 2]) < math.sin(_MAX_ELEVATION)
    azimuth = np.arctan2(rays[:, 0], rays[:, 1])[usable]
    return (float(azimuth.min()), float(azimuth.max())) if len(azimuth) else (-half, half)


def thumbnail_of(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return the whole picture at the size that objects are recognised in; its aspect changes by rounding only."""
    height, width = picture.shape[:2]
    aspect = min(max(width / height, 1.0 / _MAX_ASPECT), _MAX_ASPECT)
    rows = max(1, round(math.sqrt(_THUMBNAIL_PIXELS / aspect) / _THUMBNAIL_STEP))
    size = max(1, round(aspect * rows)) * _THUMBNAIL_STEP, rows * _THUMBNAIL_STEP
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
