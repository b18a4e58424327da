"""`lalaloc bench`, `lalaloc photographs` and `lalaloc reproduce`: published figures of a model."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from lalaloc_core.cli.options import add_options, count, positive
from lalaloc_core.cli.printing import print_json
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.files import default_bundle
from lalaloc_core.learn.dataset_names import GALLERIES

_GROUPS = (
    "rendering",
    "service",
    "accuracy",
    "views",
    "turns",
    "films",
    "bounds",
    "steps",
    "albums",
    "localisability",
    "uninformative",
    "evidence",
    "azimuths",
    "terms",
    "heights",
    "copies",
    "methods",
    "datasets",
)


def add_commands(commands: Any) -> None:
    """Add these commands to the parser."""
    _add_bench(commands)
    _add_photographs(commands)
    _add_reproduce(commands)


def _add_bench(commands: Any) -> None:
    bench = commands.add_parser("bench", help="measure the figures of the results page and print them as JSON")
    add_options(bench, "--bundle", "--textures")
    bench.add_argument(
        "--homes", type=int, default=250, help="test homes per accuracy figure, 4 queries each (default: %(default)s)"
    )
    bench.add_argument("--out", type=Path, metavar="FILE", help="also write the JSON to FILE; --only updates FILE")
    bench.add_argument(
        "--annotated",
        type=Path,
        metavar="DIR",
        help="folder of annotated photographs, for albums, bounds and films of real rooms",
    )
    bench.add_argument("--only", choices=_GROUPS, action="append", help="one group of figures; repeat for more")
    bench.add_argument(
        "--profile", action="store_true", help="print the time of each stage of a query instead of measuring figures"
    )
    bench.add_argument("--queries", type=count, default=10, help="queries for --profile (default: %(default)s)")
    bench.set_defaults(run=_bench)


def _add_photographs(commands: Any) -> None:
    photographs = commands.add_parser(
        "photographs", help="measure a model on annotated photographs of real rooms and draw its predictions"
    )
    photographs.add_argument("--data", type=Path, required=True, metavar="DIR", help="folder of annotated photographs")
    photographs.add_argument(
        "--galleries",
        type=int,
        choices=range(GALLERIES + 1),
        default=GALLERIES,
        help="number of plans to locate every photograph in; 0 measures walls and openings only (default: %(default)s)",
    )
    photographs.add_argument(
        "--view", type=positive, action="append", default=[], metavar="DEG", help="also views of this field; repeatable"
    )
    add_options(photographs, "--bundle", "--workers")
    photographs.add_argument(
        "--out", type=Path, default=Path("photographs"), metavar="DIR", help="folder of results (default: %(default)s)"
    )
    photographs.set_defaults(run=_photographs)


def _add_reproduce(commands: Any) -> None:
    reproduce = commands.add_parser("reproduce", help="measure a table of the paper and print it beside the paper's")
    reproduce.add_argument("--list", action="store_true", dest="only_list", help="list the tables and exit")
    reproduce.add_argument("--table", action="append", default=[], metavar="NAME", help="table; repeat for more")
    reproduce.add_argument("--all", action="store_true", dest="every", help="all tables")
    reproduce.add_argument("--data", type=Path, metavar="DIR", help="data set: Structured3D or the output of synth")
    reproduce.add_argument(
        "--budget",
        choices=("small", "full"),
        default="small",
        help="amount of training and of queries per row (default: %(default)s)",
    )
    reproduce.add_argument(
        "--out",
        type=Path,
        default=Path("runs/reproduce"),
        metavar="DIR",
        help="folder of models, runs and tables (default: %(default)s)",
    )
    reproduce.add_argument("--limit", type=count, metavar="N", help="queries per row (default: by --budget)")
    add_options(reproduce, "--skip-bad", "--workers")
    reproduce.add_argument(
        "--bundle", type=Path, default=default_bundle(), help="model bundle of the shipped model's rows"
    )
    reproduce.set_defaults(run=_reproduce)


def _bench(arguments: argparse.Namespace) -> None:
    if arguments.profile:
        from lalaloc_core.bundle import Bundle
        from lalaloc_core.evaluate.bench.query_profile import profile_table

        print(profile_table(Bundle.open(arguments.bundle), arguments.queries, arguments.textures))
        return
    from lalaloc_core.evaluate.bench.benchmarks import run_bench

    groups = arguments.only or _GROUPS
    report = run_bench(
        arguments.bundle, groups, homes=arguments.homes, textures=arguments.textures, annotated=arguments.annotated
    )
    if arguments.out is not None:
        keep = bool(arguments.only) and arguments.out.exists()
        before = json.loads(arguments.out.read_text(encoding="utf-8")) if keep else {}
        arguments.out.write_text(json.dumps(before | report, indent=2) + "\n", encoding="utf-8")
    print_json(report)


def _photographs(arguments: argparse.Namespace) -> None:
    from lalaloc_core.evaluate.report.photograph_report import SHEET_FILE, evaluate_photographs

    results = evaluate_photographs(
        arguments.data,
        arguments.bundle,
        arguments.out,
        galleries=arguments.galleries,
        workers=arguments.workers,
        views_deg=arguments.view,
        command=shlex.join(["lalaloc", *sys.argv[1:]]),
    )
    print(results.markdown())
    print(f"pictures: {arguments.out / SHEET_FILE}")


def _reproduce(arguments: argparse.Namespace) -> None:
    from lalaloc_core.evaluate.reproduce.paper_tables import TABLES

    if arguments.only_list:
        for table in TABLES:
            print(f"{table.name:20} {table.title} (paper: {table.source}, {table.split} split)")
        return
    known = {table.name: table for table in TABLES}
    unknown = [name for name in arguments.table if name not in known]
    if unknown:
        raise InvalidInputError(f"unknown table '{unknown[0]}'; --table is one of {', '.join(known)}")
    chosen = list(TABLES) if arguments.every else [known[name] for name in arguments.table]
    if not chosen:
        raise InvalidInputError("no table is chosen; use --table NAME, --all or --list")
    if arguments.data is None:
        raise InvalidInputError("--data is missing; give the folder of Structured3D or the output of `lalaloc synth`")

    from lalaloc_core.evaluate.reproduce.result import markdown
    from lalaloc_core.evaluate.reproduce.table_maker import TableMaker

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
