"""`lalaloc mcp`: a server of the Model Context Protocol, for assistants that localise photographs."""

from __future__ import annotations

import argparse
import os
from typing import Any

from lalaloc_core.errors import InvalidInputError

_KEY = "LALALOC_API_KEY"


def add_commands(commands: Any) -> None:
    """Add this command to the parser."""
    mcp = commands.add_parser("mcp", help="serve tools of a LaLaLoc service to assistants (Model Context Protocol)")
    mcp.add_argument(
        "--url", default="http://127.0.0.1:8000", metavar="URL", help="address of the service (default: %(default)s)"
    )
    mcp.add_argument(
        "--http",
        type=_address,
        metavar="HOST:PORT",
        help=f"serve streamable HTTP at /mcp instead of stdio; callers send their own keys (stdio: {_KEY})",
    )
    mcp.set_defaults(run=_serve)


def _serve(arguments: argparse.Namespace) -> None:
    from lalaloc_client.mcp_server import serve

    try:
        serve(arguments.url, os.environ.get(_KEY), address=arguments.http)
    except ValueError as error:
        raise InvalidInputError(str(error)) from error


def _address(text: str) -> tuple[str, int]:
    host, separator, port = text.rpartition(":")
    if not (separator and host and port.isdigit() and 0 < int(port) < 2**16):
        raise argparse.ArgumentTypeError(f"'{text}' is no address; write 127.0.0.1:8765")
    return host.strip("[]"), int(port)
