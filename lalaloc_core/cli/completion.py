"""`lalaloc completion`: what makes a shell complete commands and options."""

from __future__ import annotations

import argparse
from typing import Any


def add_commands(commands: Any, parser: argparse.ArgumentParser) -> None:
    """Add this command to the parser that it completes."""
    completion = commands.add_parser(
        "completion", help='print what makes a shell complete commands and options: eval "$(lalaloc completion bash)"'
    )
    completion.add_argument("shell", choices=("bash", "zsh"))
    completion.set_defaults(run=lambda arguments: _complete(parser, arguments.shell))


def _complete(parser: argparse.ArgumentParser, shell: str) -> None:
    import shtab

    print(shtab.complete(parser, shell=shell))
