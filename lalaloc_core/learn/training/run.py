"""A training run: one folder with the checkpoints and logs of its stages."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

from lalaloc_core.learn.data.dataset import Scene
from lalaloc_core.learn.training.best import Validate
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.data import TrainingData
from lalaloc_core.learn.training.end_to_end import EndToEndStage
from lalaloc_core.learn.training.image_stage import ImageStage
from lalaloc_core.learn.training.layout_stage import LayoutStage
from lalaloc_core.learn.training.loop import run_stage
from lalaloc_core.learn.training.trained_networks import load_layout_encoder_of
from lalaloc_core.learn.training.validate import LayoutValidation
from lalaloc_core.learn.training.warm_start import check_same_networks, checkpoint_with, load_warm_start
from lalaloc_core.nets.image_encoder import TrunkImageEncoder
from lalaloc_core.nets.trunk import load_pretrained

ONLINE = TrainingData()


def train_layout(
    config: TrainConfig,
    folder: Path,
    *,
    device: torch.device,
    data: TrainingData = ONLINE,
    workers: int = 1,
    resume: bool = False,
    init_from: Path | None = None,
) -> Checkpoint:
    """Stage 1 into `folder`.

    Args:
        init_from: a bundle or a run's folder whose weights training begins with; not for a run that resumes.

    Raises:
        CheckpointError: what to begin or to go on with is missing, or has other networks.
        DatasetError: a file of the data set cannot be used.
    """
    torch.manual_seed(config.seed)
    stage = LayoutStage(config, data.source(config))
    begun_from = None if init_from is None else _warm_start(stage, init_from, "layout")
    scenes = data.validation(config)
    validate = LayoutValidation(config, scenes, device) if scenes else None
    return run_stage(
        stage, folder, device=device, workers=workers, resume=resume, validate=validate, begun_from=begun_from
    )


def _warm_start(stage: LayoutStage | ImageStage, folder: Path, name: str) -> dict[str, Any]:
    """Initialise a stage with trained weights; returns what checkpoints say of their origin."""
    found = load_warm_start(folder, name, stage.config)
    found.load_into(stage.modules)
    return found.origin


def train_image(
    config: TrainConfig,
    folder: Path,
    *,
    device: torch.device,
    data: TrainingData = ONLINE,
    teacher: Path | None = None,
    workers: int = 1,
    resume: bool = False,
    init_from: Path | None = None,
    layout_from: Path | None = None,
) -> Checkpoint:
    """Stage 2 into `folder`, against the layout encoder that stage 1 left there, or in the folder `teacher`.

    Args:
        init_from: a bundle or a run's folder whose image encoder training begins with; not for a run that resumes.
            Where `folder` has no layout encoder and no other teacher is named, it gets the one from there.
        layout_from: a bundle or a run's folder whose layout encoder `folder` gets where it has none.

    Raises:
        CheckpointError: stage 1 has not run there, or for other networks.
        DatasetError: a file of the data set cannot be used.
    """
    torch.manual_seed(config.seed + 1)
    origin = layout_from or init_from
    if origin is not None and teacher is None and not (folder / "layout.pt").exists():
        found = load_warm_start(origin, "layout", config).checkpoint
        dataclasses.replace(found, stage="layout").save(folder / "layout.pt")
    teacher = teacher or folder
    check_same_networks("layout", config, checkpoint_with("layout", teacher).config, str(teacher))
    layout_encoder = load_layout_encoder_of(teacher)
    stage = ImageStage(config, data.source(config), layout_encoder, data.load_photographs(config))
    fresh = init_from is None and not resume
    if fresh and isinstance(stage.encoder, TrunkImageEncoder) and config.image.pretrained:
        load_pretrained(stage.encoder.trunk)
    begun_from = None if init_from is None else _warm_start(stage, init_from, "image")
    scenes = data.validation(config)
    validate = data.image_validation(config, scenes, layout_encoder, device, folder) if scenes else None
    return run_stage(
        stage, folder, device=device, workers=workers, resume=resume, validate=validate, begun_from=begun_from
    )


def train_end_to_end(
    config: TrainConfig,
    folder: Path,
    *,
    device: torch.device,
    data: TrainingData = ONLINE,
    workers: int = 1,
    resume: bool = False,
) -> Checkpoint:
    """Both branches at once into `folder`.

    Raises:
        ConfigError: the architecture cannot be trained like that.
        DatasetError: a file of the data set cannot be used.
    """
    torch.manual_seed(config.seed)
    stage = EndToEndStage(config, data.source(config))
    scenes = data.validation(config)
    validate = _both(config, data, scenes, device, folder) if scenes else None
    return run_stage(stage, folder, device=device, workers=workers, resume=resume, validate=validate)


def _both(config: TrainConfig, data: TrainingData, scenes: list[Scene], device: torch.device, folder: Path) -> Validate:
    layout = LayoutValidation(config, scenes, device)
    image = data.image_validation(config, scenes, None, device, folder)
    return lambda modules: {**{f"layout_{key}": value for key, value in layout(modules).items()}, **image(modules)}
