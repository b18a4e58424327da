"""Pictures that hold a sphere in another layout, recognised by their pixels: converted if nothing is lost, else named.

Such a picture passes for an ordinary photograph by its size, and would be localised with a wrong geometry.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.photograph.cube_maps import CubeMap, find_cube
from lalaloc_core.photograph.projection import COARSEST, is_sphere

# Longest side (pixels) of pictures that are judged: a multiple of the cells of cube maps in both directions.
JUDGED_SIDE = 504
# Relative deviation of a ratio of sides; editors round.
_TOLERANCE = 0.01
# Correlation of the two eyes of a stereo picture, and the largest shift between them, a share of the width.
_MIN_CORRELATION, _MAX_SHIFT = 0.85, 0.04
# Bars: largest spread of grey levels along a row, and least share of the height.
_MAX_BAR_SPREAD, _MIN_BARS = 4.0, 0.02
# Circles: side (pixels) of judged squares, radii of the ring inside and of the corners, and grey levels of the corners.
_CIRCLE = 128
_RING, _CORNERS = (0.8, 0.93), 1.12
_DARK, _MIN_STEP, _MIN_DARK_SHARE = 40.0, 25.0, 0.97
_SECTORS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Layout of a picture that holds a sphere.

    Attributes:
        text: its name, the reason for it, and what is done or to be done about it.
        box: part of the picture with the sphere, as shares (left, top, right, bottom); None if it is not converted.
        is_stored: `box` is one of the stored picture, before its Exif orientation is applied.
        is_half: the box shows 180° of the sphere.
        cube: the cube map, if its faces are known.
    """

    text: str
    box: tuple[float, float, float, float] | None = None
    is_stored: bool = False
    is_half: bool = False
    cube: CubeMap | None = None

    @property
    def is_usable(self) -> bool:
        """True if the sphere can be taken out of the picture without loss."""
        return self.box is not None or self.cube is not None


def find_layout(pixels: UInt8[np.ndarray, "h w 3"], *, orientation: int) -> Layout | None:
    """Return the layout of a picture; None for a photograph, or a sphere as it should be.

    Args:
        pixels: the stored picture, at most `JUDGED_SIDE` wide and high.
        orientation: its Exif orientation.
    """
    if orientation not in (5, 6, 7, 8):
        return _find_upright(pixels)
    if _has_ratio(pixels, 2.0) and _holds_sphere(pixels):
        return Layout(
            text=f"the photograph is a sphere with the Exif orientation {orientation}, which is ignored: its stored "
            "picture is twice as wide as high, and its borders continue each other",
            box=(0.0, 0.0, 1.0, 1.0),
            is_stored=True,
        )
    return _find_upright(np.ascontiguousarray(np.rot90(pixels, -1 if orientation in (5, 6) else 1)))


def _find_upright(pixels: UInt8[np.ndarray, "h w 3"]) -> Layout | None:
    if (circles := _find_circles(pixels)) is not None:
        return circles
    if (stereo := _find_stereo(pixels)) is not None:
        return stereo
    if (box := _box_within_bars(pixels)) is not None:
        share = 1.0 - (box[2] - box[0]) * (box[3] - box[1])
        return Layout(
            text=f"the photograph is a sphere with bars at its borders, {share:.0%} of the picture: they were cut off",
            box=box,
        )
    cube = find_cube(pixels)
    if cube is None:
        return None
    if cube.faces is None:
        return Layout(text=f"the photograph is a cube map, {cube.name}: convert it to equirectangular")
    text = f"the photograph is a cube map, {cube.name}: it was converted, with the front face in its centre"
    return Layout(text=text, cube=cube)


def _has_ratio(pixels: np.ndarray, ratio: float) -> bool:
    height, width = pixels.shape[:2]
    # The judged size is rounded to whole pixels.
    return abs(width - ratio * height) <= max(_TOLERANCE * width, 1.0 + ratio)


def _holds_sphere(pixels: UInt8[np.ndarray, "h w 3"]) -> bool:
    height, width = COARSEST
    return is_sphere(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA))


