"""Panoramas that wait for their next use: rendering one costs as much as learning from it."""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")


class ReplayBuffer(Generic[T]):
    """Gives everything it is given back `uses` times in all, with repeats far apart.

    What is new is used at once. Repeats begin when enough has gathered; from then on there are `uses - 1` of them, at
    random, for everything new, and about `limit` things wait, never more.

    Args:
        uses: how often everything is used; 1 keeps nothing.
        limit: how many things may wait.
    """

    def __init__(self, uses: int, limit: int) -> None:
        self._uses = uses
        self._limit = max(limit, 1)
        # Of what waits the shares that were used once, twice and so on become even: then `uses / 2` uses are left on
        # average, where all begin with `uses - 1`. Beginning with fewer things makes their number end at the limit.
        self._enough = max(int(self._limit * uses / (2 * (uses - 1))), 1) if uses > 1 else 0
        self._begun = False
        self._waiting: list[tuple[T, int]] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def add_and_sample(self, new: T, rng: np.random.Generator) -> list[T]:
        """What to use now that `new` has come: it, and what is repeated with it."""
        if self._uses == 1:
            return [new]
        self._begun |= len(self._waiting) >= self._enough
        repeated = [self._drawn(rng) for _ in range(self._uses - 1)] if self._begun and self._waiting else []
        while len(self._waiting) >= self._limit:
            repeated.append(self._drawn(rng))
        self._waiting.append((new, self._uses - 1))
        return [new, *repeated]

    def _drawn(self, rng: np.random.Generator) -> T:
        index = int(rng.integers(len(self._waiting)))
        value, left = self._waiting[index]
        if left > 1:
            self._waiting[index] = (value, left - 1)
        else:
            self._waiting[index] = self._waiting[-1]
            self._waiting.pop()
        return value
