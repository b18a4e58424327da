"""Ideas for the `ring` image encoder and its training that `encoder_sizes` compares with the preset."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.image_stage import ImageStage
from lalaloc_core.learn.training.sources import GeneratedSource
from lalaloc_core.nets.image_features import ImageFeatures
from lalaloc_core.nets.layout_encoder import RingConfig, RingLayoutEncoder
from lalaloc_core.nets.ring_image_encoder import RingImageEncoder
from scripts.encoder_pool import COLUMNS


class Gru(nn.Module):
    """A bidirectional GRU around the horizon in place of the attention mixer; it starts a quarter turn early."""

    def __init__(self, config: RingConfig) -> None:
        super().__init__()
        self.lead = config.sectors // 4
        self.gru = nn.GRU(config.mixer_width, config.mixer_width // 2, batch_first=True, bidirectional=True)

    def forward(self, x: Tensor) -> Tensor:
        around = torch.cat([x[:, -self.lead :], x, x[:, : self.lead]], dim=1)
        return x + self.gru(around)[0][:, self.lead : -self.lead]


class RingStage(ImageStage):
    """Stage 2 with the output of some modules kept, for losses that look inside."""

    def __init__(self, config: TrainConfig, teacher: RingLayoutEncoder) -> None:
        super().__init__(config, GeneratedSource(config), teacher)
        assert isinstance(self.encoder, RingImageEncoder)
        self.ring_encoder = self.encoder
        self.ring_teacher = teacher
        self.kept: dict[str, Any] = {}

    def keep(self, name: str, module: nn.Module) -> None:
        def hook(_: nn.Module, __: Any, output: Any) -> None:
            self.kept[name] = output

        module.register_forward_hook(hook)


class DenseStage(RingStage):
    """Besides, every cell of the last but one feature map says how much of it is floor, wall and ceiling."""

    weight, rows_per_cell = 0.3, 8

    def __init__(self, config: TrainConfig, teacher: RingLayoutEncoder) -> None:
        super().__init__(config, teacher)
        before = len(self.ring_encoder.stages) - config.ring.image_blocks[-1] - 1
        self.keep("map", self.ring_encoder.stages[before])
        self.modules["dense"] = self.dense = nn.Conv2d(config.ring.image_widths[-2], 3, 1)

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        terms = super().losses(batch)
        logits = self.dense(self.kept["map"])
        rows, sectors = logits.shape[2:]
        height = batch["camera_height_m"][:, None], (batch["ceiling_height_m"] - batch["camera_height_m"])[:, None]
        foot, top = -torch.atan(height[0] / batch["profile_m"]), torch.atan(height[1] / batch["profile_m"])
        count = rows * self.rows_per_cell
        elevation = (0.5 - (torch.arange(count) + 0.5) / count)[None, :, None] * TWO_PI / 2.0
        kinds = torch.stack([elevation < foot[:, None], elevation > top[:, None]], dim=1).float()
        share = functional.avg_pool2d(kinds, (self.rows_per_cell, COLUMNS // sectors))
        floor, ceiling = share.unbind(1)
        target = torch.stack([floor, 1.0 - floor - ceiling, ceiling], dim=1)
        return terms | {"dense": self.weight * functional.cross_entropy(logits, target)}


class ContrastiveStage(RingStage):
    """Besides, the true layout's latent must win against those of other poses of the same plan."""

    weight, others, temperature = 0.3, 8, 0.1

    def __init__(self, config: TrainConfig, teacher: RingLayoutEncoder) -> None:
        super().__init__(config, teacher)
        self.keep("seen", self.ring_encoder)
        self.fused = teacher.fused()

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        terms = super().losses(batch)
        seen: ImageFeatures = self.kept["seen"]
        profile = torch.cat([batch["profile_m"][:, None], batch["other_profile_m"][:, : self.others]], dim=1)
        ceiling = torch.cat(
            [batch["ceiling_height_m"][:, None], batch["other_ceiling_height_m"][:, : self.others]], dim=1
        )
        camera = batch["camera_height_m"][:, None].expand_as(ceiling)
        with torch.no_grad():
            layout = self.fused(profile.flatten(0, 1), camera.flatten(), ceiling.flatten()).unflatten(0, ceiling.shape)
        distance = torch.linalg.vector_norm(layout - self.ring_teacher.head(seen.ring)[:, None], dim=2)
        right = torch.zeros(len(distance), dtype=torch.long)
        return terms | {"contrast": self.weight * functional.cross_entropy(-distance / self.temperature, right)}
