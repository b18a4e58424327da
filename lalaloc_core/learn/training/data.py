"""Where training and its validation get their scenes from: a data set, or the generator."""

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
from lalaloc_core.learn.training.best import Validate
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.photographs import Photographs, load_photographs
from lalaloc_core.learn.training.sources import GeneratedSource, SceneSource, Source
from lalaloc_core.learn.training.validate import ImageValidation

_LOG = logging.getLogger(__name__)
_SHOTS_PER_HOME = 4


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """What to train on.

    Attributes:
        dataset: None draws homes with the generator, without touching disk.
        skip_bad: pass over files of the data set that cannot be used, naming each once.
        textures: folder of material pictures for the generator; without it all are procedural.
        validation_scenes: at most this many, spread evenly over the split.
        deferred: the generator's panoramas are rendered on the device that trains, not where homes are made.
        heldout: scenes that are nothing like those trained on; image validation reports those of their validation
            split as well, and nothing is chosen by them.
        photographs: folder of panoramas without labels that the image stage learns from as well.
        segmenter: what tells doors and windows in them, see `training.photographs`.
    """

    dataset: Dataset | None = None
    skip_bad: bool = False
    textures: Path | None = None
    deferred: bool = False
    validation_scenes: int = 50
    heldout: Dataset | None = None
    photographs: Path | None = None
    segmenter: Path | None = None

    def source(self, config: TrainConfig) -> Source:
        """What training looks at."""
        if self.dataset is None:
            return GeneratedSource(config, self.textures, self.deferred)
        return SceneSource(config, self.dataset, self.skip_bad)

    def load_photographs(self, config: TrainConfig) -> Photographs | None:
        """The photographs with what the segmenter sees in them; None where none are to be learnt from.

        Raises:
            ConfigError: photographs without a segmenter or the reverse, an architecture that tells no openings, or a
                segmenter that cannot be run.
            DatasetError: a photograph cannot be read.
        """
        if self.photographs is None and self.segmenter is None:
            return None
        if self.photographs is None or self.segmenter is None:
            raise ConfigError("photographs and their teacher are given together or not at all")
        if config.architecture != "trunk":
            raise ConfigError(
                f"architecture '{config.architecture}' tells no openings, it cannot learn from photographs"
            )
        return load_photographs(self.photographs, self.segmenter, *config.image_size)

    def validation(self, config: TrainConfig) -> list[Scene]:
        """Validation scenes, none where the data set has none.

        Raises:
            DatasetError: a scene cannot be used and `skip_bad` is off.
        """
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
        """Panorama queries in those scenes, asked in the data set's usual look; see `ImageValidation`.

        Args:
            folder: where to keep pictures that were rendered.

        Raises:
            DatasetError: a photograph cannot be read and `skip_bad` is off.
        """
        usual = None if self.dataset is None else self.dataset.appearances[0]
        problems: list[DatasetError] | None = [] if self.skip_bad else None
        cache = folder / "validation.npz" if folder is not None and self.dataset is None else None
        familiar = ImageValidation(config, scenes, layout_encoder, device, usual, problems, cache=cache)
        _log(problems)
        if self.heldout is None:
            return familiar
        others = ImageValidation(
            config,
            list(load_scenes(self.heldout, self.heldout.scenes("validation"))),
            layout_encoder,
            device,
            self.heldout.appearances[0],
            prefix="heldout",
            cache=None if folder is None else folder / "heldout.npz",
        )
        return lambda modules: familiar(modules) | others(modules)


def _log(problems: list[DatasetError] | None) -> None:
    for number, problem in enumerate(problems or [], start=1):
        _LOG.warning("left out of validation, number %d: %s", number, problem)


def _with_levels(scene: Scene) -> Scene:
    """A generated scene whose photographs say how full the rooms were drawn."""

    def with_level(camera: Camera) -> Camera:
        photographs = {
            Appearance(photograph.shot.furniture): photograph
            for photograph in camera.photographs.values()
            if isinstance(photograph, RenderedPhotograph)
        }
        return dataclasses.replace(camera, photographs=photographs)

    return dataclasses.replace(scene, cameras=tuple(with_level(camera) for camera in scene.cameras))
