"""API keys as text: `lalaloc_<id>_<secret>`; the service stores the id and a hash of the secret.

The secret is 256 random bits, so a fast hash is sufficient: slow hashes only help against guessable secrets.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import re
import secrets
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

from service.bounded_cache import BoundedCache
from service.errors import StoreBusyError, StoreUnavailableError
from service.storage.api_keys import ApiKeys
from service.storage.database import CircuitBreaker
from service.storage.records import ApiKey

_SECRET_BYTES = 32
_KEY = re.compile(r"lalaloc_([0-9a-f]{32})_([A-Za-z0-9_-]{43})")
_BEARER = re.compile(r"bearer +(\S+)", re.IGNORECASE)
# Signed JSON Web Token, of at most 8 KiB.
_TOKEN = re.compile(r"(?=.{1,8192}\Z)[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+")


@dataclass(frozen=True)
class PresentedKey:
    """Key in a request, not yet checked.

    Attributes:
        id: id of the key; not secret.
        hash: SHA-256 of its secret, 64 hexadecimal digits.
    """

    id: str
    hash: str


def new_secret() -> str:
    """Return 256 random bits as 43 characters."""
    return secrets.token_urlsafe(_SECRET_BYTES)


def hash_of(secret: str) -> str:
    """Return the stored hash of a secret: SHA-256, 64 hexadecimal digits."""
    return hashlib.sha256(secret.encode("ascii")).hexdigest()


def key_text(key_id: str, secret: str) -> str:
    """Return the key as text."""
    return f"lalaloc_{key_id}_{secret}"


def parse_authorization(values: Sequence[str]) -> PresentedKey | None:
    """Parse `Authorization` headers; None unless there is exactly one, with a well-formed key."""
    bearer = _BEARER.fullmatch(values[0]) if len(values) == 1 else None
    key = _KEY.fullmatch(bearer[1]) if bearer else None
    return None if key is None else PresentedKey(key[1], hash_of(key[2]))


def parse_token(values: Sequence[str]) -> str | None:
    """Parse `Authorization` headers; None unless there is exactly one, with a token in the form of a signed JWT."""
    bearer = _BEARER.fullmatch(values[0]) if len(values) == 1 else None
    return bearer[1] if bearer is not None and _TOKEN.fullmatch(bearer[1]) else None


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

    A revoked key is rejected after `fresh_s` (s).
    """

    def __init__(self, keys: ApiKeys, *, fresh_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._keys, self._fresh_s, self._clock = keys, fresh_s, clock
        self._known: BoundedCache[str, _CachedKey] = BoundedCache(_MEMORY_BYTES, lambda _: _RECORD_BYTES)
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="lalaloc-keys")
        self._breaker = CircuitBreaker(clock)

    async def find(self, presented: PresentedKey) -> ApiKey | None:
        """Return the key; None if it is unknown or revoked.

        The look-up uses the hash of the secret only, so its duration does not reveal whether an id exists.
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
