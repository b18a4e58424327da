"""Calls that several threads want at once, made by one of them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class SingleFlight(Generic[K, V]):
    """Makes one call per key at a time; threads that ask for the same key meanwhile wait for its result."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._begun: dict[K, Future[V]] = {}

    def run(self, key: K, make: Callable[[], V]) -> V:
        """Return what `make` returns, or the result of the call with this key that another thread makes already.

        Raises:
            Exception: what the call raises, in all threads that wait for it.
        """
        with self._lock:
            begun = self._begun.get(key)
            mine = Future[V]()
            if begun is None:
                self._begun[key] = mine
        if begun is not None:
            return begun.result()
        try:
            made = make()
        except BaseException as error:
            mine.set_exception(error)
            raise
        else:
            mine.set_result(made)
            return made
        finally:
            with self._lock:
                del self._begun[key]
