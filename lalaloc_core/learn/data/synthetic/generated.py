"""Scenes of the generator, without touching disk: homes by seed, rendered on demand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, UInt8

from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Appearance, Camera, HomeScenes, Scene, Split
from lalaloc_core.learn.synth.homes.plans import TEST, TRAIN, VALIDATION, home_of
from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer, Window
from lalaloc_core.learn.synth.scene.facts import facts_of
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import Shot, sample_shots

_DEPTH_HEIGHT = 256
_PHOTOGRAPH_RAYS = (2, 2)
SPLIT_NUMBERS: dict[Split, int] = {"train": TRAIN, "validation": VALIDATION, "test": TEST}


@dataclass(frozen=True, kw_only=True)
class GeneratedScenes(HomeScenes):
    """Homes of the generator with cameras at any heading, 1.0 to 1.9 m high.

    With `textures` None all materials are procedural.
    """

    split_numbers = SPLIT_NUMBERS
    textures: Path | None = None

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        return f"generated homes (seed {self.seed})"

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        """Generate a scene from its name."""
        number, index = self.home_number(name)
        home, rng = home_of(number, self.seed, index)
        renderers = split_renderer_cache(number, self.seed, self.textures)
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
    """Return the plans of the first training homes."""
    return [home_of(TRAIN, seed, index)[0].plan for index in range(homes)]


@dataclass(frozen=True)
class DerivedScenes:
    """Base of data sets that change the scenes of generated homes; `load` makes the change, `variant` describes it."""

    homes: GeneratedScenes
    variant: ClassVar[str]

    @property
    def description(self) -> str:
        """Name of the data set in results."""
        return f"{self.homes.description}, {self.variant}"

    @property
    def appearances(self) -> Sequence[Appearance]:
        """Appearances of the generated homes."""
        return self.homes.appearances

    def scenes(self, split: Split) -> Sequence[str]:
        """Return the names of a split's scenes."""
        return self.homes.scenes(split)


def camera_seed(camera: Camera) -> int:
    """Derive a seed for a camera's photograph from its position."""
    return int(1e3 * abs(camera.position_m).sum())


class RendererCache:
    """Materials of a split and its renderers by picture size, cached because each takes a second to build."""

    def __init__(self, materials: MaterialLibrary, device: torch.device | str = "cpu") -> None:
        self.materials = materials
        self._device = device
        self._renderers: dict[tuple[int, int, tuple[int, int], Window | None], SphereRenderer] = {}

    def renderer(
        self, height: int, width: int, supersample: tuple[int, int] = (1, 1), window: Window | None = None
    ) -> SphereRenderer:
        """Return the renderer of a picture size with `supersample` rays per pixel along (rows, columns)."""
        key = height, width, supersample, window
        if key not in self._renderers:
            self._renderers[key] = SphereRenderer(
                self.materials, height=height, width=width, device=self._device, supersample=supersample, window=window
            )
        return self._renderers[key]


@lru_cache(maxsize=4)
def split_renderer_cache(split: int, seed: int, textures: Path | None) -> RendererCache:
    """Return the renderers of a split, each with its own sample of materials."""
    return RendererCache(MaterialLibrary.create(np.random.default_rng([split, seed]), textures))


@dataclass(frozen=True, eq=False)
class RenderedPhotograph:
    """Photograph rendered on demand; like a real one it averages over each pixel's area."""

    shot: Shot
    renderers: RendererCache

    @cached_property
    def facts(self) -> frozenset[str]:
        """Facts that make the shot hard, see `synth.scene.facts`."""
        return frozenset(facts_of(self.shot))

    def image(self, height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
        """Render RGB pixels at the given size."""
        return self.renderers.renderer(height, width, _PHOTOGRAPH_RAYS).render([self.shot])[0].cpu().numpy()

    def depth_m(self) -> Float[np.ndarray, "h w"]:
        """Render the distance (m) along each pixel's ray."""
        return self.renderers.renderer(_DEPTH_HEIGHT, 2 * _DEPTH_HEIGHT).depth_m([self.shot])[0].cpu().numpy()
