"""Reader for photographs of any kind: from encoded bytes and statements to what the encoders expect."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import UInt8

from lalaloc_core.errors import InvalidPanoramaError
from lalaloc_core.panorama.images import Panorama, open_panorama
from lalaloc_core.panorama.levelling import camera_axes
from lalaloc_core.panorama.photo_sphere import PhotoSphere, read_photo_sphere
from lalaloc_core.panorama.pictures import PanoramaLimits, opened_picture, orientation_of, scaled, turned
from lalaloc_core.photograph.cameras import Around, Camera, Perspective
from lalaloc_core.photograph.exif import read_exif_lens
from lalaloc_core.photograph.levelling import (
    MAX_ESTIMATED_SD,
    estimate_attitude,
    estimate_calibration,
)
from lalaloc_core.photograph.lines import find_segments, lines_of
from lalaloc_core.photograph.patches import FINER, Patch, PatchSize, cut_patches
from lalaloc_core.photograph.projection import NO_FIELD_OF_VIEW, Lens, Projection, Source, find_lens, is_sphere
from lalaloc_core.photograph.stated import StatedView

# Least longer side (pixels) of decoded photographs, for lines; JPEGs decode at an eighth of their size fastest.
_LONG_SIDE = 480
_JPEG_FACTORS = (8, 4, 2, 1)
# Larger relative standard deviations of an estimated focal length are no answer.
_MAX_FOCAL_SD = 0.2
# Standard deviation of a stated pitch or roll.
_GIVEN_SD = math.radians(0.5)
# Seen azimuths: samples of the left and right border, and the largest elevation that counts.
_SAMPLES, _MAX_ELEVATION = 33, math.radians(45.0)


@dataclass(frozen=True, kw_only=True)
class Assumed:
    """Angle with its standard deviation (radians) and its origin."""

    value: float
    sd: float
    source: Source


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A photograph as the encoders expect it, and what was assumed about it.

    Attributes:
        projection: the projection.
        projection_source: its origin.
        hfov: horizontal field of view.
        pitch: elevation of the centre of the picture.
        roll: clockwise rotation of the camera about its optical axis.
        azimuths: first and last azimuth (radians) that the photograph shows, relative to its centre, clockwise.
        patches: level patches that cover the photograph; empty for a full sphere.
        panorama: the level sphere; None for other photographs.
        camera: camera of the full upright picture; None for a full sphere.
        warnings: metadata that were ignored, and estimates to be checked.
    """

    projection: Projection
    projection_source: Source
    hfov: Assumed
    pitch: Assumed
    roll: Assumed
    azimuths: tuple[float, float]
    patches: tuple[Patch, ...] = ()
    panorama: Panorama | None = None
    camera: Camera | None = None
    warnings: tuple[str, ...] = ()


def open_view(
    content: bytes,
    *,
    sphere_size: tuple[int, int],
    stated: StatedView | None = None,
    patch_size: PatchSize | None = None,
    limits: PanoramaLimits | None = None,
) -> View:
    """Decode a JPEG, PNG, WebP or HEIC photograph of any projection.

    Args:
        content: the file.
        sphere_size: height and width (pixels) that a full sphere is scaled to.
        stated: the caller's statements; None for none.
        patch_size: size of the patches of other photographs.
        limits: limits of the file.

    Raises:
        InvalidPanoramaError: the file is not readable or too large, a statement is invalid, or nothing says what the
            picture shows.
    """
    stated, limits = stated or StatedView(), limits or PanoramaLimits()
    size = patch_size or PatchSize()
    stated.check()

    @cache
    def panorama() -> Panorama:
        pitch, roll = (None if angle is None else math.radians(angle) for angle in (stated.pitch_deg, stated.roll_deg))
        height, width = sphere_size
        return open_panorama(content, height=height, width=width, limits=limits, pitch=pitch, roll=roll)

    with opened_picture(content, limits) as image:
        orientation = orientation_of(image)
        width, height = turned(image.size, orientation)
        if min(width, height) < limits.min_height:
            raise InvalidPanoramaError(
                f"the photograph is {width} x {height}; the minimum is {limits.min_height} pixels on each side"
            )
        sphere = read_photo_sphere(image.info.get("xmp"), width=width, height=height)
        lens = find_lens(
            width,
            height,
            stated=stated,
            sphere=sphere,
            exif=read_exif_lens(image.getexif(), width=width, height=height),
            looks_spherical=lambda: is_sphere(panorama().pixels),
        )
        if lens.is_sphere:
            return _sphere_view(panorama(), lens, stated, sphere)
        picture = np.asarray(scaled(image, orientation, _decoded_size(width, height, lens, size), oversampling=1))
    return _view(picture, (width, height), lens, stated, size)


