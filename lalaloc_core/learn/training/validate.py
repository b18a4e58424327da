"""Validation during training: retrieval in scenes that are not trained on.

Validation is fast: known heading, nearest grid latent, no refinement. `lalaloc lab evaluate` runs the full pipeline
on the exported bundle.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int, UInt8
from torch import Tensor, nn

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import DatasetError
from lalaloc_core.files import replacing
from lalaloc_core.learn.data.dataset import Appearance, Camera, Scene
from lalaloc_core.learn.metrics import Accuracy, count_classes, score_classes
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batch_streams import seen_openings
from lalaloc_core.learn.training.batches import Rotation, sample_rotation
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.nets import PaperImageEncoder, TrunkImageEncoder
from lalaloc_core.nets.image_features import ImageFeatures
from lalaloc_core.render.sampling import PoseSet, pose_grid
from lalaloc_core.render.sweep import profiles_at

_GRID_STEP_M = 0.5
_MAX_LOG_ERROR = 0.7
_BATCH = 16
_LAYOUT_BATCH = 256


class LayoutValidation:
    """Layout queries at the cameras' poses: the nearest grid latent against the nearest grid pose."""

    def __init__(self, config: TrainConfig, scenes: Sequence[Scene], device: torch.device) -> None:
        self.columns = config.profile_columns
        self.device = device
        self.queries = _queries(config, scenes)

    @torch.no_grad()
    def __call__(self, modules: dict[str, nn.Module]) -> dict[str, float]:
        """Return the metrics of the module `layout_encoder` by name."""
        encoder = modules["layout_encoder"]
        was_training = encoder.training
        encoder.eval()
        errors, oracle, targets = [], [], []
        view, grid = None, torch.empty(0)
        for query in self.queries:
            if query.view != view:
                view, grid = query.view, query.layouts(query.grid, self.columns, self.device).embed(encoder)
            target = query.layouts(query.pose, self.columns, self.device).embed(encoder)
            distance = query.distance_m()
            errors.append(distance[int(torch.cdist(target, grid).argmin())])
            oracle.append(distance.min())
            targets.append(target)
        encoder.train(was_training)
        accuracy = Accuracy.from_errors(np.array(errors))
        return {
            "val_median_cm": accuracy.median_cm,
            "val_within_1m": accuracy.within_1m,
            "val_oracle_median_cm": Accuracy.from_errors(np.array(oracle)).median_cm,
            "val_latent_spread": float(torch.cat(targets).std(dim=0).square().sum().sqrt()),
        }


