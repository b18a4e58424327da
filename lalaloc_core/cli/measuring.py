"""`lalaloc bench`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from lalaloc_core.cli.arguments import count
from lalaloc_core.cli.printing import print_json
from lalaloc_core.localise.bundle import default_bundle

_GROUPS = (
    "rendering",
    "service",
    "accuracy",
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
    bench = commands.add_parser("bench", help="measure the figures of docs/results.md and print them as JSON")
    bench.add_argument("--bundle", type=Path, default=default_bundle())
    bench.add_argument("--homes", type=int, default=250, help="test homes per accuracy figure, 4 queries each")
    bench.add_argument("--textures", type=Path, help="folder of material pictures for the test panoramas")
    bench.add_argument("--out", type=Path, help="also write the JSON to this file; with --only, into it")
    bench.add_argument("--only", choices=_GROUPS, action="append", help="a group of figures; again for more")
    bench.add_argument(
        "--profile", action="store_true", help="print where the time of one query goes, and nothing else"
    )
    bench.add_argument(
        "--queries", type=count, default=10, help="queries that --profile looks at (default: %(default)s)"
    )
    bench.set_defaults(run=_bench)


def _bench(arguments: argparse.Namespace) -> None:
    if arguments.profile:
        from lalaloc_core.evaluate.bench.profile import profile_table
        from lalaloc_core.localise.bundle import Bundle

        print(profile_table(Bundle.open(arguments.bundle), arguments.queries, arguments.textures))
        return
    from lalaloc_core.evaluate.bench.report import run_bench

    groups = arguments.only or _GROUPS
    report = run_bench(arguments.bundle, groups, homes=arguments.homes, textures=arguments.textures)
    if arguments.out is not None:
        keep = bool(arguments.only) and arguments.out.exists()
        before = json.loads(arguments.out.read_text(encoding="utf-8")) if keep else {}
        arguments.out.write_text(json.dumps(before | report, indent=2) + "\n", encoding="utf-8")
    print_json(report)
