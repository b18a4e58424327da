"""Levelling: rotation of a panorama's sphere as if the camera had been held level."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.conventions import column_azimuths, row_elevations

# Rows processed at once: all rays of a large picture would need many times its memory.
_ROWS = 64


def level(pixels: UInt8[np.ndarray, "h w 3"], *, pitch: float, roll: float) -> UInt8[np.ndarray, "h w 3"]:
    """Resample a panorama as taken by a level camera with the same heading; bilinear, across seam and poles.

    `pitch` is the elevation of the picture's centre, radians above the horizon; `roll` the rotation of the camera about
    that direction, radians clockwise.
    """
    height, width = pixels.shape[:2]
    axes = camera_axes(pitch=pitch, roll=roll)
    azimuth, elevation = column_azimuths(width), row_elevations(height)
    out = np.empty_like(pixels)
    for top in range(0, height, _ROWS):
        block = elevation[top : top + _ROWS, None]
        rays = np.stack(
            np.broadcast_arrays(np.cos(block) * np.sin(azimuth), np.cos(block) * np.cos(azimuth), np.sin(block))
        )
        out[top : top + _ROWS] = _sample(pixels, np.einsum("ij,jrc->irc", axes, rays))
    return out


def camera_axes(*, pitch: float, roll: float) -> Float[np.ndarray, "3 3"]:
    """Return the camera's right, forward and up as rows, in a level frame with the same heading."""
    forward = [0.0, math.cos(pitch), math.sin(pitch)]
    unrolled_right, unrolled_up = np.array([1.0, 0.0, 0.0]), np.array([0.0, -math.sin(pitch), math.cos(pitch)])
    right = math.cos(roll) * unrolled_right - math.sin(roll) * unrolled_up
    up = math.sin(roll) * unrolled_right + math.cos(roll) * unrolled_up
    return np.stack([right, np.array(forward), up])


def _sample(pixels: UInt8[np.ndarray, "h w 3"], rays: Float[np.ndarray, "3 r c"]) -> UInt8[np.ndarray, "r c 3"]:
    """Return the colours along unit rays in the camera's frame (right, forward, up)."""
    height, width = pixels.shape[:2]
    column = (np.arctan2(rays[0], rays[1]) / (2.0 * np.pi) + 0.5) * width - 0.5
    row = (0.5 - np.arcsin(np.clip(rays[2], -1.0, 1.0)) / np.pi) * height - 0.5
    left, above = np.floor(column).astype(int), np.floor(row).astype(int)
    across, down = (column - left)[..., None], (row - above)[..., None]
    blended = sum(
        weight * _pixels_around(pixels, above + i, left + j)
        for i, j, weight in (
            (0, 0, (1.0 - down) * (1.0 - across)),
            (0, 1, (1.0 - down) * across),
            (1, 0, down * (1.0 - across)),
            (1, 1, down * across),
        )
    )
    return np.round(blended).astype(np.uint8)


def _pixels_around(
    pixels: UInt8[np.ndarray, "h w 3"], row: np.ndarray, column: np.ndarray
) -> UInt8[np.ndarray, "r c 3"]:
    """Return pixels by row and column; a row beyond a pole is the row before it, half a turn away."""
    height, width = pixels.shape[:2]
    beyond = (row < 0) | (row >= height)
    column = np.where(beyond, column + width // 2, column)
    return pixels[np.clip(row, 0, height - 1), column % width]