def _sphere_view(panorama: Panorama, lens: Lens, stated: StatedView, sphere: PhotoSphere) -> View:
    def tilt(stated_deg: float | None, metadata: float) -> Assumed:
        if stated_deg is not None:
            return Assumed(value=math.radians(stated_deg), sd=_GIVEN_SD, source="given")
        return Assumed(value=metadata, sd=_GIVEN_SD, source="gpano" if metadata else "assumed")

    half = math.pi * (1.0 if sphere.part is None else sphere.part.width)
    return View(
        projection=lens.projection,
        projection_source=lens.projection_source,
        hfov=Assumed(value=2.0 * half, sd=0.0, source=lens.projection_source),
        pitch=tilt(stated.pitch_deg, sphere.pitch),
        roll=tilt(stated.roll_deg, sphere.roll),
        azimuths=(-half, half),
        panorama=panorama,
        warnings=lens.warnings,
    )


def _view(
    picture: UInt8[np.ndarray, "h w 3"], full_size: tuple[int, int], lens: Lens, stated: StatedView, size: PatchSize
) -> View:
    rows, columns = picture.shape[:2]
    needs_lines = lens.camera is None or stated.pitch_deg is None or stated.roll_deg is None
    segments = find_segments(picture) if needs_lines else np.zeros((0, 4))
    warnings = lens.warnings
    if lens.camera is None:
        found = estimate_calibration(segments, width=columns, height=rows)
        if found.focal_sd > _MAX_FOCAL_SD:
            raise InvalidPanoramaError(NO_FIELD_OF_VIEW)
        attitude, focal_sd = found.attitude, found.focal_sd
        camera: Camera = Perspective.of_hfov(*full_size, found.hfov)
        warnings = (
            *warnings,
            f"the field of view of {math.degrees(found.hfov):.0f}° was estimated from straight lines; send hfov_deg or "
            "the camera's original file",
        )
        small = camera.scaled(columns, rows)
    else:
        camera, focal_sd = lens.camera, lens.focal_sd
        small = camera.scaled(columns, rows)
        attitude = estimate_attitude(lines_of(segments, small))
    pitch = _tilt(stated.pitch_deg, attitude.pitch, attitude.pitch_sd)
    roll = _tilt(stated.roll_deg, attitude.roll, attitude.roll_sd)
    tilt = pitch.value
    if isinstance(camera, Around) and lens.projection == "cylindrical" and pitch.source == "given":
        # A strip's pitch is the same all around, so its camera is not rotated.
        camera, tilt = replace(camera, elevation=pitch.value), 0.0
        small = camera.scaled(columns, rows)
    return View(
        projection=lens.projection,
        projection_source=lens.projection_source,
        hfov=Assumed(value=camera.hfov, sd=_hfov_sd(camera, focal_sd), source=lens.hfov_source),
        pitch=pitch,
        roll=roll,
        azimuths=_seen_azimuths(small, tilt, roll.value),
        patches=cut_patches(picture, small, pitch=tilt, roll=roll.value, size=size),
        camera=camera,
        warnings=warnings,
    )


def _tilt(stated_deg: float | None, angle: float, sd: float) -> Assumed:
    if stated_deg is not None:
        return Assumed(value=math.radians(stated_deg), sd=_GIVEN_SD, source="given")
    return Assumed(value=angle, sd=sd, source="estimated" if sd < MAX_ESTIMATED_SD else "assumed")


def _decoded_size(width: int, height: int, lens: Lens, size: PatchSize) -> tuple[int, int]:
    """Return a size at which a JPEG decodes fast, fine enough for lines and patches if the picture is."""
    most = max(width, height) / _LONG_SIDE
    if lens.camera is not None:
        most = min(most, lens.camera.resolution / (FINER * size.resolution))
    eighth = next((factor for factor in _JPEG_FACTORS if most >= factor), 1)
    factor = eighth * max(1, int(most / eighth))
    return -(-width // factor), -(-height // factor)


def _hfov_sd(camera: Camera, focal_sd: float) -> float:
    """Return the standard deviation of the field of view; only that of perspective cameras is not linear."""
    return focal_sd * (math.sin(camera.hfov) if isinstance(camera, Perspective) else camera.hfov)


def _seen_azimuths(camera: Camera, pitch: float, roll: float) -> tuple[float, float]:
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
