"""Latency of one tenant beside another that sends the heaviest accepted input to one route.

    python -m benchmarks.neighbours --json docs/neighbours.json

Every row of the table is measured with default settings, API keys and no rate limits, on a service of its own unless it
only reads. One tenant asks `/localise` on a small plan: alone, beside the other tenant, and alone again. The other
tenant repeats its request on several connections, until at least one was answered; its process has a low CPU priority,
as if it ran on another machine. The exit status is 1 when a ratio exceeds 3, a query of the first tenant fails, or the
service refuses an input that it should accept or answers none within half a minute.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import re
import shutil
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import psutil

from benchmarks import harness, heaviest
from examples.truth import PLAN_PATH
from service.security import Permission
from service.security.keys import hash_of, key_text, new_secret
from service.settings import Settings
from service.storage import open_store

MAX_RATIO = 3.0
_SETTINGS = {"LALALOC_API_KEYS": "on", "LALALOC_KEEP_ANSWERS_S": "3600"}
_SETTINGS |= {"LALALOC_RATE_PER_MINUTE": "0", "LALALOC_RATE_BURST": "0"}
_TOO_MANY = frozenset({0, 429, 503, 507})
_ACCEPTED = frozenset({200, 201, 204, 304})
_PAUSE_S, _LEAD_S, _WARM_QUERIES = 0.05, 1.0, 5
_IDLE_SHARE, _IDLE_WINDOW_S, _IDLE_TIMEOUT_S = 0.1, 0.25, 10.0
_READY_TIMEOUT_S, _ANSWER_TIMEOUT_S = 600.0, 30.0
_NICE = 10


@dataclass(frozen=True)
class Template:
    """Data folder with the resources and keys of both tenants, copied for every row."""

    data: Path
    heavy_key: str
    light_key: str
    light_plan_id: str
    stored: Mapping[str, heaviest.Stored]


@dataclass(frozen=True)
class Latency:
    """Queries of the light tenant."""

    count: int
    failed: int
    p50_ms: float
    p99_ms: float


@dataclass(frozen=True)
class Row:
    """Measurement of one load: `answers` of the heavy tenant by status (0: a broken connection), and how long the
    service computed on after it, 10 s at most.
    """

    routes: Sequence[str]
    title: str
    connections: int
    alone: Latency
    beside: Latency
    p50_ratio: float
    p99_ratio: float
    answers: Mapping[str, int]
    busy_s: float


def main() -> int:
    """Measure and print the table; return 1 when a limit is exceeded."""
    parser = harness.argument_parser(__doc__)
    parser.add_argument(
        "--rows", default="", help="measure the rows whose 'route, input' match this regular expression"
    )
    parser.add_argument("--seconds", type=float, default=4.0, help="time beside the other tenant, and alone")
    parser.add_argument("--homes", type=int, default=100, help="homes of the venue; 10000 are accepted")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    if missing := heaviest.missing_routes():
        parser.exit(1, f"no entry in benchmarks/heaviest.py for: {', '.join(missing)}\n")
    loads = [
        replace(load, title=load.title.format(homes=options.homes))
        for load in heaviest.LOADS
        if any(re.search(options.rows, f"{route}, {load.title}") for route in load.routes)
    ]
    rows = []
    with _template(options.homes, {load.plan for load in loads}) as template:
        print(_HEAD)
        measured = (_measure(group, template, options.seconds) for group in _groups(loads))
        for row in itertools.chain.from_iterable(measured):
            rows.append(row)
            print(_line(asdict(row)), flush=True)
    if options.json:
        report = {
            "command": f"python -m benchmarks.neighbours --seconds {options.seconds:g} --homes {options.homes}",
            "cores": len(os.sched_getaffinity(0)),
            "rows": [asdict(row) for row in rows],
        }
        options.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    failed = [row for row, load in zip(rows, loads, strict=True) if not _holds(row, load.refusals)]
    for row in failed:
        print(f"exceeded: {row.routes[0]}, {row.title}", file=sys.stderr)
    return int(bool(failed))


_HEAD = harness.table_head(
    *("route", "input", "connections", "alone: p50, p99", "beside: p50, p99"),
    *("ratios", "failed", "answers by status", "busy after"),
)


def markdown(report: Mapping[str, Any]) -> str:
    """Return the table of a report that `--json` wrote."""
    return "\n".join([_HEAD, *map(_line, report["rows"])])


def _line(row: Mapping[str, Any]) -> str:
    times = [f"{row[part]['p50_ms']:.0f}, {row[part]['p99_ms']:.0f} ms" for part in ("alone", "beside")]
    answers = ", ".join(f"{count} × {status}" for status, count in sorted(row["answers"].items())) or "none"
    ratios = f"{row['p50_ratio']:.1f}, {row['p99_ratio']:.1f}"
    routes = ", ".join(f"`{route}`" for route in row["routes"])
    cells = (routes, row["title"], row["connections"], *times, ratios, row["beside"]["failed"], answers)
    return harness.table_row(*cells, f"{row['busy_s']:.1f} s")


def _holds(row: Row, refusals: frozenset[int]) -> bool:
    """Return True if the light tenant was served, and the heavy one's input was treated as expected."""
    expected = {str(status) for status in _TOO_MANY | _ACCEPTED | refusals}
    served = row.p50_ratio <= MAX_RATIO and row.p99_ratio <= MAX_RATIO and not row.beside.failed
    answered = row.answers.keys() - {str(status) for status in _TOO_MANY}
    return served and bool(answered) and row.answers.keys() <= expected


