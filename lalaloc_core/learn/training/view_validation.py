"""Validation of the encoder of views on generated homes that are not trained on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import nn

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.learn.data.synthetic.generated import SPLIT_NUMBERS, split_renderer_cache
from lalaloc_core.learn.metrics import count_classes, score_classes
from lalaloc_core.learn.synth.augmentation.framing import seen_by
from lalaloc_core.learn.synth.homes.plans import home_of
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.batch_streams import UNKNOWN, opening_kinds
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.view_stage import middle, view_window
from lalaloc_core.localise.encode.view_encoder import MIN_SEEN
from lalaloc_core.nets.view_network import ViewNetwork
from lalaloc_core.render.sweep import profiles_at

_FIELDS_DEG = (80.0, 106.0)
_ASPECT = 4.0 / 3.0
_SHOTS_PER_HOME = 4
_BATCH = 16


class ViewValidation:
    """Errors of walls and openings in level views of several fields of view.

    Args:
        config: of the run.
        homes: number of validation homes, with four views each.
        textures: folder of material pictures; None makes all materials procedural.
        device: to run on.
    """

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
                kinds.append(
                    opening_kinds(
                        home.plan,
                        shot.position_m,
                        shot.room_index,
                        shot.heading,
                        shot.camera_height_m,
                        config.profile_columns,
                    )
                )
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
        azimuths, elevations = (
            torch.from_numpy(angles).float()
            for angles in (config.view.column_azimuths(config.ring), config.view.row_elevations(config.ring))
        )
        seen = seen_by(azimuths, elevations, field_deg, field_deg / _ASPECT)
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
