"""Valid keys, cached for a few seconds, and longer while the database is away."""

from __future__ import annotations

import asyncio
import hmac
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

from service.capacity.bounded_cache import BoundedCache
from service.errors import StoreBusyError, StoreUnavailableError
from service.security.keys import PresentedKey
from service.storage.api_keys import ApiKeys
from service.storage.circuit_breaker import CircuitBreaker
from service.storage.records import ApiKey

# Lifetime of a cached key while the database is away.
_TRUSTED_S = 600.0
_TOUCHED_EVERY = timedelta(minutes=1)
# Own threads, so that look-ups do not wait behind queries and uploads.
_THREADS = 2
# Upper bound of a record with its strings.
_RECORD_BYTES = 2048
_MEMORY_BYTES = 8 * 2**20


@dataclass(frozen=True)
class _CachedKey:
    """Key that was valid; times in seconds of the cache's clock."""

    key: ApiKey
    verified_s: float
    refresh_s: float


class KeyCache:
    """Look-up of keys.

    Args:
        keys: stored keys.
        fresh_s: lifetime of a cached key; a revoked key is rejected after this delay.
        clock: current time, seconds.
    """

    def __init__(self, keys: ApiKeys, *, fresh_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._keys = keys
        self._fresh_s = fresh_s
        self._clock = clock
        self._known: BoundedCache[str, _CachedKey] = BoundedCache(_MEMORY_BYTES, lambda _: _RECORD_BYTES)
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="lalaloc-keys")
        self._breaker = CircuitBreaker(clock)

    async def find(self, presented: PresentedKey) -> ApiKey | None:
        """Return the key; None if it is unknown or revoked.

        The look-up uses the hash of the secret only, so its duration does not reveal whether an id exists.

        Raises:
            StoreUnavailableError: the database is away, and the key is not cached.
            StoreBusyError: all database connections are in use.
        """
        cached = self._known.get(presented.hash)
        if cached is not None and self._clock() < cached.refresh_s:
            key = cached.key
        else:
            key = await asyncio.get_running_loop().run_in_executor(self._threads, self._look_up, presented.hash)
        if key is None or not hmac.compare_digest(key.id, presented.id):
            return None
        return key

    def close(self) -> None:
        """Finish the look-up in progress and drop the waiting ones."""
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _look_up(self, key_hash: str) -> ApiKey | None:
        cached = self._known.get(key_hash)
        # Another request may have looked it up meanwhile.
        if cached is not None and self._clock() < cached.refresh_s:
            return cached.key
        try:
            key = self._find(key_hash)
        except StoreBusyError:
            # The database is up, so the cached key may be out of date.
            raise
        except StoreUnavailableError:
            now_s = self._clock()
            if cached is None or now_s - cached.verified_s > _TRUSTED_S:
                raise
            self._known.put(key_hash, replace(cached, refresh_s=now_s + self._fresh_s))
            return cached.key
        if key is None:
            self._known.drop(lambda cached, _: cached == key_hash)
            return None
        now_s = self._clock()
        self._known.put(key_hash, _CachedKey(key, now_s, now_s + self._fresh_s))
        if key.last_used_at is None or datetime.now(UTC) - key.last_used_at > _TOUCHED_EVERY:
            self._threads.submit(self._touch, key.id)
        return key

    def _find(self, key_hash: str) -> ApiKey | None:
        # Without the breaker every look-up would wait for the silent database.
        if self._breaker.is_open:
            raise StoreUnavailableError()
        try:
            return self._keys.find(key_hash)
        except StoreBusyError:
            raise
        except StoreUnavailableError:
            self._breaker.trip()
            raise

    def _touch(self, key_id: str) -> None:
        # For information only; the next use writes it.
        with suppress(StoreUnavailableError):
            self._keys.touch(key_id)
