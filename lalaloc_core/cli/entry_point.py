"""The command `lalaloc`: its parser, exit codes, and shell completion."""

from __future__ import annotations

import argparse
import logging
import os
import sys

from lalaloc_core import __version__
from lalaloc_core.cli import (
    assistants,
    encoding,
    evaluation,
    localising,
    measuring,
    pinning,
    plans,
    synthesis,
    tracking,
    training,
)
from lalaloc_core.errors import InvalidInputError, LaLaLocError

# The exit code that shells use for a command ended by Ctrl-C.
_INTERRUPTED = 130


def main(argv: list[str] | None = None) -> int:
    """Run one command; return 0 on success, 2 for invalid input, 1 for any other error of this project."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    # It lists every repaired detail of a DXF; the import's report has what matters.
    logging.getLogger("ezdxf").setLevel(logging.ERROR)
    arguments = build_parser().parse_args(argv)
    try:
        arguments.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader closed the pipe, as `head` does. Redirecting keeps Python from flushing to it at exit.
        for stream in (sys.stdout, sys.stderr):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
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
        print(
            f"error: '{error.name}' is not installed; pyproject.toml lists the extra that contains it", file=sys.stderr
        )
        return 1
    return 0


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of all commands."""
    parser = argparse.ArgumentParser(prog="lalaloc", description="Localise photographs in floor plans.")
    parser.add_argument("--version", action="version", version=f"lalaloc {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    groups = (localising, pinning, encoding, tracking, plans, evaluation, measuring, synthesis, training, assistants)
    for group in groups:
        group.add_commands(commands)
    completion = commands.add_parser(
        "completion", help='print the shell completion script: eval "$(lalaloc completion bash)"'
    )
    completion.add_argument("shell", choices=("bash", "zsh", "fish"), help="shell")
    completion.set_defaults(run=lambda arguments: _complete(parser, arguments.shell))
    return parser


def _complete(parser: argparse.ArgumentParser, shell: str) -> None:
    import shtab

    print(shtab.complete(parser, shell=shell))
