"""Decision which projection and lens a photograph has: statements, metadata, or the picture itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.photograph.cameras import Camera, Perspective
from lalaloc_core.photograph.exif import ExifLens
from lalaloc_core.photograph.photo_sphere import PhotoSphere
from lalaloc_core.photograph.stated_camera import (
    AUTO,
    HFOV_RANGE_DEG,
    Projection,
    StatedCamera,
    camera_of_hfov,
    camera_of_intrinsics,
    compare_focal_lengths,
    fit_intrinsics,
)

# Origins of a value: the caller, GPano metadata, EXIF metadata, the picture, or a usual value.
Source = Literal["given", "gpano", "exif", "estimated", "assumed"]
# A wider stated field of view of a photograph is a strip of a phone's panorama mode.
_WIDEST_LENS = math.radians(120.0)
# Sides of photographs differ at most by this factor; longer ones are strips.
_LONGEST = 2.25
# Relative deviation of a sphere from twice as wide as high; stitchers round.
SPHERE_TOLERANCE = 0.01
# `is_sphere`: limits of the product of seam and poles, of the seam, of the more uniform pole, and of the contrast (grey
# levels). Fitted on photographs and rendered spheres: all photographs pass, with a margin of two.
_MAX_PRODUCT, _MAX_SEAM, _MAX_POLE, _MIN_CONTRAST = 0.2, 8.0, 0.5, 2.0
# `is_closed`: limit of the difference between the borders, relative to that between columns.
_MAX_CLOSED_SEAM = 4.0
_UNCLOSED = ": GPano FullPanoWidthPixels is the width of the part, but the borders do not continue each other"
# Smallest height and width (pixels) of pictures that `is_sphere` judges.
COARSEST = 128, 256
# Relative standard deviation of a stated focal length.
_GIVEN_SD = 0.01
# That of the wide lenses of action cameras.
_ACTION_SD = 0.05
# Advice for photographs without a known field of view.
_HELP = (
    "state hfov_deg, its horizontal field of view (a phone's main lens has about 67° in landscape and 53° in portrait "
    "format), or intrinsics"
)


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Projection of a photograph.

    Attributes:
        camera: camera of the full upright picture; None if the field of view is to be estimated.
        is_doubtful: straight lines can contradict the field of view.
    """

    projection: Projection
    projection_source: Source
    camera: Camera | None = None
    hfov_source: Source = "estimated"
    focal_sd: float = 0.0
    is_doubtful: bool = False
    warnings: tuple[str, ...] = ()

    @property
    def is_sphere(self) -> bool:
        """True for the full sphere, or a part that the GPano metadata place on it."""
        return self.projection == "equirectangular" and self.camera is None


def find_lens(
    width: int,
    height: int,
    *,
    stated: StatedCamera,
    sphere: PhotoSphere,
    exif: ExifLens,
    looks_spherical: Callable[[], bool],
    closes: Callable[[], bool] = lambda: True,
    orientation: int = 1,
) -> Lens:
    """Return the projection of a picture: as stated, by GPano, by the picture itself, or by its EXIF focal length.

    `looks_spherical` is `is_sphere` of the picture, called only if nothing else decides; `closes` is `is_closed` of it,
    called only for a strip whose metadata state 360°.
    """
    projection, source = _projection(width, height, stated, sphere, exif, looks_spherical)
    unknown = Lens(projection=projection, projection_source=source)

    def known(camera: Camera, hfov_source: Source, warnings: tuple[str, ...] = ()) -> Lens:
        if isinstance(camera, Perspective) and exif.fisheye is None:
            warnings += compare_focal_lengths(camera.fx, exif.focal, width)
        return replace(unknown, camera=camera, hfov_source=hfov_source, focal_sd=_GIVEN_SD, warnings=warnings)

    if stated.intrinsics is not None and projection in ("perspective", "fisheye"):
        intrinsics, warnings = fit_intrinsics(stated.intrinsics, width, height, orientation)
        return known(camera_of_intrinsics(projection, width, height, intrinsics), "given", warnings)
    is_full = projection == "equirectangular" and is_twice_as_wide(width, height) and stated.hfov_deg == 360.0
    if stated.hfov_deg is not None and not is_full:
        return known(camera_of_hfov(projection, width, height, math.radians(stated.hfov_deg)), "given")
    kind = "sphere" if projection == "equirectangular" else "strip"
    unused = () if stated.intrinsics is None else (f"intrinsics are not used: the photograph is a {kind}",)
    if projection == "equirectangular":
        return replace(unknown, hfov_source=source, warnings=unused)
    if projection == "cylindrical" and sphere.cylinder is not None and (sphere.cylinder < TWO_PI or closes()):
        return known(camera_of_hfov(projection, width, height, sphere.cylinder), "gpano", unused)
    if projection == "cylindrical":
        raise InvalidPhotographError(
            f"nothing tells which angle the strip of {width} x {height} shows{_UNCLOSED if sphere.cylinder else ''}; "
            "state hfov_deg, its horizontal field of view (up to 360)"
        )
    if projection == "fisheye" and exif.fisheye is not None:
        return _action_camera(width, height, unknown, exif, exif.fisheye)
    if projection == "fisheye":
        raise InvalidPhotographError(
            "a fisheye photograph needs hfov_deg, its horizontal field of view, or intrinsics (OpenCV's fisheye model)"
        )
    return _perspective(width, height, replace(unknown, warnings=exif.warnings), exif)


