"""Reader for photographs of any kind: from encoded bytes and statements to what the encoders expect.

`open_photograph` opens a file once, and decides from what it reads: what is known of the camera (`_Opened`), the format
of a sphere (`sphere_formats.py`), the projection (`projection.py`), and the pixels: level spheres or patches.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import ExifTags, Image

from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.file_kinds import is_drawing
from lalaloc_core.photograph.cameras import Around, Camera, Perspective, camera_axes
from lalaloc_core.photograph.exif import ExifLens, Taken, read_exif_lens, read_taken
from lalaloc_core.photograph.levelling import (
    MAX_ESTIMATED_SD,
    bend_warnings,
    estimate_attitude,
    estimate_calibration,
    find_segments,
    lines_of,
)
from lalaloc_core.photograph.overlap import find_features, shrunk
from lalaloc_core.photograph.patches import FINER, Patch, PatchSize, cut_patches, reduced, seen_azimuths, thumbnail_of
from lalaloc_core.photograph.photo_sphere import PhotoSphere, read_photo_sphere
from lalaloc_core.photograph.picture_files import FORMATS, PhotographLimits, PictureFile, opened_picture, scaled
from lalaloc_core.photograph.projection import COARSEST, Lens, Source, find_lens, is_closed, is_twice_as_wide
from lalaloc_core.photograph.sphere_formats import THUMBNAIL_SIDE, SphereFormat, Thumbnail, find_sphere_format
from lalaloc_core.photograph.spheres import level_sphere
from lalaloc_core.photograph.stated_camera import AUTO, Projection, StatedCamera
from lalaloc_core.photograph.turn_angles import Overview

# Use of a photograph: by itself, in an album, or in a turn or a film of one, where `turned.py` finds its tilt and cuts
# its patches.
Purpose = Literal["single", "album", "turn", "film"]
# Longer side (pixels) at which to find what other photographs show too: those of one spot differ little in scale.
_OVERVIEW_SIDES = {"turn": 420, "film": 420, "album": 640}
# Least longer side (pixels) of decoded photographs, for lines; JPEGs decode at an eighth of their size fastest.
_LONG_SIDE = 480
_JPEG_FACTORS = (8, 4, 2, 1)
# Largest ratio of sides: at the size at which lines are found, flatter pictures have no row.
_MAX_RATIO = 500
# Ratios of sides of photographs, and their relative deviation.
_USUAL_RATIOS, _USUAL_TOLERANCE = (4.0 / 3.0, 1.5, 16.0 / 9.0), 0.02
# Log ratio by which lines, and twice their deviation, contradict the focal length of an edited picture: in 2 % of 848
# views of real rooms, and in 88 % (65 %) of these cropped to 0.5 (0.7) of their sides.
_NARROWER = 0.2
# Mean brightness (of 255) of photographs that are too dark.
_DARK = 12.0
# Standard deviation of a stated pitch or roll.
_GIVEN_SD = math.radians(0.5)


@dataclass(frozen=True, kw_only=True)
class Assumed:
    """Angle with its standard deviation (radians) and its origin."""

    value: float
    sd: float
    source: Source


@dataclass(frozen=True, eq=False)
class PhotographFeatures:
    """Outputs of an image encoder, which replace the pixels of a photograph.

    Attributes:
        outputs: arrays by name, for a camera height of 1 m; see `localise.encode.features`.
        azimuths: azimuth (radians) of each patch relative to the photograph's centre; empty for a full sphere.
    """

    outputs: Mapping[str, np.ndarray]
    azimuths: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Photograph:
    """A photograph as the encoders expect it, and what was assumed about it.

    Attributes:
        roll: clockwise rotation of the camera about its optical axis.
        wall_direction: azimuth of walls relative to the photograph's centre, up to quarter turns, by straight lines;
            None without lines, and for a full sphere.
        azimuths: first and last azimuth (radians) that the photograph shows, relative to its centre, clockwise.
        patches: level patches that cover the photograph; empty for a full sphere.
        sphere: (h, w, 3) pixels of the level full sphere; None for other photographs.
        thumbnail: (h, w, 3) pixels of the whole upright picture, small; None for a full sphere.
        camera: camera of the full upright picture; None for a full sphere.
        axes: rotation from level rays (right, forward, up) to the camera's frame; None for a full sphere.
        compass_heading: azimuth of the centre, radians clockwise from true north; None if not in the metadata.
        overview: parts that tell its angles to photographs that overlap it, in albums and turns.
        is_upright: its metadata or a stated tilt tell which side is up; if not, it can lie on the side or upside down.
    """

    projection: Projection
    projection_source: Source
    hfov: Assumed
    pitch: Assumed
    roll: Assumed
    azimuths: tuple[float, float]
    wall_direction: Assumed | None = None
    patches: tuple[Patch, ...] = ()
    sphere: UInt8[np.ndarray, "h w 3"] | None = None
    thumbnail: UInt8[np.ndarray, "h w 3"] | None = None
    camera: Camera | None = None
    axes: Float[np.ndarray, "3 3"] | None = None
    features: PhotographFeatures | None = None
    compass_heading: float | None = None
    taken: Taken | None = None
    overview: Overview | None = None
    is_upright: bool = False
    warnings: tuple[str, ...] = ()

    @property
    def is_sphere(self) -> bool:
        """True if the photograph is a full sphere."""
        return self.sphere is not None or (self.features is not None and not self.features.azimuths)

    @property
    def has_stated_field(self) -> bool:
        """True if the field of view is stated or in the metadata, not estimated."""
        return self.hfov.source not in ("estimated", "assumed")

    @property
    def patch_azimuths(self) -> tuple[float, ...]:
        """Azimuths (radians) of the patches relative to the photograph's centre; none for a full sphere."""
        return tuple(patch.azimuth_rad for patch in self.patches) if self.features is None else self.features.azimuths

    def tilt_sd(self, azimuth: float) -> float:
        """Return the standard deviation (radians) of elevations along an azimuth, from those of pitch and roll."""
        return math.hypot(self.pitch.sd * math.cos(azimuth), self.roll.sd * math.sin(azimuth))

    def project(self, rays: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n 2"], Bool[np.ndarray, "*n"]]:
        """Return where the upright picture shows level rays (right, forward, up), and whether it does.

        Places are shares (x, y) of its width and height. For photographs with a camera, which full spheres have not.
        """
        assert self.camera is not None
        assert self.axes is not None
        pixels, seen = self.camera.pixels(rays @ self.axes.T)
        return pixels / (self.camera.width, self.camera.height), seen


def open_picture(
    content: bytes, *, max_size: tuple[int, int], limits: PhotographLimits | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Decode the upright picture of a photograph, no wider and higher than `max_size` (pixels), to be shown."""
    with opened_picture(content, limits or PhotographLimits()) as file:
        width, height = file.upright_size
        share = min(max_size[0] / width, max_size[1] / height)
        size = max(1, round(share * width)), max(1, round(share * height))
        return np.asarray(scaled(file, size))


def warm_up(*, sphere_size: tuple[int, int], patch_size: PatchSize) -> None:
    """Read small pictures, so that codecs and detectors are loaded before the first request."""
    sphere = StatedCamera(projection="equirectangular")
    for name, height, stated in (
        *((name, 128, sphere) for name in FORMATS),
        ("JPEG", 192, StatedCamera(projection="perspective", hfov_deg=70.0)),
    ):
        buffer = io.BytesIO()
        Image.new("RGB", (256, height), "gray").save(buffer, name)
        open_photograph(buffer.getvalue(), sphere_size=sphere_size, stated=stated, patch_size=patch_size)


def open_photograph(
    content: bytes,
    *,
    sphere_size: tuple[int, int],
    stated: StatedCamera | None = None,
    patch_size: PatchSize | None = None,
    limits: PhotographLimits | None = None,
    purpose: Purpose = "single",
    refuse_drawings: bool = True,
) -> Photograph:
    """Decode a JPEG, PNG, WebP or HEIC photograph of any projection.

    A full sphere is scaled to `sphere_size` (height, width in pixels). Photographs of albums and turns get an overview,
    and those of turns no patches. A plan or a page of text is refused if `refuse_drawings`; an overexposed white wall
    can be taken for one.

    Raises:
        InvalidPhotographError: the file is not readable or too large, a statement is invalid, or nothing says what the
            picture shows.
    """
    stated, limits, size = stated or StatedCamera(), limits or PhotographLimits(), patch_size or PatchSize()
    stated.check()
    with opened_picture(content, limits) as file:
        opened = _Opened.of(file, stated, sphere_size, limits)
        taken = read_taken(file.exif, file.packets, width=opened.width, height=opened.height)
        found = opened.sphere_format()
        if found is not None and found.box is not None:
            opened = opened.taken_out(found)
            is_sphere = found.is_sphere
            lens = Lens(projection="equirectangular", projection_source="estimated") if is_sphere else opened.lens()
        elif found is not None and (stated.projection == AUTO or not is_twice_as_wide(opened.width, opened.height)):
            raise InvalidPhotographError(found.text)
        else:
            lens = opened.lens()
        pixels = opened.sphere if lens.is_sphere else opened.picture(lens.camera, size)
        named = () if found is None else (found.text,)
        light = max(cv2.mean(pixels))
        if light < _DARK:
            named += (f"the photograph is dark, {light:.0f} of 255 on average, below {_DARK:g}: take it in a lit room",)
        lens = replace(lens, warnings=(*named, *file.warnings, *opened.metadata.warnings, *lens.warnings))
    if refuse_drawings and is_drawing(pixels):
        raise InvalidPhotographError(
            "the picture is a drawing or a page of text, not a photograph: upload a plan as a floor plan, and send a "
            "photograph taken in one of its rooms"
        )
    if lens.is_sphere:
        photograph = _photograph_of_sphere(pixels, lens, stated, opened.metadata)
    else:
        photograph = photograph_of_picture(pixels, (opened.width, opened.height), lens, stated, size, purpose)
    # Software without a sensor states an orientation, too, but no camera; and editors turn pictures.
    is_by_camera = bool(taken.make) and not opened.exif.is_doubtful and ExifTags.Base.Orientation in file.exif
    is_upright = photograph.is_upright or is_by_camera
    return replace(photograph, taken=taken, is_upright=is_upright)


@dataclass(eq=False)
class _Opened:
    """An opened photograph: what is known of its camera, and its pixels, which are decoded when they are needed."""

    file: PictureFile
    stated: StatedCamera
    sphere_size: tuple[int, int]
    limits: PhotographLimits
    width: int
    height: int
    metadata: PhotoSphere
    exif: ExifLens
    _pictures: dict[tuple[int, int], UInt8[np.ndarray, "h w 3"]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, file: PictureFile, stated: StatedCamera, sphere_size: tuple[int, int], limits: PhotographLimits
    ) -> _Opened:
        """Read the metadata of a file; a stated tilt replaces that of the metadata."""
        width, height = file.upright_size
        if min(width, height) < limits.min_height:
            raise InvalidPhotographError(
                f"the photograph is {width} x {height}; the minimum is {limits.min_height} pixels on each side"
            )
        if max(width, height) > _MAX_RATIO * min(width, height):
            raise InvalidPhotographError(
                f"the photograph is {width} x {height}; one side can be {_MAX_RATIO} times as long as the other at most"
            )
        metadata = read_photo_sphere(file.packets, width=width, height=height)
        if stated.pitch_deg is not None:
            metadata = replace(metadata, pitch=math.radians(stated.pitch_deg))
        if stated.roll_deg is not None:
            metadata = replace(metadata, roll=math.radians(stated.roll_deg))
        exif = read_exif_lens(file.exif, file.packets, width=width, height=height)
        return cls(file, stated, sphere_size, limits, width, height, metadata, exif)

    @cached_property
    def sphere(self) -> UInt8[np.ndarray, "h w 3"]:
        """Pixels of the level sphere."""
        return level_sphere(self.file, self.metadata, self.sphere_size, self.limits)

    def picture(self, camera: Camera | None, patch_size: PatchSize) -> UInt8[np.ndarray, "h w 3"]:
        """Return the upright picture at a size at which a JPEG decodes fast, fine enough for lines and patches."""
        most = max(self.width, self.height) / _LONG_SIDE
        if camera is not None:
            most = min(most, camera.resolution / (FINER * patch_size.resolution))
        eighth = next((factor for factor in _JPEG_FACTORS if most >= factor), 1)
        factor = eighth * max(1, int(most / eighth))
        size = -(-self.width // factor), -(-self.height // factor)
        if size not in self._pictures:
            self._pictures[size] = np.asarray(scaled(self.file, size, oversampling=1))
        return self._pictures[size]

    @cached_property
    def thumbnail(self) -> Thumbnail:
        """Small upright picture by which the format is told; of pixels that are decoded in any case, if possible."""
        orientation = self.file.orientation
        is_plain = orientation == 1 and self.width == 2 * self.height and self.metadata.level
        is_fine = self.sphere_size[0] >= COARSEST[0]
        picture = self.sphere if is_plain and is_fine else self.picture(None, PatchSize())
        picture = shrunk(picture, COARSEST[1] if is_plain else THUMBNAIL_SIDE)
        return Thumbnail(picture, orientation)

    def sphere_format(self) -> SphereFormat | None:
        """Return the format of a sphere that the picture holds, unless statements or metadata tell its camera."""
        stated, metadata = self.stated, self.metadata
        is_known = stated.hfov_deg is not None or stated.intrinsics is not None or metadata.part is not None
        if is_known or stated.projection not in (AUTO, "equirectangular") or metadata.refusal is not None:
            return None
        ratio = max(self.width, self.height) / min(self.width, self.height)
        # Cameras write a focal length into usual photographs.
        if self.exif.focal is not None and any(abs(ratio / usual - 1.0) <= _USUAL_TOLERANCE for usual in _USUAL_RATIOS):
            return None
        found = find_sphere_format(self.thumbnail)
        is_said = metadata.declared or stated.projection == "equirectangular"
        return None if found is not None and is_said and not found.is_sphere else found

    def taken_out(self, found: SphereFormat) -> _Opened:
        """Return the sphere that the picture holds; GPano metadata count if they are of the same picture."""
        if found.is_stored:
            file = replace(self.file, exif=Image.Exif())
        else:
            assert found.box is not None
            file = replace(self.file, box=found.box, packets=[])
        return _Opened.of(file, self.stated, self.sphere_size, self.limits)

    def lens(self) -> Lens:
        """Return the projection and the camera."""
        return find_lens(
            self.width,
            self.height,
            stated=self.stated,
            sphere=self.metadata,
            exif=self.exif,
            orientation=self.file.orientation,
            looks_spherical=lambda: self.thumbnail.looks_spherical,
            closes=lambda: is_closed(self.thumbnail.pixels),
        )


def _photograph_of_sphere(
    sphere: UInt8[np.ndarray, "h w 3"], lens: Lens, stated: StatedCamera, metadata: PhotoSphere
) -> Photograph:
    half = math.pi * (1.0 if metadata.part is None else metadata.part.width)
    by_metadata = (
        Assumed(value=angle, sd=_GIVEN_SD, source="gpano" if angle else "assumed")
        for angle in (metadata.pitch, metadata.roll)
    )
    pitch, roll = map(_stated_or, (stated.pitch_deg, stated.roll_deg), by_metadata)
    heading = metadata.compass_heading
    if heading is not None and metadata.part is not None:
        # That of the picture's centre, which is not that of the full sphere in a part beside it.
        heading = (heading + metadata.part.azimuth) % math.tau
    return Photograph(
        projection=lens.projection,
        projection_source=lens.projection_source,
        hfov=Assumed(value=2.0 * half, sd=0.0, source=lens.projection_source),
        pitch=pitch,
        roll=roll,
        azimuths=(-half, half),
        sphere=sphere,
        compass_heading=heading,
        warnings=lens.warnings,
    )


def photograph_of_picture(
    picture: UInt8[np.ndarray, "h w 3"],
    full_size: tuple[int, int],
    lens: Lens,
    stated: StatedCamera,
    size: PatchSize,
    purpose: Purpose,
) -> Photograph:
    """Return the photograph of a decoded upright picture, whose full size (width, height) the lens is for."""
    rows, columns = picture.shape[:2]
    is_of_turn = purpose in ("turn", "film")
    segments = find_segments(picture)
    camera, focal_sd, attitude, warnings = lens.camera, lens.focal_sd, None, lens.warnings
    if camera is None or lens.is_doubtful:
        hfov, sd, tilt_by_lines = estimate_calibration(segments, width=columns, height=rows)
        by_lines = Perspective.of_hfov(*full_size, hfov)
        origin = "was estimated from straight lines" if len(segments) else "is only usual"
        if camera is not None and math.log(by_lines.fx / camera.resolution) > max(_NARROWER, 2.0 * sd):
            origin += f", as the picture was edited and its EXIF focal length gives {math.degrees(camera.hfov):.0f}°"
            camera, lens = None, replace(lens, hfov_source="estimated")
        if camera is None:
            camera, focal_sd, attitude = by_lines, sd, tilt_by_lines
            if not is_of_turn:
                warnings = (*warnings, field_warning(hfov, _hfov_sd(camera, focal_sd), origin))
    small = camera.scaled(columns, rows)
    lines = lines_of(segments, small)
    attitude = attitude or estimate_attitude(lines)
    warnings = (*warnings, *bend_warnings(segments, small))
    estimated = (
        Assumed(value=angle, sd=sd, source="estimated" if sd < MAX_ESTIMATED_SD else "assumed")
        for angle, sd in ((attitude.pitch, attitude.pitch_sd), (attitude.roll, attitude.roll_sd))
    )
    pitch, roll = map(_stated_or, (stated.pitch_deg, stated.roll_deg), estimated)
    tilt = pitch.value
    if isinstance(camera, Around) and lens.projection == "cylindrical" and pitch.source == "given":
        # A strip's pitch is the same all around, so its camera is not rotated.
        camera, tilt = replace(camera, elevation=pitch.value), 0.0
        small = camera.scaled(columns, rows)
    hfov = Assumed(value=camera.hfov, sd=_hfov_sd(camera, focal_sd), source=lens.hfov_source)
    walls = Assumed(value=attitude.yaw, sd=attitude.yaw_sd, source="estimated")
    # Strips are not turned by the tilt that others tell.
    is_levelled_later = is_of_turn and not isinstance(camera, Around)
    overlapping = None
    if purpose != "single":
        overlapping = Overview(
            find_features(picture, _OVERVIEW_SIDES[purpose]),
            segments / (columns, rows, columns, rows),
            attitude,
            reduced(picture, small, size)[0] if is_levelled_later else None,
        )
    return Photograph(
        projection=lens.projection,
        projection_source=lens.projection_source,
        hfov=hfov,
        pitch=pitch,
        roll=roll,
        azimuths=seen_azimuths(small, tilt, roll.value),
        wall_direction=walls if math.isfinite(walls.sd) else None,
        patches=() if is_levelled_later else cut_patches(picture, small, pitch=tilt, roll=roll.value, size=size),
        thumbnail=thumbnail_of(picture),
        camera=camera,
        axes=camera_axes(pitch=tilt, roll=roll.value),
        overview=overlapping,
        is_upright=stated.pitch_deg is not None or stated.roll_deg is not None or isinstance(camera, Around),
        warnings=warnings,
    )


def field_warning(hfov: float, sd: float, origin: str) -> str:
    """Return the warning that a field of view (radians) is not known."""
    return (
        f"the field of view of {math.degrees(hfov):.0f}° ± {math.degrees(2.0 * sd):.0f}° {origin}; "
        "state hfov_deg, or send the camera's original file"
    )


def _stated_or(stated_deg: float | None, otherwise: Assumed) -> Assumed:
    return otherwise if stated_deg is None else Assumed(value=math.radians(stated_deg), sd=_GIVEN_SD, source="given")


def _hfov_sd(camera: Camera, focal_sd: float) -> float:
    """Return the standard deviation of the field of view; only that of perspective cameras is not linear."""
    return focal_sd * (math.sin(camera.hfov) if isinstance(camera, Perspective) else camera.hfov)
