"""Training of one stage in the folder of a run, which has the checkpoints and logs of stages."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import torch

from lalaloc_core.errors import ConfigError
from lalaloc_core.learn.training.checkpoint import Checkpoint, Validate
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.image_stage import ImageStage
from lalaloc_core.learn.training.layout_stage import EndToEndStage, LayoutStage
from lalaloc_core.learn.training.loop import run_stage
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.learn.training.stages import TrainingStage
from lalaloc_core.learn.training.training_data import TrainingData
from lalaloc_core.learn.training.validate import LayoutValidation
from lalaloc_core.learn.training.view_stage import PHOTOGRAPH_SIZE, ViewStage, ViewValidation, view_window
from lalaloc_core.learn.training.warm_start import (
    check_same_networks,
    find_checkpoint,
    has_views,
    load_warm_start,
    trained_layout_encoder,
)
from lalaloc_core.nets import LayoutNetwork, TrunkImageEncoder, ViewNetwork
from lalaloc_core.nets.trunk import load_pretrained

StageName = Literal["layout", "image", "view", "end-to-end"]
# Added to the seed of a run, so that its stages begin with different weights.
_SEED_OF_STAGE: dict[StageName, int] = {"layout": 0, "image": 1, "view": 2, "end-to-end": 0}
ONLINE = TrainingData()


def train_stage(
    name: StageName,
    config: TrainConfig,
    folder: Path,
    *,
    device: torch.device,
    data: TrainingData = ONLINE,
    workers: int = 1,
    resume: bool = False,
    init_from: Path | None = None,
    layout_from: Path | None = None,
    teacher: Path | None = None,
) -> Checkpoint:
    """Train a stage in `folder`: "layout", then "image", or both at once ("end-to-end"), or "view".

    `init_from` is a bundle or run folder that provides the first weights, instead of `resume`; views start from its
    encoder of views, else from its image encoder. The image stage trains against the layout encoder in the run folder
    `teacher` (default: `folder`), or that of `layout_from` (default: `init_from`) if `folder` has none.
    """
    torch.manual_seed(config.seed + _SEED_OF_STAGE[name])
    layout_encoder = _load_teacher(config, folder, teacher, layout_from or init_from) if name == "image" else None
    stage = _build_stage(name, config, data, layout_encoder)
    encoder = stage.encoder if isinstance(stage, ImageStage | ViewStage) else None
    begins_anew = config.image.pretrained and init_from is None and not resume
    if begins_anew and isinstance(encoder, TrunkImageEncoder | ViewNetwork):
        load_pretrained(encoder.trunk)
    begun_from = None if init_from is None else _warm_start(stage, init_from)
    validate = _validation(name, config, folder, data, layout_encoder, device)
    return run_stage(
        stage, folder, device=device, workers=workers, resume=resume, validate=validate, begun_from=begun_from
    )


def _load_teacher(config: TrainConfig, folder: Path, teacher: Path | None, origin: Path | None) -> LayoutNetwork:
    """Load the layout encoder that the image stage is trained against, if need be from a bundle or another run."""
    if origin is not None and teacher is None and not (folder / "layout.pt").exists():
        start = load_warm_start(origin, "layout", config)
        dataclasses.replace(start.checkpoint, stage="layout").save(folder / "layout.pt")
    checkpoint = find_checkpoint("layout", teacher or folder)
    check_same_networks("layout", config, checkpoint.config, str(teacher or folder))
    return trained_layout_encoder(checkpoint)


def _build_stage(
    name: StageName, config: TrainConfig, data: TrainingData, layout_encoder: LayoutNetwork | None
) -> TrainingStage:
    if name == "view":
        if data.dataset is not None:
            raise ConfigError("views are rendered from generated homes; train them without a data set (--data)")
        source = GeneratedSource(config, data.textures, data.deferred, view_window(config))
        return ViewStage(config, source, data.load_photographs(config, PHOTOGRAPH_SIZE))
    source = data.source(config)
    if layout_encoder is not None:
        return ImageStage(config, source, layout_encoder, data.load_photographs(config))
    return (LayoutStage if name == "layout" else EndToEndStage)(config, source)


def _warm_start(stage: TrainingStage, folder: Path) -> dict[str, Any]:
    """Load trained weights into a stage; return their origin for checkpoints."""
    if isinstance(stage, ViewStage) and not has_views(folder):
        start = load_warm_start(folder, "image", stage.config)
        sphere = TrunkImageEncoder(stage.config.trunk, stage.config.ring)
        start.load_into({"image_encoder": sphere})
        stage.encoder.start_from(sphere)
    else:
        start = load_warm_start(folder, stage.name, stage.config)
        start.load_into(stage.modules)
    return start.origin


def _validation(
    name: StageName,
    config: TrainConfig,
    folder: Path,
    data: TrainingData,
    layout_encoder: LayoutNetwork | None,
    device: torch.device,
) -> Validate | None:
    """Return the validation of a stage; None without validation scenes."""
    if name == "view":
        return ViewValidation(config, data.validation_scenes, data.textures, device)
    scenes = data.validation(config)
    if not scenes:
        return None
    if name == "layout":
        return LayoutValidation(config, scenes, device)
    image = data.image_validation(config, scenes, layout_encoder, device, folder)
    if name == "image":
        return image
    layout = LayoutValidation(config, scenes, device)
    return lambda modules: {**{f"layout_{key}": value for key, value in layout(modules).items()}, **image(modules)}
