"""View through windows: sky above an outline of trees or houses."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.learn.synth.scene.patterns import smooth_noise
from lalaloc_core.learn.synth.scene.render_scene import Backdrop

_SIZE = 256


class Outdoors:
    """A mottled pattern shared by all backdrops; each scene colours it."""

    def __init__(self, device: torch.device) -> None:
        rng = np.random.default_rng(0)
        mottle = sum(
            weight * smooth_noise(_SIZE, rng, scale) for scale, weight in ((0.8, 0.5), (3.0, 0.6), (12.0, 0.7))
        )
        outline = sum(weight * smooth_noise(_SIZE, rng, scale)[0] for scale, weight in ((2.0, 0.3), (8.0, 0.8)))
        self._mottle = torch.tensor(mottle, dtype=torch.float32, device=device)
        self._outline = torch.tensor(outline, dtype=torch.float32, device=device)

    def colour(
        self, backdrop: Backdrop, direction: Float[Tensor, "n 2"], slope: Float[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """Return the colour along rays; `backdrop` has one row per ray."""
        azimuth = torch.atan2(direction[:, 0], direction[:, 1]) / TWO_PI
        turn = azimuth + backdrop.turn
        column = (turn.remainder(1.0) * _SIZE).long().clamp(max=_SIZE - 1)
        fine_column = ((4.0 * turn).remainder(1.0) * _SIZE).long().clamp(max=_SIZE - 1)
        row = ((slope.atan() * (4.0 / math.pi) + backdrop.lift).remainder(1.0) * _SIZE).long()
        mottle = self._mottle[row.clamp(max=_SIZE - 1), fine_column]
        horizon = backdrop.horizon + backdrop.ruggedness * self._outline[column]
        sky = ((slope - horizon) / 0.06).clamp(0.0, 1.0)[:, None]
        ground = backdrop.ground * torch.exp(0.5 * mottle)[:, None]
        return sky * backdrop.sky + (1.0 - sky) * ground.clamp(max=1.0)
