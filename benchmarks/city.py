"""Figures of very many plans and of many queries, of one or two checkouts, as a Markdown table.

    git worktree add ../before v0.9.0
    python -m benchmarks.city ../before .
    python -m benchmarks.city . --only venue --plans 10000

Each checkout runs the service of its own code with this interpreter; set-up uses its own. Single plans are measured
with both services at once, in turns (`benchmarks.pairs`), a venue over HTTP in one after the other
(`benchmarks.large_venue`, the older one by single uploads), and the index among generated homes with near-copies in
this process (`benchmarks.index_recall`): before and after stand for without and with alignment there. `--only accuracy`
needs `--photographs` and compares the answers of both on validation homes and photographs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import argument_parser, print_table_head, table_row
from benchmarks.index_recall import recall
from benchmarks.large_venue import measure
from benchmarks.pairs import bursts_of, differences_of, running_checkout
from lalaloc_core.bundle import Bundle, default_bundle

# Figure, aim, and one value per checkout.
_Row = tuple[str, str, Sequence[str]]
_NONE = "–"
_SHARES = ("within_1m", "within_10cm")
_ROUNDS, _QUERIES = 6, 80


def single_plans(checkouts: Sequence[Path], _options: argparse.Namespace) -> Iterator[_Row]:
    """Yield duration and rate of queries of one plan, and whether the answers differ."""
    with ExitStack() as stack:
        running = [stack.enter_context(running_checkout(folder)) for folder in checkouts]
        p50_ms = {}
        for known, heading, aim_ms in ((True, "known", 22), (False, "unknown", 30)):
            alone = bursts_of(running, _ROUNDS, _QUERIES, 1, known=known)
            p50_ms[known] = [float(np.median(burst.durations_ms)) for burst in alone.values()]
            yield f"`/localise` p50, heading {heading}", f"≤ {aim_ms} ms", [f"{ms:.0f} ms" for ms in p50_ms[known]]
        crowd = list(bursts_of(running, _ROUNDS, _QUERIES, 4, known=True).values())
        yield "queries a second at saturation", "≥ 80", [f"{burst.per_second:.0f}" for burst in crowd]
        ratios = [
            float(np.percentile(burst.durations_ms, 99)) / ms for burst, ms in zip(crowd, p50_ms[True], strict=True)
        ]
        yield "p99 at four clients over p50 of one", "≤ 2.5", [f"{ratio:.1f}" for ratio in ratios]
        if len(running) == 2:
            found = ", ".join(f"{name} {value:.1e}" for name, value in differences_of(*running).items())
            yield "largest differences of the answers", "0", [_NONE, found]


def venue(checkouts: Sequence[Path], options: argparse.Namespace) -> Iterator[_Row]:
    """Yield the figures of a venue of many plans over HTTP, and of one of very many in the last checkout."""
    reports = []
    for folder in checkouts:
        is_last = folder == checkouts[-1]
        reports.append(measure(options.plans, one_by_one=not is_last, checkout=folder, changes=is_last))
    yield from _venue_rows(reports, options.plans)
    if options.many_plans:
        report = measure(options.many_plans, checkout=checkouts[-1])
        blank = [_NONE] * (len(checkouts) - 1)
        yield from ((name, aim, [*blank, *cells]) for name, aim, cells in _venue_rows([report], options.many_plans))


def _venue_rows(reports: Sequence[dict[str, Any]], plans: int) -> Iterator[_Row]:
    def cells(show: Callable[[dict[str, Any]], str]) -> list[str]:
        return [show(report) for report in reports]

    prefix = f"{plans:,} plans over HTTP: "
    yield prefix + "until ready", "≤ 30 s", cells(lambda report: f"{report['until_ready']['wall_ms'] / 1e3:.0f} s")
    for heading in ("known", "unknown"):
        name = f"heading_{heading}"
        yield (
            f"{prefix}query, heading {heading}, p50; index alone",
            "≤ 150 ms" if plans <= 10_000 else "≤ 100 ms alone",
            cells(lambda report, name=name: _query_times(report["queries"][name])),
        )
    yield (
        prefix + "resident memory, ready; after queries",
        "≤ 500 MB",
        cells(lambda report: f"{report['resident_mb']['ready']}; {report['resident_mb']['localised']} MB"),
    )
    yield (prefix + "slowest change of one plan, until it is searched rightly", "≤ 1 s", cells(_slowest_change))
    yield prefix + "first query after a kill", _NONE, cells(_after_kill)
    yield prefix + "all as expected", "yes", cells(_as_expected)


def _query_times(figures: dict[str, Any]) -> str:
    return f"{figures['p50']['wall_ms']:.0f}; {figures['index_ms']:.0f} ms"


def _slowest_change(report: dict[str, Any]) -> str:
    if "changes" not in report:
        return _NONE
    return f"{max(change['until_answered']['wall_ms'] for change in report['changes'].values()) / 1e3:.2f} s"


def _after_kill(report: dict[str, Any]) -> str:
    return f"{report['after_kill']['first_query']['wall_ms'] / 1e3:.2f} s" if "after_kill" in report else _NONE


def _as_expected(report: dict[str, Any]) -> str:
    expected = report.get("expected", {"queries": report["queries"]["right"]})
    return "yes" if all(expected.values()) else f"no: {json.dumps(expected)}"


def index(checkouts: Sequence[Path], options: argparse.Namespace) -> Iterator[_Row]:
    """Yield recall and time of the index, without and with alignment."""
    both = len(checkouts) == 2
    for plans in options.index_plans:
        found = recall(Bundle.open(default_bundle()), plans, options.queries)
        for name in ("heading known", "heading unknown", "heading and height unknown"):
            rows = [found[f"{name}, not aligned"], found[name]] if both else [found[name]]
            yield (
                f"{plans:,} plans: right among 20, {name} (n = {options.queries}); index alone, p50",
                "≥ 95 %; ≤ 100 ms",
                [f"{100 * row['right_among_20']:.0f} %; {row['cpu_ms_p50']:.0f} ms" for row in rows],
            )


def set_up(checkouts: Sequence[Path], options: argparse.Namespace) -> Iterator[_Row]:
    """Yield the durations of set-up and tests of a fresh clone."""
    durations_s: dict[str, list[str]] = {"setup": [], "test": []}
    for folder in checkouts:
        with tempfile.TemporaryDirectory() as parent:
            clone = Path(parent) / folder.name
            subprocess.run(["git", "clone", "--quiet", folder, clone], check=True)
            head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=folder, check=True, capture_output=True, text=True)
            subprocess.run(["git", "checkout", "--quiet", head.stdout.strip()], cwd=clone, check=True)
            for target, found in durations_s.items():
                if target == "test" and not options.tests:
                    continue
                begin = time.perf_counter()
                done = subprocess.run(["make", target], cwd=clone, check=False, capture_output=True)
                passed = "" if done.returncode == 0 else ", failed"
                found.append(f"{time.perf_counter() - begin:.0f} s{passed}")
    yield "set-up of a fresh clone", "≤ 60 s", durations_s["setup"]
    if options.tests:
        yield "`make test`", "≤ 480 s", durations_s["test"]


def accuracy(checkouts: Sequence[Path], options: argparse.Namespace) -> Iterator[_Row]:
    """Yield the accuracy on validation homes and on annotated photographs."""
    for heading in ("known", "unknown"):
        reports = []
        for folder in checkouts:
            command = ["evaluate", "--split", "validation", "--homes", "60", "--heading", heading, "--json"]
            reports.append(json.loads(_lalaloc(folder, *command)))
        yield (
            f"60 validation homes, heading {heading}: < 1 m; < 10 cm",
            "-0.3 points",
            ["; ".join(f"{100 * report['final'][share]['value']:.1f} %" for share in _SHARES) for report in reports],
        )
    if options.photographs is not None:
        yield (
            "photographs: located, heading known; unknown",
            "-0.3 points",
            [_located_shares(folder, options.photographs) for folder in checkouts],
        )


def _located_shares(checkout: Path, photographs: Path) -> str:
    with tempfile.TemporaryDirectory() as out:
        _lalaloc(checkout, "photographs", "--data", str(photographs.resolve()), "--out", out)
        galleries = json.loads((Path(out) / "photographs.json").read_text(encoding="utf-8"))["galleries"]
    return "; ".join(f"{100 * galleries[heading]['located']:.1f} %" for heading in ("known", "unknown"))


def _lalaloc(checkout: Path, *arguments: str) -> str:
    command = [Path(sys.executable).with_name("lalaloc"), *arguments]
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=checkout, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout


_PARTS: dict[str, Callable[[Sequence[Path], argparse.Namespace], Iterator[_Row]]] = {
    "single": single_plans,
    "venue": venue,
    "index": index,
    "set-up": set_up,
    "accuracy": accuracy,
}


def main() -> None:
    """Print the table, each row as it is measured."""
    parser = argument_parser(__doc__)
    parser.add_argument("checkouts", nargs="+", type=Path, help="one or two folders, the one before first")
    parser.add_argument("--only", choices=_PARTS, action="append", help="part of the table; repeat for more")
    parser.add_argument("--plans", type=int, default=10_000, help="plans of the venue (default: %(default)s)")
    parser.add_argument("--many-plans", type=int, default=100_000, help="of the larger one; 0 leaves it out")
    parser.add_argument("--index-plans", type=int, nargs="*", default=[10_000, 100_000], help="plans of the index")
    parser.add_argument("--queries", type=int, default=300, help="photographs of the index (default: %(default)s)")
    parser.add_argument("--photographs", type=Path, help="annotated photographs, for --only accuracy")
    parser.add_argument("--tests", action="store_true", help="also time `make test` of a fresh clone")
    options = parser.parse_args()
    if len(options.checkouts) > 2:
        parser.error(f"checkouts are {len(options.checkouts)} folders; give one or two")
    checkouts = [folder.resolve() for folder in options.checkouts]
    print_table_head("figure", "aim", *(folder.name for folder in checkouts))
    for part in options.only or _PARTS:
        for name, aim, cells in _PARTS[part](checkouts, options):
            print(table_row(name, aim, *cells), flush=True)


if __name__ == "__main__":
    main()
