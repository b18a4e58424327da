"""Replay buffer of panoramas, because rendering one costs as much as a training step on it."""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")


class ReplayBuffer(Generic[T]):
    """Buffer that returns every item `uses` times in total, with repeats far apart.

    New items are used immediately. Repeats start when the buffer is filled; from then on every new item comes with
    `uses - 1` random repeats, and the buffer holds about `limit` items, never more. With `uses` 1 it stores nothing.
    """

    def __init__(self, uses: int, limit: int) -> None:
        self._uses = uses
        self._limit = max(limit, 1)
        # Items used once, twice and so on become equally frequent, with `uses / 2` uses left on average instead of the
        # initial `uses - 1`. Starting the repeats below the limit makes the number of items settle at the limit.
        self._enough = max(int(self._limit * uses / (2 * (uses - 1))), 1) if uses > 1 else 0
        self._begun = False
        self._waiting: list[tuple[T, int]] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def add_and_sample(self, new: T, rng: np.random.Generator) -> list[T]:
        """Return the items to use now: `new` and its repeats."""
        if self._uses == 1:
            return [new]
        self._begun |= len(self._waiting) >= self._enough
        repeated = [self._draw(rng) for _ in range(self._uses - 1)] if self._begun and self._waiting else []
        while len(self._waiting) >= self._limit:
            repeated.append(self._draw(rng))
        self._waiting.append((new, self._uses - 1))
        return [new, *repeated]

    def _draw(self, rng: np.random.Generator) -> T:
        index = int(rng.integers(len(self._waiting)))
        value, left = self._waiting[index]
        if left > 1:
            self._waiting[index] = (value, left - 1)
        else:
            self._waiting[index] = self._waiting[-1]
            self._waiting.pop()
        return value
