"""Generated homes with other photographs: degraded ones, and photographs of which no place is right.

Calibration (`lalaloc_core.evaluate.calibrate`) needs degraded photographs and small length errors, because renderings
of exact plans fit better than photographs do. Photographs of other homes, of no room, upside down or cropped are its
unknown places.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, UInt8

from lalaloc_core.errors import DatasetError
from lalaloc_core.learn.data.dataset import Appearance, Camera, DatasetPhotograph, Scene, WithoutDepth
from lalaloc_core.learn.data.synthetic.generated import DerivedScenes, camera_seed
from lalaloc_core.learn.synth.augmentation import jittered, optics, stretched_images

# Standard deviation of the log ratio between photographed and planned lengths, along two axes.
_LENGTH_ERROR = 0.1
# Strength of the photometric changes, 1 as in training.
_STRENGTH = 1.0


@dataclass(frozen=True)
class DisturbedScenes(DerivedScenes):
    """Generated homes whose photographs are slightly stretched, and changed in exposure, blur and compression."""

    variant: ClassVar[str] = "disturbed"

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Generate a scene and disturb its photographs."""
        scene = self.homes.load(name, problems)
        return dataclasses.replace(scene, cameras=tuple(_disturbed(camera) for camera in scene.cameras))


def _disturbed(camera: Camera) -> Camera:
    seed = camera_seed(camera)
    photographs = {look: DisturbedPhotograph(photograph, seed) for look, photograph in camera.photographs.items()}
    return dataclasses.replace(camera, photographs=photographs)


@dataclass(frozen=True, eq=False)
class DisturbedPhotograph(WithoutDepth):
    """Photograph with small length errors and the effects of a real camera."""

    photograph: DatasetPhotograph
    seed: int

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        generator = torch.Generator().manual_seed(self.seed)
        factors = torch.exp(_LENGTH_ERROR * torch.randn(1, 2, generator=generator))
        image = stretched_images(torch.from_numpy(self.photograph.image(height, width))[None], factors)
        image = optics(jittered(image, _STRENGTH, generator), _STRENGTH, generator)
        return image[0].round().to(torch.uint8).numpy()


# One of this many photographs shows no room, one is upside down, and in every second home one is cropped.
_EVERY = 4
# Rows and columns of a sphere in the view of an ordinary camera.
_CROP = slice(0.3, 0.7), slice(0.25, 0.5)


@dataclass(frozen=True)
class MismatchedScenes(DerivedScenes):
    """Generated homes whose cameras have photographs of the next home, or photographs that cannot be localised.

    Poses and heights are those of the home's own cameras, and unrelated to the photographs.
    """

    variant: ClassVar[str] = "asked with photographs of others"

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Generate a scene and replace its photographs."""
        own = self.homes.load(name, problems)
        prefix, _, number = name.rpartition("-")
        other = self.homes.load(f"{prefix}-{int(number) + 1:0{len(number)}d}", problems)
        cameras = [
            dataclasses.replace(
                camera, photographs=_mismatched(camera, other.cameras[k % len(other.cameras)], k, int(number))
            )
            for k, camera in enumerate(own.cameras)
        ]
        return dataclasses.replace(own, cameras=tuple(cameras))


def _mismatched(camera: Camera, other: Camera, k: int, home: int) -> dict[Appearance, DatasetPhotograph]:
    """Return the photographs of the k-th camera of a home."""
    if k % _EVERY == _EVERY - 3 and home % 2:
        return {look: Cropped(photograph) for look, photograph in camera.photographs.items()}
    if k % _EVERY == _EVERY - 2:
        return {look: UpsideDown(photograph) for look, photograph in camera.photographs.items()}
    if k % _EVERY == _EVERY - 1:
        seed = camera_seed(camera)
        return dict.fromkeys(camera.photographs, OutdoorPhotograph(seed))
    return dict(zip(camera.photographs, other.photographs.values(), strict=True))


@dataclass(frozen=True, eq=False)
class UpsideDown:
    """DatasetPhotograph of a camera mounted upside down: the sphere rotated by half a turn."""

    photograph: DatasetPhotograph

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        return np.ascontiguousarray(self.photograph.image(height, width)[::-1, ::-1])

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        """Return the distance (m) along each pixel's ray."""
        return np.ascontiguousarray(self.photograph.depth_m()[::-1, ::-1])


@dataclass(frozen=True, eq=False)
class Cropped(WithoutDepth):
    """View of an ordinary camera, stretched to the size of a sphere."""

    photograph: DatasetPhotograph

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        whole = self.photograph.image(height, width)
        rows, columns = (
            np.linspace(part.start * size, part.stop * size, size, endpoint=False).astype(int)
            for part, size in zip(_CROP, (height, width), strict=True)
        )
        return np.ascontiguousarray(whole[rows][:, columns])


@dataclass(frozen=True)
class OutdoorPhotograph(WithoutDepth):
    """Ground under a sky in random colours, sometimes the same colour, like a lens against a wall."""

    seed: int

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Return RGB pixels at the given size."""
        rng = np.random.default_rng(self.seed)
        sky, ground = rng.uniform(20.0, 250.0, (2, 3))
        if rng.random() < 0.4:
            ground = sky
        up = np.linspace(1.0, -1.0, height)[:, None, None]
        haze = rng.uniform(0.0, 0.5)
        colour = np.where(up > 0.0, sky, ground) * (1.0 - haze * np.abs(up))
        grain = rng.normal(0.0, rng.uniform(0.0, 10.0), (height, width, 3))
        return np.clip(colour + grain, 0.0, 255.0).astype(np.uint8)
