"""Types of setting values, each with its check."""

from __future__ import annotations

import ipaddress
import re
from typing import Annotated
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field

_HOST_NAME = re.compile(r"|\*|[A-Za-z0-9._-]+|[0-9A-Fa-f:]*:[0-9A-Fa-f:.]*")
_ORIGIN = re.compile(r"|\*|https?://(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::[0-9]{1,5})?")
_PUBLISHED = re.compile(r"|(?:(?:[0-9.]+|\[[0-9A-Fa-f:.]+\]):)?[0-9]{1,5}")


def _host_names(value: str) -> str:
    for name in value.split(","):
        if not _HOST_NAME.fullmatch(name.strip()):
            raise ValueError(f"'{name.strip()}' is neither a bare name or address nor *, without scheme and port")
    return value


def _origins(value: str) -> str:
    for origin in value.split(","):
        if not _ORIGIN.fullmatch(origin.strip()):
            raise ValueError(f"'{origin.strip()}' is neither an origin such as https://plans.example nor *")
    return value


def _port_mapping(value: str) -> str:
    if not _PUBLISHED.fullmatch(value):
        raise ValueError("neither ADDRESS:PORT, with IPv6 addresses in brackets, nor PORT")
    return value


def secure_url(value: str) -> str:
    """Return a URL if what it sends cannot be changed on the way: https, or http on a loopback address."""
    try:
        parts = urlsplit(value)
        host, _port = parts.hostname or "", parts.port
    except ValueError as error:
        raise ValueError(f"not a URL: {error}") from error
    if parts.scheme not in ("https", "http") or not host or parts.query or parts.fragment or parts.username:
        raise ValueError("not a URL such as https://login.example/realms/acme, without query and user")
    if parts.scheme == "http" and not _is_loopback(host):
        raise ValueError("must begin with https://; http:// is for loopback addresses only")
    return value


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


Count = Annotated[int, Field(ge=1)]
Seconds = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
# Lists, separated by commas.
HostNames = Annotated[str, AfterValidator(_host_names)]
Origins = Annotated[str, AfterValidator(_origins)]
PortMapping = Annotated[str, AfterValidator(_port_mapping)]
IssuerUrl = Annotated[str, AfterValidator(lambda value: value and secure_url(value))]
