"""Stage 1, the layout encoder alone (paper, section 3.1), and both stages end to end, which share its objective."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lalaloc_core.errors import ConfigError
from lalaloc_core.learn.metrics import chamfer_distance
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batch_streams import LayoutBatches
from lalaloc_core.learn.training.batches import Batch, load_batches
from lalaloc_core.learn.training.config import ImageStageConfig, LayoutStageConfig, TrainConfig
from lalaloc_core.learn.training.sources import Source
from lalaloc_core.learn.training.stages import TrainingStage, build_image_encoder, build_layout_encoder, sphere_batches
from lalaloc_core.nets import DECODED_HEIGHT, DECODED_WIDTH, LayoutDecoder, LayoutNetwork
from lalaloc_core.render.profile import back_project, layout_depth


class LayoutStage(TrainingStage[LayoutStageConfig]):
    """Stage 1: the layout encoder learns latents whose distances measure structural differences."""

    name = "layout"

    def __init__(self, config: TrainConfig, source: Source) -> None:
        self.config, self.settings, self.source = config, config.layout, source
        self.encoder = build_layout_encoder(config)
        self.decoder = _decoder(config)
        self.objective = LayoutObjective(config.layout, self.encoder, self.decoder)
        self.modules: dict[str, nn.Module] = {"layout_encoder": self.encoder}
        if self.decoder is not None:
            self.modules["decoder"] = self.decoder

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        """Yield triplet batches; a resumed run continues with homes, or parts of the epoch, it has not used."""
        # Twice the homes of a step, because some are too small for triplets.
        first_visit = 2 * first_step * self.settings.homes_per_step
        return load_batches(LayoutBatches(self.config, self.source, first_visit), workers)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the weighted losses of a batch by name."""
        return self.objective(batch)[0]


class LayoutObjective:
    """Log-ratio and decoding losses of groups: anchors, each with its neighbours (paper, section 3.1)."""

    def __init__(self, settings: LayoutStageConfig, encoder: LayoutNetwork, decoder: LayoutDecoder | None) -> None:
        self.settings = settings
        self.encoder = encoder
        self.decoder = decoder

    def __call__(self, groups: Batch) -> tuple[dict[str, Tensor], Float[Tensor, "a n d"]]:
        """Return the weighted losses by name, and the latents of the groups, anchors first."""
        stage = self.settings
        relational = bool(stage.log_ratio_weight or stage.scale_weight)
        if stage.decode_anchors_only and not relational:
            groups = {key: value[:, :1] for key, value in groups.items()}
        latent = embed(self.encoder, groups)
        terms: dict[str, Tensor] = {}
        if relational:
            distance = torch.linalg.vector_norm(latent[:, 1:] - latent[:, :1], dim=2)
            chamfer = chamfer_to_anchors(groups, stage)
            if stage.log_ratio_weight:
                ratio = losses.log_ratio(distance, chamfer, stage.triplets.positives, all_pairs=stage.all_pairs)
                terms["log_ratio"] = stage.log_ratio_weight * ratio
            if stage.scale_weight:
                terms["scale"] = stage.scale_weight * losses.distance_scale(distance, chamfer, stage.latent_per_metre)
        if self.decoder is not None:
            decoded = slice(0, 1) if stage.decode_anchors_only else slice(None)
            layouts = {key: value[:, decoded] for key, value in groups.items()}
            terms["decode"] = stage.decode_weight * _decoding_error(self.decoder, latent[:, decoded], layouts)
        return terms, latent


def embed(encoder: nn.Module, groups: Batch) -> Float[Tensor, "a n d"]:
    """Return the latents of groups of layouts in single precision."""
    leading = groups["profile_m"].shape[:2]
    return encoder(*_flatten(groups)).float().unflatten(0, leading)


def anchors_with_neighbours(batch: Batch) -> Batch:
    """Convert a batch of spheres with neighbours to stage 1's form: each sphere's own layout first."""
    profile, ceiling = batch["neighbour_profile_m"], batch["neighbour_ceiling_height_m"]
    ceiling = torch.cat([batch["ceiling_height_m"][:, None], ceiling], dim=1)
    return {
        "profile_m": torch.cat([batch["profile_m"][:, None], profile], dim=1),
        "camera_height_m": batch["camera_height_m"][:, None].expand_as(ceiling),
        "ceiling_height_m": ceiling,
    }


