"""`lalaloc photographs`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from lalaloc_core.cli.arguments import processes
from lalaloc_core.learn.data.annotated import GALLERIES
from lalaloc_core.localise.bundle import default_bundle


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    photographs = commands.add_parser(
        "photographs", help="measure a model on annotated photographs of real rooms, and draw what it reads there"
    )
    photographs.add_argument("--data", type=Path, required=True, metavar="DIR", help="folder of annotated photographs")
    photographs.add_argument("--bundle", type=Path, default=default_bundle(), help="model (default: %(default)s)")
    photographs.add_argument(
        "--galleries",
        type=int,
        choices=range(1, GALLERIES + 1),
        default=GALLERIES,
        help="plans that every photograph is asked for in (default: %(default)s)",
    )
    photographs.add_argument("--workers", type=processes, metavar="N", help="processes; default: one per core")
    photographs.add_argument(
        "--out", type=Path, default=Path("photographs"), metavar="FOLDER", help="default: %(default)s"
    )
    photographs.set_defaults(run=_photographs)


def _photographs(arguments: argparse.Namespace) -> None:
    from lalaloc_core.evaluate.report.photographs import SHEET_FILE, evaluate_photographs

    results = evaluate_photographs(
        arguments.data,
        arguments.bundle,
        arguments.out,
        galleries=arguments.galleries,
        workers=arguments.workers,
        command=shlex.join(["lalaloc", *sys.argv[1:]]),
    )
    print(results.markdown())
    print(f"drawn in {arguments.out / SHEET_FILE}")
