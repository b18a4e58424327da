"""A cache that is bounded in bytes: what was used least recently makes room."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class BoundedCache(Generic[K, V]):
    """Values by key, up to a number of bytes; safe to share between threads.

    Attributes:
        bytes: what the values in it take.
    """

    def __init__(self, limit_bytes: int, size: Callable[[V], int]) -> None:
        self._limit_bytes = limit_bytes
        self._size = size
        self._values: OrderedDict[K, tuple[V, int]] = OrderedDict()
        self._lock = threading.Lock()
        self.bytes = 0

    def get(self, key: K) -> V | None:
        """A value, which now counts as used."""
        with self._lock:
            found = self._values.get(key)
            if found is None:
                return None
            self._values.move_to_end(key)
            return found[0]

    def put(self, key: K, value: V) -> int:
        """Keep a value; one that is larger than the whole cache is not kept, and pushes nothing out.

        Returns:
            how many others had to make room.
        """
        size, evicted = self._size(value), 0
        with self._lock:
            self._remove(key)
            if size > self._limit_bytes:
                return 0
            self._values[key] = (value, size)
            self.bytes += size
            while self.bytes > self._limit_bytes:
                _, (_, dropped) = self._values.popitem(last=False)
                self.bytes -= dropped
                evicted += 1
        return evicted

    def drop(self, unwanted: Callable[[K, V], bool]) -> None:
        """Forget some of the values."""
        with self._lock:
            for key in [key for key, (value, _) in self._values.items() if unwanted(key, value)]:
                self._remove(key)

    def items(self) -> list[tuple[K, V]]:
        """Keys and values as they are now, least recently used first; none of them counts as used by that."""
        with self._lock:
            return [(key, value) for key, (value, _) in self._values.items()]

    def _remove(self, key: K) -> None:
        _, size = self._values.pop(key, (None, 0))
        self.bytes -= size
