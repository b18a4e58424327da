"""Cache with a limit in bytes and least-recently-used eviction, and calls that threads share."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Generic, TypeVar

from cachetools import Cache, LRUCache

K = TypeVar("K")
V = TypeVar("V")
M = TypeVar("M")

# Share of a cache that values may fill before anybody asks for them.
_UNREAD_SHARE = 1.0 / 32.0


class SingleFlight(Generic[K, V]):
    """Makes one call per key at a time; threads that ask for the same key meanwhile wait for its result."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._begun: dict[K, Future[V]] = {}

    def run(self, key: K, make: Callable[[], V]) -> V:
        """Return what `make` returns or raises, or what another thread's call with this key does that has begun."""
        mine = Future[V]()
        with self._lock:
            begun = self._begun.setdefault(key, mine)
        if begun is not mine:
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


class BoundedCache(Generic[K, V]):
    """Thread-safe `cachetools.LRUCache` that ignores values larger than the whole cache.

    `size` returns the bytes of a value.
    """

    def __init__(self, limit_bytes: int, size: Callable[[V], int]) -> None:
        self._values: LRUCache[K, V] = LRUCache(limit_bytes, size)
        self._lock = threading.RLock()
        self._making = SingleFlight[K, Any]()

    @property
    def bytes(self) -> int:
        """Total size of the values in bytes."""
        return int(self._values.currsize)

    def get(self, key: K) -> V | None:
        """Return a value and mark it as used."""
        with self._lock:
            return self._values.get(key)

    def pop(self, key: K) -> V | None:
        """Remove a value and return it."""
        with self._lock:
            return self._values.pop(key, None)

    def put(self, key: K, value: V) -> int:
        """Store a value, unless it is larger than the whole cache; return the number of evictions."""
        with self._lock:
            self._values.pop(key, None)
            if self._values.getsizeof(value) > self._values.maxsize:
                return 0
            count = len(self._values) + 1
            self._values[key] = value
            return count - len(self._values)

    def put_unread(self, key: K, value: V) -> None:
        """Store a value that nobody asked for, in a share of the cache: thousands do not displace those in use."""
        if self.bytes < _UNREAD_SHARE * self._values.maxsize:
            self.put(key, value)

    def get_or_make(self, key: K, make: Callable[[], M]) -> V | M:
        """Return a value; if it is missing, make and store it, once for all threads that ask meanwhile.

        `make` may return None, which is not stored.
        """

        def made() -> Any:
            # Another thread may have made it since.
            value: Any = self.get(key)
            if value is None and (value := make()) is not None:
                self.put(key, value)
            return value

        value = self.get(key)
        return self._making.run(key, made) if value is None else value

    def drop(self, unwanted: Callable[[K, V], bool]) -> None:
        """Remove the values that `unwanted` selects."""
        with self._lock:
            for key, value in self.items():
                if unwanted(key, value):
                    del self._values[key]

    def items(self) -> list[tuple[K, V]]:
        """Return keys and values without marking them as used."""
        with self._lock:
            return [(key, Cache.__getitem__(self._values, key)) for key in self._values]
