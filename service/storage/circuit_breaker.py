"""What keeps calls that can do without the database from waiting for it, one after the other, while it is away."""

from __future__ import annotations

import time
from collections.abc import Callable

# After a failure the database is left alone for so long.
_OPEN_S = 1.0


class CircuitBreaker:
    """Open for a moment after the database failed; safe to share between threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Args:
        clock: seconds.
        """
        self._clock = clock
        self._open_until_s = -float("inf")

    @property
    def is_open(self) -> bool:
        """Whether the database failed a moment ago."""
        return self._clock() < self._open_until_s

    def trip(self) -> None:
        """Note that the database does not answer."""
        self._open_until_s = self._clock() + _OPEN_S
