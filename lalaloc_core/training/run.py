"""A training run: one folder with the checkpoints and logs of its stages, and its export to a bundle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from lalaloc_core.bundle import Bundle
from lalaloc_core.data.dataset import Scene
from lalaloc_core.errors import CheckpointError
from lalaloc_core.export import export_bundle
from lalaloc_core.nets import LayoutEncoder
from lalaloc_core.nets.decoder import LayoutDecoder
from lalaloc_core.training.checkpoint import Checkpoint
from lalaloc_core.training.config import TrainConfig
from lalaloc_core.training.data import TrainingData
from lalaloc_core.training.end_to_end import EndToEndStage
from lalaloc_core.training.image_stage import ImageStage
from lalaloc_core.training.layout_stage import LayoutStage
from lalaloc_core.training.loop import Validate, run_stage
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
) -> Checkpoint:
    """Stage 1 into `folder`.

    Raises:
        DatasetError: a file of the data set cannot be used.
    """
    torch.manual_seed(config.seed)
    stage = LayoutStage(config, data.source(config))
    scenes = data.validation(config)
    validate = LayoutValidation(config, scenes, device) if scenes else None
    return run_stage(stage, folder, device=device, workers=workers, resume=resume, validate=validate)


def train_image(
    config: TrainConfig,
    folder: Path,
    *,
    device: torch.device,
    data: TrainingData = ONLINE,
    teacher: Path | None = None,
    workers: int = 1,
    resume: bool = False,
) -> Checkpoint:
    """Stage 2 into `folder`, against the layout encoder that stage 1 left there, or in the folder `teacher`.

    Raises:
        CheckpointError: stage 1 has not run there, or for other networks.
        DatasetError: a file of the data set cannot be used.
    """
    torch.manual_seed(config.seed + 1)
    teacher = teacher or folder
    _check_same_networks(_checkpoint_with("layout", teacher).config, config)
    layout_encoder = load_layout_encoder_of(teacher)
    stage = ImageStage(config, data.source(config), layout_encoder)
    scenes = data.validation(config)
    validate = data.image_validation(config, scenes, layout_encoder, device) if scenes else None
    return run_stage(stage, folder, device=device, workers=workers, resume=resume, validate=validate)


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
    validate = _both(config, data, scenes, device) if scenes else None
    return run_stage(stage, folder, device=device, workers=workers, resume=resume, validate=validate)


def _both(config: TrainConfig, data: TrainingData, scenes: list[Scene], device: torch.device) -> Validate:
    layout = LayoutValidation(config, scenes, device)
    image = data.image_validation(config, scenes, None, device)
    return lambda modules: {**{f"layout_{key}": value for key, value in layout(modules).items()}, **image(modules)}


def load_layout_encoder_of(folder: Path) -> LayoutEncoder:
    """The layout encoder that training left in a run's folder."""
    checkpoint = _checkpoint_with("layout", folder)
    encoder = build_layout_encoder(checkpoint.config)
    encoder.load_state_dict(checkpoint.best_weights["layout_encoder"])
    return encoder


def load_decoder_of(folder: Path) -> LayoutDecoder | None:
    """The layout decoder that training left in a run's folder, where it trained one."""
    checkpoint = _checkpoint_with("layout", folder)
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
) -> Bundle:
    """Export what training left in `folder` to a bundle at `out`, with the decoder where one was trained.

    Args:
        layout_from: folder of the run whose layout encoder the image encoder was trained against; default: `folder`.
        layout_only: there is no image encoder, and the bundle answers layout queries only.

    Raises:
        CheckpointError: a stage has not run there, or the branches do not belong together.
        ExportError: the exported networks differ from torch.
    """
    teacher = layout_from or folder
    layout = _checkpoint_with("layout", teacher)
    image = None if layout_only else _checkpoint_with("image", folder)
    training: dict[str, Any] = {layout.stage: _told(layout)}
    image_encoder = None
    if image is not None:
        _check_same_networks(layout.config, image.config)
        image_encoder = build_image_encoder(image.config)
        image_encoder.load_state_dict(image.best_weights["image_encoder"])
        training[image.stage] = {**_told(image), "panoramas": image.step * image.config.image.batch}
    return export_bundle(
        out,
        (image or layout).config,
        load_layout_encoder_of(teacher),
        image_encoder,
        load_decoder_of(teacher),
        name=name,
        version=version,
        training={**training, **(notes or {})},
    )


def _told(checkpoint: Checkpoint) -> dict[str, Any]:
    """What a manifest says of a stage."""
    told = {"steps": checkpoint.step, "minutes": round(checkpoint.seconds / 60.0, 1), **checkpoint.metrics}
    return {**told, "data": checkpoint.data} if checkpoint.data else told


def _check_same_networks(layout: TrainConfig, image: TrainConfig) -> None:
    """Both branches must agree on the architecture and its sizes."""
    for part in ("architecture", layout.architecture):
        if getattr(layout, part) != getattr(image, part):
            raise CheckpointError(
                f"the layout encoder was trained with {part} {getattr(layout, part)}, "
                f"the image encoder is configured with {getattr(image, part)}"
            )


def _checkpoint_with(stage: str, folder: Path) -> Checkpoint:
    """The checkpoint that holds what a stage trains: its own, or that of end-to-end training.

    Raises:
        CheckpointError: neither is there, or both are.
    """
    own, joint = folder / f"{stage}.pt", folder / f"{EndToEndStage.name}.pt"
    if not joint.exists():
        return Checkpoint.load(own, stage=stage)
    if own.exists():
        raise CheckpointError(f"'{folder}' holds both '{own.name}' and '{joint.name}': which one to take?")
    return Checkpoint.load(joint, stage=EndToEndStage.name)