class ImageValidation:
    """Sphere queries, one per camera in its usual appearance: accuracy of the nearest grid pose.

    The nearest pose is found by latent, and for networks with a wall profile also by that profile: the mean |Δ log
    distance|, each clipped at `_MAX_LOG_ERROR`, to the layouts of the grid. Metrics cover all queries and each
    furniture level. Further metrics are the median over the queries of the median |Δ log distance| to the true wall,
    and for architecture `trunk` the balanced accuracy of the openings. Without a frozen `layout_encoder` (teacher), the
    one being trained is used. Cameras without a photograph of the `usual` appearance use their first. `problems`
    receives the errors of unreadable photographs, which are left out; None raises the first error. `cache` is a file of
    the photographs, because rendering them is slow.
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
        cache: Path | None = None,
    ) -> None:
        self.columns = config.profile_columns
        self.balance = config.image.opening_balance
        self.device = device
        self.layout_encoder = layout_encoder
        self.queries = _queries(config, scenes)
        looks = [_appearance(query.camera, usual) for query in self.queries]
        readable: list[bool] = [True] * len(looks)

        def read_pictures() -> np.ndarray:
            pictures = []
            for k, (query, look) in enumerate(zip(self.queries, looks, strict=True)):
                try:
                    image = query.scene.photograph(query.camera, look).image(*config.image_size)
                except DatasetError as error:
                    if problems is None:
                        raise
                    problems.append(error)
                    readable[k] = False
                    continue
                pictures.append(query.turn.picture(image))
            if not pictures:
                raise DatasetError("no photograph of the validation scenes can be read")
            return np.stack(pictures)

        identity = [str(config.image_size).encode()]
        identity += [query.fingerprint + str(look).encode() for query, look in zip(self.queries, looks, strict=True)]
        self.images = torch.from_numpy(cached_pictures(cache, identity, read_pictures))
        self.queries = [query for query, good in zip(self.queries, readable, strict=True) if good]
        self.levels = np.array([str(look.furniture) for look, good in zip(looks, readable, strict=True) if good])
        self._grid_latents: list[Tensor] | None = None
        self._layouts: list[_Layouts] = []

    @torch.no_grad()
    def __call__(self, modules: dict[str, nn.Module]) -> dict[str, float]:
        """Return the metrics of the module `image_encoder` by name."""
        encoder = modules["image_encoder"]
        layout_encoder = self.layout_encoder or modules["layout_encoder"]
        modes = [(module, module.training) for module in (encoder, layout_encoder)]
        encoder.eval()
        layout_encoder.to(self.device).eval()
        if not self._layouts:
            self._layouts = [query.layouts(query.grid, self.columns, self.device) for query in self.queries]
        if self._grid_latents is None or self.layout_encoder is None:
            self._grid_latents = [layouts.embed(layout_encoder) for layouts in self._layouts]
        parts = range(0, len(self.queries), _BATCH)
        predictions = [self._predict(encoder, layout_encoder, slice(k, k + _BATCH)) for k in parts]
        latents = torch.cat([prediction.latent for prediction in predictions])
        nearest = [
            int(torch.cdist(latent[None], grid).argmin())
            for latent, grid in zip(latents, self._grid_latents, strict=True)
        ]
        metrics = self._accuracies("", nearest)
        profiles = [prediction.log_profile for prediction in predictions if prediction.log_profile is not None]
        if profiles:
            nearest = [
                int((profile - layouts.profile_m.log()).abs().clamp_max(_MAX_LOG_ERROR).mean(dim=1).argmin())
                for profile, layouts in zip(torch.cat(profiles), self._layouts, strict=True)
            ]
            metrics |= self._accuracies("profile_", nearest)
            metrics["val_nll"] = sum(prediction.nll for prediction in predictions) / len(self.queries)
            true = torch.cat([part.true_profile_m for part in predictions if part.true_profile_m is not None])
            error = (torch.cat(profiles) - true.log()).abs().median(dim=1).values
            metrics["val_log_error"] = float(error.median())
        confusions = [prediction.confusion for prediction in predictions if prediction.confusion is not None]
        if confusions:
            accuracy = score_classes(np.sum(confusions, axis=0), OPENING_CLASSES).balanced_accuracy
            metrics["val_opening_accuracy"] = accuracy
        for module, was_training in modes:
            module.train(was_training)
        return metrics

    def _accuracies(self, method: str, nearest: list[int]) -> dict[str, float]:
        """Return the metrics of one retrieval method over all queries and by furniture level."""
        errors = np.array([query.distance_m()[k] for query, k in zip(self.queries, nearest, strict=True)])
        levels = sorted(set(self.levels))
        slices = {"": np.full(len(errors), True)}
        slices |= {f"_{level}": self.levels == level for level in levels} if len(levels) > 1 else {}
        metrics = {}
        for name, members in slices.items():
            accuracy = Accuracy.from_errors(errors[members])
            metrics[f"val_{method}within_1m{name}"] = accuracy.within_1m
            metrics[f"val_{method}median_cm{name}"] = accuracy.median_cm
        return metrics

    def _predict(self, encoder: nn.Module, layout_encoder: nn.Module, part: slice) -> _Prediction:
        images = self.images[part].to(self.device)
        if isinstance(encoder, PaperImageEncoder):
            return _Prediction(encoder(images))
        queries = self.queries[part]
        heights = torch.tensor([query.camera.camera_height_m for query in queries], dtype=torch.float32)
        features = encoder(images, heights.to(self.device))
        true = torch.cat([query.layouts(query.pose, self.columns, self.device).profile_m for query in queries])
        nll = float(losses.laplace_mixture(features.walls, true.log()))
        latent = layout_encoder.get_submodule("head")(features.ring)
        return _Prediction(
            latent, features.walls.likeliest, nll * len(queries), true, self._confusion(encoder, features, queries)
        )

    def _confusion(
        self, encoder: nn.Module, features: ImageFeatures, queries: list[_Query]
    ) -> Int[np.ndarray, "c c"] | None:
        """Count azimuths by true and by predicted class; predictions are relative to the classes' shares."""
        if features.structure is None or not isinstance(encoder, TrunkImageEncoder):
            return None
        logits = features.structure.opening_logits
        prior = losses.opening_prior(encoder.opening_share, self.balance)
        predicted = (torch.log_softmax(logits, dim=2) - prior.log()).argmax(dim=2).cpu().numpy()
        kinds = [seen_openings(of.scene.plan, of.camera, of.turn.heading, self.columns)[0] for of in queries]
        return count_classes(np.stack(kinds), predicted, logits.shape[2])