def _find_stereo(pixels: UInt8[np.ndarray, "h w 3"]) -> Layout | None:
    """Return the layout of a picture with two eyes, each with a sphere or with 180° of it."""
    height, width = pixels.shape[:2]
    for name, first, second, box in (
        ("above", pixels[: height // 2], pixels[height - height // 2 :], (0.0, 0.0, 1.0, 0.5)),
        ("beside", pixels[:, : width // 2], pixels[:, width - width // 2 :], (0.0, 0.0, 0.5, 1.0)),
    ):
        if not _look_alike(first, second):
            continue
        used = "the first one, of the left eye, is used"
        if _holds_sphere(first) and _holds_sphere(second):
            return Layout(text=f"the photograph is a stereo sphere, one eye {name} the other: {used}", box=box)
        if name == "beside" and _has_ratio(pixels, 2.0):
            text = f"the photograph is VR180, two eyes with 180° {name} each other: {used}"
            return Layout(text=text, box=box, is_half=True)
    return None


def _look_alike(first: UInt8[np.ndarray, "h w 3"], second: UInt8[np.ndarray, "h w 3"]) -> bool:
    """Return whether two pictures show the same, up to the shift between two eyes."""
    height, width = COARSEST
    grey = [
        cv2.resize(cv2.cvtColor(half, cv2.COLOR_RGB2GRAY), (width, height), interpolation=cv2.INTER_AREA).astype(float)
        for half in (first, second)
    ]
    # Slow changes and rows, as of light from above, are alike in all pictures.
    margin = width // 16
    details = (half - cv2.GaussianBlur(half, (0, 0), margin / 2) for half in grey)
    inner = (half[:, margin:-margin] for half in details)
    left, right = (half - half.mean(axis=1, keepdims=True) for half in inner)
    if min(left.std(), right.std()) < 1.0:
        return False
    shift = round(_MAX_SHIFT * width)
    core = left[:, shift:-shift]
    found = cv2.matchTemplate(right.astype(np.float32), core.astype(np.float32), cv2.TM_CCOEFF_NORMED)
    return float(found.max()) > _MIN_CORRELATION


def _box_within_bars(pixels: UInt8[np.ndarray, "h w 3"]) -> tuple[float, float, float, float] | None:
    """Return the part of a picture within bars of one colour, if it is a sphere."""
    height, width = pixels.shape[:2]
    top, bottom = _bars(pixels)
    left, right = _bars(pixels.transpose(1, 0, 2))
    if (bottom - top) * (right - left) > (1.0 - _MIN_BARS) * height * width or min(bottom - top, right - left) < 16:
        return None
    # The bars are equal and the sphere twice as wide as high, which is more exact than the judged pixels.
    across, down = (right - left) / width, (bottom - top) / height
    exact = (1.0, width / 2.0 / height) if across > 0.98 else (2.0 * height / width, 1.0)
    slack = 2.5 / min(height, width)
    if max(abs(exact[0] - across), abs(exact[1] - down), abs(left + right - width) / width) > slack:
        return None
    if abs(top + bottom - height) / height > slack or max(exact) > 1.0 + slack:
        return None
    inner = pixels[top:bottom, left:right]
    if not _holds_sphere(inner):
        return None
    beside, above = 0.5 * (1.0 - min(exact[0], 1.0)), 0.5 * (1.0 - min(exact[1], 1.0))
    return beside, above, 1.0 - beside, 1.0 - above


def _bars(pixels: UInt8[np.ndarray, "n m 3"]) -> tuple[int, int]:
    """Return the first row and the end of the rows between bars of one colour at the top and bottom."""
    values = pixels.astype(np.float32)
    is_bar = values.std(axis=1).max(axis=1) < _MAX_BAR_SPREAD
    is_bar &= np.abs(values.mean(axis=1) - values[[0, -1]].mean(axis=(0, 1))).max(axis=1) < 2.0 * _MAX_BAR_SPREAD
    if is_bar.all():
        return 0, len(pixels)
    return int(np.argmin(is_bar)), len(pixels) - int(np.argmin(is_bar[::-1]))


def _find_circles(pixels: UInt8[np.ndarray, "h w 3"]) -> Layout | None:
    """Return the layout of a picture with one or two circles of fisheye lenses on black."""
    height, width = pixels.shape[:2]
    for ratio, halves in (
        (2.0, (pixels[:, : width // 2], pixels[:, width - width // 2 :])),
        (0.5, (pixels[: height // 2], pixels[height - height // 2 :])),
    ):
        if _has_ratio(pixels, ratio) and all(_is_circle(half) for half in halves):
            return Layout(
                text="the photograph is the dual fisheye picture of a 360° camera, two circles that are not stitched: "
                "export it from the camera's app as an equirectangular 360° photograph"
            )
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    if _is_circle(pixels[top : top + side, left : left + side]) and _is_dark_beside(pixels, side):
        return Layout(
            text="the photograph is the circle of a fisheye lens: send projection=fisheye and hfov_deg, its horizontal "
            "field of view (often 180), of the square around the circle"
        )
    return None


def _is_dark_beside(pixels: UInt8[np.ndarray, "h w 3"], side: int) -> bool:
    height, width = pixels.shape[:2]
    beside = [pixels[: (height - side) // 2], pixels[:, : (width - side) // 2]]
    return all(part.size == 0 or float(np.percentile(part, 90)) < _DARK for part in beside)


def _is_circle(square: UInt8[np.ndarray, "h w 3"]) -> bool:
    """Return whether a square picture is dark in its corners, and bright within its largest circle all around."""
    grey = cv2.resize(cv2.cvtColor(square, cv2.COLOR_RGB2GRAY), (_CIRCLE, _CIRCLE), interpolation=cv2.INTER_AREA)
    radius, sector = _polar()
    corners = grey[radius > _CORNERS].astype(float)
    if np.mean(corners < _DARK) < _MIN_DARK_SHARE or corners.std() > 0.3 * _DARK:
        return False
    ring = (radius > _RING[0]) & (radius < _RING[1])
    bright = [np.median(grey[ring & (sector == index)]) > corners.mean() + _MIN_STEP for index in range(_SECTORS)]
    return int(sum(bright)) >= _SECTORS - 1


def _polar() -> tuple[Float[np.ndarray, "s s"], np.ndarray]:
    """Return the distance of each pixel of a square from its centre, in halves of its side, and its sector."""
    place = (np.arange(_CIRCLE) + 0.5) / _CIRCLE * 2.0 - 1.0
    x, y = np.meshgrid(place, place)
    return np.hypot(x, y), ((np.arctan2(y, x) / (2.0 * math.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
