"""Access checks of every request before its body is read: exposure, API key, rate limit, scope."""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import Scope

from service.errors import (
    ExposedWithoutKeysError,
    InsufficientScopeError,
    RateLimitedError,
    StoreUnavailableError,
    TooManyRefusedKeysError,
    UnauthenticatedError,
)
from service.security.exposure import check_origin, is_local
from service.security.key_cache import KeyCache
from service.security.keys import parse_authorization
from service.security.permissions import Caller, Permission, anyone, is_page, permissions_needed
from service.security.rate_limits import RateLimits
from service.settings import Settings
from service.storage.api_keys import ApiKeys
from service.storage.records import ApiKey
from service.telemetry import add_log_fields

# Errors of `AuthorisationMiddleware`, besides 404 and 405.
REFUSALS = (
    UnauthenticatedError,
    InsufficientScopeError,
    ExposedWithoutKeysError,
    RateLimitedError,
    TooManyRefusedKeysError,
    StoreUnavailableError,
)
_NO_KEY = "an API key is required: send `Authorization: Bearer lalaloc_...`"
_MALFORMED = "the Authorization header must be `Bearer lalaloc_...`, with one API key"
_REFUSED = "the API key is unknown or revoked"


class AccessControl:
    """Access checks of one running app."""

    def __init__(self, keys: ApiKeys, settings: Settings) -> None:
        self._needs_keys = settings.access.api_keys
        # A container port that is published locally is reached over a network address of the container.
        published_here = settings.access.published_host is not None and is_local((settings.access.published_host, 0))
        self._allow_anonymous = settings.access.allow_anonymous or published_here
        self._pages = settings.access.cors_origin_set
        self._hosts = settings.access.allowed_host_names
        self._keys = KeyCache(keys, fresh_s=settings.access.key_cache_s)
        self._rates = RateLimits(settings)

    def close(self) -> None:
        """Stop looking up keys."""
        self._keys.close()

    async def authorise(self, request: Request) -> Caller:
        """Return the caller of a request.

        Raises:
            ExposedWithoutKeysError: a remote request while keys are off.
            UnauthenticatedError: no valid key.
            TooManyRefusedKeysError: too many invalid keys from the client.
            RateLimitedError: the key exceeded its rate limit.
            StoreUnavailableError: the database is away, and the key is not cached.
            InsufficientScopeError: the key lacks the scope.
            HTTPException: unknown route or method.
        """
        if not self._needs_keys:
            self._check_local(request, request.method)
            return anyone(_client_of(request))
        is_read = request.method in ("GET", "HEAD")
        if is_read and is_page(routed_path(request.scope)) and "authorization" not in request.headers:
            return anyone(_client_of(request))
        key = await self._key_of(request)
        add_log_fields(request, key=key.id, tenant=key.tenant)
        await self._rates.count(key)
        scopes = frozenset(scope for scope in Permission if scope in key.scopes)
        caller = Caller(key.tenant, key, scopes, client=key.tenant)
        needed = _needed(request)
        if needed not in caller.permissions:
            raise InsufficientScopeError(needed, caller.permissions)
        return caller

    async def charge(self, caller: Caller, sent_bytes: int) -> None:
        """Count the bytes of an answer to a read against the rate limit of its caller's key."""
        if caller.key is not None:
            await self._rates.charge(caller.key, sent_bytes)

    async def count_photographs(self, caller: Caller, photographs: int) -> None:
        """Count each photograph of a request against the rate limit of its caller's key.

        Raises:
            RateLimitedError, InvalidRequestError: see `RateLimits.count_photographs`.
        """
        if caller.key is not None:
            await self._rates.count_photographs(caller.key, photographs)

    async def still_authorised(self, request: Request) -> bool:
        """Return True while the key of an accepted request is valid, or keys are off."""
        presented = parse_authorization(Headers(scope=request.scope).getlist("authorization"))
        if not self._needs_keys or presented is None:
            return not self._needs_keys
        try:
            return await self._keys.find(presented) is not None
        except StoreUnavailableError:
            return False

    def check_handshake(self, request: Request) -> None:
        """Refuse an authorised handshake of a WebSocket if a page of another site made it.

        Pages can read the answers of other sites' WebSockets, so the rules are those of changes. Browsers do not send
        keys with a handshake.

        Raises:
            ExposedWithoutKeysError: the handshake comes from a page of another site.
        """
        if not self._needs_keys:
            self._check_local(request, "POST")

    def _check_local(self, request: Request, method: str) -> None:
        """Refuse requests from other machines and from pages of other sites.

        Raises:
            ExposedWithoutKeysError: the request comes from another machine or site.
        """
        server = request.scope.get("server")
        if not self._allow_anonymous and not is_local(server):
            raise ExposedWithoutKeysError("over a loopback address")
        # Only proxies use Unix sockets, and they pass on the host name that their clients use.
        if server is not None and server[1] is not None:
            headers = Headers(scope=request.scope)
            check_origin(method, headers.getlist("host"), headers.getlist("origin"), self._hosts, self._pages)

    async def _key_of(self, request: Request) -> ApiKey:
        values = Headers(scope=request.scope).getlist("authorization")
        if not values:
            raise UnauthenticatedError(_NO_KEY)
        client = _client_of(request)
        presented = parse_authorization(values)
        if presented is None:
            await self._rates.count_refused(client)
            raise UnauthenticatedError(_MALFORMED)
        # Clients can share an address, so valid keys are not affected by invalid ones.
        if not self._keys.remembers(presented):
            await self._rates.check_refused(client)
        key = await self._keys.find(presented)
        if key is None:
            await self._rates.count_refused(client)
            raise UnauthenticatedError(_REFUSED)
        return key


def _client_of(request: Request) -> str:
    return request.client.host if request.client is not None else ""


def _needed(request: Request) -> Permission:
    """Return the scope that the request's route requires.

    Raises:
        HTTPException: unknown route or method.
    """
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