def is_sphere(pixels: UInt8[np.ndarray, "h w 3"]) -> bool:
    """Return whether a picture twice as wide as high looks like a full sphere.

    Its left and right border continue each other, and its first and last row, around the poles, hardly vary. Pictures
    less than `COARSEST` have too wide rows.
    """
    # Rows, channels, columns: numpy reduces the last axis several times as fast as one before it.
    values = np.ascontiguousarray(pixels.transpose(0, 2, 1), np.float32)
    rows = len(values)
    body = slice(rows // 8, rows - rows // 8)
    spread = values.std(axis=2).mean(axis=1)
    contrast = float(np.median(spread[body]))
    if contrast < _MIN_CONTRAST:
        return False
    step = float(np.abs(np.diff(values[body], axis=2)).mean())
    seam = float(np.abs(values[body, :, 0] - values[body, :, -1]).mean()) / (step + 0.5)
    # A tripod or the edge of a table at one pole must not outweigh the other pole and the borders.
    top, bottom = (min((float(spread[row]) + 0.5) / (contrast + 0.5), 1.0) for row in (0, -1))
    return seam < _MAX_SEAM and min(top, bottom) < _MAX_POLE and seam * top * bottom < _MAX_PRODUCT


def is_closed(pixels: UInt8[np.ndarray, "h w 3"]) -> bool:
    """Return whether the left and right border of a picture continue each other."""
    values = pixels.astype(np.float32)
    step = float(np.abs(np.diff(values, axis=1)).mean())
    return float(np.abs(values[:, 0] - values[:, -1]).mean()) / (step + 0.5) < _MAX_CLOSED_SEAM


def is_twice_as_wide(width: int, height: int) -> bool:
    """Return whether a picture has the sides of a full sphere."""
    return abs(width / height - 2.0) <= 2.0 * SPHERE_TOLERANCE


def _projection(
    width: int,
    height: int,
    stated: StatedCamera,
    sphere: PhotoSphere,
    exif: ExifLens,
    looks_spherical: Callable[[], bool],
) -> tuple[Projection, Source]:
    if stated.projection != AUTO:
        return stated.projection, "given"  # pyright: ignore[reportReturnType]
    if sphere.declared:
        if sphere.fault is not None and is_twice_as_wide(width, height) and not looks_spherical():
            raise InvalidPhotographError(
                f"the photograph of {width} x {height} has invalid photo sphere metadata, {sphere.fault}, and is not a "
                f"full 360° sphere; {_HELP}"
            )
        return "equirectangular", "gpano"
    if sphere.cylinder is not None:
        return "cylindrical", "gpano"
    if stated.intrinsics is not None:
        return "perspective", "assumed"
    hfov = TWO_PI if stated.hfov_deg is None else math.radians(stated.hfov_deg)
    twice_as_wide = is_twice_as_wide(width, height)
    if twice_as_wide and hfov == TWO_PI and looks_spherical():
        return "equirectangular", "estimated"
    if exif.fisheye is not None and not exif.strip and not twice_as_wide:
        return "fisheye", "exif"
    if stated.hfov_deg is not None:
        return ("cylindrical" if exif.strip or hfov > _WIDEST_LENS else "perspective"), "assumed"
    if exif.strip:
        return "cylindrical", "exif"
    if exif.focal is None and twice_as_wide:
        raise InvalidPhotographError(
            f"the photograph of {width} x {height} is not a full 360° sphere: its borders do not continue each other, "
            f"or its poles are not uniform; {_HELP}, or projection=equirectangular if it is one"
        )
    if max(width, height) > _LONGEST * min(width, height):
        raise InvalidPhotographError(
            f"the photograph of {width} x {height} is a strip; state projection=cylindrical and hfov_deg, its "
            "horizontal field of view (up to 360)"
        )
    return "perspective", "exif" if exif.focal is not None else "assumed"


def _action_camera(width: int, height: int, lens: Lens, exif: ExifLens, angle: float) -> Lens:
    """Return the lens of an action camera by its maker and model."""
    text = (
        f"{exif.camera} has a fisheye lens of about {math.degrees(angle):.0f}° across the longer side, which is "
        "assumed; for a linear mode state projection=perspective and hfov_deg"
    )
    camera = camera_of_hfov("fisheye", width, height, angle * width / max(width, height))
    warnings = (*exif.warnings, text)
    return replace(lens, camera=camera, hfov_source="assumed", focal_sd=_ACTION_SD, warnings=warnings)


def _perspective(width: int, height: int, lens: Lens, exif: ExifLens) -> Lens:
    """Return the lens of an ordinary photograph by its EXIF focal length, if that is plausible."""
    if exif.focal is None:
        return lens
    camera = Perspective(width=width, height=height, fx=exif.focal, fy=exif.focal, cx=0.5 * width, cy=0.5 * height)
    low, high = HFOV_RANGE_DEG["perspective"]
    if not low <= math.degrees(camera.hfov) <= high:
        warning = f"the EXIF focal length gives a field of view of {math.degrees(camera.hfov):.3g}° and is ignored"
        return replace(lens, warnings=(*exif.warnings, warning))
    return replace(lens, camera=camera, hfov_source="exif", focal_sd=exif.focal_sd, is_doubtful=exif.is_doubtful)
