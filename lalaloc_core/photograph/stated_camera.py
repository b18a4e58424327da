"""Statements of a caller about a photograph: projection, lens and tilt.

Intrinsics are compared with the photograph, as calibrations are often of another size or orientation: principal points
are near the middle of the picture, which tells the size that a calibration was made for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.photograph.cameras import HALF_PIXEL, Around, Camera, Fisheye, Perspective

Projection = Literal["equirectangular", "perspective", "cylindrical", "fisheye"]
AUTO = "auto"
# Horizontal fields of view, degrees.
HFOV_RANGE_DEG = {
    AUTO: (10.0, 360.0),
    "equirectangular": (10.0, 360.0),
    "perspective": (10.0, 150.0),
    "cylindrical": (10.0, 360.0),
    "fisheye": (10.0, 300.0),
}
MAX_PITCH_DEG, MAX_ROLL_DEG = 60.0, 180.0
_MAX_FOCAL_RATIO = 2.0
_MAX_COEFFICIENT = 100.0
# Largest error (pixels) of distorting again what was undistorted.
_ROUND_TRIP = 0.5
# Distance of the principal point from the middle, a share of the side, beyond which a calibration hardly fits.
_FAR = 0.1
# Relative difference of the scales across and down of an exact multiple, and distance of the principal point from the
# middle of a phone's stored picture, a share of the side.
_EXACT, _NEAR = 0.005, 0.05
# Fields of view that differ by more, as a ratio of focal lengths, are contradictory.
_CONTRADICTORY = 1.25


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """Camera matrix and distortion as OpenCV's calibration prints them, for the upright picture at its full size.

    Attributes:
        cx, cy: optical centre, pixels from the centre of the top left pixel; None for the picture's centre.
        k1, k2, k3: radial distortion, of the fisheye model for projection "fisheye".
        p1, p2: tangential distortion, not of the fisheye model.
    """

    fx: float
    fy: float
    cx: float | None = None
    cy: float | None = None
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


@dataclass(frozen=True, kw_only=True)
class StatedCamera:
    """Caller's statements about one photograph; None for unknown values. Degrees, as in requests.

    Attributes:
        pitch_deg: elevation of the picture's centre above the horizon; of its whole middle row, if it is cylindrical.
        roll_deg: clockwise rotation of the camera about its optical axis.
    """

    projection: str = AUTO
    hfov_deg: float | None = None
    intrinsics: Intrinsics | None = None
    pitch_deg: float | None = None
    roll_deg: float | None = None

    def check(self) -> None:
        """Check all values that do not depend on the picture."""
        if self.projection not in HFOV_RANGE_DEG:
            raise InvalidPhotographError(
                f"projection is '{str(self.projection)[:50]}'; it must be one of {', '.join(HFOV_RANGE_DEG)}"
            )
        _check_range("hfov_deg", self.hfov_deg, *HFOV_RANGE_DEG[self.projection])
        _check_range("pitch_deg", self.pitch_deg, -MAX_PITCH_DEG, MAX_PITCH_DEG)
        _check_range("roll_deg", self.roll_deg, -MAX_ROLL_DEG, MAX_ROLL_DEG)
        if self.intrinsics is None:
            return
        if self.hfov_deg is not None:
            raise InvalidPhotographError("hfov_deg and intrinsics exclude each other; send one of them")
        if self.projection not in (AUTO, "perspective", "fisheye"):
            raise InvalidPhotographError(
                f"intrinsics do not apply to the projection '{self.projection}'; state hfov_deg"
            )
        self._check_intrinsics(self.intrinsics)

    def _check_intrinsics(self, intrinsics: Intrinsics) -> None:
        for name, value in vars(intrinsics).items():
            if value is not None and not math.isfinite(value):
                raise InvalidPhotographError(f"intrinsics: {name} is {value}; it must be finite")
        for name, focal in (("fx", intrinsics.fx), ("fy", intrinsics.fy)):
            if focal <= 0.0:
                raise InvalidPhotographError(f"intrinsics: {name} is {focal:g}; it must be positive")
        if not 1.0 / _MAX_FOCAL_RATIO <= intrinsics.fx / intrinsics.fy <= _MAX_FOCAL_RATIO:
            raise InvalidPhotographError(
                f"intrinsics: fx is {intrinsics.fx:g} and fy {intrinsics.fy:g}; they must agree within a factor of "
                f"{_MAX_FOCAL_RATIO:g}"
            )
        for name in ("k1", "k2", "k3", "k4", "p1", "p2"):
            _check_range(f"intrinsics: {name}", getattr(intrinsics, name), -_MAX_COEFFICIENT, _MAX_COEFFICIENT)
        kind, unused = ("fisheye", ("p1", "p2")) if self.projection == "fisheye" else ("perspective", ("k4",))
        for name in unused:
            if getattr(intrinsics, name) != 0.0:
                raise InvalidPhotographError(
                    f"intrinsics: {name} does not belong to the projection '{kind}'; leave it out"
                )


def camera_of_hfov(projection: Projection, width: int, height: int, hfov: float) -> Camera:
    """Return the camera of a projection with a horizontal field of view (radians)."""
    if projection == "perspective":
        return Perspective.of_hfov(width, height, hfov)
    if projection == "fisheye":
        return Fisheye.of_hfov(width, height, hfov)
    return Around(width=width, height=height, hfov=hfov, spherical=projection == "equirectangular")


def camera_of_intrinsics(
    projection: Literal["perspective", "fisheye"], width: int, height: int, intrinsics: Intrinsics
) -> Camera:
    """Return the camera of checked intrinsics."""
    centre: list[float] = []
    for name, value, side in (("cx", intrinsics.cx, width), ("cy", intrinsics.cy, height)):
        position = 0.5 * side if value is None else value + HALF_PIXEL
        if not 0.0 <= position <= side:
            raise InvalidPhotographError(
                f"intrinsics: {name} is {value:g}, outside of the upright picture of {width} x {height}"
            )
        centre.append(position)
    k1, k2, k3 = intrinsics.k1, intrinsics.k2, intrinsics.k3
    matrix = {"fx": intrinsics.fx, "fy": intrinsics.fy, "cx": centre[0], "cy": centre[1]}
    camera: Camera
    if projection == "fisheye":
        camera = Fisheye(width=width, height=height, **matrix, radial=(k1, k2, k3, intrinsics.k4))
    else:
        tangential = intrinsics.p1, intrinsics.p2
        camera = Perspective(width=width, height=height, **matrix, radial=(k1, k2, k3), tangential=tangential)
    low, high = HFOV_RANGE_DEG[projection]
    hfov_deg = math.degrees(camera.hfov)
    if not low <= hfov_deg <= high:
        raise InvalidPhotographError(
            f"intrinsics: fx is {intrinsics.fx:g} for a picture {width} pixels wide, a field of view of "
            f"{hfov_deg:.3g}°; it must be between {low:g}° and {high:g}°"
        )
    if projection == "perspective":
        _check_distortion(camera)
    return camera


def intrinsics_of(camera: Perspective | Fisheye) -> Intrinsics:
    """Return the intrinsics of a camera, from which `camera_of_intrinsics` makes it again."""
    matrix = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx - HALF_PIXEL, "cy": camera.cy - HALF_PIXEL}
    if isinstance(camera, Fisheye):
        k1, k2, k3, k4 = camera.radial
        return Intrinsics(**matrix, k1=k1, k2=k2, k3=k3, k4=k4)
    (k1, k2, k3), (p1, p2) = camera.radial, camera.tangential
    return Intrinsics(**matrix, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)


def _check_distortion(camera: Camera) -> None:
    """Refuse a distortion that maps no ray to some border."""
    across, down = np.meshgrid(np.linspace(0.0, camera.width, 9), np.linspace(0.0, camera.height, 9))
    pixels = np.stack([across, down], axis=-1)
    # Rounding can place points of the border outside of it.
    again, _ = camera.pixels(camera.rays(pixels))
    if not np.abs(again - pixels).max() < _ROUND_TRIP:
        raise InvalidPhotographError(
            "intrinsics: the distortion is not invertible within the picture; check k1, k2, k3, p1 and p2"
        )


def _check_range(name: str, value: float | None, low: float, high: float) -> None:
    # NaN is in no range.
    if value is not None and not low <= value <= high:
        raise InvalidPhotographError(f"{name} is {value:g}; it must be between {low:g} and {high:g}")


def fit_intrinsics(stated: Intrinsics, width: int, height: int, orientation: int) -> tuple[Intrinsics, tuple[str, ...]]:
    """Return the intrinsics of the upright picture, and a warning if they were changed or do not fit."""
    if stated.cx is None or stated.cy is None:
        return stated, ()
    x, y = stated.cx + HALF_PIXEL, stated.cy + HALF_PIXEL
    named = f"intrinsics: (cx, cy) is ({stated.cx:g}, {stated.cy:g})"
    if max(abs(x / width - 0.5), abs(y / height - 0.5)) <= _FAR or min(x, y) <= 0.0:
        return stated, ()
    if abs(x / width / (y / height) - 1.0) <= _EXACT:
        return _scaled(stated, (x, y), width, height, named)
    # Of the stored picture, whose width is the height of the upright one.
    is_size = max(abs(x / height - 0.5), abs(y / width - 0.5)) <= _NEAR
    if is_size or abs(x / height / (y / width) - 1.0) <= _EXACT:
        at_size, scaling = (stated, ()) if is_size else _scaled(stated, (x, y), height, width, named)
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


def _scaled(
    stated: Intrinsics, centre: tuple[float, float], width: int, height: int, named: str
) -> tuple[Intrinsics, tuple[str, ...]]:
    """Return the intrinsics scaled to a picture in whose middle the principal point is."""
    x, y = centre
    scale = 0.5 * math.sqrt(width * height / (x * y))
    fitted = replace(
        stated, fx=stated.fx * scale, fy=stated.fy * scale, cx=x * scale - HALF_PIXEL, cy=y * scale - HALF_PIXEL
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
    x, y = stated.cx + HALF_PIXEL, stated.cy + HALF_PIXEL
    cx, cy, p1, p2 = (width - y, x, stated.p2, -stated.p1) if is_clockwise else (y, height - x, -stated.p2, stated.p1)
    return replace(stated, fx=stated.fy, fy=stated.fx, cx=cx - HALF_PIXEL, cy=cy - HALF_PIXEL, p1=p1, p2=p2)
