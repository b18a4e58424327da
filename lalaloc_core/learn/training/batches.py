"""Loading of batches in worker processes, and reporting of files that could not be used."""

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
    """Yield the results of `draw` for this worker's share of the visits from number `first` on, without None.

    Raises:
        DatasetError: `patience` visits in a row returned None.
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
            raise DatasetError(f"{empty} scenes in a row have no training sample: all are unusable or too small")


def stack_rows(rows: list[dict[str, np.ndarray]]) -> Batch:
    """Stack rows to a batch of tensors with a leading dimension."""
    return {key: torch.from_numpy(np.stack([row[key] for row in rows])) for key in rows[0]}


def load_batches(stream: Stream, workers: int) -> Iterator[Any]:
    """Yield batches from `workers` processes with one thread each; 0 makes them in this process.

    Each file that cannot be used is logged once, with a running number.
    """
    options: dict[str, Any] = {}
    if workers:
        options = {"multiprocessing_context": "spawn", "worker_init_fn": _single_thread, "prefetch_factor": 6}
    yield from _without_failures(DataLoader(stream, batch_size=None, num_workers=workers, **options))


def _without_failures(items: Iterable[Any]) -> Iterator[Any]:
    skipped: set[str] = set()
    for item in items:
        if not isinstance(item, LoadFailure):
            yield item
        elif item.fatal:
            raise item.error
        elif str(item.error) not in skipped:
            skipped.add(str(item.error))
            _LOG.warning("skipped, number %d: %s", len(skipped), item.error)


def _single_thread(_: int) -> None:
    torch.set_num_threads(1)
