"""Unlabelled real photographs with the predictions of a segmenter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lalaloc_core.errors import DatasetError, InvalidPhotographError
from lalaloc_core.learn.synth.augmentation.stretching import stretched
from lalaloc_core.learn.training.segmenter import PANORAMA_ROWS, load_segmenter, read_walls_and_openings
from lalaloc_core.photograph.spheres import read_sphere

# Rooms are stretched along two axes by log-uniform factors between these limits, because half of the available
# unlabelled photographs show halls.
_MIN_STRETCH, _MAX_STRETCH = 0.5, 1.6


@dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs with a segmenter's predictions.

    `openings` are probabilities of door and window by column. `log_distance` is that of the walls in camera heights;
    NaN where they are not visible.
    """

    images: UInt8[Tensor, "n h w 3"]
    openings: Float[Tensor, "n c 2"]
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


def load_photographs(folder: Path, segmenter: Path, height: int, width: int) -> Photographs:
    """Read the panoramas (`*.jpg`, `*.jpeg`, `*.png`) of a folder and segment each with a TensorFlow Lite file.

    Raises:
        ConfigError: the segmenter cannot be run.
        DatasetError: the folder has no panorama, or one that cannot be read.
    """
    paths = sorted(path for pattern in ("*.jpg", "*.jpeg", "*.png") for path in folder.glob(pattern))
    if not paths:
        raise DatasetError("no photographs (*.jpg, *.jpeg, *.png)", path=folder)
    segment = load_segmenter(segmenter)
    images, readings = [], []
    for path in paths:
        try:
            content = path.read_bytes()
            large = read_sphere(content, height=PANORAMA_ROWS, width=2 * PANORAMA_ROWS)
            images.append(read_sphere(content, height=height, width=width))
        except (OSError, InvalidPhotographError) as error:
            raise DatasetError(f"cannot be read: {error}", path=path) from error
        readings.append(read_walls_and_openings(large, segment, width))
    openings, log_distance = (
        np.stack([getattr(reading, name) for reading in readings]) for name in ("openings", "log_distance")
    )
    return Photographs(torch.from_numpy(np.stack(images)), torch.from_numpy(openings), torch.from_numpy(log_distance))
