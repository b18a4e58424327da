"""Straight line segments of a photograph, as planes through the camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.photograph.cameras import Camera

# Shorter segments, as a share of the picture's longer side, are mostly texture.
_MIN_LENGTH = 0.025
_MAX_SEGMENTS = 150
# OpenCV counts from the centre of the first pixel.
_HALF_PIXEL = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Lines:
    """Segments seen from the camera, in its frame (right, forward, up).

    Attributes:
        normal: (n, 3) unit normals of the planes through the camera and each segment.
        middle: (n, 3) unit rays to the middles.
        length: (n,) angles (radians) between the ends.
        pixel: angle (radians) of one pixel at the optical axis.
    """

    normal: Float[np.ndarray, "n 3"]
    middle: Float[np.ndarray, "n 3"]
    length: Float[np.ndarray, "n"]
    pixel: float


def find_segments(pixels: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "n 4"]:
    """Return the longest segments (x, y, x, y; pixels from the top left corner) found by OpenCV's LSD."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    if found is None:
        return np.zeros((0, 4))
    segments = found.reshape(-1, 4).astype(float) + _HALF_PIXEL
    length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    order = np.argsort(-length, kind="stable")[:_MAX_SEGMENTS]
    return segments[order[length[order] > _MIN_LENGTH * max(grey.shape)]]


def lines_of(segments: Float[np.ndarray, "n 4"], camera: Camera) -> Lines:
    """Return the segments as a camera sees them."""
    rays = camera.rays(segments.reshape(-1, 2, 2))
    cross = np.cross(rays[:, 0], rays[:, 1])
    sine = np.linalg.norm(cross, axis=-1)
    middle = rays.sum(axis=1)
    middle_norm = np.linalg.norm(middle, axis=-1)
    usable = (sine > 1e-4) & (middle_norm > 1e-4)
    return Lines(
        normal=cross[usable] / sine[usable, None],
        middle=middle[usable] / middle_norm[usable, None],
        length=np.arctan2(sine, (rays[:, 0] * rays[:, 1]).sum(axis=-1))[usable],
        pixel=1.0 / camera.resolution,
    )
