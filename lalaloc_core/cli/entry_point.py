"""The command `lalaloc`: its parser, exit codes, and shell completion."""

from __future__ import annotations

import argparse
import logging
import os
import re
import runpy
import sys
from collections.abc import Mapping
from glob import escape
from itertools import chain
from pathlib import Path

from lalaloc_core import __version__
from lalaloc_core.cli import encoding, localising, pinning, plans, tracking
from lalaloc_core.cli.options import add_options
from lalaloc_core.cli.printing import with_options
from lalaloc_core.errors import ConfigError, InvalidInputError, InvalidPhotographError, LaLaLocError, MissingExtraError

_MCP_OPTIONS = """
--url URL: address of the service (default: %(default)s)
--http HOST:PORT: serve HTTP at /mcp of a loopback address, not stdio; callers send their keys (stdio: LALALOC_API_KEY)
"""
# The exit code that shells use for a command ended by Ctrl-C.
_INTERRUPTED = 130

# Commands whose options are those of the laboratory; making them takes as long as all the rest, so others do without.
_WITH_LAB = ("bench", "lab", "completion")
# Options that name files to write; all other paths are read.
_WRITTEN = frozenset({"out", "csv", "geojson", "map", "debug", "picture", "trajectory"})
# Commands of `lalaloc lab` that stood outside of it until 0.11.
_MOVED = re.compile(
    "add-objects|calibrate|evaluate|export|export-again|photographs|report|reproduce|score|synth|train|worst"
)


def main(argv: list[str] | None = None) -> int:
    """Run one command; return 0 on success, 2 for invalid input, 1 for any other error of this project."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    # It lists every repaired detail of a DXF; the import's report has what matters.
    logging.getLogger("ezdxf").setLevel(logging.ERROR)
    words = sys.argv[1:] if argv is None else argv
    command = words[0] if words else ""
    if _MOVED.fullmatch(command):
        print(f"error: `lalaloc {command}` is now `lalaloc lab {command}`", file=sys.stderr)
        return 2
    arguments = build_parser(with_lab=command in _WITH_LAB).parse_args(words)
    try:
        _check_written(vars(arguments))
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
    except (InvalidInputError, ConfigError) as error:
        print(f"error: {with_options(error) if isinstance(error, InvalidPhotographError) else error}", file=sys.stderr)
        return 2
    except LaLaLocError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("lalaloc"):
            raise
        extra = {"mcp": "mcp", "lab": "train", "bench": "train"}.get(command, "service")
        print(f"error: {MissingExtraError(f'`lalaloc {command}`', extra)}", file=sys.stderr)
        return 1
    return 0


def _check_written(values: Mapping[str, object]) -> None:
    """Refuse to write over a file that is read."""
    given = [(name, path) for name, value in values.items() for path in (value if isinstance(value, list) else [value])]
    paths = [(name, path) for name, path in given if isinstance(path, Path)]
    read = [path for name, path in paths if name not in (*_WRITTEN, "bundle") and os.path.exists(path)]
    for path in [path for path in read if path.suffix.lower() in (".yaml", ".yml") and path.is_file()]:
        from lalaloc_core.importers.formats.ros import map_picture

        read += [picture] if (picture := map_picture(path)).exists() else []
    # Several files are numbered.
    named = [path for name, path in paths if name in _WRITTEN and path.name]
    numbered = (path.parent.glob(f"{escape(path.stem)}-[0-9]*{escape(path.suffix)}") for path in named)
    for out in filter(os.path.isfile, chain(named, *numbered)):
        # Of a folder, the pictures are read.
        if any(map(out.samefile, read)) or (any(map(out.parent.samefile, read)) and _is_picture(out)):
            raise InvalidInputError(f"'{out}' is read and never changed; write another file")


def _is_picture(path: Path) -> bool:
    from lalaloc_core.photograph.picture_folders import PICTURES

    return path.suffix.lower() in PICTURES


def build_parser(*, with_lab: bool = True) -> argparse.ArgumentParser:
    """Build the parser of all commands; those of the laboratory have their options only if `with_lab`."""
    parser = argparse.ArgumentParser(prog="lalaloc", description="Localise photographs in floor plans.")
    parser.add_argument("--version", action="version", version=f"lalaloc {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (localising, pinning, encoding, tracking, plans):
        group.add_commands(commands)
    mcp = commands.add_parser("mcp", help="serve tools of a LaLaLoc service to assistants (Model Context Protocol)")
    add_options(mcp, _MCP_OPTIONS, url={"default": "http://127.0.0.1:8000"})
    mcp.set_defaults(run=_serve_assistants)
    bench = commands.add_parser("bench", help="measure the figures of the results page and print them as JSON")
    laboratory = commands.add_parser(
        "lab", help="train, measure and export models, by configuration files and options (docs/how-to/train.md)"
    )
    if with_lab:
        from lalaloc_core.cli import evaluation, lab, measuring, training

        lab.add_options(bench, measuring.COMMANDS["bench"])
        actions = laboratory.add_subparsers(required=True, metavar="COMMAND")
        for name, command in (training.COMMANDS | evaluation.COMMANDS | measuring.COMMANDS).items():
            lab.add_options(actions.add_parser(name, help=lab.summary(command)), command)
    completion = commands.add_parser(
        "completion", help='print the shell completion script: eval "$(lalaloc completion bash)"'
    )
    completion.add_argument("shell", choices=("bash", "zsh", "fish"), help="shell")
    completion.set_defaults(run=lambda arguments: _complete(parser, arguments.shell))
    return parser


def _serve_assistants(arguments: argparse.Namespace) -> None:
    given = [] if arguments.http is None else [f"--http={arguments.http}"]
    sys.argv = ["lalaloc mcp", f"--url={arguments.url}", *given]
    runpy.run_module("lalaloc_client.mcp_server", run_name="__main__")


def _complete(parser: argparse.ArgumentParser, shell: str) -> None:
    import shtab

    print(shtab.complete(parser, shell=shell))
