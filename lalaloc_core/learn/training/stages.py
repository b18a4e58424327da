"""Base class of the training stages, and the networks, batches and optimiser they build."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from lalaloc_core.errors import ConfigError
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batch_streams import SphereBatches
from lalaloc_core.learn.training.batches import Batch, Photographs, load_batches
from lalaloc_core.learn.training.config import ImageStageConfig, LayoutStageConfig, OptimiserConfig, TrainConfig
from lalaloc_core.learn.training.deferred import DeferredRenderer
from lalaloc_core.learn.training.sources import GeneratedSource, Source
from lalaloc_core.nets import ImageEncoder, LayoutNetwork, RingImageEncoder, RingLayoutEncoder
from lalaloc_core.nets.image_features import StructureFeatures, WallModes
from lalaloc_core.nets.paper_encoders import PaperImageEncoder, PaperLayoutEncoder
from lalaloc_core.nets.sphere_network import HorizonEncoder, TrunkImageEncoder
from lalaloc_core.nets.trunk import StyleMixing, Trunk

StageConfigT = TypeVar("StageConfigT", LayoutStageConfig, ImageStageConfig)


class TrainingStage(ABC, Generic[StageConfigT]):
    """Networks, data and losses of one stage, run by the training loop; `teacher` is a frozen network."""

    name: ClassVar[str]
    config: TrainConfig
    settings: StageConfigT
    source: Source
    modules: dict[str, nn.Module]
    teacher: nn.Module | None = None
    photographs: Photographs | None = None

    @property
    def ema_decay(self) -> float:
        """Decay per step of the averaged weights; 0 turns averaging off."""
        return self.settings.ema_decay if isinstance(self.settings, ImageStageConfig) else 0.0

    @property
    def data(self) -> dict[str, Any]:
        """Description of the training data, stored in checkpoints and manifests."""
        if self.photographs is None:
            return self.source.data
        return {**self.source.data, "photographs": len(self.photographs.images)}

    @abstractmethod
    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        """Yield batches from a step on; earlier steps used other homes, or other parts of the epoch."""

    @abstractmethod
    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the weighted losses of a batch by name; the loop minimises their sum."""


def build_layout_encoder(config: TrainConfig) -> LayoutNetwork:
    """Build an untrained layout encoder of the configured architecture."""
    return RingLayoutEncoder(config.ring) if config.has_ring else PaperLayoutEncoder(config.paper)


def build_image_encoder(config: TrainConfig) -> ImageEncoder:
    """Build an untrained image encoder of the configured architecture."""
    if config.architecture == "trunk":
        return TrunkImageEncoder(config.trunk, config.ring)
    return RingImageEncoder(config.ring) if config.has_ring else PaperImageEncoder(config.paper)


