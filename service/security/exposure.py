"""Rules without API keys: only local requests are answered, unless configured otherwise.

Addresses and host names are checked separately: a container receives requests over its own network, but only from
programs and pages of its host. A browser must use a loopback name, and for changes a page of this service: other sites
can make their names resolve to 127.0.0.1 (DNS rebinding), and can send forms anywhere.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence, Set
from urllib.parse import urlsplit

from lalaloc_core.errors import ConfigError
from service.errors import ExposedWithoutKeysError
from service.settings import Settings

_CHANGING = frozenset({"POST", "PUT", "PATCH", "DELETE"})


def is_local(server: tuple[str, int | None] | None) -> bool:
    """Return True if only this machine can reach the server's local address.

    Args:
        server: local address: host and port, or path and None; None for a Unix socket.
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


def check_origin(
    method: str,
    hosts: Sequence[str],
    origins: Sequence[str],
    allowed: Set[str] = frozenset(),
    pages: Set[str] = frozenset(),
) -> None:
    """Refuse requests that a page of another site makes a browser send.

    Args:
        method: HTTP method.
        hosts: values of `Host`, which browsers always send.
        origins: values of `Origin`, which browsers send with changes.
        allowed: allowed host names besides this machine's, `*` for any.
        pages: allowed origins.
    """
    for host in hosts:
        if not is_allowed_host(host, allowed):
            raise ExposedWithoutKeysError("to localhost, a loopback address or an allowed name (Host)", host)
    foreign = [origin for origin in origins if origin.lower() not in pages]
    for origin in foreign if method in _CHANGING else ():
        if not is_allowed_host(origin.partition("://")[2], allowed):
            raise ExposedWithoutKeysError("from pages of this machine or an allowed name (Origin)", origin)


def check_address(host: str, settings: Settings) -> None:
    """Refuse to listen on a public address without keys.

    Args:
        host: numeric address to listen on; `published_on` in the settings takes precedence.
        settings: settings of the service.
    """
    reached = settings.access.published_host or host
    if not settings.access.api_keys and not settings.access.allow_anonymous and not is_local((reached, 0)):
        raise ConfigError(
            f"refusing to listen on {reached} without API keys: anyone on the network could read, change and delete "
            "every floor plan. Set LALALOC_API_KEYS=on and create keys with `lalaloc-service keys create`, listen on "
            "127.0.0.1, or, behind your own access control, set LALALOC_ALLOW_ANONYMOUS=on"
        )
