"""Training and validation of the encoder of views: photographs that show a part of the horizon."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, split_renderer_cache
from lalaloc_core.learn.metrics import count_classes, score_classes
from lalaloc_core.learn.synth.augmentation import framed, jittered, optics, seen_by
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.rendering.sphere_renderer import Window
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batch_streams import UNKNOWN, seen_openings
from lalaloc_core.learn.training.batches import Batch, Photographs
from lalaloc_core.learn.training.config import ImageStageConfig, TrainConfig
from lalaloc_core.learn.training.sources import Source
from lalaloc_core.learn.training.stages import (
    TrainingStage,
    edges_loss,
    opening_weight,
    photograph_loss,
    sample_styles,
    sphere_batches,
    structure_losses,
)
from lalaloc_core.localise.encode.view_encoder import MIN_SEEN
from lalaloc_core.nets.object_network import ObjectNetwork
from lalaloc_core.nets.view_network import ViewFeatures, ViewNetwork
from lalaloc_core.render.sweep import profiles_at

# Size of the spheres from which views of photographs are cut, about as fine as the views.
PHOTOGRAPH_SIZE = (384, 768)


def view_window(config: TrainConfig) -> Window:
    """Return the part of the sphere that views show."""
    return Window(config.view.width_rad(config.ring), float(np.radians(config.view.top_deg)))


class ViewStage(TrainingStage[ImageStageConfig]):
    """Train the encoder of views on renderings and on parts of photographs, each seen through a random camera."""

    name = "view"

    def __init__(self, config: TrainConfig, source: Source, photographs: Photographs | None = None) -> None:
        self.config, self.settings, self.source, self.photographs = config, config.image, source, photographs
        self.encoder = ViewNetwork(config.view, config.ring)
        self.modules: dict[str, nn.Module] = {"view_encoder": self.encoder}
        self._azimuths, self._elevations = config.view.directions(config.ring)
        self._generator = torch.Generator()
        # Teacher of household objects in photographs.
        self._objects = None
        if photographs is not None and config.view.objects:
            self._objects = ObjectNetwork().eval().requires_grad_(False)

    def batches(self, first_step: int, workers: int) -> Iterator[Batch]:
        """Yield batches of level pictures of the patch's size."""
        device = next(self.encoder.parameters()).device
        seed = int(np.random.default_rng([10, self.config.seed, first_step]).integers(1 << 62))
        self._generator = torch.Generator(device).manual_seed(seed)
        return sphere_batches(self.config, self.source, first_step, workers, device, views=True)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the weighted losses of a batch by name; azimuths that are not seen do not count."""
        settings, height = self.settings, batch["camera_height_m"]
        image, walls = batch["image"][..., :3], batch["image"][..., 3]
        count = settings.photographs_per_batch if self.photographs is not None else 0
        photographs, styles = None, None
        if self.photographs is not None:
            photographs = self.photographs.draw(count, self.config.profile_columns, torch.default_generator)
            styles = sample_styles(settings.style_mixing, len(image), count, torch.default_generator, image.device)
            cut = self._cut(photographs.images).to(image.device)
            image, height = torch.cat([image, cut]), torch.cat([height, height.new_ones(count)])
        shown = self._shown(image)
        features = self.encoder(shown, height, styles)
        seen = features.seen >= MIN_SEEN
        rendered = slice(0, len(image) - count)
        terms = self._rendered_losses(features, seen, rendered, batch)
        if settings.edges_weight:
            edges, visible = batch["edges"][:, middle(self.config)], walls * (shown[rendered, ..., 3] > 0.0)
            terms["edges"] = edges_loss(settings, features.structure.rows(rendered), edges, visible, seen[rendered])
        if self.photographs is not None and photographs is not None:
            rows = slice(len(image) - count, None)
            modes, logits = features.walls.rows(rows), features.structure.opening_logits[rows]
            weight, columns = opening_weight(settings, self.encoder, self.photographs), middle(self.config)
            terms["photographs"] = photograph_loss(settings, modes, logits, seen[rows], photographs, weight, columns)
            if self._objects is not None and features.objects is not None:
                taught, _ = self._objects.to(shown.device)(shown[rows, ..., :3])
                codes = photographs.room_type.to(taught.device)
                terms["objects"] = settings.room_type_weight * losses.objects(features.objects[rows], taught, codes)
        return terms

    def _rendered_losses(
        self, features: ViewFeatures, seen: Bool[Tensor, "b w"], rows: slice, batch: Batch
    ) -> dict[str, Tensor]:
        settings, part = self.settings, middle(self.config)
        log_profile = batch["profile_m"][:, part].log()
        walls = losses.laplace_mixture(features.walls.rows(rows), log_profile, seen[rows])
        shape = losses.wall_shape(features.walls.rows(rows), log_profile, seen[rows])
        kind = torch.where(seen[rows], batch["opening_kind"][:, part], UNKNOWN)
        structure = structure_losses(settings, self.encoder, features.structure.rows(rows), kind, batch)
        return {"profile": settings.profile_weight * walls, "shape": settings.shape_weight * shape} | structure

    def _cut(self, images: UInt8[Tensor, "n h w 3"]) -> UInt8[Tensor, "n h2 w2 3"]:
        rows, columns = images.shape[1:3]
        pixel = np.pi / rows
        top = round((np.pi / 2.0 - np.radians(self.config.view.top_deg)) / pixel)
        width = round(self.config.view.width_rad(self.config.ring) / pixel)
        height = round(width * self.config.view.image_height / self.config.view.image_width)
        left = (columns - width) // 2
        patch = images[:, top : top + height, left : left + width].permute(0, 3, 1, 2).float()
        size = (self.config.view.image_height, self.config.view.image_width)
        return functional.interpolate(patch, size, mode="bilinear").permute(0, 2, 3, 1).round().to(torch.uint8)

    def _shown(self, image: UInt8[Tensor, "b h w 3"]) -> Float[Tensor, "b h w 4"]:
        """Apply photometric augmentation, and show the pictures through random cameras."""
        settings, generator = self.settings, self._generator
        # Single precision, because bfloat16 cannot represent 256 grey levels.
        with torch.autocast(image.device.type, enabled=False):
            pixels = jittered(image, settings.photometric, generator)
            if settings.optics:
                pixels = optics(pixels, settings.optics, generator)
            azimuths, elevations = (angles.to(image.device) for angles in (self._azimuths, self._elevations))
            return framed(pixels, azimuths, elevations, generator)


def middle(config: TrainConfig) -> slice:
    """Return the azimuth columns of a view among those of the full circle."""
    columns = config.view.sectors * config.profile_columns // config.ring.sectors
    first = (config.profile_columns - columns) // 2
    return slice(first, first + columns)


_FIELDS_DEG = (80.0, 106.0)
_ASPECT = 4.0 / 3.0
_SHOTS_PER_HOME = 4
_BATCH = 16


class ViewValidation:
    """Errors of walls and openings in level views of several fields of view."""

    def __init__(self, config: TrainConfig, homes: int, textures: Path | None, device: torch.device) -> None:
        self._config, self._device = config, device
        number = SPLIT_NUMBERS["validation"]
        renderers = split_renderer_cache(number, config.seed, textures)
        renderer = renderers.renderer(config.view.image_height, config.view.image_width, (2, 2), view_window(config))
        images, profiles, kinds, heights = [], [], [], []
        for index in range(homes):
            home, rng = home_of(number, config.seed, index)
            shots = sample_shots(home, _SHOTS_PER_HOME, rng)
            images.append(renderer.render(shots))
            for shot in shots:
                pose = shot.position_m[None], np.array([shot.room_index]), np.array([shot.heading])
                profiles.append(profiles_at(home.plan, *pose, config.profile_columns, np.float32)[0])
                kinds.append(seen_openings(home.plan, shot, shot.heading, config.profile_columns)[0])
                heights.append(shot.camera_height_m)
        part = middle(config)
        self._images = torch.cat(images)
        self._log_profile = torch.from_numpy(np.stack(profiles)[:, part]).log()
        self._kinds = np.stack(kinds)[:, part]
        self._heights = torch.tensor(heights, dtype=torch.float32)

    @torch.no_grad()
    def __call__(self, modules: dict[str, nn.Module]) -> dict[str, float]:
        """Return the metrics of the module `view_encoder` by name."""
        encoder = modules["view_encoder"]
        assert isinstance(encoder, ViewNetwork)
        was_training = encoder.training
        encoder.eval()
        metrics = {}
        for field_deg in _FIELDS_DEG:
            measured = self._measure(encoder, field_deg)
            metrics |= {f"val_{name}_{field_deg:g}": value for name, value in measured.items()}
        metrics["val_nll"] = float(np.mean([metrics[f"val_nll_{field_deg:g}"] for field_deg in _FIELDS_DEG]))
        encoder.train(was_training)
        return metrics

    def _measure(self, encoder: ViewNetwork, field_deg: float) -> dict[str, float]:
        config = self._config
        seen = seen_by(*config.view.directions(config.ring), field_deg, field_deg / _ASPECT)
        opacity = 255 * seen.to(torch.uint8)[None, :, :, None]
        nll, errors, confusion = [], [], np.zeros((len(OPENING_CLASSES),) * 2, dtype=int)
        for first in range(0, len(self._images), _BATCH):
            part = slice(first, first + _BATCH)
            images = self._images[part]
            images = torch.cat([images, opacity.expand(*images.shape[:3], 1)], dim=3)
            features = encoder(images.to(self._device), self._heights[part].to(self._device))
            known = features.seen.cpu() >= MIN_SEEN
            target = self._log_profile[part]
            likelihood = losses.laplace_mixture(features.walls, target.to(self._device), known.to(self._device))
            nll.append(len(images) * float(likelihood))
            error = (features.walls.likeliest.cpu() - target).abs()
            errors += [float(row[shown].median()) for row, shown in zip(error, known, strict=True)]
            prior = losses.opening_prior(encoder.opening_share, config.image.opening_balance)
            logits = torch.log_softmax(features.structure.opening_logits, dim=2) - prior.log()
            true = np.where(known.numpy(), self._kinds[part], UNKNOWN)
            confusion += count_classes(true, logits.argmax(dim=2).cpu().numpy(), len(OPENING_CLASSES))
        return {
            "nll": sum(nll) / len(self._images),
            "log_error": float(np.median(errors)),
            "opening_accuracy": score_classes(confusion, OPENING_CLASSES).balanced_accuracy,
        }
