"""Synthetic spheres of empty rectangular rooms, whose pixels are floor, wall or ceiling, and pictures as files."""

from __future__ import annotations

import io
import struct
import zlib
from typing import Any

import numpy as np
from PIL import Image

FLOOR, WALL, CEILING = range(3)


def wall_distance_m(azimuth: np.ndarray, size_m: tuple[float, float], at_m: tuple[float, float]) -> np.ndarray:
    """Return the distance to the walls of a room from (0, 0) to `size_m`; azimuths are clockwise from +y."""
    with np.errstate(divide="ignore"):
        across, along = 1.0 / np.sin(azimuth), 1.0 / np.cos(azimuth)
    east_west = np.where(across > 0.0, size_m[0] - at_m[0], -at_m[0]) * across
    north_south = np.where(along > 0.0, size_m[1] - at_m[1], -at_m[1]) * along
    return np.minimum(east_west, north_south)


def painted_surfaces(
    size_m: tuple[float, float],
    at_m: tuple[float, float],
    *,
    camera_m: float = 1.5,
    ceiling_m: float = 2.5,
    rows: int = 256,
) -> np.ndarray:
    """Return the surface of each pixel, (rows, 2 rows), with +y in the centre."""
    azimuth = ((np.arange(2 * rows) + 0.5) / (2 * rows) - 0.5) * 2.0 * np.pi
    up = np.tan((0.5 - (np.arange(rows) + 0.5) / rows) * np.pi)[:, None]
    distance_m = wall_distance_m(azimuth, size_m, at_m)
    below_ceiling = np.where(up < -camera_m / distance_m, FLOOR, WALL)
    return np.where(up > (ceiling_m - camera_m) / distance_m, CEILING, below_ceiling)


def painted_room(size_m: tuple[float, float], at_m: tuple[float, float]) -> bytes:
    """Return a JPEG of a room with a brown floor, pale walls and a white ceiling, with a little noise."""
    colours = np.array([[140.0, 105.0, 75.0], [195.0, 190.0, 182.0], [235.0, 235.0, 230.0]])
    grain = np.random.default_rng(0).normal(0.0, 3.0, (256, 512, 3))
    picture = np.clip(colours[painted_surfaces(size_m, at_m)] + grain, 0.0, 255.0).astype(np.uint8)
    return picture_file(picture, "JPEG", quality=95)


def picture_file(picture: Image.Image | np.ndarray, kind: str = "PNG", **options: Any) -> bytes:
    """Return a picture as a file; options are those of `Image.save`."""
    buffer = io.BytesIO()
    image = Image.fromarray(picture) if isinstance(picture, np.ndarray) else picture
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def png_chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_file(width: int, height: int, packed: bytes, *, depth: int = 8, colour_type: int = 2) -> bytes:
    """Return a PNG of packed rows, which begin with their filter types and may be fewer than the header states."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + png_chunk(b"IDAT", packed) + png_chunk(b"IEND", b"")