@contextmanager
def _template(homes: int, plans: set[str]) -> Iterator[Template]:
    """Store the plans, the venue and the keys, and wait until all pose grids are ready."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        data.mkdir()
        keys = {tenant: _new_key(data, tenant) for tenant in ("heavy", "light")}
        # Reading the plans is not measured, and must not fail on a busy machine.
        settings = _SETTINGS | {"LALALOC_MAX_IMPORT_S": "600"}
        with harness.started_service(data, settings) as service:
            light, heavy = harness.Caller(service.url, keys["light"]), harness.Caller(service.url, keys["heavy"])
            light_plan_id = heaviest.created_id(light.send("POST", "/floorplans", PLAN_PATH.read_bytes()))
            venue_id, _, member_ids = heaviest.store_venue(heavy, homes)
            bodies = {name: json.dumps(heaviest.building(*heaviest.PLANS[name])).encode() for name in plans}
            plan_ids = {
                name: heaviest.created_id(heavy.send("POST", "/floorplans", body)) for name, body in bodies.items()
            }
            preparing = lambda: heavy.send("GET", "/readyz").json()["plans_preparing"]  # noqa: E731
            harness.wait_until(lambda: not preparing(), "all plans are ready", _READY_TIMEOUT_S, 0.2)
            venue = venue_id, heavy.send("GET", f"/venues/{venue_id}").etag, member_ids
            stored = {name: heaviest.Stored.of(heavy, plan_id, *venue) for name, plan_id in plan_ids.items()}
        yield Template(data, keys["heavy"], keys["light"], light_plan_id, stored)


def _new_key(data: Path, tenant: str) -> str:
    secret = new_secret()
    with closing(open_store(Settings(data_dir=data))) as store:
        key = store.keys.create(tenant, tenant, hash_of(secret), [str(scope) for scope in Permission])
    return key_text(key.id, secret)


def _groups(loads: Iterable[heaviest.Load]) -> Iterator[list[heaviest.Load]]:
    """Yield loads that share a service: neighbours in the table that only read, and each of the others alone."""

    def key(load: heaviest.Load) -> heaviest.Load | None:
        return None if all(route.startswith("GET ") for route in load.routes) else load

    for _, group in itertools.groupby(loads, key):
        yield list(group)


def _measure(loads: Sequence[heaviest.Load], template: Template, seconds: float) -> Iterator[Row]:
    """Measure loads one after the other on a fresh service with a copy of the data folder."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        shutil.copytree(template.data, data)
        with harness.started_service(data, _SETTINGS) as service:
            process, probe = service.process, _Probe(service.url, template, loads[0])
            for _ in range(_WARM_QUERIES):
                probe.ask()
            _idle_after(process)
            before = probe.run(seconds / 2.0)
            for load in loads:
                with _flood(service.url, template, load) as (answers, answered):
                    time.sleep(_LEAD_S)
                    beside = probe.run(seconds)
                    beside += probe.run(_ANSWER_TIMEOUT_S - seconds, answered)
                busy_s = _idle_after(process)
                after = probe.run(seconds / 2.0)
                # Albums are still solved after the flood, between rests in which the service looks idle.
                alone, others = _latency(before if load.beside_albums else before + after), _latency(beside)
                ratios = others.p50_ms / alone.p50_ms, others.p99_ms / alone.p99_ms
                yield Row(load.routes, load.title, load.connections, alone, others, *ratios, answers, busy_s)
                before = after
            # Work that is still in progress belongs to no other row.
            for child in process.children(recursive=True):
                child.kill()
            process.kill()


