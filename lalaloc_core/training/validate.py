"""Validation while training: retrieval on fixed homes that training never draws.

Cheap by design: known heading, the nearest grid latent, no refinement. `lalaloc evaluate` runs the full path on the
exported bundle.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from lalaloc_core.metrics import Accuracy
from lalaloc_core.nets import LayoutEncoder
from lalaloc_core.nets.resnet import PaperImageEncoder
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.sampling import PoseSet, pose_grid, random_poses
from lalaloc_core.synth.materials import MaterialLibrary
from lalaloc_core.synth.panorama import PanoramaRenderer, Shot, sample_shots
from lalaloc_core.synth.plans import Home
from lalaloc_core.synth.splits import VALIDATION, home_of
from lalaloc_core.training.config import TrainConfig

_HOMES = 25
_SHOTS_PER_HOME = 4
_GRID_STEP_M = 0.5
_BATCH = 16


class LayoutValidation:
    """Layout queries: accuracy of the nearest grid latent against that of the nearest grid pose."""

    def __init__(self, config: TrainConfig, device: torch.device) -> None:
        self.columns = config.profile_columns
        self.device = device
        self.queries: list[tuple[Home, PoseSet]] = []
        for index in range(_HOMES):
            home, rng = home_of(VALIDATION, config.seed, index)
            self.queries.append((home, random_poses(home.plan, _SHOTS_PER_HOME, rng)))

    @torch.no_grad()
    def __call__(self, modules: dict[str, nn.Module]) -> dict[str, float]:
        encoder = modules["layout_encoder"]
        training = encoder.training
        encoder.eval()
        errors, oracle, latents = [], [], []
        for home, queries in self.queries:
            camera = float(home.plan.camera_height_m)
            grid = pose_grid(home.plan, _GRID_STEP_M)
            grid_latents = embed_poses(encoder, home, grid, camera, self.columns, self.device)
            targets = embed_poses(encoder, home, queries, camera, self.columns, self.device)
            nearest = torch.cdist(targets, grid_latents).argmin(dim=1).cpu().numpy()
            offset = queries.position_m[:, None] - grid.position_m[None]
            distance = np.linalg.norm(offset, axis=-1)
            errors.append(distance[np.arange(len(nearest)), nearest])
            oracle.append(distance.min(axis=1))
            latents.append(grid_latents)
        encoder.train(training)
        spread = torch.cat(latents).std(dim=0).square().sum().sqrt()
        accuracy = Accuracy.of(np.concatenate(errors))
        return {
            "val_median_cm": accuracy.median_cm,
            "val_within_1m": accuracy.within_1m,
            "val_oracle_median_cm": Accuracy.of(np.concatenate(oracle)).median_cm,
            "val_latent_spread": float(spread),
        }


class ImageValidation:
    """Panorama queries of every furniture level, rendered once: accuracy of the nearest grid latent."""

    def __init__(
        self, config: TrainConfig, layout_encoder: LayoutEncoder, device: torch.device, textures: Path | None
    ) -> None:
        self.device = device
        self.shots: list[Shot] = []
        for index in range(_HOMES):
            home, rng = home_of(VALIDATION, config.seed, index)
            self.shots += sample_shots(home, _SHOTS_PER_HOME, rng)
        height, width = config.image_size
        materials = MaterialLibrary.create(np.random.default_rng([VALIDATION, config.seed]), textures)
        renderer = PanoramaRenderer(materials, height=height, width=width)
        parts = [self.shots[first : first + _BATCH] for first in range(0, len(self.shots), _BATCH)]
        self.images = torch.cat([renderer.render(part) for part in parts])
        self.columns = config.profile_columns
        self.layout_encoder = layout_encoder

    @torch.no_grad()
    def __call__(self, modules: dict[str, nn.Module]) -> dict[str, float]:
        encoder = modules["image_encoder"]
        training = encoder.training
        encoder.eval()
        self.layout_encoder.to(self.device).eval()
        parts = range(0, len(self.shots), _BATCH)
        latents = torch.cat([self._embed(encoder, slice(first, first + _BATCH)) for first in parts])
        encoder.train(training)
        errors = np.array([self._error_m(shot, latent) for shot, latent in zip(self.shots, latents, strict=True)])
        levels = np.array([shot.furniture for shot in self.shots])
        scores = {"val_within_1m": Accuracy.of(errors).within_1m, "val_median_cm": Accuracy.of(errors).median_cm}
        for level in sorted(set(levels)):
            scores[f"val_within_1m_{level}"] = Accuracy.of(errors[levels == level]).within_1m
        return scores

    def _embed(self, encoder: nn.Module, part: slice) -> Tensor:
        images = self.images[part].to(self.device)
        if isinstance(encoder, PaperImageEncoder):
            return encoder(images)
        heights = torch.tensor([shot.camera_height_m for shot in self.shots[part]], device=self.device)
        return self.layout_encoder.get_submodule("head")(encoder(images, heights).ring)

    def _error_m(self, shot: Shot, latent: Tensor) -> float:
        """Distance from the nearest grid latent's pose to the truth; the grid is turned to the shot's heading."""
        grid = pose_grid(shot.home.plan, _GRID_STEP_M)
        latents = embed_poses(
            self.layout_encoder, shot.home, grid, shot.camera_height_m, self.columns, self.device, shot.heading
        )
        nearest = int(torch.cdist(latent[None], latents).argmin())
        return float(np.linalg.norm(grid.position_m[nearest] - shot.position_m))


def embed_poses(
    encoder: nn.Module,
    home: Home,
    poses: PoseSet,
    camera_height_m: float,
    columns: int,
    device: torch.device,
    heading: float = 0.0,
) -> Tensor:
    """Latents (n, d) of the layouts at some poses of a home."""
    plan = home.plan
    profile = wall_profile(poses.position_m, np.full(len(poses), heading), plan.walls_m[poses.room_index], columns)
    ceiling = plan.ceiling_heights_m[poses.room_index]
    return encoder(
        torch.tensor(profile, dtype=torch.float32, device=device),
        torch.full((len(poses),), camera_height_m, dtype=torch.float32, device=device),
        torch.tensor(ceiling, dtype=torch.float32, device=device),
    )
