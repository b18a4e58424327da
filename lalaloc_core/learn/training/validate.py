"""Validation while training: retrieval in scenes that training never sees.

Cheap by design: known heading, the nearest grid latent, no refinement. `lalaloc evaluate` runs the full path on the
exported bundle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cachetools import LRUCache, cachedmethod
from jaxtyping import Int
from torch import Tensor, nn

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import DatasetError
from lalaloc_core.learn.azimuth_metrics import score_classes
from lalaloc_core.learn.data.dataset import Appearance, Camera, Scene
from lalaloc_core.learn.metrics import Accuracy
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batch_streams import UNKNOWN, opening_kinds
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.picture_cache import cached_pictures
from lalaloc_core.learn.training.rotation import Rotation, sample_rotation
from lalaloc_core.nets.image_encoder import TrunkImageEncoder
from lalaloc_core.nets.image_features import ImageFeatures
from lalaloc_core.nets.paper_encoders import PaperImageEncoder
from lalaloc_core.render.sampling import PoseSet, pose_grid
from lalaloc_core.render.sweep import profiles_at

_GRID_STEP_M = 0.5
_MAX_LOG_ERROR = 0.7
_BATCH = 16
_LAYOUT_BATCH = 256


@dataclass(frozen=True, eq=False)
class _Query:
    """A camera, and the turn that brings its photograph to heading 0 but for less than a pixel."""

    scene: Scene
    grid: PoseSet
    camera: Camera
    turn: Rotation

    @property
    def pose(self) -> PoseSet:
        return PoseSet(np.asarray(self.camera.position_m)[None], np.array([self.camera.room_index]))

    @property
    def fingerprint(self) -> bytes:
        """Distinguishes this query from others of its kind."""
        camera, plan = self.camera, self.scene.plan
        numbers = [*camera.position_m, camera.heading, camera.camera_height_m, self.turn.shift]
        return np.array(numbers).tobytes() + plan.walls_m.tobytes() + plan.ceiling_heights_m.tobytes()

    def opening_kinds(self, columns: int) -> Int[np.ndarray, "{columns}"]:
        """What the turned photograph shows at each azimuth, see `stream.opening_kinds`."""
        camera = self.camera
        return opening_kinds(
            self.scene.plan,
            np.asarray(camera.position_m),
            camera.room_index,
            self.turn.heading,
            camera.camera_height_m,
            columns,
        )

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
    """Panorama queries, each camera in its usual look, read once: accuracy of the nearest grid pose.

    Nearest by latent, and with architecture `ring` also by the predicted wall profile: the mean |Δ log distance|, each
    at most `_MAX_LOG_ERROR`, against the layouts of the grid. Reported over all queries and by furniture level. Beside
    it the median over the queries of the median |Δ log distance| of the true wall, and with architecture `trunk` the
    balanced accuracy of the openings.

    Args:
        config: sizes.
        scenes: with cameras whose photographs can be read.
        layout_encoder: the frozen teacher; None takes the one that is being trained.
        device: where to run.
        usual: the look to ask with, where a camera was photographed so; else its first.
        problems: photographs that cannot be read are left out and their errors appended here.
        prefix: what the names of all figures begin with.
        cache: file that caches the pictures, for photographs that take long to make.

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
        *,
        prefix: str = "val",
        cache: Path | None = None,
    ) -> None:
        self.columns = config.profile_columns
        self.balance = config.image.opening_balance
        self.device = device
        self.layout_encoder = layout_encoder
        self.prefix = prefix
        self.queries = _queries(config, scenes)
        looks = [_look(query.camera, usual) for query in self.queries]
        read: list[bool] = [True] * len(looks)

        def pictures() -> np.ndarray:
            found = []
            for k, (query, look) in enumerate(zip(self.queries, looks, strict=True)):
                try:
                    image = query.scene.photograph(query.camera, look).image(*config.image_size)
                except DatasetError as error:
                    if problems is None:
                        raise
                    problems.append(error)
                    read[k] = False
                    continue
                found.append(query.turn.picture(image))
            if not found:
                raise DatasetError("no validation scene has a photograph that can be read")
            return np.stack(found)

        about = [str(config.image_size).encode()]
        about += [query.fingerprint + str(look).encode() for query, look in zip(self.queries, looks, strict=True)]
        self.images = torch.from_numpy(cached_pictures(cache, about, pictures))
        self.queries = [query for query, good in zip(self.queries, read, strict=True) if good]
        self.levels = np.array([str(look.furniture) for look, good in zip(looks, read, strict=True) if good])
        self._grid_latents: list[Tensor] | None = None
        self._layouts: list[_Layouts] = []

    @torch.no_grad()
    def __call__(self, modules: dict[str, nn.Module]) -> dict[str, float]:
        encoder = modules["image_encoder"]
        layout_encoder = self.layout_encoder or modules["layout_encoder"]
        training = [(module, module.training) for module in (encoder, layout_encoder)]
        encoder.eval()
        layout_encoder.to(self.device).eval()
        if not self._layouts:
            self._layouts = [_Layouts.of(query, query.grid, self.columns, self.device) for query in self.queries]
        if self._grid_latents is None or self.layout_encoder is None:
            self._grid_latents = [layouts.embedded(layout_encoder) for layouts in self._layouts]
        parts = range(0, len(self.queries), _BATCH)
        seen = [self._see(encoder, layout_encoder, slice(k, k + _BATCH)) for k in parts]
        latents = torch.cat([answer.latent for answer in seen])
        nearest = [
            int(torch.cdist(latent[None], grid).argmin())
            for latent, grid in zip(latents, self._grid_latents, strict=True)
        ]
        scores = self._scores("", nearest)
        profiles = [answer.log_profile for answer in seen if answer.log_profile is not None]
        if profiles:
            scores |= self._scores(
                "profile_",
                [
                    int((profile - layouts.profile_m.log()).abs().clamp_max(_MAX_LOG_ERROR).mean(dim=1).argmin())
                    for profile, layouts in zip(torch.cat(profiles), self._layouts, strict=True)
                ],
            )
            scores[f"{self.prefix}_nll"] = sum(answer.nll for answer in seen) / len(self.queries)
            true = torch.cat([answer.true_profile_m for answer in seen if answer.true_profile_m is not None])
            error = (torch.cat(profiles) - true.log()).abs().median(dim=1).values
            scores[f"{self.prefix}_log_error"] = float(error.median())
        confusions = [answer.confusion for answer in seen if answer.confusion is not None]
        if confusions:
            accuracy = score_classes(np.sum(confusions, axis=0), OPENING_CLASSES).balanced_accuracy
            scores[f"{self.prefix}_opening_accuracy"] = accuracy
        for module, was_training in training:
            module.train(was_training)
        return scores

    def _scores(self, by: str, nearest: list[int]) -> dict[str, float]:
        errors = np.array([query.distance_m()[k] for query, k in zip(self.queries, nearest, strict=True)])
        levels = sorted(set(self.levels))
        slices = {"": np.full(len(errors), True)}
        slices |= {f"_{level}": self.levels == level for level in levels} if len(levels) > 1 else {}
        scores = {}
        for name, chosen in slices.items():
            accuracy = Accuracy.of(errors[chosen])
            scores[f"{self.prefix}_{by}within_1m{name}"] = accuracy.within_1m
            scores[f"{self.prefix}_{by}median_cm{name}"] = accuracy.median_cm
        return scores

    def _see(self, encoder: nn.Module, layout_encoder: nn.Module, part: slice) -> _Answer:
        images = self.images[part].to(self.device)
        if isinstance(encoder, PaperImageEncoder):
            return _Answer(encoder(images))
        queries = self.queries[part]
        heights = torch.tensor([query.camera.camera_height_m for query in queries], dtype=torch.float32)
        features = encoder(images, heights.to(self.device))
        true = torch.cat([_Layouts.of(query, query.pose, self.columns, self.device).profile_m for query in queries])
        nll = float(losses.laplace(features.log_profile, features.log_scale, true))
        latent = layout_encoder.get_submodule("head")(features.ring)
        return _Answer(
            latent, features.log_profile, nll * len(queries), true, self._confusion(encoder, features, queries)
        )

    def _confusion(
        self, encoder: nn.Module, features: ImageFeatures, queries: list[_Query]
    ) -> Int[np.ndarray, "c c"] | None:
        """Azimuths by true and by likeliest class, relative to the classes' shares."""
        if features.structure is None or not isinstance(encoder, TrunkImageEncoder):
            return None
        logits = features.structure.opening_logits
        prior = losses.opening_prior(encoder.opening_share, self.balance)
        predicted = (torch.log_softmax(logits, dim=2) - prior.log()).argmax(dim=2).cpu().numpy()
        true = np.stack([query.opening_kinds(self.columns) for query in queries])
        confusion = np.zeros((logits.shape[2],) * 2, dtype=int)
        known = true != UNKNOWN
        np.add.at(confusion, (true[known], predicted[known]), 1)
        return confusion


