"""Stage 2: the image encoder against the frozen layout encoder (paper, section 3.2)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from lalaloc_core.nets import LayoutEncoder
from lalaloc_core.nets.resnet import PaperImageEncoder
from lalaloc_core.nets.ring import RingLayoutEncoder
from lalaloc_core.training import losses
from lalaloc_core.training.config import ImageStageConfig, TrainConfig
from lalaloc_core.training.panoramas import PanoramaBatches
from lalaloc_core.training.stages import build_image_encoder
from lalaloc_core.training.stream import Batch, loader


class ImageStage:
    """Stage 2: the image encoder learns to give a panorama the latent of its bare layout; the teacher is frozen."""

    name = "image"

    def __init__(self, config: TrainConfig, layout_encoder: LayoutEncoder, textures: Path | None = None) -> None:
        self.config = config
        self.textures = textures
        self.teacher = layout_encoder.eval().requires_grad_(False)
        self.encoder = build_image_encoder(config)
        self.modules: dict[str, nn.Module] = {"image_encoder": self.encoder}

    @property
    def settings(self) -> ImageStageConfig:
        """Settings of this stage."""
        return self.config.image

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        """Panorama batches; a resumed run goes on with homes it has not seen."""
        first = first_step * (self.settings.batch // self.settings.shots_per_home + 1)
        return iter(loader(PanoramaBatches(self.config, self.textures, first), workers))

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Weighted losses of a batch by name; their sum is minimised."""
        heights = (batch["camera_height_m"], batch["ceiling_height_m"])
        stage = self.settings
        if isinstance(self.encoder, PaperImageEncoder):
            with torch.no_grad():
                target = self.teacher(batch["profile_m"], *heights)
            return {"l2": stage.l2_weight * losses.l2(self.encoder(batch["image"]), target)}
        assert isinstance(self.teacher, RingLayoutEncoder)
        with torch.no_grad():
            ring = self.teacher.ring(batch["profile_m"], *heights)
            target = self.teacher.head(ring)
        seen = self.encoder(batch["image"], batch["camera_height_m"])
        terms = {"l2": stage.l2_weight * losses.l2(self.teacher.head(seen.ring), target)}
        if stage.ring_weight:
            terms["ring"] = stage.ring_weight * losses.ring_distillation(seen.ring, ring)
        if stage.profile_weight:
            likelihood = losses.laplace(seen.log_profile, seen.log_scale, batch["profile_m"])
            terms["profile"] = stage.profile_weight * likelihood
        return terms
