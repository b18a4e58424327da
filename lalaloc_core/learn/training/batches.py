"""Batches: loaded in worker processes, turned, with photographs; files that could not be used are reported."""

from __future__ import annotations

import atexit
import itertools
import logging
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.errors import DatasetError
from lalaloc_core.learn.synth.augmentation import stretched
from lalaloc_core.learn.training.config import Turns

_LOG = logging.getLogger(__name__)
_Drawn = TypeVar("_Drawn")

Batch = dict[str, torch.Tensor]


@dataclass(frozen=True)
class LoadFailure:
    """A file that could not be used; `fatal` if training cannot continue without it."""

    error: DatasetError
    fatal: bool


# Yields batches, with or without pixels, and load failures.
Stream = IterableDataset[Any]


def worker_share() -> tuple[int, int]:
    """Return (number, count) of the worker process that calls this."""
    info = get_worker_info()
    return (0, 1) if info is None else (info.id, info.num_workers)


def draw_visits(draw: Callable[[int], _Drawn | None], first: int, patience: int) -> Iterator[_Drawn]:
    """Yield the results of `draw` for this worker's share of the visits from number `first` on, without None."""
    worker, workers = worker_share()
    empty = 0
    for visit in itertools.count(first + worker, workers):
        drawn = draw(visit)
        if drawn is not None:
            empty = 0
            yield drawn
            continue
        empty += 1
        if empty >= patience:
            raise DatasetError(f"{empty} scenes in a row have no training sample: all are unusable or too small")


def stack_rows(rows: list[dict[str, np.ndarray]]) -> Batch:
    """Stack rows to a batch of tensors with a leading dimension."""
    return {key: torch.from_numpy(np.stack([row[key] for row in rows])) for key in rows[0]}


def load_batches(stream: Stream, workers: int) -> Iterator[Any]:
    """Yield batches from `workers` processes, 0 for this one; each file that cannot be used is logged once."""
    options: dict[str, Any] = {}
    if workers:
        options = {"multiprocessing_context": "spawn", "worker_init_fn": _single_thread, "prefetch_factor": 6}
    skipped: set[str] = set()
    for item in DataLoader(stream, batch_size=None, num_workers=workers, **options):
        if not isinstance(item, LoadFailure):
            yield item
        elif item.fatal:
            raise item.error
        elif str(item.error) not in skipped:
            skipped.add(str(item.error))
            _LOG.warning("skipped, number %d: %s", len(skipped), item.error)


def _single_thread(_: int) -> None:
    torch.set_num_threads(1)
    # Threads of libraries that are destroyed at the end of a process can abort it.
    atexit.register(os._exit, 0)


_QUARTER = TWO_PI / 4.0


@dataclass(frozen=True, kw_only=True)
class Rotation:
    """Rotation and mirroring of a sphere: columns moved to the right, and the heading after that (radians)."""

    shift: int
    heading: float
    mirrored: bool

    def picture(self, image: Shaped[np.ndarray, "h w c"]) -> Shaped[np.ndarray, "h w c"]:
        """Rotate and mirror a sphere."""
        turned = np.roll(image, self.shift, axis=1)
        return turned[:, ::-1] if self.mirrored else turned

    def profile(self, profile_m: Shaped[np.ndarray, "*n columns"]) -> Shaped[np.ndarray, "*n columns"]:
        """Mirror wall profiles, or other values by azimuth column, that were cast at `heading`."""
        return profile_m[..., ::-1] if self.mirrored else profile_m


def sample_rotation(turns: Turns, heading: float, width: int, rng: np.random.Generator) -> Rotation:
    """Draw the rotation of a sphere of `width` columns whose centre column looks along `heading` (radians)."""
    pixel = TWO_PI / width
    shift = int(rng.integers(width)) if turns == "any" else round((heading - _target(turns, rng)) / pixel)
    mirrored = turns != "none" and bool(rng.random() < 0.5)
    return Rotation(shift=shift, heading=float(wrap_angle(heading - shift * pixel)), mirrored=mirrored)


def sample_heading(turns: Turns, rng: np.random.Generator) -> float:
    """Draw the heading (radians) of a layout."""
    return float(rng.uniform(0.0, TWO_PI)) if turns == "any" else _target(turns, rng)


def _target(turns: Turns, rng: np.random.Generator) -> float:
    return 0.0 if turns == "none" else float(rng.integers(4)) * _QUARTER


# Rooms are stretched along two axes by log-uniform factors between these limits, because half of the available
# unlabelled photographs show halls.
_MIN_STRETCH, _MAX_STRETCH = 0.5, 1.6


@dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs with targets by column.

    `openings` are probabilities of door, window and passage; passages are NaN where the teacher cannot tell them from
    walls. `log_distance` is that of the walls in camera heights; NaN where they are not visible. `room_type` has codes
    of `conventions.ROOM_TYPES`, -1 where unknown, and `weight` shares in which photographs are drawn.
    """

    images: UInt8[Tensor, "n h w 3"]
    openings: Float[Tensor, "n c 3"]
    log_distance: Float[Tensor, "n c"]
    room_type: Int[Tensor, "n"]
    weight: Float[Tensor, "n"]

    @cached_property
    def opening_share(self) -> Float[Tensor, "4"]:
        """Mean share of each opening class in what is drawn, at least 0.001; unknown passages count as walls."""
        openings = self.weight @ self.openings.nan_to_num().mean(dim=1) / self.weight.sum()
        return torch.cat([1.0 - openings.sum(dim=0, keepdim=True), openings]).clamp_min(1e-3)

    def draw(self, count: int, columns: int, generator: torch.Generator) -> Photographs:
        """Draw photographs, each randomly rotated, stretched and mirrored, with targets of `columns` columns."""
        width = self.images.shape[2]
        chosen = torch.multinomial(self.weight, count, replacement=True, generator=generator)
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
            self.room_type[chosen],
            self.weight[chosen],
        )
