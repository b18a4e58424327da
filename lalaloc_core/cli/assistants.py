"""`lalaloc mcp`: starts the client's server of the Model Context Protocol."""

from __future__ import annotations

import argparse
import runpy
import sys
from typing import Any

from lalaloc_core.cli.options import add_options

_OPTIONS = """
--url URL: address of the service (default: %(default)s)
--http HOST:PORT: serve streamable HTTP at /mcp instead of stdio; callers send their own keys (stdio: LALALOC_API_KEY)
"""


def add_commands(commands: Any) -> None:
    """Add this command to the parser."""
    mcp = commands.add_parser("mcp", help="serve tools of a LaLaLoc service to assistants (Model Context Protocol)")
    add_options(mcp, _OPTIONS, url={"default": "http://127.0.0.1:8000"})
    mcp.set_defaults(run=_serve)


def _serve(arguments: argparse.Namespace) -> None:
    given = [] if arguments.http is None else [f"--http={arguments.http}"]
    sys.argv = ["lalaloc mcp", f"--url={arguments.url}", *given]
    runpy.run_module("lalaloc_client.mcp_server", run_name="__main__")
