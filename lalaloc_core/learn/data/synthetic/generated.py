"""Synthetic scenes from the generator, without touching disk: homes by seed, rendered when they are looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Appearance, Camera, Scene, Split
from lalaloc_core.learn.synth.furniture.furnish import FurnitureLevel
from lalaloc_core.learn.synth.homes.splits import TEST, TRAIN, VALIDATION, home_of
from lalaloc_core.learn.synth.rendering.panorama import PanoramaRenderer
from lalaloc_core.learn.synth.scene.facts import facts_of
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots

_DEPTH_HEIGHT = 256
_PHOTOGRAPH_RAYS = (2, 2)
SPLIT_NUMBERS: dict[Split, int] = {"train": TRAIN, "validation": VALIDATION, "test": TEST}


@dataclass(frozen=True, kw_only=True)
class GeneratedScenes:
    """Homes of the generator with a few cameras each, at every heading and camera heights of 1.0 to 1.9 m.

    Attributes:
        homes: how many per split.
        shots_per_home: cameras per home.
        furniture: every camera's level, or None to draw it for each: then a camera's one photograph has no level.
        textures: folder of material pictures; without it all are procedural.
    """

    homes: int
    shots_per_home: int = 4
    seed: int = 0
    furniture: FurnitureLevel | None = "full"
    textures: Path | None = None

    @property
    def description(self) -> str:
        return f"generated homes (seed {self.seed})"

    @property
    def appearances(self) -> Sequence[Appearance]:
        return (Appearance(self.furniture),)

    def scenes(self, split: Split) -> Sequence[str]:
        return [f"{split}-{index:05d}" for index in range(self.homes)]

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        split, _, index = name.partition("-")
        number = next((n for known, n in SPLIT_NUMBERS.items() if known == split), None)
        if number is None or not index.isdecimal():
            raise DatasetError("no such generated scene; names are like 'test-00042'", scene=name)
        home, rng = home_of(number, self.seed, int(index))
        renderers = renderer_cache_of(number, self.seed, self.textures)
        shots = sample_shots(home, self.shots_per_home, rng, self.furniture)
        cameras = tuple(
            Camera(
                name=str(k),
                position_m=shot.position_m,
                room_index=shot.room_index,
                heading=shot.heading,
                camera_height_m=shot.camera_height_m,
                photographs={self.appearances[0]: RenderedPhotograph(shot, renderers)},
            )
            for k, shot in enumerate(shots)
        )
        return Scene(name=name, plan=home.plan, cameras=cameras)


def training_plans(homes: int, seed: int) -> list[FloorPlan]:
    """The plans of the first training homes."""
    return [home_of(TRAIN, seed, index)[0].plan for index in range(homes)]


class RendererCache:
    """The materials of a split, and its renderers by picture: both take a second to build and are kept."""

    def __init__(self, materials: MaterialLibrary, device: torch.device | str = "cpu") -> None:
        self.materials = materials
        self._device = device
        self._renderers: dict[tuple[int, int, tuple[int, int]], PanoramaRenderer] = {}

    def renderer(self, height: int, width: int, supersample: tuple[int, int] = (1, 1)) -> PanoramaRenderer:
        """The renderer of a picture size with `supersample` rays per pixel along (rows, columns)."""
        key = height, width, supersample
        if key not in self._renderers:
            self._renderers[key] = PanoramaRenderer(
                self.materials, height=height, width=width, device=self._device, supersample=supersample
            )
        return self._renderers[key]


@lru_cache(maxsize=4)
def renderer_cache_of(split: int, seed: int, textures: Path | None) -> RendererCache:
    """The renderers of a split: materials are sampled anew for each."""
    return RendererCache(MaterialLibrary.create(np.random.default_rng([split, seed]), textures))


@dataclass(frozen=True, eq=False)
class RenderedPhotograph:
    """A photograph that is rendered whenever it is asked for; like a real one it averages over each pixel's area."""

    shot: Shot
    renderers: RendererCache

    @cached_property
    def facts(self) -> frozenset[str]:
        """What makes the shot hard, see `synth.scene.facts`."""
        return frozenset(facts_of(self.shot))

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        return self.renderers.renderer(height, width, _PHOTOGRAPH_RAYS).render([self.shot])[0].cpu().numpy()

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        return self.renderers.renderer(_DEPTH_HEIGHT, 2 * _DEPTH_HEIGHT).depth_m([self.shot])[0].cpu().numpy()
