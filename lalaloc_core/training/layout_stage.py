"""Stage 1: the layout encoder alone (paper, section 3.1)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from lalaloc_core.metrics import chamfer_distance
from lalaloc_core.nets.decoder import DECODED_HEIGHT, DECODED_WIDTH, LayoutDecoder
from lalaloc_core.render.depth import back_project, layout_depth
from lalaloc_core.training import losses
from lalaloc_core.training.config import LayoutStageConfig, TrainConfig
from lalaloc_core.training.stages import build_layout_encoder
from lalaloc_core.training.stream import Batch, LayoutBatches, loader


class LayoutStage:
    """Stage 1: the layout encoder learns that latent distance means structural difference."""

    name = "layout"

    def __init__(self, config: TrainConfig) -> None:
        self.config = config
        self.encoder = build_layout_encoder(config)
        latent_size = config.ring.latent_size if config.architecture == "ring" else config.paper.latent_size
        self.decoder = LayoutDecoder(latent_size)
        self.modules: dict[str, nn.Module] = {"layout_encoder": self.encoder, "decoder": self.decoder}

    @property
    def settings(self) -> LayoutStageConfig:
        """Settings of this stage."""
        return self.config.layout

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        """Triplet batches; a resumed run goes on with homes it has not seen."""
        # Twice the homes of a step: some are too small to give triplets.
        first = 2 * first_step * self.settings.homes_per_step
        return iter(loader(LayoutBatches(self.config, first), workers))

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Weighted losses of a batch by name; their sum is minimised."""
        anchors, size, columns = batch["profile_m"].shape
        profile = batch["profile_m"].reshape(-1, columns)
        camera, ceiling = batch["camera_height_m"].reshape(-1), batch["ceiling_height_m"].reshape(-1)
        latent = self.encoder(profile, camera, ceiling)
        grouped = latent.float().reshape(anchors, size, -1)
        distance = torch.linalg.vector_norm(grouped[:, 1:] - grouped[:, :1], dim=2)
        chamfer = self._chamfer(profile, camera, ceiling, anchors, size)
        stage = self.settings
        terms = {"log_ratio": losses.log_ratio(distance, chamfer, stage.triplets.positives, all_pairs=stage.all_pairs)}
        if stage.scale_weight:
            terms["scale"] = stage.scale_weight * losses.distance_scale(distance, chamfer, stage.latent_per_metre)
        if stage.decode_weight:
            rows = slice(None, None, size) if stage.decode_anchors_only else slice(None)
            terms["decode"] = stage.decode_weight * self._decode(
                latent[rows], profile[rows], camera[rows], ceiling[rows]
            )
        return terms

    def _decode(self, latent: Tensor, profile: Tensor, camera: Tensor, ceiling: Tensor) -> Tensor:
        thinned = profile[:, :: max(profile.shape[1] // DECODED_WIDTH, 1)]
        depth = layout_depth(thinned, camera, ceiling, DECODED_HEIGHT)
        # Profiles coarser than the decoder's output (small test networks) are compared at their own resolution.
        decoded = nn.functional.interpolate(self.decoder(latent)[:, None].float(), depth.shape[1:])[:, 0]
        return losses.decode(decoded, depth)

    @torch.no_grad()
    def _chamfer(self, profile: Tensor, camera: Tensor, ceiling: Tensor, anchors: int, size: int) -> Tensor:
        """Chamfer distance (m) of every neighbour's point cloud to its anchor's, (anchors, size - 1)."""
        stage = self.settings
        thinned = profile[:, :: max(profile.shape[1] // stage.cloud_columns, 1)]
        cloud = back_project(layout_depth(thinned, camera, ceiling, stage.cloud_rows))
        cloud = cloud.reshape(anchors, size, -1, 3)
        neighbours = cloud[:, 1:].flatten(0, 1)
        repeated = cloud[:, :1].expand(-1, size - 1, -1, -1).flatten(0, 1)
        return chamfer_distance(neighbours, repeated).reshape(anchors, size - 1)
