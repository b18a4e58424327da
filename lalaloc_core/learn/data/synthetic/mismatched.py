"""Questions without an answer: homes that are asked with photographs of others, of no room, turned over, or cut out.

Confidence learns from them what it looks like when nothing fits (`lalaloc_core.evaluate.calibrate`).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.errors import DatasetError
from lalaloc_core.learn.data.dataset import Appearance, Camera, Photograph, Scene
from lalaloc_core.learn.data.synthetic.derived import DerivedScenes, seed_of

# One of so many photographs shows no room, and one is the camera's own upside down; of every other home one is cut out.
_EVERY = 4
# Of a picture's rows and columns, what an ordinary camera shows of them.
_CUT_OUT = slice(0.3, 0.7), slice(0.25, 0.5)


@dataclass(frozen=True)
class MismatchedScenes(DerivedScenes):
    """Generated homes whose cameras show what those of the next home see, or nothing that can be localised.

    Poses and heights are those of the home's own cameras: where a camera stands has nothing to do with what it shows.
    """

    asked: ClassVar[str] = "asked with photographs of others"

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        own = self.homes.load(name, problems)
        prefix, _, number = name.rpartition("-")
        other = self.homes.load(f"{prefix}-{int(number) + 1:0{len(number)}d}", problems)
        cameras = [
            dataclasses.replace(
                camera, photographs=_shown(camera, other.cameras[k % len(other.cameras)], k, int(number))
            )
            for k, camera in enumerate(own.cameras)
        ]
        return dataclasses.replace(own, cameras=tuple(cameras))


def _shown(camera: Camera, other: Camera, k: int, home: int) -> dict[Appearance, Photograph]:
    """What the k-th camera of a home shows."""
    if k % _EVERY == _EVERY - 3 and home % 2:
        return {look: CutOut(photograph) for look, photograph in camera.photographs.items()}
    if k % _EVERY == _EVERY - 2:
        return {look: TurnedOver(photograph) for look, photograph in camera.photographs.items()}
    if k % _EVERY == _EVERY - 1:
        seed = seed_of(camera)
        return dict.fromkeys(camera.photographs, OutdoorPhotograph(seed))
    return dict(zip(camera.photographs, other.photographs.values(), strict=True))


@dataclass(frozen=True, eq=False)
class TurnedOver:
    """What a camera that hangs upside down takes: the picture turned by half a turn."""

    photograph: Photograph

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        return np.ascontiguousarray(self.photograph.image(height, width)[::-1, ::-1])

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        return np.ascontiguousarray(self.photograph.depth_m()[::-1, ::-1])


@dataclass(frozen=True, eq=False)
class CutOut:
    """What an ordinary camera shows of the room, drawn out to the size of a panorama."""

    photograph: Photograph

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        whole = self.photograph.image(height, width)
        rows, columns = (
            np.linspace(part.start * size, part.stop * size, size, endpoint=False).astype(int)
            for part, size in zip(_CUT_OUT, (height, width), strict=True)
        )
        return np.ascontiguousarray(whole[rows][:, columns])

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        raise DatasetError("a picture that is cut out has no depth all around")


@dataclass(frozen=True)
class OutdoorPhotograph:
    """Ground under a sky, both of any colour, at times the same one, as of a lens against a wall."""

    seed: int

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        rng = np.random.default_rng(self.seed)
        sky, ground = rng.uniform(20.0, 250.0, (2, 3))
        if rng.random() < 0.4:
            ground = sky
        up = np.linspace(1.0, -1.0, height)[:, None, None]
        haze = rng.uniform(0.0, 0.5)
        colour = np.where(up > 0.0, sky, ground) * (1.0 - haze * np.abs(up))
        grain = rng.normal(0.0, rng.uniform(0.0, 10.0), (height, width, 3))
        return np.clip(colour + grain, 0.0, 255.0).astype(np.uint8)

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        raise DatasetError("a photograph of no room has no depth")
