"""The command `lalaloc`: which groups of commands it has, and how it ends."""

from __future__ import annotations

import argparse
import logging
import os
import sys

from lalaloc_core import __version__
from lalaloc_core.cli import (
    completion,
    evaluation,
    localising,
    measuring,
    photographs,
    plans,
    reproduction,
    synthesis,
    training,
)
from lalaloc_core.errors import InvalidInputError, LaLaLocError

# What shells say of a command that Ctrl-C ended.
_INTERRUPTED = 130


def main(argv: list[str] | None = None) -> int:
    """Run one command; 0 on success, 2 on the caller's mistake, 1 on any other error of this project."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    arguments = build_parser().parse_args(argv)
    try:
        arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever reads what is printed has read enough, as `head` does. What is left is not tried again at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return _INTERRUPTED
    except InvalidInputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except LaLaLocError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("lalaloc"):
            raise
        print(f"error: '{error.name}' is not installed; the README says which extra brings it", file=sys.stderr)
        return 1
    return 0


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="lalaloc", description="Localise panoramas in floor plans.")
    parser.add_argument("--version", action="version", version=f"lalaloc {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (
        localising,
        plans,
        evaluation,
        photographs,
        synthesis,
        training,
        reproduction,
        measuring,
    ):
        group.add_commands(commands)
    completion.add_commands(commands, parser)
    return parser
