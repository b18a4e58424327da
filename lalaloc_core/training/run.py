"""A training run: one folder with the checkpoints and logs of both stages, and its export to a bundle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from lalaloc_core.bundle import Bundle
from lalaloc_core.export import export_bundle
from lalaloc_core.nets import LayoutEncoder
from lalaloc_core.training.checkpoint import Checkpoint
from lalaloc_core.training.config import TrainConfig
from lalaloc_core.training.image_stage import ImageStage
from lalaloc_core.training.layout_stage import LayoutStage
from lalaloc_core.training.loop import run_stage
from lalaloc_core.training.stages import build_image_encoder, build_layout_encoder
from lalaloc_core.training.validate import ImageValidation, LayoutValidation


def train_layout(
    config: TrainConfig, folder: Path, *, device: torch.device, workers: int = 1, resume: bool = False
) -> Checkpoint:
    """Stage 1 into `folder`."""
    torch.manual_seed(config.seed)
    stage = LayoutStage(config)
    return run_stage(
        stage, folder, device=device, workers=workers, resume=resume, validate=LayoutValidation(config, device)
    )


def train_image(
    config: TrainConfig,
    folder: Path,
    *,
    device: torch.device,
    workers: int = 1,
    resume: bool = False,
    textures: Path | None = None,
) -> Checkpoint:
    """Stage 2 into `folder`, against the layout encoder that stage 1 left there.

    Raises:
        CheckpointError: stage 1 has not run there.
    """
    torch.manual_seed(config.seed + 1)
    teacher = load_layout_encoder_of(folder)
    stage = ImageStage(config, teacher, textures)
    validation = ImageValidation(config, teacher, device, textures)
    return run_stage(stage, folder, device=device, workers=workers, resume=resume, validate=validation)


def load_layout_encoder_of(folder: Path) -> LayoutEncoder:
    """The layout encoder that stage 1 left in a run's folder."""
    checkpoint = Checkpoint.load(folder / "layout.pt", stage="layout")
    encoder = build_layout_encoder(checkpoint.config)
    encoder.load_state_dict(checkpoint.best_weights["layout_encoder"])
    return encoder


def export_run(folder: Path, out: Path, *, name: str, version: str, notes: dict[str, Any] | None = None) -> Bundle:
    """Export what both stages left in `folder` to a bundle at `out`.

    Raises:
        CheckpointError: a stage has not run there.
        ExportError: the exported networks differ from torch.
    """
    layout = Checkpoint.load(folder / "layout.pt", stage="layout")
    image = Checkpoint.load(folder / "image.pt", stage="image")
    image_encoder = build_image_encoder(image.config)
    image_encoder.load_state_dict(image.best_weights["image_encoder"])
    training = {
        "layout": {"steps": layout.step, "minutes": round(layout.seconds / 60.0, 1), **layout.metrics},
        "image": {
            "steps": image.step,
            "panoramas": image.step * image.config.image.batch,
            "minutes": round(image.seconds / 60.0, 1),
            **image.metrics,
        },
        **(notes or {}),
    }
    return export_bundle(
        out,
        image.config,
        load_layout_encoder_of(folder),
        image_encoder,
        name=name,
        version=version,
        training=training,
    )
