"""Types of setting values, each with its check."""

from __future__ import annotations

import re
from typing import Annotated

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


Count = Annotated[int, Field(ge=1)]
Seconds = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Metres = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Area = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
# Lists, separated by commas.
HostNames = Annotated[str, AfterValidator(_host_names)]
Origins = Annotated[str, AfterValidator(_origins)]
PortMapping = Annotated[str, AfterValidator(_port_mapping)]
