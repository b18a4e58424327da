"""Stated intrinsics compared with the photograph: calibrations are often of another size or orientation.

Principal points of lenses are near the middle of the picture, which tells the size that a calibration was made for.
"""

from __future__ import annotations

import math
from dataclasses import replace

from lalaloc_core.photograph.stated_camera import Intrinsics

# Distance of the principal point from the middle, a share of the side, beyond which a calibration hardly fits.
_FAR = 0.1
# Relative difference of the scales across and down of an exact multiple, and distance of the principal point from the
# middle of a phone's stored picture, a share of the side.
_EXACT, _NEAR = 0.005, 0.05
# Fields of view that differ by more, as a ratio of focal lengths, are contradictory.
_CONTRADICTORY = 1.25
# OpenCV counts pixels from the centre of the first one.
_HALF_PIXEL = 0.5


def fit_intrinsics(stated: Intrinsics, width: int, height: int, orientation: int) -> tuple[Intrinsics, tuple[str, ...]]:
    """Return the intrinsics of the upright picture, and a warning if they were changed or do not fit.

    Args:
        stated: checked intrinsics of a request.
        width: columns of the upright picture.
        height: rows of the upright picture.
        orientation: Exif orientation of the stored picture.
    """
    if stated.cx is None or stated.cy is None:
        return stated, ()
    x, y = stated.cx + _HALF_PIXEL, stated.cy + _HALF_PIXEL
    named = f"intrinsics: (cx, cy) is ({stated.cx:g}, {stated.cy:g})"
    if max(abs(x / width - 0.5), abs(y / height - 0.5)) <= _FAR or min(x, y) <= 0.0:
        return stated, ()
    if abs(x / width / (y / height) - 1.0) <= _EXACT:
        return _scaled(stated, width, height, named)
    # Of the stored picture, whose width is the height of the upright one.
    is_size = max(abs(x / height - 0.5), abs(y / width - 0.5)) <= _NEAR
    if is_size or abs(x / height / (y / width) - 1.0) <= _EXACT:
        at_size, scaling = (stated, ()) if is_size else _scaled(stated, height, width, named)
        text = (
            f"{named}, the middle of a picture on its side, not of the upright one of {width} x {height}: the "
            "intrinsics were turned with it"
        )
        return _turned(at_size, width, height, is_clockwise=orientation != 8), (*scaling, text)
    text = (
        f"{named}, more than {_FAR:.0%} of a side from ({0.5 * width:g}, {0.5 * height:g}), the middle of the upright "
        f"picture of {width} x {height}: check that the intrinsics are of this picture at its full size"
    )
    return stated, (text,)


def compare_focal_lengths(stated: float, by_exif: float | None, width: int) -> tuple[str, ...]:
    """Return a warning if a stated focal length (pixels) contradicts that of the Exif metadata."""
    if by_exif is None or max(stated / by_exif, by_exif / stated) <= _CONTRADICTORY:
        return ()
    given_deg, exif_deg = (math.degrees(2.0 * math.atan(0.5 * width / focal)) for focal in (stated, by_exif))
    return (
        f"the stated field of view is {given_deg:.0f}°, and the EXIF focal length gives {exif_deg:.0f}°: the stated "
        "one is used; check that it is of this photograph at its full size",
    )


def _scaled(stated: Intrinsics, width: int, height: int, named: str) -> tuple[Intrinsics, tuple[str, ...]]:
    """Return the intrinsics scaled to a picture in whose middle the principal point is."""
    assert stated.cx is not None
    assert stated.cy is not None
    x, y = stated.cx + _HALF_PIXEL, stated.cy + _HALF_PIXEL
    scale = 0.5 * math.sqrt(width * height / (x * y))
    fitted = replace(
        stated, fx=stated.fx * scale, fy=stated.fy * scale, cx=x * scale - _HALF_PIXEL, cy=y * scale - _HALF_PIXEL
    )
    text = (
        f"{named}, the middle of a picture of {2.0 * x:.0f} x {2.0 * y:.0f}, and the photograph has {width} x "
        f"{height}: the intrinsics were scaled by {scale:.4g}"
    )
    return fitted, (text,)


def _turned(stated: Intrinsics, width: int, height: int, *, is_clockwise: bool) -> Intrinsics:
    """Return the intrinsics of the upright picture, by a quarter turn of the stored one."""
    assert stated.cx is not None
    assert stated.cy is not None
    x, y = stated.cx + _HALF_PIXEL, stated.cy + _HALF_PIXEL
    cx, cy, p1, p2 = (width - y, x, stated.p2, -stated.p1) if is_clockwise else (y, height - x, -stated.p2, stated.p1)
    return replace(stated, fx=stated.fy, fy=stated.fx, cx=cx - _HALF_PIXEL, cy=cy - _HALF_PIXEL, p1=p1, p2=p2)
