"""Validation while training: retrieval in scenes that training never sees.

Cheap by design: known heading, the nearest grid latent, no refinement. `lalaloc evaluate` runs the full path on the
exported bundle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from lalaloc_core.data.dataset import Appearance, Camera, Scene
from lalaloc_core.errors import DatasetError
from lalaloc_core.metrics import Accuracy
from lalaloc_core.nets.resnet import PaperImageEncoder
from lalaloc_core.sampling import PoseSet, pose_grid
from lalaloc_core.training.config import TrainConfig
from lalaloc_core.training.recent import Recent
from lalaloc_core.training.stream import layouts
from lalaloc_core.training.turning import Turn, draw_turn

_GRID_STEP_M = 0.5
_BATCH = 16
_LAYOUT_BATCH = 256


@dataclass(frozen=True, eq=False)
class _Query:
    """A camera, and the turn that brings its photograph to heading 0 but for less than a pixel."""

    scene: Scene
    grid: PoseSet
    camera: Camera
    turn: Turn

    @property
    def pose(self) -> PoseSet:
        return PoseSet(np.asarray(self.camera.position_m)[None], np.array([self.camera.room_index]))

    def distance_m(self) -> np.ndarray:
        """From every grid pose to the camera."""
        return np.linalg.norm(self.grid.position_m - self.camera.position_m, axis=1)


class LayoutValidation:
    """Layout queries at the cameras' poses: the nearest grid latent against the nearest grid pose."""

    def __init__(self, config: TrainConfig, scenes: Sequence[Scene], device: torch.device) -> None:
        self.columns = config.profile_columns
        self.device = device
        self.queries = _queries(config, scenes)

    @torch.no_grad()
    def __call__(self, modules: dict[str, nn.Module]) -> dict[str, float]:
        encoder = modules["layout_encoder"]
        training = encoder.training
        encoder.eval()
        grids = _Grids(encoder, self.columns, self.device)
        errors, oracle, targets = [], [], []
        for query in self.queries:
            target = grids.embed(query, query.pose)
            distance = query.distance_m()
            errors.append(distance[grids.nearest(query, target)])
            oracle.append(distance.min())
            targets.append(target)
        encoder.train(training)
        accuracy = Accuracy.of(np.array(errors))
        return {
            "val_median_cm": accuracy.median_cm,
            "val_within_1m": accuracy.within_1m,
            "val_oracle_median_cm": Accuracy.of(np.array(oracle)).median_cm,
            "val_latent_spread": float(torch.cat(targets).std(dim=0).square().sum().sqrt()),
        }


