"""Venues of very many floor plans, of one or two checkouts: uploads, queries, changes of one plan, a crash and memory.

    python -m benchmarks.large_venues . --plans 10000 100000
    python -m benchmarks.large_venues ../before . --plans 10000

The plans are random homes of two rooms and the example flat. They are uploaded in files of 200 plans, which extend the
venue. All example photographs are localised in the venue, whose answer must name the flat. The pages of the venue must
list every plan once and in order. Then the flat is removed from the venue, added again, replaced and deleted: each
time, the first query must be answered by the new state. At last the service is killed and started again. Prints a
Markdown table, and exits with 1 when something was not as expected. `--json` writes all figures, with the processor
time of the service and its workers, which other work on the machine hardly changes.
"""

from __future__ import annotations

import json
import random
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks import harness
from examples.truth import PLAN_PATH, TruePose, read_poses
from lalaloc_client import Client, VenuePlan

_CLIENTS, _PAGE, _ROUNDS, _FILE = 4, 500, 3, 200
_TIMEOUT_S = 7200.0
_Report = dict[str, Any]


def random_home(number: int) -> dict[str, Any]:
    """Return a plan of two rooms with a door between them; the same for the same number."""
    rng = random.Random(number)
    width, depth, split, wall = rng.uniform(3.0, 6.0), rng.uniform(2.2, 4.5), rng.uniform(0.35, 0.65), 0.1
    middle, door = split * width, rng.uniform(0.2, depth - 1.2)
    sides = ("left", 0.0, middle), ("right", middle + wall, width)
    return {
        "name": f"home {number:05d}",
        "ceiling_height_m": round(rng.uniform(2.3, 2.9), 2),
        "camera_height_m": 1.5,
        "rooms": [{"name": name, "polygon": [[a, 0.0], [b, 0.0], [b, depth], [a, depth]]} for name, a, b in sides],
        "openings": [{"kind": "door", "line": [[middle, door], [middle, door + 0.9]]}],
    }


def make_venue(service: harness.Service, homes: int) -> str:
    """Upload homes in files that extend a venue with the example plan; return its id."""
    documents = [random_home(number) for number in range(homes)]
    files = [documents[first : first + _FILE] for first in range(0, homes, _FILE)]
    with Client(service.url, timeout_s=300.0) as client, ThreadPoolExecutor(_CLIENTS) as threads:
        venue_id = client.make_venue([VenuePlan(service.plan_id, level=0)]).id

        def extend(number: int) -> None:
            plans = [{**plan, "level": number % 5} for plan in files[number]]
            client.extend_venue(venue_id, {"plans": plans})

        list(threads.map(extend, range(len(files))))
    return venue_id


def wait_until_ready(client: httpx.Client, venue_id: str) -> dict[str, Any]:
    """Return the venue once all of its plans are ready or failed."""
    venue: dict[str, Any] = {}

    def is_ready() -> bool:
        venue.update(client.get(f"/venues/{venue_id}").raise_for_status().json())
        return venue["plans_ready"] + venue["plans_failed"] == venue["plans"]

    harness.wait_until(is_ready, "all plans of the venue are ready", _TIMEOUT_S, 1.0)
    return venue


def _times(watch: harness.Stopwatch) -> dict[str, float]:
    """Return the times (ms) of a service since a stopwatch was made."""
    wall_s, cpu_s = watch.times_s()
    return {"wall_ms": round(1e3 * wall_s), "cpu_ms": round(1e3 * cpu_s)}


class _Venue:
    """Venue of the benchmark, and its client."""

    def __init__(self, service: harness.Service, client: httpx.Client, venue_id: str) -> None:
        self._service, self._client, self._id = service, client, venue_id

    def localise(self, pose: TruePose, *, heading: bool) -> tuple[dict[str, Any], dict[str, float]]:
        """Localise an example photograph, with or without its heading; return the answer and the times."""
        query, watch = harness.query_of(pose, venue_id=self._id), harness.Stopwatch(self._service.process)
        if not heading:
            del query["data"]["heading_deg"]
        answer = self._client.post("/localise", **query).raise_for_status().json()
        return answer, _times(watch)

    def queries(self) -> _Report:
        """Localise all example photographs several times; return the median times, and whether all were right."""
        report: _Report = {"right": True}
        for name, heading in (("heading_known", True), ("heading_unknown", False)):
            found = [self.localise(pose, heading=heading) for _ in range(_ROUNDS) for pose in read_poses()]
            report["right"] &= all(answer["floorplan_id"] == self._service.plan_id for answer, _ in found)
            # The first ones read plans from the database.
            later = found[len(read_poses()) :]
            p50 = {key: float(np.median([times[key] for _, times in later])) for key in ("wall_ms", "cpu_ms")}
            index_ms = np.median([answer["timings_ms"].get("shortlist", 0.0) for answer, _ in later])
            report[name] = {"first": found[0][1], "p50": p50, "index_ms": round(float(index_ms), 1)}
        return report

    def changes(self) -> Iterator[tuple[str, _Report]]:
        """Remove, add, replace, delete and upload the plan that the photographs show."""
        path, own = f"/venues/{self._id}", f"/floorplans/{self._service.plan_id}"
        yield "removed", self._change("PATCH", path, {"remove": [self._service.plan_id]}, is_found=False)
        yield "added", self.add(self._service.plan_id)
        yield "replaced", self._change("PUT", own, random_home(0), is_found=False)
        yield "replaced again", self._change("PUT", own, json.loads(PLAN_PATH.read_text()), is_found=True)
        yield "deleted", self._change("DELETE", own, None, is_found=False)

    def add(self, plan_id: str) -> _Report:
        """Add a plan that the photographs show."""
        member = {"plans": [{"floorplan_id": plan_id, "level": 0}]}
        return self._change("PATCH", f"/venues/{self._id}", member, is_found=True, plan_id=plan_id)

    def _change(
        self, method: str, path: str, document: Mapping[str, Any] | None, *, is_found: bool, plan_id: str = ""
    ) -> _Report:
        """Change a plan; return the times until a query was answered, and whether its answer was as it should be."""
        watch = harness.Stopwatch(self._service.process)
        self._client.request(method, path, json=document).raise_for_status()
        request = _times(watch)
        answer, _ = self.localise(read_poses()[0], heading=True)
        right = (answer["floorplan_id"] == (plan_id or self._service.plan_id)) == is_found
        return {"request": request, "until_answered": _times(watch), "right": right}


