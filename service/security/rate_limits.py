"""Rate limits: requests per key or token's subject, and invalid ones per client address; in memory per replica."""

from __future__ import annotations

import math
import time

from limits import RateLimitItem, RateLimitItemPerMinute, RateLimitItemPerSecond
from limits.aio.storage import MemoryStorage
from limits.aio.strategies import SlidingWindowCounterRateLimiter

from service.errors import InvalidRequestError, RateLimitedError, TooManyRefusedKeysError
from service.security.permissions import Identity, network_of
from service.settings import Settings

# Client addresses share a fixed number of counters, which bounds memory. A collision only affects addresses that send
# invalid keys.
_ADDRESS_COUNTERS = 1024
# Invalid API keys per minute of a client address; further ones get a 429. Valid keys are not affected.
REFUSED_KEYS_PER_MINUTE = 60
# Bytes of an answer that cost as much as a request.
BYTES_PER_REQUEST = 256 * 1024


class RateLimits:
    """Rate limits over a sliding window; for one event loop."""

    def __init__(self, settings: Settings) -> None:
        self._limiter = SlidingWindowCounterRateLimiter(MemoryStorage())
        self._per_minute = settings.access.rate_per_minute
        self._burst = settings.access.rate_burst
        self._refused = RateLimitItemPerMinute(REFUSED_KEYS_PER_MINUTE, namespace="refused")

    async def count(self, caller: Identity) -> None:
        """Count a request."""
        if self._burst:
            await self._count(RateLimitItemPerSecond(self._burst, namespace="burst"), caller.id, "second")
        if (limit := self._limit_of(caller)) is not None:
            await self._count(limit, caller.id, "minute")

    async def count_photographs(self, caller: Identity, photographs: int) -> None:
        """Count each photograph of a request, which was counted once, as a request; all of them or none."""
        limit = self._limit_of(caller)
        if limit is None or photographs <= 1:
            return
        if photographs > limit.amount:
            fault = f"is given {photographs} times; the rate limit is {limit.amount} per minute: send fewer"
            raise InvalidRequestError([("photo", fault)])
        await self._count(limit, caller.id, "minute", cost=photographs - 1)

    async def charge(self, caller: Identity, sent_bytes: int) -> None:
        """Count an answer as one more request per `BYTES_PER_REQUEST`, up to the limit."""
        more, limit = sent_bytes // BYTES_PER_REQUEST, self._limit_of(caller)
        if more and limit is not None:
            _, left = await self._limiter.get_window_stats(limit, caller.id)
            await self._limiter.hit(limit, caller.id, cost=min(more, left))

    async def count_refused(self, client: str) -> None:
        """Count an invalid key of a client address."""
        if not await self._limiter.hit(self._refused, _counter_of(client)):
            retry_after_s = await self._retry_after_s(self._refused, _counter_of(client))
            raise TooManyRefusedKeysError(self._refused.amount, retry_after_s)

    def _limit_of(self, caller: Identity) -> RateLimitItem | None:
        per_minute = self._per_minute if caller.rate_per_minute is None else caller.rate_per_minute
        return RateLimitItemPerMinute(per_minute, namespace="rate") if per_minute else None

    async def _count(self, limit: RateLimitItem, key_id: str, period: str, cost: int = 1) -> None:
        if not await self._limiter.hit(limit, key_id, cost=cost):
            raise RateLimitedError(limit.amount, period, await self._retry_after_s(limit, key_id))

    async def _retry_after_s(self, limit: RateLimitItem, identifier: str) -> int:
        """Return the whole seconds until the count drops."""
        freed_at_s, _ = await self._limiter.get_window_stats(limit, identifier)
        return max(math.ceil(freed_at_s - time.time()), 1)


def _counter_of(client: str) -> str:
    """Return the counter of a client address; the hash is salted per process, so collisions cannot be planned."""
    return str(hash(network_of(client)) % _ADDRESS_COUNTERS)
