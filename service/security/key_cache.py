"""Which keys are valid: what the store says, remembered for a few seconds, and longer while the database is away."""

from __future__ import annotations

import asyncio
import hmac
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

from service.bounded_cache import BoundedCache
from service.errors import StoreBusyError, StoreUnavailableError
from service.security.keys import PresentedKey
from service.storage.api_keys import ApiKeys
from service.storage.circuit_breaker import CircuitBreaker
from service.storage.records import ApiKey

# How long a key goes on working while the database is away.
_TRUSTED_S = 600.0
_TOUCHED_EVERY = timedelta(minutes=1)
# Look-ups do not wait behind queries and uploads for a thread.
_THREADS = 2
# A record with its strings; generous.
_RECORD_BYTES = 2048
_MEMORY_BYTES = 8 * 2**20


@dataclass(frozen=True)
class _Known:
    """A key that was valid; moments in seconds of the ring's clock."""

    key: ApiKey
    verified_s: float
    ask_again_s: float


class KeyCache:
    """Looks keys up."""

    def __init__(self, keys: ApiKeys, *, fresh_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Args:
        fresh_s: how long an answer of the store is used; a revoked key is refused at most that much later.
        clock: seconds.
        """
        self._keys = keys
        self._fresh_s = fresh_s
        self._clock = clock
        self._known: BoundedCache[str, _Known] = BoundedCache(_MEMORY_BYTES, lambda _: _RECORD_BYTES)
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="lalaloc-keys")
        self._breaker = CircuitBreaker(clock)

    def remembers(self, presented: PresentedKey) -> bool:
        """Whether the key was valid not long ago."""
        return self._known.get(presented.hash) is not None

    async def find(self, presented: PresentedKey) -> ApiKey | None:
        """The key, or None when it is unknown or revoked.

        A key is found by the hash of its secret alone: an unknown id and a wrong secret are the same look-up, and the
        time it takes tells no more than how a hash begins that nobody can choose or undo.

        Raises:
            StoreUnavailableError: the database is away, and the key is not known from the last minutes.
            StoreBusyError: too many use it.
        """
        known = self._known.get(presented.hash)
        if known is not None and self._clock() < known.ask_again_s:
            key = known.key
        else:
            key = await asyncio.get_running_loop().run_in_executor(self._threads, self._ask, presented.hash)
        if key is None or not hmac.compare_digest(key.id, presented.id):
            return None
        return key

    def close(self) -> None:
        """Finish the look-up in work, drop the others."""
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _ask(self, key_hash: str) -> ApiKey | None:
        known = self._known.get(key_hash)
        # Another request may have asked since this one began to wait.
        if known is not None and self._clock() < known.ask_again_s:
            return known.key
        try:
            key = self._find(key_hash)
        except StoreBusyError:
            # It is there, and the key may be revoked.
            raise
        except StoreUnavailableError:
            now_s = self._clock()
            if known is None or now_s - known.verified_s > _TRUSTED_S:
                raise
            self._known.put(key_hash, replace(known, ask_again_s=now_s + self._fresh_s))
            return known.key
        if key is None:
            self._known.drop(lambda other, _: other == key_hash)
            return None
        now_s = self._clock()
        self._known.put(key_hash, _Known(key, now_s, now_s + self._fresh_s))
        if key.last_used_at is None or datetime.now(UTC) - key.last_used_at > _TOUCHED_EVERY:
            self._threads.submit(self._touch, key.id)
        return key

    def _find(self, key_hash: str) -> ApiKey | None:
        # One after the other would wait for a database that does not answer.
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
        # Only told to operators; the next use writes it.
        with suppress(StoreUnavailableError):
            self._keys.touch(key_id)