@contextmanager
def _running(data: str, plans: int, checkout: Path) -> Iterator[tuple[harness.Service, httpx.Client]]:
    limits = {"LALALOC_MAX_FLOORPLANS": f"{plans + 10}", "LALALOC_MAX_VENUE_PLANS": f"{plans + 10}"}
    # 7.5 kB per home, and some to spare.
    limits["LALALOC_VENUE_CACHE_BYTES"] = f"{max(2**27, 10_000 * plans)}"
    with (
        harness.started_service(Path(data), limits, checkout) as service,
        httpx.Client(base_url=service.url, timeout=300.0) as client,
    ):
        yield service, client


def measure(plans: int, checkout: Path) -> _Report:
    """Return the figures of a venue in the service of a checkout."""
    report: _Report = {"checkout": checkout.name, "plans": plans}
    with tempfile.TemporaryDirectory() as data:
        with _running(data, plans, checkout) as (service, client):

            def resident_mb() -> int:
                return round(harness.resident_mb(service.process))

            resident = report["resident_mb"] = {"empty": resident_mb()}
            service = replace(service, plan_id=harness.upload_example_plan(service.url))
            watch = harness.Stopwatch(service.process)
            venue_id = make_venue(service, plans - 1)
            report["uploaded"] = _times(watch)
            ready = wait_until_ready(client, venue_id)
            report["until_ready"], resident["ready"] = _times(watch), resident_mb()
            with Client(service.url) as paging:
                listed = [(plan.level, plan.floorplan_id) for plan in paging.venue_plans(venue_id, page_size=_PAGE)]
            venue = _Venue(service, client, venue_id)
            report["queries"] = venue.queries()
            resident["localised"] = resident_mb()
            report["changes"] = dict(venue.changes())
            again = harness.upload_example_plan(service.url)
            report["changes"]["uploaded"] = venue.add(again)
            service.process.kill()
        with _running(data, plans, checkout) as (service, client):
            answer, times = _Venue(service, client, venue_id).localise(read_poses()[0], heading=True)
            report["after_kill"] = times
            resident["after_kill"] = round(harness.resident_mb(service.process))
    report["expected"] = {
        "all plans are ready": ready["plans_ready"] == plans,
        "pages list every plan once, in order": listed == sorted(set(listed)) and len(listed) == plans,
        "answers name the right plan": report["queries"]["right"],
        "changes take effect": all(change["right"] for change in report["changes"].values()),
        "the state outlives a crash": answer["floorplan_id"] == again,
    }
    return report


def _seconds(times: Mapping[str, float]) -> str:
    return f"{times['wall_ms'] / 1e3:.2f} s"


def _query(figures: Mapping[str, Any]) -> str:
    return f"{figures['p50']['wall_ms']:.0f}; {figures['index_ms']:.0f} ms"


def _slowest_change(report: _Report) -> str:
    return _seconds(max((c["until_answered"] for c in report["changes"].values()), key=lambda times: times["wall_ms"]))


def _as_expected(report: _Report) -> str:
    return "yes" if all(report["expected"].values()) else f"no: {json.dumps(report['expected'])}"


# Figure, aim, and the cell of a report.
_ROWS: Sequence[tuple[str, str, Callable[[_Report], str]]] = (
    ("until ready", "≤ 30 s", lambda report: _seconds(report["until_ready"])),
    ("query, heading known, p50; index alone", "≤ 150 ms", lambda report: _query(report["queries"]["heading_known"])),
    (
        "query, heading unknown, p50; index alone",
        "≤ 150 ms",
        lambda report: _query(report["queries"]["heading_unknown"]),
    ),
    (
        "resident memory, ready; after queries",
        "≤ 500 MB",
        lambda report: f"{report['resident_mb']['ready']}; {report['resident_mb']['localised']} MB",
    ),
    ("slowest change of one plan, until it is searched rightly", "≤ 1 s", _slowest_change),
    ("first query after a kill", "–", lambda report: _seconds(report["after_kill"])),
    ("all as expected", "yes", _as_expected),
)


def main() -> int:
    """Measure and print the tables; return 1 when a plan is missing or an answer is wrong."""
    parser = harness.argument_parser(__doc__)
    parser.add_argument("checkouts", nargs="+", type=Path, help="folders, the one before first")
    parser.add_argument("--plans", type=int, nargs="+", default=[10_000], help="plans of each venue")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    folders = [folder.resolve() for folder in options.checkouts]
    reports = []
    harness.print_table_head("figure", "aim", *(folder.name for folder in folders))
    for plans in options.plans:
        found = [measure(plans, folder) for folder in folders]
        reports += found
        for name, aim, cell in _ROWS:
            print(harness.table_row(f"{plans:,} plans over HTTP: {name}", aim, *map(cell, found)), flush=True)
    if options.json:
        options.json.write_text(json.dumps(reports, indent=2) + "\n", encoding="utf-8")
    return int(not all(all(report["expected"].values()) for report in reports))


if __name__ == "__main__":
    sys.exit(main())
