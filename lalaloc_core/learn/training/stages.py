"""What the training loop needs to know of a stage, and what the two stages share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from lalaloc_core.learn.training.batch_streams import PanoramaBatches
from lalaloc_core.learn.training.batches import Batch, load_batches
from lalaloc_core.learn.training.config import ImageStageConfig, LayoutStageConfig, OptimiserConfig, TrainConfig
from lalaloc_core.learn.training.deferred import DeferredRenderer
from lalaloc_core.learn.training.sources import GeneratedSource, Source
from lalaloc_core.nets import ImageEncoder, LayoutEncoder
from lalaloc_core.nets.decoder import LayoutDecoder
from lalaloc_core.nets.image_encoder import TrunkImageEncoder
from lalaloc_core.nets.layout_encoder import RingLayoutEncoder
from lalaloc_core.nets.paper_encoders import PaperImageEncoder, PaperLayoutEncoder
from lalaloc_core.nets.ring_image_encoder import RingImageEncoder
from lalaloc_core.nets.trunk import Trunk


@runtime_checkable
class TrainingStage(Protocol):
    """What the training loop needs to know of a stage.

    Attributes:
        modules: the networks that are trained, by name.
        teacher: a frozen network that the losses ask, on the device of the others; None for none.
        ema_decay: decay per step of the averaged weights; 0 turns averaging off.
        data: what checkpoints and manifests say of what it is trained on.
    """

    name: str
    config: TrainConfig
    modules: dict[str, nn.Module]

    @property
    def teacher(self) -> nn.Module | None: ...

    @property
    def ema_decay(self) -> float: ...

    @property
    def settings(self) -> LayoutStageConfig | ImageStageConfig: ...

    @property
    def data(self) -> dict[str, Any]: ...

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]: ...

    def losses(self, batch: Batch) -> dict[str, Tensor]: ...


def build_layout_encoder(config: TrainConfig) -> LayoutEncoder:
    """A fresh layout encoder of the configured architecture."""
    return RingLayoutEncoder(config.ring) if config.has_ring else PaperLayoutEncoder(config.paper)


def build_image_encoder(config: TrainConfig) -> ImageEncoder:
    """A fresh image encoder of the configured architecture."""
    if config.architecture == "trunk":
        return TrunkImageEncoder(config.trunk, config.ring)
    return RingImageEncoder(config.ring) if config.has_ring else PaperImageEncoder(config.paper)


def build_decoder(config: TrainConfig) -> LayoutDecoder | None:
    """A fresh layout decoder, where one is trained."""
    return LayoutDecoder(config.latent_size) if config.layout.decode_weight else None


def panorama_batches(
    config: TrainConfig, source: Source, *, neighbours: bool, first_step: int, workers: int, device: torch.device
) -> Iterator[Batch]:
    """Panorama batches from a step on: with homes, or parts of the epoch, that earlier steps have not seen.

    Args:
        neighbours: whether rows have the layouts of neighbours.
        device: where deferred panoramas are rendered.
    """
    first = first_step * (config.image.batch // config.image.shots_per_home + 1)
    batches = load_batches(PanoramaBatches(config, source, neighbours, first), workers)
    if isinstance(source, GeneratedSource) and source.deferred:
        return DeferredRenderer(source.renderer(device)).rendered(batches)
    return batches


def build_optimiser(modules: dict[str, nn.Module], config: OptimiserConfig) -> torch.optim.Optimizer:
    """The optimiser over all parameters; AdamW decays matrices only."""
    trunks = [part for module in modules.values() for part in module.modules() if isinstance(part, Trunk)]
    slow = {id(p) for trunk in trunks for p in trunk.parameters()}
    parameters = [p for module in modules.values() for p in module.parameters() if p.requires_grad]
    if config.kind == "sgd":
        groups = _by_rate(parameters, slow, config, weight_decay=config.weight_decay)
        return torch.optim.SGD(groups, config.learning_rate, momentum=config.momentum)
    groups = _by_rate([p for p in parameters if p.ndim > 1], slow, config, weight_decay=config.weight_decay)
    groups += _by_rate([p for p in parameters if p.ndim <= 1], slow, config, weight_decay=0.0)
    return torch.optim.AdamW(groups, config.learning_rate)


def _by_rate(
    parameters: list[nn.Parameter], slow: set[int], config: OptimiserConfig, *, weight_decay: float
) -> list[dict[str, Any]]:
    """Groups of parameters with the factor on the learning rate that each keeps all along."""
    groups = []
    for factor, chosen in (
        (1.0, [p for p in parameters if id(p) not in slow]),
        (config.trunk_factor, [p for p in parameters if id(p) in slow]),
    ):
        groups += [{"params": chosen, "weight_decay": weight_decay, "factor": factor}] if chosen else []
    return groups
