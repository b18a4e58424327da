"""Scopes, the one table that says which route needs which, and on whose behalf a request comes."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from starlette.routing import compile_path
from starlette.types import Scope

from service.storage.records import DEFAULT_TENANT

_SCOPE_KEY = "lalaloc.caller"
# Who has one IPv6 address commonly has all that begin like it.
_IPV6_NETWORK_BITS = 64


class Permission(StrEnum):
    """What a key is good for; none includes another."""

    READ = "read"
    LOCALISE = "localise"
    WRITE = "write"


# Answered to everybody: whoever watches the process need not have a key.
OPEN_PATHS = frozenset({"/healthz", "/readyz"})
# Answered without a key, from where requests are answered at all: pages, which ask for one themselves. They are the
# same for everybody.
PAGES = frozenset({"/", "/docs", "/web/{name}", "/favicon.ico"})

# Every other route. With keys, what does not stand here is not there: a new route is closed until it has a row.
NEEDED: Mapping[tuple[str, str], Permission] = {
    ("GET", "/openapi.json"): Permission.READ,
    ("GET", "/metrics"): Permission.READ,
    ("GET", "/limits"): Permission.READ,
    ("GET", "/floorplans"): Permission.READ,
    ("POST", "/floorplans"): Permission.WRITE,
    ("GET", "/floorplans/{floorplan_id}"): Permission.READ,
    ("PUT", "/floorplans/{floorplan_id}"): Permission.WRITE,
    ("DELETE", "/floorplans/{floorplan_id}"): Permission.WRITE,
    ("GET", "/floorplans/{floorplan_id}/events"): Permission.READ,
    ("GET", "/floorplans/{floorplan_id}/layout"): Permission.READ,
    ("GET", "/floorplans/{floorplan_id}/original"): Permission.READ,
    ("GET", "/floorplans/{floorplan_id}/export"): Permission.READ,
    ("GET", "/floorplans/{floorplan_id}/preview.svg"): Permission.READ,
    ("GET", "/floorplans/{floorplan_id}/mesh.glb"): Permission.READ,
    ("GET", "/venues"): Permission.READ,
    ("POST", "/venues"): Permission.WRITE,
    ("GET", "/venues/{venue_id}"): Permission.READ,
    ("PUT", "/venues/{venue_id}"): Permission.WRITE,
    ("PATCH", "/venues/{venue_id}"): Permission.WRITE,
    ("DELETE", "/venues/{venue_id}"): Permission.WRITE,
    ("GET", "/venues/{venue_id}/plans"): Permission.READ,
    ("GET", "/answers/{answer_id}"): Permission.READ,
    ("DELETE", "/answers/{answer_id}"): Permission.LOCALISE,
    ("POST", "/localise"): Permission.LOCALISE,
    ("POST", "/localise/sequence"): Permission.LOCALISE,
    ("POST", "/geopose"): Permission.LOCALISE,
}
_PATTERNS = {path: compile_path(path)[0] for _, path in NEEDED}
_PAGE_PATTERNS = [compile_path(path)[0] for path in PAGES]


@dataclass(frozen=True)
class Caller:
    """On whose behalf a request comes.

    Attributes:
        tenant: whose plans it may see.
        key_id: id of its API key, None where there are no keys.
        permissions: what it may do.
        client: with whom it shares what the service can do at a time: its tenant, or without keys its client address.
    """

    tenant: str
    key_id: str | None
    permissions: frozenset[Permission]
    client: str


def anyone(client: str) -> Caller:
    """Whoever asks while keys are off, from a client address."""
    return Caller(DEFAULT_TENANT, None, frozenset(Permission), network_of(client))


def permissions_needed(path: str) -> dict[str, Permission]:
    """Which methods a path has and what each needs; empty for a path that is none of a route."""
    if is_page(path):
        return {"GET": Permission.READ}
    # The framework redirects from a path with a slash at its end.
    plain = path.rstrip("/") or "/"
    template = next((template for template, pattern in _PATTERNS.items() if pattern.match(plain)), None)
    return {method: needed for (method, row), needed in NEEDED.items() if row == template}


def is_page(path: str) -> bool:
    """Whether a path is that of a page, or of what one is made of."""
    return any(pattern.match(path) for pattern in _PAGE_PATTERNS)


def put_caller(scope: Scope, caller: Caller) -> None:
    """Attach the caller to a request."""
    scope[_SCOPE_KEY] = caller


def caller_of(scope: Scope) -> Caller:
    """The caller of a request that was let in."""
    return scope[_SCOPE_KEY]


def network_of(client: str) -> str:
    """The network that a client address stands for: itself, or the /64 of an IPv6 address."""
    try:
        address = ipaddress.ip_address(client)
    except ValueError:
        # A Unix socket has none, and proxies may state anything.
        return client
    if address.version == 4:
        return client
    mapped = address.ipv4_mapped
    return str(mapped or ipaddress.ip_network((int(address), _IPV6_NETWORK_BITS), strict=False))
