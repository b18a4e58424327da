"""Scenes of training and validation, from a data set or the generator."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from lalaloc_core.errors import ConfigError, DatasetError
from lalaloc_core.learn.data.dataset import Appearance, Camera, Dataset, Scene, load_scenes
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes, RenderedPhotograph
from lalaloc_core.learn.training.batches import Photographs
from lalaloc_core.learn.training.checkpoint import Validate
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.photograph_targets import load_photographs
from lalaloc_core.learn.training.sources import GeneratedSource, SceneSource, Source
from lalaloc_core.learn.training.validate import ImageValidation

_LOG = logging.getLogger(__name__)
_SHOTS_PER_HOME = 4


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """Data of a training run.

    Attributes:
        dataset: data set; None draws homes with the generator, without touching disk.
        textures: folder of material pictures for the generator; None makes all materials procedural.
        deferred: render the generator's spheres on the training device instead of in the workers.
        validation_scenes: maximum number of validation scenes, spread evenly over the split.
        photographs: folders of spheres for the image stages, see `training.photograph_targets`.
        teachers: segmenter and bundle that predict the walls and openings of those without annotation.
    """

    dataset: Dataset | None = None
    skip_bad: bool = False
    textures: Path | None = None
    deferred: bool = False
    validation_scenes: int = 50
    photographs: tuple[Path, ...] = ()
    teachers: tuple[Path, ...] = ()

    def source(self, config: TrainConfig) -> Source:
        """Create the source of training scenes."""
        if self.dataset is None:
            return GeneratedSource(config, self.textures, self.deferred)
        return SceneSource(config, self.dataset, self.skip_bad)

    def load_photographs(self, config: TrainConfig, size: tuple[int, int] | None = None) -> Photographs | None:
        """Load the photographs with their targets at a (height, width), by default that of the image encoder."""
        if not self.photographs:
            if self.teachers:
                raise ConfigError("--teacher is for --photographs, which are not given")
            return None
        if config.architecture != "trunk":
            raise ConfigError(
                f"architecture '{config.architecture}' predicts no openings; --photographs needs architecture 'trunk'"
            )
        size, shares = size or config.image_size, config.image.photograph_shares
        return load_photographs(self.photographs, self.teachers, *size, shares)

    def validation(self, config: TrainConfig) -> list[Scene]:
        """Load the validation scenes; empty if the data set has none."""
        if self.dataset is None:
            generated = GeneratedScenes(
                homes=self.validation_scenes,
                shots_per_home=_SHOTS_PER_HOME,
                seed=config.seed,
                furniture=None,
                textures=self.textures,
            )
            return [_with_levels(scene) for scene in load_scenes(generated, generated.scenes("validation"))]
        names = self.dataset.scenes("validation")
        chosen = names[:: -(-len(names) // self.validation_scenes)] if names else []
        problems: list[DatasetError] | None = [] if self.skip_bad else None
        scenes = list(load_scenes(self.dataset, chosen, problems))
        _log(problems)
        return scenes

    def image_validation(
        self,
        config: TrainConfig,
        scenes: Sequence[Scene],
        layout_encoder: nn.Module | None,
        device: torch.device,
        folder: Path | None = None,
    ) -> Validate:
        """Create the validation with sphere queries; without a `layout_encoder` the one being trained is used."""
        usual = None if self.dataset is None else self.dataset.appearances[0]
        problems: list[DatasetError] | None = [] if self.skip_bad else None
        cache = folder / "validation.npz" if folder is not None and self.dataset is None else None
        validation = ImageValidation(config, scenes, layout_encoder, device, usual, problems, cache=cache)
        _log(problems)
        return validation


def _log(problems: list[DatasetError] | None) -> None:
    for number, problem in enumerate(problems or [], start=1):
        _LOG.warning("skipped in validation, number %d: %s", number, problem)


def _with_levels(scene: Scene) -> Scene:
    """Add the drawn furniture level to the appearances of a generated scene."""

    def with_level(camera: Camera) -> Camera:
        photographs = {
            Appearance(photograph.shot.furniture): photograph
            for photograph in camera.photographs.values()
            if isinstance(photograph, RenderedPhotograph)
        }
        return dataclasses.replace(camera, photographs=photographs)

    return dataclasses.replace(scene, cameras=tuple(with_level(camera) for camera in scene.cameras))
