"""Photographs of real rooms that are trained on beside renderings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lalaloc_core.learn.synth.augmentation.stretching import stretched

# Rooms are stretched along two axes by log-uniform factors between these limits, because half of the available
# unlabelled photographs show halls.
_MIN_STRETCH, _MAX_STRETCH = 0.5, 1.6


@dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs with targets by column.

    `openings` are probabilities of door, window and passage; passages are NaN where the teacher cannot tell them from
    walls. `log_distance` is that of the walls in camera heights; NaN where they are not visible.
    """

    images: UInt8[Tensor, "n h w 3"]
    openings: Float[Tensor, "n c 3"]
    log_distance: Float[Tensor, "n c"]

    def draw(self, count: int, columns: int, generator: torch.Generator) -> Photographs:
        """Draw photographs, each randomly rotated, stretched and mirrored, with targets of `columns` columns."""
        width = self.images.shape[2]
        chosen = torch.randint(len(self.images), (count,), generator=generator)
        shifts = torch.randint(width, (count,), generator=generator)
        mirrored = torch.randint(2, (count,), generator=generator).bool()
        low, high = np.log(_MIN_STRETCH), np.log(_MAX_STRETCH)
        factors = torch.exp(low + (high - low) * torch.rand(count, 2, generator=generator))
        turns = list(zip(chosen.tolist(), shifts.tolist(), strict=True))
        images, openings, log_distance = (
            torch.stack([part[index].roll(shift, axis) for index, shift in turns])
            for part, axis in ((self.images, 1), (self.openings, 0), (self.log_distance, 0))
        )
        images, openings, log_distance = stretched(images, openings, log_distance, factors)
        images[mirrored] = images[mirrored].flip(2)
        openings[mirrored] = openings[mirrored].flip(1)
        log_distance[mirrored] = log_distance[mirrored].flip(1)
        return Photographs(
            images,
            openings.unflatten(1, (columns, -1)).mean(dim=2),
            log_distance.unflatten(1, (columns, -1)).nanmean(dim=2),
        )
