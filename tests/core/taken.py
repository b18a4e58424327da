"""Photographs with a known camera, cut from the example spheres."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import ExifTags, Image

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.photograph import Photograph, StatedCamera, open_photograph
from lalaloc_core.photograph.cameras import Camera, camera_axes
from tests.painted import picture_file

EXAMPLES = Path(__file__).parents[2] / "examples"
# Exif metadata of the main camera of a phone, 67° wide.
PHONE: dict[Any, Any] = {
    ExifTags.Base.FocalLengthIn35mmFilm: 26,
    ExifTags.Base.ExifImageWidth: 640,
    ExifTags.Base.ExifImageHeight: 480,
}


@cache
def sphere(name: str) -> np.ndarray:
    with Image.open(EXAMPLES / f"{name}.jpg") as image:
        return np.asarray(image.convert("RGB"))


def take(
    sphere: np.ndarray, camera: Camera, *, pitch_deg: float = 0.0, roll_deg: float = 0.0, heading_deg: float = 0.0
) -> np.ndarray:
    """Return the picture that a camera in the middle of a sphere takes; black where the camera sees nothing."""
    height, width = sphere.shape[:2]
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays(np.stack([x, y], axis=-1))
    rays = rays @ camera_axes(pitch=math.radians(pitch_deg), roll=math.radians(roll_deg))
    azimuth = np.arctan2(rays[..., 0], rays[..., 1]) + math.radians(heading_deg)
    column = (azimuth / TWO_PI + 0.5) % 1.0 * width - 0.5
    row = (0.5 - np.arcsin(np.clip(rays[..., 2], -1.0, 1.0)) / math.pi) * height - 0.5
    wrapped = np.concatenate([sphere[:, -1:], sphere, sphere[:, :1]], axis=1)
    map_x, map_y = (column + 1.0).astype(np.float32), row.astype(np.float32)
    return cv2.remap(wrapped, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def exif_of(tags: dict[Any, Any]) -> Image.Exif:
    """Return Exif metadata with tags of the EXIF IFD as phones write them."""
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    return exif


def jpeg(
    pixels: np.ndarray,
    exif: dict[Any, Any] | None = None,
    orientation: int | None = None,
    *,
    maker: str | None = None,
    model: str | None = None,
) -> bytes:
    """Return a JPEG file with tags of the EXIF IFD as phones write them."""
    tags = exif_of(exif or {})
    for tag, value in ((0x0112, orientation), (0x010F, maker), (0x0110, model)):
        if value is not None:
            tags[tag] = value
    return picture_file(pixels, "JPEG", quality=92, exif=tags)


def opened(content: bytes, **stated: Any) -> Photograph:
    return open_photograph(content, sphere_size=(128, 256), stated=StatedCamera(**stated))


def within_bars(picture: np.ndarray, kind: str) -> np.ndarray:
    """Return a picture between bars above and below, as videos and screenshots have them."""
    above, below = {"unequal": (30, 120), "on one side": (100, 0)}.get(kind, (80, 80))
    border = cv2.BORDER_WRAP if kind == "blurred" else cv2.BORDER_CONSTANT
    barred = cv2.GaussianBlur(cv2.copyMakeBorder(picture, above, below, 0, 0, border), (0, 0), 15.0)
    barred[above : above + len(picture)] = picture
    if kind == "gradient":
        barred[:above] = barred[above + len(picture) :] = np.arange(80)[:, None, None]
    elif kind != "blurred":
        barred[:above], barred[above + len(picture) :] = 255 * (kind == "of two colours"), 0
    if kind == "with a strip":
        barred[-50:-20] = picture[:30]
    if kind == "in a window":
        barred = cv2.copyMakeBorder(barred, 40, 40, 0, 0, cv2.BORDER_CONSTANT, value=(70, 70, 70))
    return barred
