"""Venues of very many floor plans, of one or two checkouts: uploads, queries, changes of one plan, a crash and memory.

    python -m benchmarks.large_venues . --plans 10000 100000
    python -m benchmarks.large_venues ../before . --plans 10000

The plans are random homes of two rooms and the example flat. They are uploaded in files of 200 plans, which extend the
venue. All example photographs are localised in the venue, whose answer must name the flat. The pages of the venue must
list every plan once and in order. Then the flat is removed from the venue, added again, replaced and deleted: each
time, the first query must be answered by the new state. At last the service is killed and started again. Prints a
Markdown table, and exits with 1 when something was not as expected.
"""

from __future__ import annotations

import json
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
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


class _Venue:
    """Venue of the benchmark with the plan that the photographs show, and its client."""

    def __init__(self, plan_id: str, client: httpx.Client, venue_id: str) -> None:
        self._plan_id, self._client, self._id = plan_id, client, venue_id

    def localise(self, pose: TruePose, *, heading: bool) -> tuple[dict[str, Any], float]:
        """Localise an example photograph, with or without its heading; return the answer and the duration (s)."""
        query, begin = harness.query_of(pose, venue_id=self._id), time.perf_counter()
        if not heading:
            del query["data"]["heading_deg"]
        answer = self._client.post("/localise", **query).raise_for_status().json()
        return answer, time.perf_counter() - begin

    def queries(self, *, heading: bool) -> tuple[str, bool]:
        """Localise all example photographs several times; return the median times, and whether all were right."""
        found = [self.localise(pose, heading=heading) for _ in range(_ROUNDS) for pose in read_poses()]
        right = all(answer["floorplan_id"] == self._plan_id for answer, _ in found)
        # The first ones read plans from the database.
        later = found[len(read_poses()) :]
        p50_ms = 1e3 * float(np.median([seconds for _, seconds in later]))
        index_ms = float(np.median([answer["timings_ms"].get("shortlist", 0.0) for answer, _ in later]))
        return f"{p50_ms:.0f}; {index_ms:.0f} ms", right

    def changes(self) -> Iterator[tuple[float, bool]]:
        """Remove, add, replace, replace again and delete the plan that the photographs show."""
        path, own = f"/venues/{self._id}", f"/floorplans/{self._plan_id}"
        yield self._change("PATCH", path, {"remove": [self._plan_id]}, is_found=False)
        yield self.add(self._plan_id)
        yield self._change("PUT", own, random_home(0), is_found=False)
        yield self._change("PUT", own, json.loads(PLAN_PATH.read_text()), is_found=True)
        yield self._change("DELETE", own, None, is_found=False)

    def add(self, plan_id: str) -> tuple[float, bool]:
        """Add a plan that the photographs show."""
        member = {"plans": [{"floorplan_id": plan_id, "level": 0}]}
        return self._change("PATCH", f"/venues/{self._id}", member, is_found=True, plan_id=plan_id)

    def _change(
        self, method: str, path: str, document: Mapping[str, Any] | None, *, is_found: bool, plan_id: str = ""
    ) -> tuple[float, bool]:
        """Change a plan; return the time until a query was answered (s), and whether its answer was as it should be."""
        begin = time.perf_counter()
        self._client.request(method, path, json=document).raise_for_status()
        answer, _ = self.localise(read_poses()[0], heading=True)
        right = (answer["floorplan_id"] == (plan_id or self._plan_id)) == is_found
        return time.perf_counter() - begin, right


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


# Aims by figure.
_AIMS = {
    "until ready": "≤ 30 s",
    "query, heading known, p50; index alone": "≤ 150 ms",
    "query, heading unknown, p50; index alone": "≤ 150 ms",
    "resident memory, ready; after queries": "≤ 500 MB",
    "slowest change of one plan, until it is searched rightly": "≤ 1 s",
    "first query after a kill": "–",
    "all as expected": "yes",
}


def measure(plans: int, checkout: Path) -> tuple[dict[str, str], bool]:
    """Return the figures of a venue in the service of a checkout by name, and whether all was as expected."""
    with tempfile.TemporaryDirectory() as data:
        with _running(data, plans, checkout) as (service, client):
            plan_id = harness.upload_example_plan(service.url)
            begin = time.perf_counter()
            venue_id = make_venue(replace(service, plan_id=plan_id), plans - 1)
            ready = wait_until_ready(client, venue_id)
            ready_s, ready_mb = time.perf_counter() - begin, harness.resident_mb(service.process)
            with Client(service.url) as paging:
                listed = [(plan.level, plan.floorplan_id) for plan in paging.venue_plans(venue_id, page_size=_PAGE)]
            venue = _Venue(plan_id, client, venue_id)
            known, is_known_right = venue.queries(heading=True)
            unknown, is_unknown_right = venue.queries(heading=False)
            localised_mb = harness.resident_mb(service.process)
            changes = list(venue.changes())
            again = harness.upload_example_plan(service.url)
            changes.append(venue.add(again))
            service.process.kill()
        with _running(data, plans, checkout) as (_, client):
            answer, after_kill_s = _Venue(again, client, venue_id).localise(read_poses()[0], heading=True)
    expected = {
        "all plans are ready": ready["plans_ready"] == plans,
        "pages list every plan once, in order": listed == sorted(set(listed)) and len(listed) == plans,
        "answers name the right plan": is_known_right and is_unknown_right,
        "changes take effect": all(right for _, right in changes),
        "the state outlives a crash": answer["floorplan_id"] == again,
    }
    as_expected = all(expected.values())
    figures = (
        f"{ready_s:.2f} s",
        known,
        unknown,
        f"{ready_mb:.0f}; {localised_mb:.0f} MB",
        f"{max(seconds for seconds, _ in changes):.2f} s",
        f"{after_kill_s:.2f} s",
        "yes" if as_expected else f"no: {json.dumps(expected)}",
    )
    return dict(zip(_AIMS, figures, strict=True)), as_expected


def main() -> int:
    """Measure and print the tables; return 1 when a plan is missing or an answer is wrong."""
    parser = harness.argument_parser(__doc__)
    parser.add_argument("checkouts", nargs="+", type=Path, help="folders, the one before first")
    parser.add_argument("--plans", type=int, nargs="+", default=[10_000], help="plans of each venue")
    options = parser.parse_args()
    folders, is_wrong = [folder.resolve() for folder in options.checkouts], False
    harness.print_table_head("figure", "aim", *(folder.name for folder in folders))
    for plans in options.plans:
        found = [measure(plans, folder) for folder in folders]
        for name, aim in _AIMS.items():
            cells = (figures[name] for figures, _ in found)
            print(harness.table_row(f"{plans:,} plans over HTTP: {name}", aim, *cells), flush=True)
        is_wrong |= not all(as_expected for _, as_expected in found)
    return int(is_wrong)


if __name__ == "__main__":
    sys.exit(main())
