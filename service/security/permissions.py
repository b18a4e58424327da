"""Scopes, the table of scopes per route, and the caller of a request."""

from __future__ import annotations

import ipaddress
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Self

from starlette.routing import compile_path
from starlette.types import Scope

from service.storage.records import DEFAULT_TENANT, ApiKey

_SCOPE_KEY = "lalaloc.caller"
# An IPv6 client usually owns a whole /64.
_IPV6_NETWORK_BITS = 64


class Permission(StrEnum):
    """Scope of a key or token; no scope includes another.

    All but `admin` are about the caller's tenant; `metrics` shows numbers of all tenants.
    """

    METRICS = "metrics"
    READ = "read"
    LOCALISE = "localise"
    WRITE = "write"
    ADMIN = "admin"


# Open to everyone, so that monitoring needs no key.
OPEN_PATHS = frozenset({"/healthz", "/readyz"})
# Pages, open without a key; they ask for one themselves.
PAGES = frozenset({"/", "/pin", "/docs", "/web/{name}", "/favicon.ico"})

_TABLE = tomllib.loads(Path(__file__).with_name("scopes.toml").read_text(encoding="utf-8"))
_SCOPES: Mapping[str, Mapping[str, Permission]] = {
    path: {method: Permission(scope) for method, scope in methods.items()} for path, methods in _TABLE.items()
}
NEEDED = {(method, path): needed for path, methods in _SCOPES.items() for method, needed in methods.items()}
_PATTERNS = {path: compile_path(path)[0] for path in _SCOPES}
_PAGE_PATTERNS = [compile_path(path)[0] for path in PAGES]


@dataclass(frozen=True)
class Identity:
    """Holder of a valid key or token.

    Attributes:
        id: id of the key, or `oidc:` and the subject of the token.
        rate_per_minute: limit of requests per minute; 0 for none, None for the limit in the settings.
    """

    id: str
    tenant: str
    permissions: frozenset[Permission]
    rate_per_minute: int | None = None

    @classmethod
    def of_key(cls, key: ApiKey) -> Self:
        """Return the identity of a key's holder; scopes of other versions of the service are ignored."""
        scopes = frozenset(scope for scope in Permission if scope in key.scopes)
        return cls(key.id, key.tenant, scopes, key.rate_per_minute)


@dataclass(frozen=True)
class Caller:
    """Caller of a request.

    Attributes:
        tenant: tenant whose plans are visible.
        identity: holder of the key or token; None while keys are off.
        client: unit of fair sharing: the tenant, or without keys the client address.
    """

    tenant: str
    identity: Identity | None
    client: str


def anyone(client: str) -> Caller:
    """Return the caller of a request while keys are off."""
    return Caller(DEFAULT_TENANT, None, network_of(client))


def template_of(path: str) -> str | None:
    """Return the route's template of a path; None for an unknown path."""
    # The framework redirects from a path with a slash at its end.
    plain = path.rstrip("/") or "/"
    return next((template for template, pattern in _PATTERNS.items() if pattern.match(plain)), None)


def permissions_needed(path: str) -> Mapping[str, Permission]:
    """Return the methods of a path with their scopes; empty for an unknown path."""
    if is_page(path):
        return {"GET": Permission.READ}
    return _SCOPES.get(template_of(path) or "", {})


def is_page(path: str) -> bool:
    """Return True for the path of a page or of its files."""
    return any(pattern.match(path) for pattern in _PAGE_PATTERNS)


def put_caller(scope: Scope, caller: Caller) -> None:
    """Attach the caller to a request."""
    scope[_SCOPE_KEY] = caller


def caller_of(scope: Scope) -> Caller:
    """Return the caller of an accepted request."""
    return scope[_SCOPE_KEY]


def client_of(scope: Mapping[str, Any], address: str) -> str:
    """Return the unit of fair sharing of a request, or of an address whose request was not accepted yet."""
    caller: Caller | None = scope.get(_SCOPE_KEY)
    return network_of(address) if caller is None else caller.client


def network_of(client: str) -> str:
    """Return the network that an address is counted under: the address itself, or the /64 of an IPv6 address."""
    try:
        address = ipaddress.ip_address(client)
    except ValueError:
        # Unix sockets have no address, and proxies can send any text.
        return client
    if address.version == 4:
        return client
    mapped = address.ipv4_mapped
    return str(mapped or ipaddress.ip_network((int(address), _IPV6_NETWORK_BITS), strict=False))
