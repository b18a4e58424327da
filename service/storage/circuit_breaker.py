"""Circuit breaker, which saves calls that have an alternative from waiting for an unavailable database."""

from __future__ import annotations

import time
from collections.abc import Callable

# Duration (s) without calls after a failure.
_OPEN_S = 1.0


class CircuitBreaker:
    """Switch that is open for a moment after the database failed; safe to share between threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Create a closed circuit breaker with a clock (s)."""
        self._clock = clock
        self._open_until_s = -float("inf")

    @property
    def is_open(self) -> bool:
        """True shortly after a failure of the database."""
        return self._clock() < self._open_until_s

    def trip(self) -> None:
        """Open the circuit breaker, because the database failed."""
        self._open_until_s = self._clock() + _OPEN_S
