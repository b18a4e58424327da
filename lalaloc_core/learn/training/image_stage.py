"""Stage 2: the image encoder against the frozen layout encoder (paper, sections 3.2 and A.1.5)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor, nn

from lalaloc_core.learn.synth.augmentation import jittered, optics
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batches import Batch, Photographs
from lalaloc_core.learn.training.config import ImageStageConfig, TrainConfig
from lalaloc_core.learn.training.layout_stage import anchors_with_neighbours, chamfer_to_anchors, embed
from lalaloc_core.learn.training.sources import Source
from lalaloc_core.learn.training.stages import (
    TrainingStage,
    build_image_encoder,
    edges_loss,
    opening_weight,
    photograph_loss,
    sample_styles,
    sphere_batches,
    structure_losses,
)
from lalaloc_core.nets import LayoutNetwork, RingLayoutEncoder, TrunkImageEncoder
from lalaloc_core.nets.image_features import ImageFeatures, first_rows


class ImageStage(TrainingStage[ImageStageConfig]):
    """Stage 2: train the image encoder to map a sphere to the latent of its bare layout; the teacher is frozen."""

    name = "image"

    def __init__(
        self, config: TrainConfig, source: Source, layout_encoder: LayoutNetwork, photographs: Photographs | None = None
    ) -> None:
        self.config, self.settings, self.source, self.photographs = config, config.image, source, photographs
        self.teacher: LayoutNetwork = layout_encoder.eval().requires_grad_(False)
        self.encoder = build_image_encoder(config)
        self.modules: dict[str, nn.Module] = {"image_encoder": self.encoder}
        self._generators: dict[torch.device, torch.Generator] = {}
        self._first_step = 0

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        """Yield sphere batches."""
        self._first_step, self._generators = first_step, {}
        device = next(self.encoder.parameters()).device
        neighbours = bool(self.settings.log_ratio_weight or self.settings.kd_weight)
        return sphere_batches(self.config, self.source, first_step, workers, device, neighbours=neighbours)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the weighted losses of a batch by name."""
        layout = (batch["profile_m"], batch["camera_height_m"], batch["ceiling_height_m"])
        settings, terms = self.settings, {}
        # Renderings have walls as a fourth channel.
        walls = batch["image"][..., 3] if batch["image"].shape[3] == 4 else None
        batch = batch | {"image": batch["image"][..., :3]}
        if isinstance(self.teacher, RingLayoutEncoder):
            with torch.no_grad():
                ring = self.teacher.ring(*layout)
                target = self.teacher.head(ring)
            features, photograph_terms = self._encode(batch)
            latent = self.teacher.head(features.ring)
            known = torch.ones_like(batch["profile_m"], dtype=torch.bool)
            if features.structure is not None:
                assert isinstance(self.encoder, TrunkImageEncoder)
                terms |= structure_losses(settings, self.encoder, features.structure, batch["opening_kind"], batch)
                if settings.edges_weight:
                    terms["edges"] = edges_loss(settings, features.structure, batch["edges"], walls, known)
            terms |= photograph_terms
            if settings.ring_weight:
                terms["ring"] = settings.ring_weight * losses.ring_distillation(features.ring, ring)
            if settings.profile_weight:
                likelihood = losses.laplace_mixture(features.walls, batch["profile_m"].log(), known)
                terms["profile"] = settings.profile_weight * likelihood
        else:
            with torch.no_grad():
                target = self.teacher(*layout)
            latent = self.encoder(self._augment(batch["image"]))
        if settings.l2_weight:
            terms["l2"] = settings.l2_weight * losses.l2(latent, target)
        if settings.log_ratio_weight or settings.kd_weight:
            terms |= self._distance_losses(latent.float(), target.float(), batch)
        return terms

    def _encode(self, batch: Batch) -> tuple[ImageFeatures, dict[str, Tensor]]:
        """Return the features of a batch's spheres, and the loss of the photographs encoded with them."""
        settings, image, height = self.settings, batch["image"], batch["camera_height_m"]
        if self.photographs is None or not (settings.photograph_weight or settings.photograph_profile_weight):
            return self.encoder(self._augment(image), height), {}
        count, columns = settings.photographs_per_batch, self.config.profile_columns
        photographs = self.photographs.draw(count, columns, self._generator(torch.device("cpu")))
        images = self._augment(torch.cat([image, photographs.images.to(image.device)]))
        # The camera height of photographs is unknown, so their unit of length is the camera height.
        heights = torch.cat([height, height.new_ones(count)])
        styles = sample_styles(
            settings.style_mixing, len(image), count, self._generator(torch.device("cpu")), image.device
        )
        features = self.encoder(images, heights, styles)
        assert features.structure is not None
        assert isinstance(self.encoder, TrunkImageEncoder)
        rows = slice(len(image), None)
        logits = features.structure.opening_logits[rows]
        known = torch.ones(logits.shape[:2], dtype=torch.bool, device=logits.device)
        weight = opening_weight(settings, self.encoder, self.photographs)
        loss = photograph_loss(settings, features.walls.rows(rows), logits, known, photographs, weight)
        return first_rows(features, len(image)), {"photographs": loss}

    def _augment(self, image: Tensor) -> Tensor:
        """Apply the configured photometric augmentation; its random numbers depend on the seed and the first step."""
        # Single precision, because bfloat16 cannot represent 256 grey levels.
        with torch.autocast(image.device.type, enabled=False):
            if self.settings.photometric:
                image = jittered(image, self.settings.photometric, self._generator(image.device))
            if self.settings.optics:
                image = optics(image.float(), self.settings.optics, self._generator(image.device))
        return image

    def _generator(self, device: torch.device) -> torch.Generator:
        if device not in self._generators:
            seed = int(np.random.default_rng([9, self.config.seed, self._first_step]).integers(1 << 62))
            self._generators[device] = torch.Generator(device).manual_seed(seed)
        return self._generators[device]

    def _distance_losses(self, latent: Tensor, target: Tensor, batch: Batch) -> dict[str, Tensor]:
        """Return the losses on the latent distances between a sphere and its neighbours' layouts."""
        settings, layout = self.settings, self.config.layout
        groups = anchors_with_neighbours(batch)
        with torch.no_grad():
            neighbours = embed(self.teacher, {key: value[:, 1:] for key, value in groups.items()})
            teacher_distance = torch.linalg.vector_norm(neighbours - target[:, None], dim=2)
        distance = torch.linalg.vector_norm(neighbours - latent[:, None], dim=2)
        positives, all_pairs, terms = layout.triplets.positives, layout.all_pairs, {}
        if settings.log_ratio_weight:
            chamfer = chamfer_to_anchors(groups, layout)
            ratio = losses.log_ratio(distance, chamfer, positives, all_pairs=all_pairs)
            terms["log_ratio"] = settings.log_ratio_weight * ratio
        if settings.kd_weight:
            terms["kd"] = settings.kd_weight * losses.log_ratio(
                distance, teacher_distance, positives, all_pairs=all_pairs
            )
        return terms
