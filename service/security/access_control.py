"""Access checks of every request before its body is read: exposure, API key or token, rate limit, scope.

Without API keys, only local requests are answered, unless configured otherwise. Addresses and host names are checked
separately: a container receives requests over its own network, but only from programs and pages of its host. A browser
must use a loopback name, and for changes a page of this service: other sites can make their names resolve to 127.0.0.1
(DNS rebinding), and can send forms anywhere.
"""

from __future__ import annotations

import ipaddress
import math
import time
from collections.abc import Set
from datetime import UTC, datetime
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from limits import RateLimitItem, RateLimitItemPerMinute, RateLimitItemPerSecond
from limits.aio.storage import MemoryStorage
from limits.aio.strategies import SlidingWindowCounterRateLimiter
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import Scope

from lalaloc_core.errors import ConfigError
from service import errors
from service.security.keys import KeyCache, PresentedKey, parse_authorization, parse_token
from service.security.permissions import Caller, Identity, Permission, anyone, is_page, network_of, permissions_needed
from service.settings import Settings
from service.storage.api_keys import ApiKeys
from service.telemetry import add_log_fields

if TYPE_CHECKING:
    from service.security.oidc import TokenVerifier

# Errors of `AuthorisationMiddleware`, besides 404 and 405.
REFUSALS = (
    errors.UnauthenticatedError,
    errors.InsufficientScopeError,
    errors.ExposedWithoutKeysError,
    errors.RateLimitedError,
    errors.TooManyRefusedKeysError,
    errors.StoreUnavailableError,
    errors.IssuerUnavailableError,
)
_NO_KEY = "an API key is required: send `Authorization: Bearer lalaloc_...`"
_MALFORMED = "the Authorization header must be `Bearer lalaloc_...`, with one API key"
_TOKEN_TOO = ", or a token of the issuer"
_REFUSED = "the API key is unknown or revoked; ask the operator of the service for a valid one"


class AccessControl:
    """Access checks of one running app."""

    def __init__(self, keys: ApiKeys, settings: Settings) -> None:
        self._needs_keys = settings.access.api_keys
        # A container port that is published locally is reached over a network address of the container.
        published_here = settings.access.published_host is not None and is_local((settings.access.published_host, 0))
        self._allow_anonymous = settings.access.allow_anonymous or published_here
        self._pages, self._hosts = settings.access.cors_origin_set, settings.access.allowed_host_names
        self._keys = KeyCache(keys, fresh_s=settings.access.key_cache_s)
        self._rates = RateLimits(settings)
        self._tokens: TokenVerifier | None = None
        if settings.access.oidc_issuer:
            # Imported late: services without an issuer need neither its HTTP client nor its cryptography.
            from service.security.oidc import TokenVerifier

            self._tokens = TokenVerifier(settings.access)
        self._or_token = "" if self._tokens is None else _TOKEN_TOO

    def close(self) -> None:
        """Stop looking up keys."""
        self._keys.close()

    async def authorise(self, request: Request) -> Caller:
        """Return the caller of a request."""
        if not self._needs_keys:
            self._check_local(request)
            if Permission.ADMIN in permissions_needed(routed_path(request.scope)).values():
                # A key that is created while keys are off would outlast this state.
                raise errors.InsufficientScopeError(Permission.ADMIN, None)
            return anyone(_client_of(request))
        is_read = request.method in ("GET", "HEAD")
        if is_read and is_page(routed_path(request.scope)) and "authorization" not in request.headers:
            return anyone(_client_of(request))
        identity = await self._identity_of(request)
        add_log_fields(request, key=identity.id, tenant=identity.tenant)
        await self._rates.count(identity)
        needed = _needed(request)
        if needed not in identity.permissions:
            raise errors.InsufficientScopeError(needed, identity.permissions)
        return Caller(identity.tenant, identity, client=identity.tenant)

    async def charge(self, caller: Caller, sent_bytes: int) -> None:
        """Count the bytes of an answer to a read against the rate limit of its caller's key."""
        if caller.identity is not None:
            await self._rates.charge(caller.identity, sent_bytes)

    async def count_photographs(self, caller: Caller, photographs: int) -> None:
        """Count each photograph of a request against the rate limit of its caller's key."""
        if caller.identity is not None:
            await self._rates.count_photographs(caller.identity, photographs)

    async def still_authorised(self, request: Request) -> bool:
        """Return True while the key or token of an accepted request is valid, or keys are off."""
        values = request.headers.getlist("authorization")
        presented, token = parse_authorization(values), parse_token(values)
        if not self._needs_keys or (presented is None and token is None):
            return not self._needs_keys
        try:
            if presented is not None:
                return await self._holder_of_key(request, presented) is not None
            return self._tokens is not None and token is not None and await self._tokens.verify(token) is not None
        except (errors.StoreUnavailableError, errors.IssuerUnavailableError, errors.UnauthenticatedError):
            return False

    def _check_local(self, request: Request) -> None:
        """Refuse requests from other machines and from pages of other sites."""
        server = request.scope.get("server")
        if not self._allow_anonymous and not is_local(server):
            raise errors.ExposedWithoutKeysError("over a loopback address", "" if server is None else str(server[0]))
        # Only proxies use Unix sockets, and they pass on the host name that their clients use.
        if server is not None and server[1] is not None:
            _check_origin(request, self._hosts, self._pages)

    async def _identity_of(self, request: Request) -> Identity:
        values = request.headers.getlist("authorization")
        if not values:
            raise errors.UnauthenticatedError(_NO_KEY + self._or_token)
        client = _client_of(request)
        presented = parse_authorization(values)
        try:
            if presented is not None:
                # Looked up first: clients can share an address, so valid keys are not affected by invalid ones.
                identity = await self._holder_of_key(request, presented)
                if identity is None:
                    raise errors.UnauthenticatedError(_REFUSED)
                return identity
            token = parse_token(values)
            if self._tokens is None or token is None:
                raise errors.UnauthenticatedError(_MALFORMED + self._or_token)
            return await self._tokens.verify(token)
        except errors.UnauthenticatedError:
            await self._rates.count_refused(client)
            raise

    async def _holder_of_key(self, request: Request, presented: PresentedKey) -> Identity | None:
        """Return the holder of a key; None if it is unknown or revoked."""
        key = await self._keys.find(presented)
        if key is not None and key.expires_at is not None and datetime.now(UTC) >= key.expires_at:
            add_log_fields(request, key=key.id, tenant=key.tenant)
            raise errors.UnauthenticatedError(
                f"the API key expired at {key.expires_at:%Y-%m-%dT%H:%M:%SZ}; use its successor, or ask the operator"
            )
        return None if key is None else Identity.of_key(key)


