"""`lalaloc reproduce`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from lalaloc_core.cli.arguments import count, processes
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.localise.bundle import default_bundle


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    reproduce = commands.add_parser("reproduce", help="run a table of the paper, with the paper's figures beside ours")
    reproduce.add_argument("--list", action="store_true", dest="only_list", help="list the tables and end")
    reproduce.add_argument("--table", action="append", default=[], metavar="NAME", help="a table; again for more")
    reproduce.add_argument("--all", action="store_true", dest="every", help="every table")
    reproduce.add_argument("--data", type=Path, metavar="DIR", help="the data set")
    reproduce.add_argument("--budget", choices=("small", "full"), default="small", help="training and queries per row")
    reproduce.add_argument("--out", type=Path, default=Path("runs/reproduce"), help="models, runs and tables")
    reproduce.add_argument("--bundle", type=Path, default=default_bundle(), help="model of the rows `ring`")
    reproduce.add_argument("--limit", type=count, metavar="N", help="queries per row; default: the budget's")
    reproduce.add_argument("--workers", type=processes, metavar="N", help="processes; default: one per core")
    reproduce.add_argument("--skip-bad", action="store_true", help="leave out and count what cannot be used")
    reproduce.set_defaults(run=_reproduce)


def _reproduce(arguments: argparse.Namespace) -> None:
    from lalaloc_core.evaluate.reproduce.tables import TABLES

    if arguments.only_list:
        for table in TABLES:
            print(f"{table.name:20} {table.title} (paper: {table.source}, {table.split} split)")
        return
    known = {table.name: table for table in TABLES}
    unknown = [name for name in arguments.table if name not in known]
    if unknown:
        raise InvalidInputError(f"no table '{unknown[0]}', there are: {', '.join(known)}")
    chosen = list(TABLES) if arguments.every else [known[name] for name in arguments.table]
    if not chosen:
        raise InvalidInputError("name a table with --table, or use --all or --list")
    if arguments.data is None:
        raise InvalidInputError("--data is missing: Structured3D, or what `lalaloc synth` writes")

    from lalaloc_core.evaluate.reproduce.result import markdown
    from lalaloc_core.evaluate.reproduce.run import TableMaker

    table_maker = TableMaker(
        data=arguments.data,
        out=arguments.out,
        budget=arguments.budget,
        shipped=arguments.bundle,
        limit=arguments.limit,
        workers=arguments.workers,
        skip_bad=arguments.skip_bad,
        command=shlex.join(["lalaloc", *sys.argv[1:]]),
    )
    for table in chosen:
        print(markdown(table_maker.make(table)))
