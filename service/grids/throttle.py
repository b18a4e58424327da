"""Priority of queries over background work."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

# Under constant load the background gets a fifth of its thread's time.
_PAUSE_PER_WORK = 4.0
_MAX_PAUSE_S = 1.0


class BackgroundThrottle:
    """Counter of the queries that compute at the moment; waiting queries do not count."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._count = 0
        self._none = threading.Event()
        self._none.set()

    @contextmanager
    def query(self) -> Iterator[None]:
        """Count a query that computes inside the block."""
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
        """Pause until no query computes, at most a few times as long as the last work took (s).

        Called between two chunks of a grid, so that a query waits for at most one chunk, and a grid is finished even
        under constant load.
        """
        self._none.wait(min(worked_s * _PAUSE_PER_WORK, _MAX_PAUSE_S))