def sphere_batches(
    config: TrainConfig,
    source: Source,
    first_step: int,
    workers: int,
    device: torch.device,
    *,
    neighbours: bool = False,
    views: bool = False,
) -> Iterator[Batch]:
    """Yield sphere batches from a step on, with homes or parts of the epoch that earlier steps have not used.

    Rows hold the layouts of neighbouring poses if `neighbours` is set; `views` are parts of the horizon; `device`
    renders deferred spheres.
    """
    first_visit = first_step * (config.image.batch // config.image.shots_per_home + 1)
    batches = load_batches(SphereBatches(config, source, neighbours, first_visit, views), workers)
    if isinstance(source, GeneratedSource) and source.deferred:
        sizes = config.view if views else config.image_sizes
        renderer = source.renderer(device, sizes.image_height, sizes.image_width)
        return DeferredRenderer(renderer).render_batches(batches)
    return batches


def structure_losses(
    settings: ImageStageConfig,
    encoder: HorizonEncoder,
    features: StructureFeatures,
    kind: Int[Tensor, "b w"],
    batch: Batch,
) -> dict[str, Tensor]:
    """Return the weighted losses of openings, ceiling and room type by name, those whose weight is not 0.

    `kind` is the class of the opening at each azimuth, `batch_streams.UNKNOWN` where it is not seen.
    """
    room_type = batch["room_type"]
    encoder.update_class_shares(kind, room_type)
    terms = {}
    if settings.opening_weight:
        share = encoder.opening_share
        loss = losses.opening(features.opening_logits, kind, share, settings.opening_balance)
        terms["opening"] = settings.opening_weight * loss
    if settings.ceiling_weight:
        above_m = batch["ceiling_height_m"] - batch["camera_height_m"]
        loss = losses.ceiling(features.log_ceiling, features.log_ceiling_scale, above_m)
        terms["ceiling"] = settings.ceiling_weight * loss
    if settings.room_type_weight:
        terms["room_type"] = settings.room_type_weight * losses.room_type(features.room_type_logits, room_type)
    return terms


def photograph_loss(
    settings: ImageStageConfig,
    walls: WallModes,
    opening_logits: Float[Tensor, "n w c"],
    seen: Bool[Tensor, "n w"],
    targets: Photographs,
    class_weight: Float[Tensor, "c"],
    columns: slice = slice(None),
) -> Tensor:
    """Return the weighted loss of predictions for photographs, against those columns of their targets that are seen."""
    openings, log_distance = (part[:, columns].to(seen.device) for part in (targets.openings, targets.log_distance))
    agreement = losses.teacher_openings(opening_logits[seen][None], openings[seen][None], class_weight)
    known = losses.visible_walls(torch.where(seen, log_distance, torch.nan), openings, opening_logits)
    target = log_distance.nan_to_num()
    distance = losses.laplace_mixture(walls, target, known)
    loss = settings.photograph_weight * agreement + settings.photograph_profile_weight * distance
    if settings.shape_weight:
        loss += settings.shape_weight * losses.wall_shape(walls, target, known)
    return loss


def opening_weight(settings: ImageStageConfig, encoder: HorizonEncoder, photographs: Photographs) -> Float[Tensor, "c"]:
    """Return the weights of the opening classes in photographs, by which renderings and photographs share a prior."""
    prior = losses.opening_prior(encoder.opening_share, settings.opening_balance)
    return prior / photographs.opening_share.to(prior)


def edges_loss(
    settings: ImageStageConfig,
    structure: StructureFeatures,
    edges: Float[Tensor, "b w 2"],
    walls: Shaped[Tensor, "b h v"] | None,
    seen: Bool[Tensor, "b w"],
) -> Tensor:
    """Return the weighted loss of openings' edges, and of seeing walls where `walls` tells them (above 0)."""
    loss = losses.opening_edges(structure, edges, seen)
    if walls is not None:
        loss = loss + losses.wall_seen(structure.wall_seen_logit, (walls > 0).float(), seen)
    return settings.edges_weight * loss


def sample_styles(
    mixed_share: float, rendered: int, photographs: int, generator: torch.Generator, device: torch.device
) -> StyleMixing | None:
    """Draw style partners for a share of a batch, half of them photographs, because queries look like photographs."""
    if not mixed_share:
        return None
    count = rendered + photographs
    partner = torch.randint(count, (count,), generator=generator)
    photograph = rendered + torch.randint(photographs, (count,), generator=generator)
    partner = torch.where(torch.rand(count, generator=generator) < 0.5, photograph, partner)
    share = torch.rand(count, generator=generator)
    share[torch.rand(count, generator=generator) >= mixed_share] = 0.0
    return StyleMixing(partner.to(device), share.to(device))


def build_optimiser(modules: dict[str, nn.Module], config: OptimiserConfig) -> torch.optim.Optimizer:
    """Build the optimiser of the parameters in `config.only`, and freeze the others; AdamW decays matrices only."""
    if config.only:
        names = {f"{part}.{name}": p for part, module in modules.items() for name, p in module.named_parameters()}
        for wanted in config.only:
            if not any(name.startswith(wanted) for name in names):
                first = next(iter(names))
                raise ConfigError(f"optimiser.only has '{wanted}', but no parameter begins with it; one is '{first}'")
        for name, parameter in names.items():
            parameter.requires_grad_(parameter.requires_grad and name.startswith(config.only))
    if config.keep_depthwise:
        for part in (part for module in modules.values() for part in module.modules()):
            if isinstance(part, nn.Conv2d) and part.groups > 1:
                part.requires_grad_(False)
    trunks = [part for module in modules.values() for part in module.modules() if isinstance(part, Trunk)]
    slow = {id(p) for trunk in trunks for p in trunk.parameters()}
    parameters = [p for module in modules.values() for p in module.parameters() if p.requires_grad]
    decayed = [p for p in parameters if config.kind == "sgd" or p.ndim > 1]
    others = [p for p in parameters if config.kind != "sgd" and p.ndim <= 1]
    # By decay, and by the factor that multiplies the learning rate.
    groups = [
        {"params": members, "weight_decay": decay, "factor": factor}
        for part, decay in ((decayed, config.weight_decay), (others, 0.0))
        for factor, is_slow in ((1.0, False), (config.trunk_factor, True))
        if (members := [p for p in part if (id(p) in slow) == is_slow])
    ]
    if config.kind == "sgd":
        return torch.optim.SGD(groups, config.learning_rate, momentum=config.momentum)
    return torch.optim.AdamW(groups, config.learning_rate)
