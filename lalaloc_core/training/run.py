"""A training run: one folder with the checkpoints and logs of its stages, and its export to a bundle."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

from lalaloc_core.bundle import Bundle
from lalaloc_core.data.dataset import Scene
from lalaloc_core.export import export_bundle
from lalaloc_core.nets import LayoutEncoder
from lalaloc_core.nets.decoder import LayoutDecoder
from lalaloc_core.training.beginning import (
    JOINT,
    begin_from,
    check_same_networks,
    checkpoint_with,
    panoramas,
    totals,
)
from lalaloc_core.training.best import Validate, best_path
from lalaloc_core.training.checkpoint import Checkpoint
from lalaloc_core.training.config import TrainConfig
from lalaloc_core.training.data import TrainingData
from lalaloc_core.training.end_to_end import EndToEndStage
from lalaloc_core.training.image_stage import ImageStage
from lalaloc_core.training.layout_stage import LayoutStage
from lalaloc_core.training.loop import run_stage
from lalaloc_core.training.stages import build_image_encoder, build_layout_encoder
from lalaloc_core.training.validate import LayoutValidation

ONLINE = TrainingData()


def train_layout(
    config: TrainConfig,
    folder: Path,
    *,
    device: torch.device,
    data: TrainingData = ONLINE,
    workers: int = 1,
    resume: bool = False,
    begin: Path | None = None,
) -> Checkpoint:
    """Stage 1 into `folder`.

    Args:
        begin: a bundle or a run's folder with whose weights to begin; a run that resumes has begun already.

    Raises:
        CheckpointError: what to begin or to go on with is missing, or has other networks.
        DatasetError: a file of the data set cannot be used.
    """
    torch.manual_seed(config.seed)
    stage = LayoutStage(config, data.source(config))
    begun_from = None if begin is None else _begin(stage, begin, "layout")
    scenes = data.validation(config)
    validate = LayoutValidation(config, scenes, device) if scenes else None
    return run_stage(
        stage, folder, device=device, workers=workers, resume=resume, validate=validate, begun_from=begun_from
    )


def _begin(stage: LayoutStage | ImageStage, folder: Path, name: str) -> dict[str, Any]:
    """Give a stage the weights to begin with; returns what is told of their origin."""
    beginning = begin_from(folder, name, stage.config)
    beginning.load_into(stage.modules)
    return beginning.told


def train_image(
    config: TrainConfig,
    folder: Path,
    *,
    device: torch.device,
    data: TrainingData = ONLINE,
    teacher: Path | None = None,
    workers: int = 1,
    resume: bool = False,
    begin: Path | None = None,
) -> Checkpoint:
    """Stage 2 into `folder`, against the layout encoder that stage 1 left there, or in the folder `teacher`.

    Args:
        begin: a bundle or a run's folder with whose image encoder to begin; a run that resumes has begun already.
            Where `folder` has no layout encoder and no other teacher is named, it gets the one from there.

    Raises:
        CheckpointError: stage 1 has not run there, or for other networks.
        DatasetError: a file of the data set cannot be used.
    """
    torch.manual_seed(config.seed + 1)
    if begin is not None and teacher is None and not (folder / "layout.pt").exists():
        found = begin_from(begin, "layout", config).checkpoint
        dataclasses.replace(found, stage="layout").save(folder / "layout.pt")
    teacher = teacher or folder
    check_same_networks(config, checkpoint_with("layout", teacher).config, str(teacher))
    layout_encoder = load_layout_encoder_of(teacher)
    stage = ImageStage(config, data.source(config), layout_encoder)
    begun_from = None if begin is None else _begin(stage, begin, "image")
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


def load_layout_encoder_of(folder: Path, *, last: bool = False) -> LayoutEncoder:
    """The layout encoder that training left in a run's folder: the best by validation, unless the last is asked for."""
    checkpoint = checkpoint_with("layout", folder, last=last)
    encoder = build_layout_encoder(checkpoint.config)
    encoder.load_state_dict(checkpoint.best_weights["layout_encoder"])
    return encoder


def load_decoder_of(folder: Path, *, last: bool = False) -> LayoutDecoder | None:
    """The decoder that was trained with `load_layout_encoder_of`, where one was."""
    checkpoint = checkpoint_with("layout", folder, last=last)
    if "decoder" not in checkpoint.best_weights:
        return None
    decoder = LayoutDecoder(checkpoint.config.latent_size)
    decoder.load_state_dict(checkpoint.best_weights["decoder"])
    return decoder


def export_run(
    folder: Path,
    out: Path,
    *,
    name: str,
    version: str,
    notes: dict[str, Any] | None = None,
    layout_from: Path | None = None,
    layout_only: bool = False,
    last: bool = False,
) -> Bundle:
    """Export what training left in `folder` to a bundle at `out`, with the decoder where one was trained.

    Args:
        layout_from: folder of the run whose layout encoder the image encoder was trained against; default: `folder`.
        layout_only: there is no image encoder, and the bundle answers layout queries only.
        last: take the last weights of the run, not the best by validation. Of two stages this is the second: it has
            learnt to follow the best layout encoder.

    Raises:
        CheckpointError: a stage has not run there, or the branches do not belong together.
        ExportError: the exported networks differ from torch.
    """
    teacher = layout_from or folder
    # Branches that were trained together are taken from one moment.
    last_layout = last and (layout_only or (teacher / f"{JOINT}.pt").exists())
    layout = checkpoint_with("layout", teacher, last=last_layout)
    image = None if layout_only else checkpoint_with("image", folder, last=last)
    training: dict[str, Any] = {layout.stage: _told(layout, teacher, last=last_layout)}
    image_encoder = None
    if image is not None:
        check_same_networks(image.config, layout.config, str(teacher))
        image_encoder = build_image_encoder(image.config)
        image_encoder.load_state_dict(image.best_weights["image_encoder"])
        training[image.stage] = {**_told(image, folder, last=last), "panoramas": panoramas(image)}
    return export_bundle(
        out,
        (image or layout).config,
        load_layout_encoder_of(teacher, last=last_layout),
        image_encoder,
        load_decoder_of(teacher, last=last_layout),
        name=name,
        version=version,
        training={**training, **(notes or {})},
    )


def _told(checkpoint: Checkpoint, folder: Path, *, last: bool) -> dict[str, Any]:
    """What a manifest says of a stage; steps and minutes are those until the chosen checkpoint."""
    told: dict[str, Any] = {"steps": checkpoint.step, "minutes": round(checkpoint.seconds / 60.0, 1)}
    told |= checkpoint.metrics
    path = folder / f"{checkpoint.stage}.pt"
    if best_path(path).exists():
        chosen = {"checkpoint": "last" if last else "best by validation"}
        told |= {**chosen, "minutes_of_run": round(Checkpoint.load(path).seconds / 60.0, 1)}
    if checkpoint.data:
        told["data"] = checkpoint.data
    if checkpoint.begun_from:
        told |= {"begun_from": checkpoint.begun_from, **totals(checkpoint)}
    return told