@dataclass(frozen=True, eq=False)
class _Answer:
    """What an image encoder says of some queries; `nll` is the sum of their profiles' negative log likelihoods."""

    latent: Tensor
    log_profile: Tensor | None = None
    nll: float = 0.0
    true_profile_m: Tensor | None = None
    confusion: Int[np.ndarray, "c c"] | None = None


@dataclass(frozen=True, eq=False)
class _Layouts:
    """Layouts at some poses of a query's plan, seen as its camera is turned."""

    profile_m: Tensor
    camera_height_m: Tensor
    ceiling_height_m: Tensor

    @classmethod
    def of(cls, query: _Query, poses: PoseSet, columns: int, device: torch.device) -> _Layouts:
        plan = query.scene.plan
        heading = np.full(len(poses), query.turn.heading)
        profile = torch.from_numpy(profiles_at(plan, poses.position_m, poses.room_index, heading, columns, np.float32))
        ceiling = torch.tensor(plan.ceiling_heights_m[poses.room_index], dtype=torch.float32)
        camera = torch.full((len(poses),), query.camera.camera_height_m)
        return cls(profile.to(device), camera.to(device), ceiling.to(device))

    def embedded(self, encoder: nn.Module) -> Tensor:
        """Latents (n, d)."""
        inputs = (self.profile_m, self.camera_height_m, self.ceiling_height_m)
        parts = zip(*(tensor.split(_LAYOUT_BATCH) for tensor in inputs), strict=True)
        return torch.cat([encoder(*part) for part in parts])


