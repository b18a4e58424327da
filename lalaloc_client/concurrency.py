"""Queries of several threads wait for their turn."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class ConcurrencyLimit:
    """Lets as many queries be under way as the service takes.

    One alone is sent at once; how many more may be is asked for when there is a second one.
    """

    def __init__(self, max_queries: int | None, ask: Callable[[], int]) -> None:
        """Args:
        max_queries: how many may be under way; None: to be asked for.
        ask: how many the service takes, at least 1.
        """
        self._slots = threading.Semaphore(max_queries or 1)
        self._known = max_queries is not None
        self._ask = ask
        self._asking = threading.Lock()

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Wait until one more query may be under way, and let it be for the block."""
        if not self._slots.acquire(blocking=False):
            self._learn()
            self._slots.acquire()
        try:
            yield
        finally:
            self._slots.release()

    def _learn(self) -> None:
        with self._asking:
            if not self._known:
                for _ in range(self._ask() - 1):
                    self._slots.release()
                self._known = True
