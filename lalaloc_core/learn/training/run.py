"""A training run: one folder with the checkpoints and logs of its stages."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

from lalaloc_core.errors import ConfigError
from lalaloc_core.learn.data.dataset import Scene
from lalaloc_core.learn.training.checkpoint import Checkpoint, Validate
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.data import TrainingData
from lalaloc_core.learn.training.end_to_end import EndToEndStage
from lalaloc_core.learn.training.image_stage import ImageStage
from lalaloc_core.learn.training.layout_stage import LayoutStage
from lalaloc_core.learn.training.loop import run_stage
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.learn.training.stages import TrainingStage
from lalaloc_core.learn.training.validate import LayoutValidation
from lalaloc_core.learn.training.view_stage import PHOTOGRAPH_SIZE, ViewStage, view_window
from lalaloc_core.learn.training.view_validation import ViewValidation
from lalaloc_core.learn.training.warm_start import (
    check_same_networks,
    find_checkpoint,
    has_views,
    load_trained_layout_encoder,
    load_warm_start,
)
from lalaloc_core.nets.sphere_network import TrunkImageEncoder
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
    """Run stage 1 in `folder`, with batches from `workers` processes.

    `init_from` is a bundle or run folder that provides the first weights; it excludes `resume`.

    Raises:
        CheckpointError: initial weights or the checkpoint are missing, or have other networks.
        DatasetError: a file of the data set cannot be used.
    """
    torch.manual_seed(config.seed)
    stage = LayoutStage(config, data.source(config))
    begun_from = None if init_from is None else _warm_start(stage, init_from)
    scenes = data.validation(config)
    validate = LayoutValidation(config, scenes, device) if scenes else None
    return run_stage(
        stage, folder, device=device, workers=workers, resume=resume, validate=validate, begun_from=begun_from
    )


def _warm_start(stage: TrainingStage, folder: Path) -> dict[str, Any]:
    """Load trained weights into a stage; return their origin for checkpoints."""
    start = load_warm_start(folder, stage.name, stage.config)
    start.load_into(stage.modules)
    return start.origin


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
    """Run stage 2 in `folder`, against the layout encoder of the run folder `teacher` (default: `folder`).

    `init_from` is a bundle or run folder that provides the first image encoder; it excludes `resume`. Without
    `teacher`, a `folder` without layout encoder gets the one of `layout_from` or `init_from`.

    Raises:
        CheckpointError: the layout encoder is missing or has other networks.
        DatasetError: a file of the data set cannot be used.
    """
    torch.manual_seed(config.seed + 1)
    origin = layout_from or init_from
    if origin is not None and teacher is None and not (folder / "layout.pt").exists():
        start = load_warm_start(origin, "layout", config)
        dataclasses.replace(start.checkpoint, stage="layout").save(folder / "layout.pt")
    teacher = teacher or folder
    check_same_networks("layout", config, find_checkpoint("layout", teacher).config, str(teacher))
    layout_encoder = load_trained_layout_encoder(teacher)
    stage = ImageStage(config, data.source(config), layout_encoder, data.load_photographs(config))
    fresh = init_from is None and not resume
    if fresh and isinstance(stage.encoder, TrunkImageEncoder) and config.image.pretrained:
        load_pretrained(stage.encoder.trunk)
    begun_from = None if init_from is None else _warm_start(stage, init_from)
    scenes = data.validation(config)
    validate = data.image_validation(config, scenes, layout_encoder, device, folder) if scenes else None
    return run_stage(
        stage, folder, device=device, workers=workers, resume=resume, validate=validate, begun_from=begun_from
    )


def train_views(
    config: TrainConfig,
    folder: Path,
    *,
    device: torch.device,
    data: TrainingData = ONLINE,
    workers: int = 1,
    resume: bool = False,
    init_from: Path | None = None,
) -> Checkpoint:
    """Train the encoder of views in `folder`.

    `init_from` is a bundle or run folder whose encoder of views, else its image encoder, provides the first weights; it
    excludes `resume`.

    Raises:
        ConfigError: a data set is given; views are rendered from generated homes only.
        CheckpointError: initial weights or the checkpoint are missing, or have other networks.
        DatasetError: a photograph cannot be read.
    """
    if data.dataset is not None:
        raise ConfigError("views are rendered from generated homes; train them without a data set (--data)")
    torch.manual_seed(config.seed + 2)
    source = GeneratedSource(config, data.textures, data.deferred, view_window(config))
    stage = ViewStage(config, source, data.load_photographs(config, PHOTOGRAPH_SIZE))
    begun_from = None
    if init_from is None and not resume and config.image.pretrained:
        load_pretrained(stage.encoder.trunk)
    if init_from is not None and has_views(init_from):
        begun_from = _warm_start(stage, init_from)
    elif init_from is not None:
        start = load_warm_start(init_from, "image", config)
        sphere = TrunkImageEncoder(config.trunk, config.ring)
        start.load_into({"image_encoder": sphere})
        stage.encoder.start_from(sphere)
        begun_from = start.origin
    validate = ViewValidation(config, data.validation_scenes, data.textures, device)
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
    """Train both branches at once in `folder`.

    Raises:
        ConfigError: the architecture does not support end-to-end training.
        DatasetError: a file of the data set cannot be used.
    """
    torch.manual_seed(config.seed)
    stage = EndToEndStage(config, data.source(config))
    scenes = data.validation(config)
    validate = _joint_validation(config, data, scenes, device, folder) if scenes else None
    return run_stage(stage, folder, device=device, workers=workers, resume=resume, validate=validate)


def _joint_validation(
    config: TrainConfig, data: TrainingData, scenes: list[Scene], device: torch.device, folder: Path
) -> Validate:
    layout = LayoutValidation(config, scenes, device)
    image = data.image_validation(config, scenes, None, device, folder)
    return lambda modules: {**{f"layout_{key}": value for key, value in layout(modules).items()}, **image(modules)}
