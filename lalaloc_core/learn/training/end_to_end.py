"""Both branches at once, which the paper compares with its two stages (section 6, "End-to-End Training")."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from torch import Tensor, nn

from lalaloc_core.errors import ConfigError
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batches import Batch
from lalaloc_core.learn.training.config import ImageStageConfig, TrainConfig
from lalaloc_core.learn.training.objective import LayoutObjective, anchors_with_neighbours
from lalaloc_core.learn.training.sources import Source
from lalaloc_core.learn.training.stages import (
    build_decoder,
    build_image_encoder,
    build_layout_encoder,
    panorama_batches,
)


class EndToEndStage:
    """The layout branch learns as in stage 1; the image branch follows its latents, which get no gradient from that.

    Raises:
        ConfigError: an architecture whose branches share their head, or changed exposures, cannot be trained like that.
    """

    name = "end-to-end"
    teacher = None

    def __init__(self, config: TrainConfig, source: Source) -> None:
        if config.architecture != "paper":
            raise ConfigError(f"config.architecture is '{config.architecture}', end-to-end training knows 'paper' only")
        for name in ("photometric", "optics"):
            if getattr(config.image, name):
                raise ConfigError(
                    f"config.image.{name} is {getattr(config.image, name):g}, end-to-end training has none"
                )
        self.config = config
        self.source = source
        layout_encoder, decoder = build_layout_encoder(config), build_decoder(config)
        self.objective = LayoutObjective(config.layout, layout_encoder, decoder)
        self.encoder = build_image_encoder(config)
        self.modules: dict[str, nn.Module] = {"layout_encoder": layout_encoder, "image_encoder": self.encoder}
        if decoder is not None:
            self.modules["decoder"] = decoder

    @property
    def settings(self) -> ImageStageConfig:
        """Schedule, batch and the weight of the latent distance; the rest is in `config.layout`."""
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
        """Panorama batches with neighbours."""
        return panorama_batches(
            self.config,
            self.source,
            neighbours=True,
            first_step=first_step,
            workers=workers,
            device=next(self.encoder.parameters()).device,
        )

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Weighted losses of a batch by name; their sum is minimised."""
        terms, latent = self.objective(anchors_with_neighbours(batch))
        distance = losses.l2(self.encoder(batch["image"]).float(), latent[:, 0].detach())
        return {**terms, "l2": self.settings.l2_weight * distance}
