"""Without API keys the service answers its own machine only, unless it is told otherwise."""

from __future__ import annotations

import ipaddress

from lalaloc_core.errors import ConfigError
from service.settings import Settings


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


def check_address(host: str, settings: Settings) -> None:
    """Refuse to listen where others could ask without a key.

    Args:
        host: the numeric address that is listened on; `0.0.0.0` and `::` are all of the machine's.

    Raises:
        ConfigError: not a loopback address, while there are neither keys nor leave to do without.
    """
    if not settings.api_keys and not settings.allow_anonymous and not is_local((host, 0)):
        raise ConfigError(
            f"refusing to listen on {host} without API keys: others than this machine could read, change and delete "
            "every floor plan. Set LALALOC_API_KEYS=on and make keys with `lalaloc-service keys create`, listen on "
            "127.0.0.1, or, where something else decides who gets here, set LALALOC_ALLOW_ANONYMOUS=on"
        )
