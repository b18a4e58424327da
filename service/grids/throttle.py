"""How work in the background makes way for queries."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

# While queries keep coming, the background has a fifth of its thread's time; then it goes on, however slowly.
_PAUSE_PER_WORK = 4.0
_MAX_PAUSE_S = 1.0


class BackgroundThrottle:
    """Counts the queries that compute at this moment; those that wait for something are not in the way."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._count = 0
        self._none = threading.Event()
        self._none.set()

    @contextmanager
    def query(self) -> Iterator[None]:
        """A query computes inside the block."""
        with self._lock:
            self._count += 1
            self._none.clear()
        try:
            yield
        finally:
            with self._lock:
                self._count -= 1
                if self._count == 0:
                    self._none.set()

    def pause(self, worked_s: float) -> None:
        """Pause until no query computes, but no longer than a few times what was last worked.

        Between two chunks of a grid, so that a query finds at most one chunk in its way, and a grid gets done also
        when there is always a query.
        """
        self._none.wait(min(worked_s * _PAUSE_PER_WORK, _MAX_PAUSE_S))
