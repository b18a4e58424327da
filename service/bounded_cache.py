"""A cache that is bounded in bytes: what was used least recently makes room."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from cachetools import Cache, LRUCache

K = TypeVar("K")
V = TypeVar("V")


class _CountingLruCache(LRUCache[K, V]):
    """Counts what it drops to make room."""

    evictions = 0

    def popitem(self) -> tuple[K, V]:
        self.evictions += 1
        return super().popitem()


class BoundedCache(Generic[K, V]):
    """`cachetools.LRUCache` with what it leaves to its user: a lock, and values that are larger than all of it."""

    def __init__(self, limit_bytes: int, size: Callable[[V], int]) -> None:
        self._values: _CountingLruCache[K, V] = _CountingLruCache(limit_bytes, size)
        self._lock = threading.Lock()

    @property
    def bytes(self) -> int:
        """What the values in it take."""
        return int(self._values.currsize)

    def get(self, key: K) -> V | None:
        """A value, which now counts as used."""
        with self._lock:
            return self._values.get(key)

    def put(self, key: K, value: V) -> int:
        """Keep a value; one that is larger than the whole cache is not kept, and pushes nothing out.

        Returns:
            how many others had to make room.
        """
        with self._lock:
            self._values.pop(key, None)
            before = self._values.evictions
            if self._values.getsizeof(value) <= self._values.maxsize:
                self._values[key] = value
            return self._values.evictions - before

    def drop(self, unwanted: Callable[[K, V], bool]) -> None:
        """Forget some of the values."""
        with self._lock:
            for key, value in self._items():
                if unwanted(key, value):
                    del self._values[key]

    def items(self) -> list[tuple[K, V]]:
        """Keys and values as they are now; none of them counts as used by that."""
        with self._lock:
            return self._items()

    def _items(self) -> list[tuple[K, V]]:
        # Looked up past the least-recently-used order, which would count each as used.
        return [(key, Cache.__getitem__(self._values, key)) for key in self._values]
