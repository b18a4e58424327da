"""Stream of training panoramas with their layouts, rendered in worker processes (stage 2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import IterableDataset

from lalaloc_core.render.profile import wall_profile
from lalaloc_core.synth.materials import MaterialLibrary
from lalaloc_core.synth.panorama import PanoramaRenderer, Shot, sample_shots
from lalaloc_core.synth.splits import TRAIN, home_of
from lalaloc_core.training.config import TrainConfig
from lalaloc_core.training.stream import Batch, worker_share

# Panoramas rendered together by a worker; more gains nothing on a CPU and costs memory.
_RENDER_BATCH = 8


@dataclass
class PanoramaBatches(IterableDataset[Batch]):
    """Stage 2: panoramas with their layouts, randomly rolled and mirrored.

    Each batch holds `image` (b, h, w, 3) uint8, `profile_m` (b, columns), `camera_height_m` and `ceiling_height_m`.
    """

    config: TrainConfig
    textures: Path | None = None
    first: int = 0

    def __iter__(self) -> Iterator[Batch]:
        stage = self.config.image
        worker, workers = worker_share()
        height, width = self.config.image_size
        materials = MaterialLibrary.create(np.random.default_rng(self.config.seed), self.textures)
        renderer = PanoramaRenderer(materials, height=height, width=width)
        index = self.first + worker
        parts: list[Batch] = []
        while True:
            shots: list[Shot] = []
            while len(shots) < min(_RENDER_BATCH, stage.batch):
                home, rng = home_of(TRAIN, self.config.seed, index)
                index += workers
                shots += sample_shots(home, stage.shots_per_home, rng, by_room_share=stage.by_room_share)
            parts.append(self._render(renderer, shots, np.random.default_rng([3, self.config.seed, index])))
            if sum(len(part["image"]) for part in parts) >= stage.batch:
                yield {key: torch.cat([part[key] for part in parts])[: stage.batch] for key in parts[0]}
                parts = []

    def _render(self, renderer: PanoramaRenderer, shots: list[Shot], rng: np.random.Generator) -> Batch:
        images = renderer.render(shots)
        profiles = torch.from_numpy(shot_profiles(shots, self.config.profile_columns))
        for row in range(len(shots)):
            images[row], profiles[row] = turn_and_mirror(images[row], profiles[row], rng)
        return {"image": images, "profile_m": profiles, **shot_heights(shots)}


def shot_heights(shots: list[Shot]) -> Batch:
    """Camera and ceiling height (m) of each shot."""
    ceilings = [shot.home.plan.ceiling_heights_m[shot.room_index] for shot in shots]
    return {
        "camera_height_m": torch.tensor([shot.camera_height_m for shot in shots], dtype=torch.float32),
        "ceiling_height_m": torch.tensor(np.array(ceilings), dtype=torch.float32),
    }


def turn_and_mirror(
    image: torch.Tensor, profile_m: torch.Tensor, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Exact augmentation: roll and maybe mirror a panorama (h, w, 3) together with its wall profile (columns)."""
    pixels_per_column = max(image.shape[1] // profile_m.shape[0], 1)
    columns_per_pixel = max(profile_m.shape[0] // image.shape[1], 1)
    turn = int(rng.integers(min(image.shape[1], profile_m.shape[0])))
    image = image.roll(turn * pixels_per_column, dims=1)
    profile_m = profile_m.roll(turn * columns_per_pixel, dims=0)
    if rng.random() < 0.5:
        image, profile_m = image.flip(1), profile_m.flip(0)
    return image, profile_m


def shot_profiles(shots: list[Shot], columns: int) -> np.ndarray:
    """Wall profile (m) of each shot's pose, (b, columns)."""
    return np.concatenate(
        [
            wall_profile(
                shot.position_m[None],
                np.array([shot.heading]),
                shot.home.plan.walls_m[shot.room_index][None],
                columns,
            )
            for shot in shots
        ]
    ).astype(np.float32)
