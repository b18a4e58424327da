"""Reader for spheres: from encoded bytes to the level pixels that the image encoder expects.

Three kinds of metadata are used: the EXIF orientation, the visible part of the sphere, and the camera's pitch and roll
(`photo_sphere`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from lalaloc_core.conventions import TWO_PI, column_azimuths, row_elevations, unit_rays
from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.photograph.cameras import camera_axes
from lalaloc_core.photograph.photo_sphere import PhotoSphere, SpherePart, read_photo_sphere
from lalaloc_core.photograph.picture_files import NEUTRAL, PhotographLimits, PictureFile, opened_picture, scaled
from lalaloc_core.photograph.projection import SPHERE_TOLERANCE, is_twice_as_wide

# Oversampling of pictures that are placed or levelled, relative to the encoder's input.
_FINER = 2
# Rounding error, in pixels.
_EDGE = 1e-6
# Rows levelled at once: all rays of a large picture would need many times its memory.
_ROWS = 64


def read_sphere(
    content: bytes, *, height: int, width: int, limits: PhotographLimits | None = None
) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Decode an equirectangular JPEG, PNG or WebP (the first picture of several) and scale it to `height` x `width`."""
    limits = limits or PhotographLimits()
    with opened_picture(content, limits) as file:
        columns, rows = file.upright_size
        return level_sphere(file, read_photo_sphere(file.packets, width=columns, height=rows), (height, width), limits)


def level_sphere(
    file: PictureFile, sphere: PhotoSphere, size: tuple[int, int], limits: PhotographLimits
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the pixels of a sphere at a size (height, width), level.

    Their centre is that of the file's picture, also of a part that is not in the middle of the sphere.
    """
    _check_shape(*file.upright_size, sphere, limits)
    height, width = size
    part, turn = sphere.part, 0.0 if sphere.part is None else sphere.part.azimuth
    if part is not None and sphere.level:
        # Moved to the middle, instead of turning the sphere.
        part, turn = replace(part, left=0.5 - 0.5 * part.width), 0.0
    finer = 1 if part is None and sphere.level else _FINER
    canvas_size = (width * finer, height * finer)
    if part is None:
        canvas = scaled(file, canvas_size)
    else:
        # At least as fine as the canvas.
        shown_size = math.ceil(canvas_size[0] * part.width), math.ceil(canvas_size[1] * part.height)
        canvas = _placed(scaled(file, shown_size), part, canvas_size)
    if not sphere.level or turn:
        canvas = Image.fromarray(level(np.asarray(canvas), pitch=sphere.pitch, roll=sphere.roll, turn=turn))
    return np.asarray(canvas if finer == 1 else canvas.resize((width, height), Image.Resampling.BOX))


def _check_shape(width: int, height: int, sphere: PhotoSphere, limits: PhotographLimits) -> None:
    if sphere.refusal is not None:
        raise InvalidPhotographError(f"the photograph's photo sphere metadata rule it out: {sphere.refusal}")
    full_height = height if sphere.part is None else round(height / sphere.part.height)
    if full_height < limits.min_height:
        raise InvalidPhotographError(f"the photograph is {full_height} pixels high; the minimum is {limits.min_height}")
    if sphere.part is None and not is_twice_as_wide(width, height):
        fault = "" if sphere.fault is None else f"; its photo sphere metadata are invalid: {sphere.fault}"
        raise InvalidPhotographError(
            f"the photograph is {width} x {height}; a full 360° sphere is twice as wide as high, within "
            f"{SPHERE_TOLERANCE:.0%}{fault}"
        )


def _placed(picture: Image.Image, part: SpherePart, size: tuple[int, int]) -> Image.Image:
    """Place a picture of a part on the neutral full sphere; pixels that it covers partly stay neutral."""
    width, height = size
    edges_x = (part.left * width, (part.left + part.width) * width)
    edges_y = (part.top * height, (part.top + part.height) * height)
    left, right = math.ceil(edges_x[0] - _EDGE), math.floor(edges_x[1] + _EDGE)
    top, bottom = math.ceil(edges_y[0] - _EDGE), math.floor(edges_y[1] + _EDGE)
    scale_x = picture.width / (edges_x[1] - edges_x[0])
    scale_y = picture.height / (edges_y[1] - edges_y[0])
    box = (
        max(0.0, (left - edges_x[0]) * scale_x),
        max(0.0, (top - edges_y[0]) * scale_y),
        min(float(picture.width), (right - edges_x[0]) * scale_x),
        min(float(picture.height), (bottom - edges_y[0]) * scale_y),
    )
    canvas = Image.new("RGB", size, NEUTRAL)
    canvas.paste(picture.resize((right - left, bottom - top), Image.Resampling.BILINEAR, box=box), (left, top))
    return canvas


def level(
    pixels: UInt8[np.ndarray, "h w 3"], *, pitch: float, roll: float, turn: float = 0.0
) -> UInt8[np.ndarray, "h w 3"]:
    """Resample a sphere as taken by a level camera with the same heading; bilinear, across seam and poles.

    `pitch` is the elevation of the picture's centre, radians above the horizon; `roll` the rotation of the camera about
    that direction, radians clockwise. The result's centre has the azimuth `turn` in `pixels`, radians clockwise.
    """
    height, width = pixels.shape[:2]
    # A row beyond a pole is the row before it, half a turn away.
    around = np.concatenate([np.roll(pixels[:1], width // 2, axis=1), pixels, np.roll(pixels[-1:], width // 2, axis=1)])
    elevation, axes, parts = row_elevations(height)[:, None], camera_axes(pitch=pitch, roll=roll), []
    for top in range(0, height, _ROWS):
        rays = unit_rays(column_azimuths(width) + turn, elevation[top : top + _ROWS]) @ axes.T
        column = (np.arctan2(rays[..., 0], rays[..., 1]) / TWO_PI + 0.5) * width - 0.5
        row = (0.5 - np.arcsin(np.clip(rays[..., 2], -1.0, 1.0)) / math.pi) * height + 0.5
        where = column.astype(np.float32), row.astype(np.float32)
        parts.append(cv2.remap(around, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))
    return np.concatenate(parts)