@dataclass(frozen=True, eq=False)
class _Query:
    """A camera, and the rotation that brings its photograph to heading 0 within a pixel."""

    scene: Scene
    grid: PoseSet
    camera: Camera
    turn: Rotation

    @property
    def pose(self) -> PoseSet:
        return PoseSet(np.asarray(self.camera.position_m)[None], np.array([self.camera.room_index]))

    @property
    def view(self) -> tuple[int, float, float]:
        """Key of the layouts of the grid: grid, camera height and heading."""
        return id(self.grid), self.camera.camera_height_m, self.turn.heading

    @property
    def fingerprint(self) -> bytes:
        camera, plan = self.camera, self.scene.plan
        numbers = [*camera.position_m, camera.heading, camera.camera_height_m, self.turn.shift]
        return np.array(numbers).tobytes() + plan.walls_m.tobytes() + plan.ceiling_heights_m.tobytes()

    def layouts(self, poses: PoseSet, columns: int, device: torch.device) -> _Layouts:
        plan = self.scene.plan
        heading = np.full(len(poses), self.turn.heading)
        profile = torch.from_numpy(profiles_at(plan, poses.position_m, poses.room_index, heading, columns, np.float32))
        ceiling = torch.tensor(plan.ceiling_heights_m[poses.room_index], dtype=torch.float32)
        camera = torch.full((len(poses),), self.camera.camera_height_m)
        return _Layouts(profile.to(device), camera.to(device), ceiling.to(device))

    def distance_m(self) -> np.ndarray:
        return np.linalg.norm(self.grid.position_m - self.camera.position_m, axis=1)


@dataclass(frozen=True, eq=False)
class _Prediction:
    """Output of an image encoder for some queries; `nll` is the sum of their negative log likelihoods."""

    latent: Tensor
    log_profile: Tensor | None = None
    nll: float = 0.0
    true_profile_m: Tensor | None = None
    confusion: Int[np.ndarray, "c c"] | None = None


@dataclass(frozen=True, eq=False)
class _Layouts:
    """Inputs of a layout encoder."""

    profile_m: Tensor
    camera_height_m: Tensor
    ceiling_height_m: Tensor

    def embed(self, encoder: nn.Module) -> Tensor:
        inputs = (self.profile_m, self.camera_height_m, self.ceiling_height_m)
        parts = zip(*(tensor.split(_LAYOUT_BATCH) for tensor in inputs), strict=True)
        return torch.cat([encoder(*part) for part in parts])


def _queries(config: TrainConfig, scenes: Sequence[Scene]) -> list[_Query]:
    rng = np.random.default_rng(0)
    queries = []
    for scene in scenes:
        grid = pose_grid(scene.plan, _GRID_STEP_M)
        turns = [sample_rotation("none", camera.heading, config.image_size[1], rng) for camera in scene.cameras]
        queries += [_Query(scene, grid, camera, turn) for camera, turn in zip(scene.cameras, turns, strict=True)]
    return queries


def _appearance(camera: Camera, usual: Appearance | None) -> Appearance:
    if usual is not None and (usual in camera.photographs or not camera.photographs):
        return usual
    return min(camera.photographs, key=str, default=Appearance())


def cached_pictures(
    path: Path | None, identity: list[bytes], make: Callable[[], UInt8[np.ndarray, "n h w 3"]]
) -> UInt8[np.ndarray, "n h w 3"]:
    """Return pictures from a file; make and write them if it is missing, damaged or holds other pictures.

    `path` is an npz file; None caches nothing. `identity` distinguishes these pictures from others, such as their
    poses. It does not cover the renderer: delete the file after changing that.
    """
    if path is None:
        return make()
    digest = hashlib.sha256(b"\n".join(identity)).hexdigest()
    try:
        with np.load(path) as kept:
            if str(kept["digest"]) == digest:
                return kept["pictures"]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile):
        # A missing or damaged file is written again.
        pass
    pictures = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, digest=np.array(digest), pictures=pictures)
    return pictures
