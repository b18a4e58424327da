"""Run the service: `python -m service [--host HOST] [--port PORT]`; port 0 picks a free one."""

from __future__ import annotations

import argparse

from lalaloc_core.errors import LaLaLocError
from service.cli.entry_point import add_serve_arguments, serve
from service.settings import settings_table


def main() -> None:
    """Run `lalaloc-service serve`."""
    parser = argparse.ArgumentParser(prog="python -m service", description=__doc__)
    add_serve_arguments(parser)
    parser.add_argument("--settings", action="store_true", help="print all settings as a Markdown table and exit")
    arguments = parser.parse_args()
    if arguments.settings:
        print(settings_table(), end="")
        return
    try:
        serve(arguments)
    except LaLaLocError as error:
        parser.exit(1, f"{parser.prog}: {error}\n")


if __name__ == "__main__":
    main()
