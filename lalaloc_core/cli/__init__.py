"""The command line, `lalaloc`; each module here adds one group of commands.

Begin with `evaluation.py`, which has the most of them. Commands import what they run when they run it, so that
`lalaloc --help` loads no network.
"""

from __future__ import annotations

import argparse
import logging
import sys

from lalaloc_core.cli import evaluation, measuring, photographs, plans, reproduction, synthesis, training
from lalaloc_core.errors import InvalidInputError, LaLaLocError


def main(argv: list[str] | None = None) -> int:
    """Run one command; 0 on success, 2 on the caller's mistake, 1 on any other error of this project."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    arguments = _parser().parse_args(argv)
    try:
        arguments.run(arguments)
    except InvalidInputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except LaLaLocError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="lalaloc", description="Localise panoramas in floor plans.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (synthesis, training, evaluation, photographs, plans, reproduction, measuring):
        group.add_commands(commands)
    return parser
