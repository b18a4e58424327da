"""Generated homes with degraded photographs and small length errors, as with real cameras and plans.

Calibration needs them (`lalaloc_core.evaluate.calibrate`), because renderings of exact plans fit better than
photographs do.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import UInt8

from lalaloc_core.errors import DatasetError
from lalaloc_core.learn.data.dataset import Camera, DatasetPhotograph, Scene, WithoutDepth
from lalaloc_core.learn.data.synthetic.generated import DerivedScenes, camera_seed
from lalaloc_core.learn.synth.augmentation.photometric import jittered, optics
from lalaloc_core.learn.synth.augmentation.stretching import stretched_images

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
