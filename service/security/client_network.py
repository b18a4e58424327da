"""Which client addresses count as one."""

from __future__ import annotations

import ipaddress

# Who has one IPv6 address commonly has all that begin like it.
_IPV6_NETWORK_BITS = 64


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