class ImageValidation:
    """Panorama queries, each camera in its usual look, read once: accuracy of the nearest grid latent.

    Args:
        config: sizes.
        scenes: with cameras whose photographs can be read.
        layout_encoder: the frozen teacher; None takes the one that is being trained.
        device: where to run.
        usual: the look to ask with, where a camera was photographed so; else its first.
        problems: photographs that cannot be read are left out and their errors appended here.

    Raises:
        DatasetError: the first of them where `problems` is None; or none can be read.
    """

    def __init__(
        self,
        config: TrainConfig,
        scenes: Sequence[Scene],
        layout_encoder: nn.Module | None,
        device: torch.device,
        usual: Appearance | None = None,
        problems: list[DatasetError] | None = None,
    ) -> None:
        self.columns = config.profile_columns
        self.device = device
        self.layout_encoder = layout_encoder
        self.queries: list[_Query] = []
        levels, pictures = [], []
        for query in _queries(config, scenes):
            look = _look(query.camera, usual)
            try:
                image = query.scene.photograph(query.camera, look).image(*config.image_size)
            except DatasetError as error:
                if problems is None:
                    raise
                problems.append(error)
                continue
            self.queries.append(query)
            levels.append(str(look.furniture))
            pictures.append(query.turn.picture(image))
        if not pictures:
            raise DatasetError("no validation scene has a photograph that can be read")
        self.levels = np.array(levels)
        self.images = torch.from_numpy(np.stack(pictures))

    @torch.no_grad()
    def __call__(self, modules: dict[str, nn.Module]) -> dict[str, float]:
        encoder = modules["image_encoder"]
        layout_encoder = self.layout_encoder or modules["layout_encoder"]
        training = [(module, module.training) for module in (encoder, layout_encoder)]
        encoder.eval()
        layout_encoder.to(self.device).eval()
        parts = range(0, len(self.queries), _BATCH)
        latents = torch.cat([self._embed(encoder, layout_encoder, slice(k, k + _BATCH)) for k in parts])
        grids = _Grids(layout_encoder, self.columns, self.device)
        errors = np.array(
            [
                query.distance_m()[grids.nearest(query, latent[None])]
                for query, latent in zip(self.queries, latents, strict=True)
            ]
        )
        for module, was_training in training:
            module.train(was_training)
        scores = {"val_within_1m": Accuracy.of(errors).within_1m, "val_median_cm": Accuracy.of(errors).median_cm}
        levels = sorted(set(self.levels))
        if len(levels) > 1:
            scores |= {f"val_within_1m_{k}": Accuracy.of(errors[self.levels == k]).within_1m for k in levels}
        return scores

    def _embed(self, encoder: nn.Module, layout_encoder: nn.Module, part: slice) -> Tensor:
        images = self.images[part].to(self.device)
        if isinstance(encoder, PaperImageEncoder):
            return encoder(images)
        heights = torch.tensor([query.camera.camera_height_m for query in self.queries[part]], dtype=torch.float32)
        return layout_encoder.get_submodule("head")(encoder(images, heights.to(self.device)).ring)


class _Grids:
    """Latents of the grids of one encoder; the last is kept, because queries come scene by scene."""

    def __init__(self, encoder: nn.Module, columns: int, device: torch.device) -> None:
        self.encoder, self.columns, self.device = encoder, columns, device
        self._kept: Recent[Tensor] = Recent(1)

    def nearest(self, query: _Query, latent: Tensor) -> int:
        """Number of the query's grid pose whose latent is nearest to `latent` (1, d)."""
        key = (id(query.grid), query.camera.camera_height_m, query.turn.heading)
        return int(torch.cdist(latent, self._kept.get(key, lambda: self.embed(query, query.grid))).argmin())

    def embed(self, query: _Query, poses: PoseSet) -> Tensor:
        """Latents (n, d) of the layouts at some poses, seen as the query's camera is turned."""
        plan = query.scene.plan
        heading = np.full(len(poses), query.turn.heading)
        profile = torch.from_numpy(layouts(plan, poses.position_m, poses.room_index, heading, self.columns))
        ceiling = torch.tensor(plan.ceiling_heights_m[poses.room_index], dtype=torch.float32)
        camera = torch.full((len(poses),), query.camera.camera_height_m)
        parts = [
            self.encoder(*(part.to(self.device) for part in inputs))
            for inputs in zip(*(tensor.split(_LAYOUT_BATCH) for tensor in (profile, camera, ceiling)), strict=True)
        ]
        return torch.cat(parts)


def _queries(config: TrainConfig, scenes: Sequence[Scene]) -> list[_Query]:
    rng = np.random.default_rng(0)
    queries = []
    for scene in scenes:
        grid = pose_grid(scene.plan, _GRID_STEP_M)
        turns = [draw_turn("none", camera.heading, config.image_size[1], rng) for camera in scene.cameras]
        queries += [_Query(scene, grid, camera, turn) for camera, turn in zip(scene.cameras, turns, strict=True)]
    return queries


def _look(camera: Camera, usual: Appearance | None) -> Appearance:
    if usual is not None and (usual in camera.photographs or not camera.photographs):
        return usual
    return min(camera.photographs, key=str, default=Appearance())
