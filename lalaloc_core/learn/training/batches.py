"""Batches on their way from worker processes to the training loop, and what was left out on the way."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from lalaloc_core.errors import DatasetError

_LOG = logging.getLogger(__name__)
_Drawn = TypeVar("_Drawn")

Batch = dict[str, torch.Tensor]


@dataclass(frozen=True)
class LoadFailure:
    """A file that could not be used; `fatal` when training cannot go on without it."""

    error: DatasetError
    fatal: bool


# Of batches, with pixels or without, and of trouble.
Stream = IterableDataset[Any]


def worker_share() -> tuple[int, int]:
    """(number, count) of the worker process this runs in."""
    info = get_worker_info()
    return (0, 1) if info is None else (info.id, info.num_workers)


def non_empty(draw: Callable[[int], _Drawn | None], first: int, patience: int) -> Iterator[_Drawn]:
    """What `draw` makes of this worker's share of the visits from number `first` on, without those that give nothing.

    Raises:
        DatasetError: `patience` visits in a row gave nothing.
    """
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
            raise DatasetError(f"{empty} scenes in a row gave nothing to train on: none is usable and large enough")


def stacked(rows: list[dict[str, np.ndarray]]) -> Batch:
    """Rows of a batch as tensors with a leading dimension."""
    return {key: torch.from_numpy(np.stack([row[key] for row in rows])) for key in rows[0]}


def load_batches(stream: Stream, workers: int) -> Iterator[Any]:
    """Batches from `workers` processes with one thread each; 0 makes them in this process.

    What could not be used is logged with its number, once.

    Raises:
        DatasetError: the data set has a fault that training may not pass over.
    """
    options: dict[str, Any] = {}
    if workers:
        options = {"multiprocessing_context": "spawn", "worker_init_fn": _single_thread, "prefetch_factor": 6}
    yield from _loaded(DataLoader(stream, batch_size=None, num_workers=workers, **options))


def _loaded(items: Iterable[Any]) -> Iterator[Any]:
    left_out: set[str] = set()
    for item in items:
        if not isinstance(item, LoadFailure):
            yield item
        elif item.fatal:
            raise item.error
        elif str(item.error) not in left_out:
            left_out.add(str(item.error))
            _LOG.warning("left out, number %d: %s", len(left_out), item.error)


def _single_thread(_: int) -> None:
    torch.set_num_threads(1)
