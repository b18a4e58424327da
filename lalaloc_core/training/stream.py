"""Endless streams of training batches, made in worker processes while the network trains; here: layouts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.sampling import sample_triplets
from lalaloc_core.synth.splits import TRAIN, home_of
from lalaloc_core.training.config import TrainConfig

Batch = dict[str, torch.Tensor]


@dataclass
class LayoutBatches(IterableDataset[Batch]):
    """Stage 1: triplets of layouts.

    Each batch holds `profile_m` (anchors, 1 + neighbours, columns) with the anchor first, `camera_height_m` and
    `ceiling_height_m` of the same leading shape.
    """

    config: TrainConfig
    first: int = 0

    def __iter__(self) -> Iterator[Batch]:
        stage = self.config.layout
        worker, workers = worker_share()
        index = self.first + worker
        while True:
            groups: list[dict[str, np.ndarray]] = []
            while len(groups) < stage.homes_per_step:
                home, rng = home_of(TRAIN, self.config.seed, index)
                index += workers
                group = self._triplets(home.plan, rng)
                if group is not None:
                    groups.append(group)
            yield {key: torch.from_numpy(np.concatenate([group[key] for group in groups])) for key in groups[0]}

    def _triplets(self, plan: FloorPlan, rng: np.random.Generator) -> dict[str, np.ndarray] | None:
        stage = self.config.layout
        drawn = sample_triplets(plan, stage.anchors_per_home, stage.triplets, rng)
        if drawn is None:
            return None
        poses, rows = drawn
        anchors, size = rows.shape
        # A random heading per anchor turns the whole plan; some negatives keep the place and change the heading.
        heading = np.repeat(rng.uniform(0.0, TWO_PI, (anchors, 1)), size, axis=1)
        turned = int(stage.turned_share * stage.triplets.negatives)
        if turned:
            last = size - turned
            rows[:, last:] = rows[:, rng.integers(0, 1 + stage.triplets.positives, turned)]
            heading[:, last:] = rng.uniform(0.0, TWO_PI, (anchors, turned))
        chosen = rows.reshape(-1)
        room = poses.room_index[chosen]
        profile = wall_profile(
            poses.position_m[chosen].astype(np.float32),
            heading.reshape(-1).astype(np.float32),
            plan.walls_m[room].astype(np.float32),
            self.config.profile_columns,
        )
        ceiling = plan.ceiling_heights_m[room].reshape(anchors, size)
        camera = rng.uniform(1.0, np.minimum(1.9, ceiling.min(axis=1, keepdims=True) - 0.3))
        return {
            "profile_m": profile.reshape(anchors, size, -1),
            "camera_height_m": np.broadcast_to(camera, (anchors, size)).astype(np.float32),
            "ceiling_height_m": ceiling.astype(np.float32),
        }


def loader(dataset: IterableDataset[Batch], workers: int) -> DataLoader[Batch]:
    """Batches from `workers` processes with one thread each; 0 makes them in this process."""
    options: dict[str, Any] = {}
    if workers:
        options = {"multiprocessing_context": "spawn", "worker_init_fn": _single_thread, "prefetch_factor": 6}
    return DataLoader(dataset, batch_size=None, num_workers=workers, **options)


def _single_thread(_: int) -> None:
    torch.set_num_threads(1)


def worker_share() -> tuple[int, int]:
    """(number, count) of the worker process this runs in."""
    info = get_worker_info()
    return (0, 1) if info is None else (info.id, info.num_workers)
