"""Stage 2: the image encoder against the frozen layout encoder (paper, sections 3.2 and A.1.5)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lalaloc_core.nets import LayoutEncoder
from lalaloc_core.nets.ring import RingLayoutEncoder
from lalaloc_core.training import losses
from lalaloc_core.training.batches import Batch
from lalaloc_core.training.config import ImageStageConfig, TrainConfig
from lalaloc_core.training.objective import anchors_with_neighbours, chamfer_to_anchors, embed
from lalaloc_core.training.photometric import changed
from lalaloc_core.training.sources import Source
from lalaloc_core.training.stages import build_image_encoder, panorama_batches


class ImageStage:
    """Stage 2: the image encoder learns to give a panorama the latent of its bare layout; the teacher is frozen."""

    name = "image"

    def __init__(self, config: TrainConfig, source: Source, layout_encoder: LayoutEncoder) -> None:
        self.config = config
        self.source = source
        self.teacher = layout_encoder.eval().requires_grad_(False)
        self.encoder = build_image_encoder(config)
        self.modules: dict[str, nn.Module] = {"image_encoder": self.encoder}
        self._generator: torch.Generator | None = None
        self._first_step = 0

    @property
    def settings(self) -> ImageStageConfig:
        """Settings of this stage."""
        return self.config.image

    @property
    def ema_decay(self) -> float:
        """Decay per step of the averaged weights."""
        return self.settings.ema_decay

    @property
    def data(self) -> dict[str, Any]:
        """What is trained on."""
        return self.source.data

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        """Panorama batches, see `panorama_batches`."""
        self._first_step, self._generator = first_step, None
        return panorama_batches(
            self.config,
            self.source,
            neighbours=bool(self.settings.log_ratio_weight or self.settings.kd_weight),
            first_step=first_step,
            workers=workers,
            device=next(self.encoder.parameters()).device,
        )

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Weighted losses of a batch by name; their sum is minimised."""
        layout = (batch["profile_m"], batch["camera_height_m"], batch["ceiling_height_m"])
        stage, terms = self.settings, {}
        image = self._seen(batch["image"])
        if isinstance(self.teacher, RingLayoutEncoder):
            with torch.no_grad():
                ring = self.teacher.ring(*layout)
                target = self.teacher.head(ring)
            seen = self.encoder(image, batch["camera_height_m"])
            latent = self.teacher.head(seen.ring)
            if stage.ring_weight:
                terms["ring"] = stage.ring_weight * losses.ring_distillation(seen.ring, ring)
            if stage.profile_weight:
                likelihood = losses.laplace(seen.log_profile, seen.log_scale, batch["profile_m"])
                terms["profile"] = stage.profile_weight * likelihood
        else:
            with torch.no_grad():
                target = self.teacher(*layout)
            latent = self.encoder(image)
        if stage.l2_weight:
            terms["l2"] = stage.l2_weight * losses.l2(latent, target)
        if stage.log_ratio_weight or stage.kd_weight:
            terms |= self._relational(latent.float(), target.float(), batch)
        return terms

    def _seen(self, image: Tensor) -> Tensor:
        """Pictures with the photometric changes that are asked for; what is drawn depends on seed and first step."""
        if not self.settings.photometric:
            return image
        if self._generator is None:
            seed = int(np.random.default_rng([9, self.config.seed, self._first_step]).integers(1 << 62))
            self._generator = torch.Generator(image.device).manual_seed(seed)
        return changed(image, self.settings.photometric, self._generator)

    def _relational(self, latent: Tensor, target: Tensor, batch: Batch) -> dict[str, Tensor]:
        """Losses on the distances of the neighbours' layouts to the panorama."""
        stage, layout = self.settings, self.config.layout
        groups = anchors_with_neighbours(batch)
        with torch.no_grad():
            neighbours = embed(self.teacher, {key: value[:, 1:] for key, value in groups.items()})
            taught = torch.linalg.vector_norm(neighbours - target[:, None], dim=2)
        distance = torch.linalg.vector_norm(neighbours - latent[:, None], dim=2)
        positives, all_pairs, terms = layout.triplets.positives, layout.all_pairs, {}
        if stage.log_ratio_weight:
            chamfer = chamfer_to_anchors(groups, layout)
            ratio = losses.log_ratio(distance, chamfer, positives, all_pairs=all_pairs)
            terms["log_ratio"] = stage.log_ratio_weight * ratio
        if stage.kd_weight:
            terms["kd"] = stage.kd_weight * losses.log_ratio(distance, taught, positives, all_pairs=all_pairs)
        return terms
