"""Views as a data set: parts of the spheres of another data set, taken by an ordinary camera."""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.errors import DatasetError
from lalaloc_core.learn.data.dataset import Appearance, Camera, Dataset, DatasetPhotograph, Scene, Split, WithoutDepth
from lalaloc_core.photograph.cameras import Perspective, camera_axes
from lalaloc_core.photograph.patches import PatchSize
from lalaloc_core.photograph.photograph import Photograph, open_photograph
from lalaloc_core.photograph.picture_files import jpeg as encode_jpeg
from lalaloc_core.photograph.stated_camera import StatedCamera

# What is stated about photographs: nothing, the field of view, or the tilt as well.
Stated = Literal["nothing", "field", "tilt"]
# Horizontal fields of view (degrees) of phones, from which random ones are drawn.
FIELDS_DEG = (55.0, 110.0)
# Size of the spheres that views are cut from, somewhat finer than the encoder's patches, and of the views (pixels).
_SPHERE_SIZE = (512, 1024)
_VIEW_SIZE = (640, 480)
# Normal spreads and limits of pitch and roll (degrees).
_PITCH_DEG, _MAX_PITCH_DEG = 8.0, 20.0
_ROLL_DEG, _MAX_ROLL_DEG = 2.0, 5.0


@dataclass(frozen=True)
class ViewScenes:
    """Data set whose cameras take views instead of spheres, tilted as photographs taken by hand are.

    Attributes:
        field_deg: horizontal field of view; None draws one for each view.
        per_camera: number of views of each camera, at equal angles; the first looks along the sphere's centre.
        stated: what is known about the views; the rest is estimated.
    """

    spheres: Dataset
    field_deg: float | None = None
    per_camera: int = 1
    stated: Stated = "field"

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        angle = "55° to 110°" if self.field_deg is None else f"{self.field_deg:g}°"
        return f"{self.spheres.description}, views of {angle}"

    @property
    def appearances(self) -> Sequence[Appearance]:
        """Appearances of the spheres."""
        return self.spheres.appearances

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of a split's scenes."""
        return self.spheres.scenes(split)

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Load a scene and cut its views."""
        scene = self.spheres.load(name, problems)
        cameras = tuple(view for camera in scene.cameras for view in self._views(name, camera))
        return dataclasses.replace(scene, cameras=cameras)

    def _views(self, scene: str, camera: Camera) -> list[Camera]:
        rng = np.random.default_rng([zlib.crc32(f"{scene}/{camera.name}".encode()), 0])
        spheres = {look: CachedSphere(photograph) for look, photograph in camera.photographs.items()}
        views = []
        for number in range(self.per_camera):
            azimuth = float(wrap_angle(TWO_PI * number / self.per_camera))
            lens_deg = rng.uniform(*FIELDS_DEG)
            pitch, roll = tilt_by_hand(rng)
            photographs: dict[Appearance, DatasetPhotograph] = {
                look: ViewPhotograph(
                    sphere=sphere,
                    azimuth=azimuth,
                    field_deg=lens_deg if self.field_deg is None else self.field_deg,
                    pitch=pitch,
                    roll=roll,
                    stated=self.stated,
                )
                for look, sphere in spheres.items()
            }
            name = camera.name if self.per_camera == 1 else f"{camera.name}@{math.degrees(azimuth):g}"
            heading = float(wrap_angle(camera.heading + azimuth))
            views.append(dataclasses.replace(camera, name=name, heading=heading, photographs=photographs))
        return views


def tilt_by_hand(rng: np.random.Generator) -> tuple[float, float]:
    """Return a random pitch and roll (radians) of a camera held by hand."""
    pitch_deg, roll_deg = (
        float(np.clip(rng.normal(0.0, spread), -limit, limit))
        for spread, limit in ((_PITCH_DEG, _MAX_PITCH_DEG), (_ROLL_DEG, _MAX_ROLL_DEG))
    )
    return math.radians(pitch_deg), math.radians(roll_deg)


@dataclass(frozen=True, eq=False)
class CachedSphere:
    """DatasetPhotograph of which several views are cut."""

    photograph: DatasetPhotograph

    @cached_property
    def pixels(self) -> UInt8[np.ndarray, "h w 3"]:
        """The whole sphere, of the size that views are cut from."""
        return self.photograph.image(*_SPHERE_SIZE)


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewPhotograph(WithoutDepth):
    """Part of a sphere, as an ordinary camera takes it: azimuth and elevation of its centre, and its roll (radians)."""

    sphere: CachedSphere = field(repr=False)
    azimuth: float
    field_deg: float
    pitch: float
    roll: float
    stated: Stated = "field"

    @property
    def stated_camera(self) -> StatedCamera:
        """Return what is known about it as a query states it."""
        tilted = self.stated == "tilt"
        return StatedCamera(
            projection="perspective",
            hfov_deg=None if self.stated == "nothing" else self.field_deg,
            pitch_deg=math.degrees(self.pitch) if tilted else None,
            roll_deg=math.degrees(self.roll) if tilted else None,
        )

    def content(self) -> bytes:
        """Return the photograph as a file."""
        camera = Perspective.of_hfov(*_VIEW_SIZE, math.radians(self.field_deg))
        pixels = cut_view(self.sphere.pixels, camera, azimuth=self.azimuth, pitch=self.pitch, roll=self.roll)
        return encode_jpeg(pixels)

    def open(self, size: PatchSize) -> Photograph:
        """Read the photograph as the service reads a file."""
        return open_photograph(
            self.content(),
            sphere_size=_SPHERE_SIZE,
            stated=self.stated_camera,
            patch_size=size,
            # Disturbed renderings of white walls are as pale as paper.
            refuse_drawings=False,
        )

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return the whole sphere at the given size, turned to the view."""
        pixels = self.sphere.photograph.image(height, width)
        return np.roll(pixels, -round(self.azimuth / TWO_PI * width), axis=1)


def cut_view(
    sphere: UInt8[np.ndarray, "h w 3"],
    camera: Perspective,
    *,
    azimuth: float | Float[np.ndarray, "h2 1"],
    pitch: float,
    roll: float,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Return what a camera sees of a sphere: its centre at an azimuth relative to the sphere's, its tilt in radians.

    Each row has an azimuth of its own if several are given, as under a rolling shutter.
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays(np.stack([x, y], axis=-1)) @ camera_axes(pitch=pitch, roll=roll)
    right, ahead, up = np.moveaxis(rays, -1, 0)
    height, width = sphere.shape[:2]
    column = ((np.arctan2(right, ahead) + azimuth) / TWO_PI + 0.5) * width - 0.5
    row = (0.5 - np.arcsin(np.clip(up, -1.0, 1.0)) / np.pi) * height - 0.5
    where = column.astype(np.float32), row.astype(np.float32)
    return cv2.remap(sphere, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(np.uint8)