class _Probe:
    """Queries of the light tenant, or its albums, one after the other."""

    def __init__(self, url: str, template: Template, load: heaviest.Load) -> None:
        self._pins = load.beside_albums
        self._caller = harness.Caller(url, template.light_key)
        self._plan_id = template.light_plan_id
        self._numbers = itertools.count()

    def ask(self) -> float:
        """Return the duration (s) of one query; infinite if it failed."""
        query = harness.example_query(next(self._numbers), self._plan_id)
        begin = time.perf_counter()
        if self._pins:
            is_answered = bool(heaviest.store_album(self._caller, self._plan_id))
        else:
            is_answered = self._caller.send("POST", "/localise", *query).status == 200
        if not is_answered:
            time.sleep(_PAUSE_S)
            return math.inf
        return time.perf_counter() - begin

    def run(self, seconds: float, ended: Callable[[], bool] = lambda: False) -> list[float]:
        """Return the durations (s) of queries for a time, or until `ended`."""
        end, durations_s = time.monotonic() + seconds, []
        while time.monotonic() < end and not ended():
            durations_s.append(self.ask())
        return durations_s


def _lower_priority() -> None:
    """Leave the processor to others; where Linux groups processes by session, the session's priority counts."""
    os.nice(_NICE)
    with suppress(OSError):
        os.setsid()
        Path("/proc/self/autogroup").write_text(str(_NICE))


def _latency(durations_s: Sequence[float]) -> Latency:
    p50_s, p99_s = statistics.median(durations_s), harness.percentile(durations_s, 99)
    return Latency(len(durations_s), durations_s.count(math.inf), 1e3 * p50_s, 1e3 * p99_s)


@contextmanager
def _flood(url: str, template: Template, load: heaviest.Load) -> Iterator[tuple[dict[str, int], Callable[[], bool]]]:
    """Repeat a load in another process."""
    # The work itself cannot be sent to a process, so its place in the table is.
    number = [known.work for known in heaviest.LOADS].index(load.work)
    arguments = (url, template.heavy_key, number, load.size, template.stored[load.plan])
    answers: dict[str, int] = {}
    with harness.child_process(_send_flood, *arguments) as pipe:
        pipe.recv()
        yield answers, pipe.poll
        pipe.send("end")
        while isinstance(message := pipe.recv(), str):
            pass
        answers |= message


def _send_flood(url: str, key: str, number: int, size: int, stored: heaviest.Stored, pipe: Connection) -> None:
    _lower_priority()
    load = heaviest.LOADS[number]
    counts: Counter[int] = Counter()
    lock = threading.Lock()

    def count(status: int) -> None:
        with lock:
            if status not in _TOO_MANY and not counts.keys() - _TOO_MANY:
                pipe.send("answered")
            counts[status] += 1
        if status in _TOO_MANY:
            time.sleep(_PAUSE_S)

    def repeat() -> None:
        caller = harness.Caller(url, key, count)
        while True:
            load.work(caller, stored, size)

    # The bodies are made before they are needed.
    load.work(harness.Rehearsal(url), stored, size)
    for _ in range(load.connections):
        threading.Thread(target=repeat, daemon=True).start()
    pipe.send("begun")
    pipe.recv()
    with lock:
        pipe.send({str(status): number for status, number in counts.items()})


def _idle_after(process: psutil.Process) -> float:
    """Wait until the service computes nothing, for 10 s at most; return the time (s)."""
    begin = time.monotonic()
    while (waited_s := time.monotonic() - begin) < _IDLE_TIMEOUT_S:
        before_s = harness.cpu_s(process)
        time.sleep(_IDLE_WINDOW_S)
        if harness.cpu_s(process) - before_s < _IDLE_SHARE * _IDLE_WINDOW_S:
            break
    return waited_s


if __name__ == "__main__":
    sys.exit(main())
