"""What the layout branch is trained for, in stage 1 and end to end, and the structure its neighbours have."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lalaloc_core.learn.metrics import chamfer_distance
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batches import Batch
from lalaloc_core.learn.training.config import LayoutStageConfig
from lalaloc_core.nets import LayoutEncoder
from lalaloc_core.nets.decoder import DECODED_HEIGHT, DECODED_WIDTH, LayoutDecoder
from lalaloc_core.render.depth import back_project, layout_depth


class LayoutObjective:
    """Log-ratio and decoding losses of groups: anchors, each with its neighbours (paper, section 3.1)."""

    def __init__(self, settings: LayoutStageConfig, encoder: LayoutEncoder, decoder: LayoutDecoder | None) -> None:
        self.settings = settings
        self.encoder = encoder
        self.decoder = decoder

    def __call__(self, groups: Batch) -> tuple[dict[str, Tensor], Float[Tensor, "a n d"]]:
        """Weighted losses by name, and the latents of all that was embedded, anchors first."""
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
            shown = {key: value[:, decoded] for key, value in groups.items()}
            terms["decode"] = stage.decode_weight * decoding_error(self.decoder, latent[:, decoded], shown)
        return terms, latent


def embed(encoder: nn.Module, groups: Batch) -> Float[Tensor, "a n d"]:
    """Latents, in single precision, of groups of layouts."""
    leading = groups["profile_m"].shape[:2]
    return encoder(*_flat(groups)).float().unflatten(0, leading)


def anchors_with_neighbours(batch: Batch) -> Batch:
    """The layouts of a batch of panoramas with neighbours, in the form of stage 1: each panorama's own one first."""
    profile, ceiling = batch["neighbour_profile_m"], batch["neighbour_ceiling_height_m"]
    ceiling = torch.cat([batch["ceiling_height_m"][:, None], ceiling], dim=1)
    return {
        "profile_m": torch.cat([batch["profile_m"][:, None], profile], dim=1),
        "camera_height_m": batch["camera_height_m"][:, None].expand_as(ceiling),
        "ceiling_height_m": ceiling,
    }


@torch.no_grad()
def chamfer_to_anchors(groups: Batch, stage: LayoutStageConfig) -> Float[Tensor, "a k"]:
    """Chamfer distance (m) of every neighbour's point cloud to its anchor's."""
    anchors, size = groups["profile_m"].shape[:2]
    profile, camera, ceiling = _flat(groups)
    cloud = back_project(layout_depth(thinned(profile, stage.cloud_columns), camera, ceiling, stage.cloud_rows))
    cloud = cloud.reshape(anchors, size, -1, 3)
    neighbours = cloud[:, 1:].flatten(0, 1)
    repeated = cloud[:, :1].expand(-1, size - 1, -1, -1).flatten(0, 1)
    return chamfer_distance(neighbours, repeated).reshape(anchors, size - 1)


def decoding_error(decoder: LayoutDecoder, latent: Float[Tensor, "a n d"], groups: Batch) -> Tensor:
    """Mean |L' - L| (m) of what the decoder makes of the latents of these layouts."""
    profile, camera, ceiling = _flat(groups)
    depth = layout_depth(thinned(profile, DECODED_WIDTH), camera, ceiling, DECODED_HEIGHT)
    # Profiles coarser than the decoder's output (small test networks) are compared at their own resolution.
    decoded = nn.functional.interpolate(decoder(latent.flatten(0, 1))[:, None].float(), depth.shape[1:])[:, 0]
    return losses.decode(decoded, depth)


def thinned(profile_m: Float[Tensor, "b w"], columns: int) -> Float[Tensor, "b v"]:
    """Every so many columns of a profile, `columns` of them or all; the configuration sees to it that they divide."""
    return profile_m[:, :: max(profile_m.shape[1] // columns, 1)]


def _flat(groups: Batch) -> tuple[Tensor, Tensor, Tensor]:
    return (
        groups["profile_m"].flatten(0, 1),
        groups["camera_height_m"].flatten(0, 1),
        groups["ceiling_height_m"].flatten(0, 1),
    )
