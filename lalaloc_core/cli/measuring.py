"""`lalaloc bench`, `lalaloc lab photographs` and `lalaloc lab reproduce`: published figures of a model."""

from __future__ import annotations

import json
import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from lalaloc_core.cli.lab import BundleFolder, Command, SkipBad, Textures, Workers, check_range
from lalaloc_core.cli.printing import print_json
from lalaloc_core.errors import ConfigError, InvalidInputError
from lalaloc_core.files import default_bundle
from lalaloc_core.learn.dataset_names import GALLERIES

# Decimals of printed figures.
_DECIMALS = 4


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure the figures of the results page and print them as JSON."""

    only: Annotated[tuple[str, ...], "groups of figures (default: all but `album_weights`, which takes an hour)"] = ()
    bundle: BundleFolder = field(default_factory=default_bundle)
    textures: Textures = None
    homes: Annotated[int, "test homes per accuracy figure, 4 queries each"] = 250
    out: Annotated[Path | None, "also write the JSON to this file; with `only`, update it"] = None
    data: Annotated[Path | None, "folder with `annotated` and `rendered_house`, for figures of pictures by others"] = (
        None
    )
    rooms: Annotated[Path | None, "folder of path-traced rooms, for albums of them"] = None


@dataclass(frozen=True, kw_only=True)
class Photographs:
    """Measure a model on annotated photographs of real rooms."""

    data: Annotated[Path, "folder of annotated photographs"]
    galleries: Annotated[int, "number of plans to locate every photograph in; 0 measures walls and openings only"] = (
        GALLERIES
    )
    view: Annotated[tuple[float, ...], "also views of these fields, degrees"] = ()
    bundle: BundleFolder = field(default_factory=default_bundle)
    workers: Workers = None
    out: Annotated[Path, "folder of results"] = Path("photographs")


@dataclass(frozen=True, kw_only=True)
class Short:
    """Measure walls and openings of a bundle, or of a run, on pictures by others."""

    real: Annotated[Path, "folder with `annotated` and `rendered_house`"]
    rooms: Annotated[Path, "folder of path-traced rooms"]
    bundle: BundleFolder = field(default_factory=default_bundle)
    run_: Annotated[Path | None, "run whose last weights replace those of the bundle"] = None
    out: Annotated[Path | None, "folder to keep the run's weights in, with a line of figures in runs.csv"] = None
    note: Annotated[dict[str, str], "note for the line in runs.csv as KEY=VALUE"] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Measure a table of the paper and print it beside the paper's."""

    table: Annotated[tuple[str, ...], "tables"] = ()
    list_: Annotated[bool, "list the tables and exit"] = False
    all_: Annotated[bool, "all tables"] = False
    data: Annotated[Path | None, "data set: Structured3D or the output of synth"] = None
    budget: Annotated[Literal["small", "full"], "amount of training and of queries per row"] = "small"
    out: Annotated[Path, "folder of models, runs and tables"] = Path("runs/reproduce")
    limit: Annotated[int | None, "queries per row (default: by `budget`)"] = None
    skip_bad: SkipBad = False
    workers: Workers = None
    bundle: Annotated[Path, "model bundle of the shipped model's rows (default: the shipped one)"] = field(
        default_factory=default_bundle
    )


def _bench(arguments: Bench) -> None:
    check_range(arguments, 1, "homes")
    from lalaloc_core.bundle import Bundle
    from lalaloc_core.evaluate.bench.bench_groups import run_bench
    from lalaloc_core.evaluate.bench.measured import Setting

    folders = arguments.textures, arguments.data, arguments.rooms
    report = run_bench(Setting(Bundle.open(arguments.bundle), arguments.homes, *folders), arguments.only)
    if arguments.out is not None:
        keep = bool(arguments.only) and arguments.out.exists()
        before = json.loads(arguments.out.read_text(encoding="utf-8")) if keep else {}
        arguments.out.write_text(json.dumps(before | report, indent=2) + "\n", encoding="utf-8")
    print_json(report)


def _photographs(arguments: Photographs) -> None:
    check_range(arguments, 0, "workers", "galleries")
    if arguments.galleries > GALLERIES:
        raise ConfigError(f"galleries is {arguments.galleries}; the limit is {GALLERIES}")
    from lalaloc_core.evaluate.report.photograph_report import evaluate_photographs

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


def _short(arguments: Short) -> None:
    from lalaloc_core.evaluate.bench.short_table import keep_run, measure_run

    run, bundle = arguments.run_, arguments.bundle
    figures = measure_run(run, bundle, arguments.real, arguments.rooms)
    if arguments.out is not None:
        keep_run(run, bundle, figures, arguments.out, arguments.note)
    print_json(figures, _DECIMALS)


def _reproduce(arguments: Reproduce) -> None:
    check_range(arguments, 1, "limit")
    check_range(arguments, 0, "workers")
    from lalaloc_core.evaluate.reproduce.paper_tables import TABLES, markdown

    if arguments.list_:
        for table in TABLES:
            print(f"{table.name:20} {table.title} (paper: {table.source}, {table.split} split)")
        return
    known = {table.name: table for table in TABLES}
    unknown = [name for name in arguments.table if name not in known]
    if unknown:
        raise InvalidInputError(f"unknown table '{unknown[0]}'; --table is one of {', '.join(known)}")
    chosen = list(TABLES) if arguments.all_ else [known[name] for name in arguments.table]
    if not chosen:
        raise InvalidInputError("no table is chosen; use --table NAME, --all or --list")
    if arguments.data is None:
        raise InvalidInputError(
            "--data is missing; give the folder of Structured3D or the output of `lalaloc lab synth`"
        )

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


COMMANDS = {
    "bench": Command(Bench, _bench, "only"),
    "photographs": Command(Photographs, _photographs, "data"),
    "short": Command(Short, _short, "bundle"),
    "reproduce": Command(Reproduce, _reproduce, "table"),
}