@torch.no_grad()
def chamfer_to_anchors(groups: Batch, stage: LayoutStageConfig) -> Float[Tensor, "a k"]:
    """Return the Chamfer distance (m) between each neighbour's point cloud and its anchor's."""
    anchors, size = groups["profile_m"].shape[:2]
    profile, camera, ceiling = _flatten(groups)
    cloud = back_project(layout_depth(_thin(profile, stage.cloud_columns), camera, ceiling, stage.cloud_rows))
    cloud = cloud.reshape(anchors, size, -1, 3)
    neighbours = cloud[:, 1:].flatten(0, 1)
    repeated = cloud[:, :1].expand(-1, size - 1, -1, -1).flatten(0, 1)
    return chamfer_distance(neighbours, repeated).reshape(anchors, size - 1)


def _decoder(config: TrainConfig) -> LayoutDecoder | None:
    """Return an untrained layout decoder; None if the decoding loss is off."""
    return LayoutDecoder(config.layout_sizes.latent_size) if config.layout.decode_weight else None


def _decoding_error(decoder: LayoutDecoder, latent: Float[Tensor, "a n d"], groups: Batch) -> Tensor:
    """Return the mean |L' - L| (m) between decoded latents and these layouts."""
    profile, camera, ceiling = _flatten(groups)
    depth = layout_depth(_thin(profile, DECODED_WIDTH), camera, ceiling, DECODED_HEIGHT)
    # Profiles coarser than the decoder's output (small test networks) are compared at their own resolution.
    decoded = nn.functional.interpolate(decoder(latent.flatten(0, 1))[:, None].float(), depth.shape[1:])[:, 0]
    return losses.decode(decoded, depth)


def _thin(profile_m: Float[Tensor, "b w"], columns: int) -> Float[Tensor, "b v"]:
    """Keep `columns` evenly spaced columns of a profile, or all; `TrainConfig` checks that the counts divide."""
    return profile_m[:, :: max(profile_m.shape[1] // columns, 1)]


def _flatten(groups: Batch) -> tuple[Tensor, Tensor, Tensor]:
    return (
        groups["profile_m"].flatten(0, 1),
        groups["camera_height_m"].flatten(0, 1),
        groups["ceiling_height_m"].flatten(0, 1),
    )


class EndToEndStage(TrainingStage[ImageStageConfig]):
    """Both branches at once: layouts as in stage 1, images against the layout latents, which get no image gradient."""

    name = "end-to-end"

    def __init__(self, config: TrainConfig, source: Source) -> None:
        if config.architecture != "paper":
            raise ConfigError(
                f"config.architecture is '{config.architecture}'; end-to-end training supports 'paper' only"
            )
        for name in ("photometric", "optics"):
            if getattr(config.image, name):
                raise ConfigError(
                    f"config.image.{name} is {getattr(config.image, name):g}; end-to-end training needs 0"
                )
        # The image stage's settings have schedule, batch and weight of the latent distance; `config.layout` the rest.
        self.config, self.settings, self.source = config, config.image, source
        layout_encoder, decoder = build_layout_encoder(config), _decoder(config)
        self.objective = LayoutObjective(config.layout, layout_encoder, decoder)
        self.encoder = build_image_encoder(config)
        self.modules: dict[str, nn.Module] = {"layout_encoder": layout_encoder, "image_encoder": self.encoder}
        if decoder is not None:
            self.modules["decoder"] = decoder

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        """Yield sphere batches with neighbours."""
        device = next(self.encoder.parameters()).device
        return sphere_batches(self.config, self.source, first_step, workers, device, neighbours=True)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the weighted losses of a batch by name."""
        terms, latent = self.objective(anchors_with_neighbours(batch))
        distance = losses.l2(self.encoder(batch["image"][..., :3]).float(), latent[:, 0].detach())
        return {**terms, "l2": self.settings.l2_weight * distance}
