"""Questions as they are asked with real cameras and plans: worse pictures, and lengths that are a little off.

Confidence learns from them how badly a right answer may fit (`lalaloc_core.evaluate.calibrate`): renderings of exact plans alone
fit better than any photograph does.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, UInt8

from lalaloc_core.errors import DatasetError
from lalaloc_core.learn.data.dataset import Camera, Photograph, Scene
from lalaloc_core.learn.data.synthetic.derived import DerivedScenes, seed_of
from lalaloc_core.learn.synth.augmentation.photometric import jittered, optics
from lalaloc_core.learn.synth.augmentation.stretching import stretched_images

# Standard deviation of the logarithm of how much longer rooms look than their plan says, along two axes.
_LENGTH_ERROR = 0.1
# Of what training does to pictures.
_STRENGTH = 1.0


@dataclass(frozen=True)
class DisturbedScenes(DerivedScenes):
    """Generated homes whose photographs are drawn out a little, and exposed, blurred and compressed anew."""

    asked: ClassVar[str] = "disturbed"

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        scene = self.homes.load(name, problems)
        return dataclasses.replace(scene, cameras=tuple(_disturbed(camera) for camera in scene.cameras))


def _disturbed(camera: Camera) -> Camera:
    seed = seed_of(camera)
    photographs = {look: DisturbedPhotograph(photograph, seed) for look, photograph in camera.photographs.items()}
    return dataclasses.replace(camera, photographs=photographs)


@dataclass(frozen=True, eq=False)
class DisturbedPhotograph:
    """A photograph of a room whose lengths are a little off, by a camera that is not the renderer's."""

    photograph: Photograph
    seed: int

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        generator = torch.Generator().manual_seed(self.seed)
        factors = torch.exp(_LENGTH_ERROR * torch.randn(1, 2, generator=generator))
        image = stretched_images(torch.from_numpy(self.photograph.image(height, width))[None], factors)
        image = optics(jittered(image, _STRENGTH, generator), _STRENGTH, generator)
        return image[0].round().to(torch.uint8).numpy()

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        raise DatasetError("a photograph that is drawn out has no depth")