class _Grids:
    """Latents of the grids of one encoder; the last is cached, because queries come scene by scene."""

    def __init__(self, encoder: nn.Module, columns: int, device: torch.device) -> None:
        self.encoder, self.columns, self.device = encoder, columns, device
        self._latents: LRUCache[tuple[Any, ...], Tensor] = LRUCache(1)

    def nearest(self, query: _Query, latent: Tensor) -> int:
        """Number of the query's grid pose whose latent is nearest to `latent` (1, d)."""
        return int(torch.cdist(latent, self._of_grid(query)).argmin())

    @cachedmethod(
        attrgetter("_latents"), lambda _, query: (id(query.grid), query.camera.camera_height_m, query.turn.heading)
    )
    def _of_grid(self, query: _Query) -> Tensor:
        return self.embed(query, query.grid)

    def embed(self, query: _Query, poses: PoseSet) -> Tensor:
        """Latents (n, d) of the layouts at some poses, seen as the query's camera is turned."""
        return _Layouts.of(query, poses, self.columns, self.device).embedded(self.encoder)


def _queries(config: TrainConfig, scenes: Sequence[Scene]) -> list[_Query]:
    rng = np.random.default_rng(0)
    queries = []
    for scene in scenes:
        grid = pose_grid(scene.plan, _GRID_STEP_M)
        turns = [sample_rotation("none", camera.heading, config.image_size[1], rng) for camera in scene.cameras]
        queries += [_Query(scene, grid, camera, turn) for camera, turn in zip(scene.cameras, turns, strict=True)]
    return queries


def _look(camera: Camera, usual: Appearance | None) -> Appearance:
    if usual is not None and (usual in camera.photographs or not camera.photographs):
        return usual
    return min(camera.photographs, key=str, default=Appearance())
