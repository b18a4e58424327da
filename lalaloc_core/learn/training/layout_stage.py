"""Stage 1: the layout encoder alone (paper, section 3.1)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from torch import Tensor, nn

from lalaloc_core.learn.training.batch_streams import LayoutBatches
from lalaloc_core.learn.training.batches import Batch, load_batches
from lalaloc_core.learn.training.config import LayoutStageConfig, TrainConfig
from lalaloc_core.learn.training.objective import LayoutObjective
from lalaloc_core.learn.training.sources import Source
from lalaloc_core.learn.training.stages import build_decoder, build_layout_encoder


class LayoutStage:
    """Stage 1: the layout encoder learns that latent distance means structural difference."""

    name = "layout"
    teacher = None
    ema_decay = 0.0

    def __init__(self, config: TrainConfig, source: Source) -> None:
        self.config = config
        self.source = source
        self.encoder = build_layout_encoder(config)
        self.decoder = build_decoder(config)
        self.objective = LayoutObjective(config.layout, self.encoder, self.decoder)
        self.modules: dict[str, nn.Module] = {"layout_encoder": self.encoder}
        if self.decoder is not None:
            self.modules["decoder"] = self.decoder

    @property
    def settings(self) -> LayoutStageConfig:
        """Settings of this stage."""
        return self.config.layout

    @property
    def data(self) -> dict[str, Any]:
        """What is trained on."""
        return self.source.data

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        """Triplet batches; a resumed run goes on with homes, or parts of the epoch, that it has not seen."""
        # Twice the homes of a step: some are too small to give triplets.
        first = 2 * first_step * self.settings.homes_per_step
        return load_batches(LayoutBatches(self.config, self.source, first), workers)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Weighted losses of a batch by name; their sum is minimised."""
        return self.objective(batch)[0]
