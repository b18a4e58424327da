"""Without API keys the service answers its own machine only, unless it is told otherwise.

Other machines and other names are let in apart from each other: a container is asked over a network of its own, and yet
only by programs and pages of the machine that it runs on. A browser on this machine counts as it only under a loopback
name, and for changes only with a page from here: names of other sites may be made to resolve to 127.0.0.1, and their
forms may be sent anywhere.
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
    """Whether a connection cannot come from another machine.

    Args:
        server: the address of this end of it: host and port, or path and None; None for a Unix socket as well.
    """
    if server is None or server[1] is None:
        return True
    try:
        address = ipaddress.ip_address(server[0])
    except ValueError:
        return False
    # 127.0.0.1 as a socket for both kinds of addresses names it.
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback


def may_be_named(authority: str, allowed: Set[str] = frozenset()) -> bool:
    """Whether a host with or without a port is a loopback address, `localhost`, or among those allowed (`*`: any).

    A browser that was sent here by the page of another site, under a name that the site controls, says that name.
    """
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
    """Refuse what a browser was made to send by a page from elsewhere.

    Args:
        hosts: values of `Host`; programs may leave it out, browsers do not.
        origins: values of `Origin`, which browsers send with whatever changes something.
        allowed: names besides this machine's that will do, `*` for any.
        pages: whole origins whose pages will do as well.

    Raises:
        ExposedWithoutKeysError: another name, or a change that a page from elsewhere asked for.
    """
    if not all(may_be_named(host, allowed) for host in hosts):
        raise ExposedWithoutKeysError("to localhost, a loopback address or an allowed name (Host)")
    strange = [origin for origin in origins if origin.lower() not in pages]
    if method in _CHANGING and not all(may_be_named(origin.partition("://")[2], allowed) for origin in strange):
        raise ExposedWithoutKeysError("from pages of this machine or an allowed name (Origin)")


def check_address(host: str, settings: Settings) -> None:
    """Refuse to listen where others could ask without a key.

    Args:
        host: the numeric address that is listened on; `0.0.0.0` and `::` are all of the machine's. Where the settings
            say that the port is published on another one, that counts.

    Raises:
        ConfigError: not a loopback address, while there are neither keys nor leave to do without.
    """
    reached = settings.access.published_host or host
    if not settings.access.api_keys and not settings.access.allow_anonymous and not is_local((reached, 0)):
        raise ConfigError(
            f"refusing to listen on {reached} without API keys: others than this machine could read, change and delete "
            "every floor plan. Set LALALOC_API_KEYS=on and make keys with `lalaloc-service keys create`, listen on "
            "127.0.0.1, or, where something else decides who gets here, set LALALOC_ALLOW_ANONYMOUS=on"
        )
