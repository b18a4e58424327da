"""Scopes, the table of scopes per route, and the caller of a request."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
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

METRICS, READ, LOCALISE, WRITE, ADMIN = Permission
# Scopes of all other routes. With keys on, a route without a row does not exist.
_SCOPES: Mapping[str, Mapping[str, Permission]] = {
    "/openapi.json": {"GET": READ},
    "/metrics": {"GET": METRICS},
    "/limits": {"GET": READ},
    "/usage": {"GET": READ},
    "/floorplans": {"GET": READ, "POST": WRITE},
    "/floorplans/{floorplan_id}": {"GET": READ, "PUT": WRITE, "DELETE": WRITE},
    "/floorplans/{floorplan_id}/events": {"GET": READ},
    "/floorplans/{floorplan_id}/layout": {"GET": READ},
    "/floorplans/{floorplan_id}/original": {"GET": READ},
    "/floorplans/{floorplan_id}/export": {"GET": READ},
    "/floorplans/{floorplan_id}/preview.svg": {"GET": READ},
    "/floorplans/{floorplan_id}/mesh.glb": {"GET": READ},
    "/floorplans/{floorplan_id}/localisability": {"GET": READ},
    "/floorplans/{floorplan_id}/localisability.svg": {"GET": READ},
    "/venues": {"GET": READ, "POST": WRITE},
    "/venues/{venue_id}": {"GET": READ, "PUT": WRITE, "PATCH": WRITE, "DELETE": WRITE},
    "/venues/{venue_id}/plans": {"GET": READ},
    "/answers/{answer_id}": {"GET": READ, "DELETE": LOCALISE},
    "/model/{file}": {"GET": LOCALISE},
    "/localise": {"POST": LOCALISE},
    "/localise/batch": {"POST": LOCALISE},
    "/localise/sequence": {"POST": LOCALISE},
    "/sessions": {"POST": LOCALISE},
    "/sessions/{session_id}": {"GET": LOCALISE, "DELETE": LOCALISE},
    "/sessions/{session_id}/photographs": {"POST": LOCALISE},
    "/albums": {"GET": LOCALISE, "POST": LOCALISE},
    "/albums/{album_id}": {"GET": LOCALISE, "DELETE": LOCALISE},
    "/albums/{album_id}/events": {"GET": LOCALISE},
    "/albums/{album_id}/copies": {"POST": LOCALISE},
    "/albums/{album_id}/photographs": {"GET": LOCALISE, "POST": LOCALISE},
    "/albums/{album_id}/photographs/{photograph_id}": {"GET": LOCALISE, "PATCH": LOCALISE, "DELETE": LOCALISE},
    "/admin/keys": {"GET": ADMIN, "POST": ADMIN},
    "/admin/keys/{key_id}": {"GET": ADMIN, "DELETE": ADMIN},
    "/admin/keys/{key_id}/rotation": {"POST": ADMIN},
    "/admin/tenants": {"GET": ADMIN},
    "/admin/tenants/{tenant}": {"PATCH": ADMIN},
    "/admin/audit": {"GET": ADMIN},
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
