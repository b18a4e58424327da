"""End-to-end training of both branches, the paper's alternative to two stages (section 6, "End-to-End Training")."""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor, nn

from lalaloc_core.errors import ConfigError
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batches import Batch
from lalaloc_core.learn.training.config import ImageStageConfig, TrainConfig
from lalaloc_core.learn.training.layout_stage import LayoutObjective, anchors_with_neighbours
from lalaloc_core.learn.training.sources import Source
from lalaloc_core.learn.training.stages import (
    TrainingStage,
    build_decoder,
    build_image_encoder,
    build_layout_encoder,
    sphere_batches,
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
        layout_encoder, decoder = build_layout_encoder(config), build_decoder(config)
        self.objective = LayoutObjective(config.layout, layout_encoder, decoder)
        self.encoder = build_image_encoder(config)
        self.modules: dict[str, nn.Module] = {"layout_encoder": layout_encoder, "image_encoder": self.encoder}
        if decoder is not None:
            self.modules["decoder"] = decoder

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        """Yield sphere batches with neighbours."""
        return sphere_batches(
            self.config,
            self.source,
            neighbours=True,
            first_step=first_step,
            workers=workers,
            device=next(self.encoder.parameters()).device,
        )

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the weighted losses of a batch by name."""
        terms, latent = self.objective(anchors_with_neighbours(batch))
        distance = losses.l2(self.encoder(batch["image"]).float(), latent[:, 0].detach())
        return {**terms, "l2": self.settings.l2_weight * distance}