def _client_of(request: Request) -> str:
    return request.client.host if request.client is not None else ""


def _needed(request: Request) -> Permission:
    methods = permissions_needed(routed_path(request.scope))
    if not methods:
        raise HTTPException(404)
    # HEAD needs the scope of GET.
    method = "GET" if request.method == "HEAD" else request.method
    if method not in methods:
        raise HTTPException(405, headers={"Allow": ", ".join(methods)})
    return methods[method]


def routed_path(scope: Scope) -> str:
    """Return the path without the prefix of a proxy."""
    path, prefix = scope["path"], scope.get("root_path", "")
    return path[len(prefix) :] if prefix and path.startswith(f"{prefix}/") else path


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
        self._per_minute, self._burst = settings.access.rate_per_minute, settings.access.rate_burst
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
            raise errors.InvalidRequestError([("photo", fault)])
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
            raise errors.TooManyRefusedKeysError(self._refused.amount, retry_after_s=retry_after_s)

    def _limit_of(self, caller: Identity) -> RateLimitItem | None:
        per_minute = self._per_minute if caller.rate_per_minute is None else caller.rate_per_minute
        return RateLimitItemPerMinute(per_minute, namespace="rate") if per_minute else None

    async def _count(self, limit: RateLimitItem, key_id: str, period: str, cost: int = 1) -> None:
        if not await self._limiter.hit(limit, key_id, cost=cost):
            raise errors.RateLimitedError(limit.amount, period, retry_after_s=await self._retry_after_s(limit, key_id))

    async def _retry_after_s(self, limit: RateLimitItem, identifier: str) -> int:
        """Return the whole seconds until the count drops."""
        freed_at_s, _ = await self._limiter.get_window_stats(limit, identifier)
        return max(math.ceil(freed_at_s - time.time()), 1)


def _counter_of(client: str) -> str:
    """Return the counter of a client address; the hash is salted per process, so collisions cannot be planned."""
    return str(hash(network_of(client)) % _ADDRESS_COUNTERS)


_CHANGING = frozenset({"POST", "PUT", "PATCH", "DELETE"})


def is_local(server: tuple[str, int | None] | None) -> bool:
    """Return True if only this machine can reach the server's local address.

    The address is host and port, or path and None; it is None for a Unix socket.
    """
    if server is None or server[1] is None:
        return True
    try:
        address = ipaddress.ip_address(server[0])
    except ValueError:
        return False
    # A dual-stack socket reports 127.0.0.1 as an IPv4-mapped address.
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback


def is_allowed_host(authority: str, allowed: Set[str] = frozenset()) -> bool:
    """Return True if a host, with or without port, is loopback, `localhost` or in `allowed` (`*`: any)."""
    try:
        host = urlsplit(f"//{authority}").hostname or ""
    except ValueError:
        return False
    return host == "localhost" or is_local((host, 0)) or host in allowed or "*" in allowed


def _check_origin(request: Request, allowed: Set[str], pages: Set[str]) -> None:
    """Refuse requests that a page of another site makes a browser send.

    Hosts are `allowed` besides those of this machine (`*`: any), and origins if they are of the `pages`. Browsers send
    `Host` always, and `Origin` with changes.
    """
    for host in request.headers.getlist("host"):
        if not is_allowed_host(host, allowed):
            raise errors.ExposedWithoutKeysError("to localhost, a loopback address or an allowed name (Host)", host)
    foreign = [origin for origin in request.headers.getlist("origin") if origin.lower() not in pages]
    for origin in foreign if request.method in _CHANGING else ():
        if not is_allowed_host(origin.partition("://")[2], allowed):
            raise errors.ExposedWithoutKeysError("from pages of this machine or an allowed name (Origin)", origin)


def check_address(host: str, settings: Settings) -> None:
    """Refuse to listen on a public address without keys.

    `published_on` in the settings takes precedence over the numeric address to listen on.
    """
    reached = settings.access.published_host or host
    if not settings.access.api_keys and not settings.access.allow_anonymous and not is_local((reached, 0)):
        raise ConfigError(
            f"refusing to listen on {reached} without API keys: anyone on the network could read, change and delete "
            "every floor plan. Set LALALOC_API_KEYS=on and create keys with `lalaloc-service keys create`, listen on "
            "127.0.0.1, or, behind your own access control, set LALALOC_ALLOW_ANONYMOUS=on"
        )
