"""Venue with many floor plans: upload, queries, changes of one plan, a crash and memory, over HTTP.

    python -m benchmarks.large_venue --plans 10000

The plans are random homes of two rooms and the example flat. They are uploaded in files of 200 plans, which extend the
venue. All example panoramas are localised in the venue, whose answer must name the flat. The pages of the venue must
list every plan once and in order. Then the flat is removed from the venue, added again, replaced and deleted: each
time, the first query must be answered by the new state. At last the service is killed and started again.

Next to the time of the wall clock stands the processor time of the service and its workers, which other work on the
machine hardly changes.
"""

from __future__ import annotations

import json
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks import harness
from examples.launch import ROOT
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


def upload(client: httpx.Client, documents: Sequence[dict[str, Any]]) -> list[str]:
    """Return the ids of the uploaded plans, in order."""
    with ThreadPoolExecutor(_CLIENTS) as threads:
        responses = threads.map(lambda document: client.post("/floorplans", json=document), documents)
        return [response.raise_for_status().json()["id"] for response in responses]


def upload_files(service: harness.Service, shown: str, documents: Sequence[dict[str, Any]]) -> str:
    """Upload plans in files that extend a venue, which begins with a stored plan; return its id."""
    files = [documents[first : first + _FILE] for first in range(0, len(documents), _FILE)]
    with Client(service.url, timeout_s=300.0) as client, ThreadPoolExecutor(_CLIENTS) as threads:
        venue_id = client.make_venue([VenuePlan(shown, level=0)]).id

        def extend(number: int) -> None:
            plans = [{**plan, "level": number % 5} for plan in files[number]]
            client.extend_venue(venue_id, {"plans": plans})

        list(threads.map(extend, range(len(files))))
    return venue_id


def upload_one_by_one(client: httpx.Client, shown: str, documents: Sequence[dict[str, Any]]) -> str:
    """Upload plans, one per request, then a venue of them, which begins with a stored plan; return its id."""
    members = [
        {"floorplan_id": plan_id, "level": number % 5}
        for number, plan_id in enumerate([shown, *upload(client, documents)])
    ]
    return client.post("/venues", json={"plans": members}).raise_for_status().json()["id"]


def wait_until_ready(client: httpx.Client, venue_id: str) -> dict[str, Any]:
    """Return the venue once all of its plans are ready or failed."""
    deadline = time.monotonic() + _TIMEOUT_S
    while True:
        venue = client.get(f"/venues/{venue_id}").raise_for_status().json()
        if venue["plans_ready"] + venue["plans_failed"] == venue["plans"]:
            return venue
        if time.monotonic() > deadline:
            raise TimeoutError(f"{venue['plans_ready']} of {venue['plans']} plans are ready after {_TIMEOUT_S:g} s")
        time.sleep(1.0)


class Stopwatch:
    """Wall clock and processor time of a service and its workers since the stopwatch was made."""

    def __init__(self, service: harness.Service) -> None:
        self._process, self._wall, self._cpu = service.process, time.perf_counter(), harness.cpu_s(service.process)

    def figures(self) -> dict[str, float]:
        """Return the times in ms."""
        wall, cpu = time.perf_counter() - self._wall, harness.cpu_s(self._process) - self._cpu
        return {"wall_ms": round(1e3 * wall), "cpu_ms": round(1e3 * cpu)}


class Venue:
    """Venue of the benchmark, and its client."""

    def __init__(self, service: harness.Service, client: httpx.Client, venue_id: str) -> None:
        self.service, self.client, self.id = service, client, venue_id

    def localise(self, pose: TruePose, *, heading: bool) -> dict[str, Any]:
        """Localise an example panorama, with or without its heading; return the answer and the times."""
        query, watch = harness.query_of(pose, venue_id=self.id), Stopwatch(self.service)
        if not heading:
            del query["data"]["heading_deg"]
        answer = self.client.post("/localise", **query).raise_for_status().json()
        return {"answer": answer, **watch.figures()}

    def change(self, method: str, path: str, plan_id: str, *, is_found: bool, **content: Any) -> dict[str, Any]:
        """Change one plan; return the times until a query was answered, and whether `plan_id` was as it should be."""
        watch = Stopwatch(self.service)
        self.client.request(method, path, **content).raise_for_status()
        request = watch.figures()
        first = self.localise(read_poses()[0], heading=True)
        right = (first["answer"]["floorplan_id"] == plan_id) == is_found
        until = watch.figures()
        # A query takes this long without a change.
        again = self.localise(read_poses()[0], heading=True)
        return {"request": request, "until_answered": until, "a_query": _times(again), "right": right}


def _times(figures: Mapping[str, Any]) -> dict[str, Any]:
    return {name: figures[name] for name in ("wall_ms", "cpu_ms")}


def _median(figures: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    return {name: float(np.median([each[name] for each in figures])) for name in ("wall_ms", "cpu_ms")}


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


def _queries(venue: Venue, plan_id: str) -> dict[str, Any]:
    report: dict[str, Any] = {"right": True}
    for name, heading in (("heading_known", True), ("heading_unknown", False)):
        found = [venue.localise(pose, heading=heading) for _ in range(_ROUNDS) for pose in read_poses()]
        report["right"] &= all(each["answer"]["floorplan_id"] == plan_id for each in found)
        # The first ones read plans from the database.
        later = found[len(read_poses()) :]
        index_ms = np.median([each["answer"]["timings_ms"].get("shortlist", 0.0) for each in later])
        report[name] = {"first": _times(found[0]), "p50": _median(later), "index_ms": round(float(index_ms), 1)}
    return report


def _changes(venue: Venue, plan_id: str) -> dict[str, Any]:
    """Remove, add, replace and delete the plan that the panoramas show."""
    path, own = f"/venues/{venue.id}", f"/floorplans/{plan_id}"
    shown = json.loads(PLAN_PATH.read_text())
    member = {"floorplan_id": plan_id, "level": 0}
    return {
        "removed": venue.change("PATCH", path, plan_id, is_found=False, json={"remove": [plan_id]}),
        "added": venue.change("PATCH", path, plan_id, is_found=True, json={"plans": [member]}),
        "replaced": venue.change("PUT", own, plan_id, is_found=False, json=random_home(0)),
        "replaced again": venue.change("PUT", own, plan_id, is_found=True, json=shown),
        "deleted": venue.change("DELETE", own, plan_id, is_found=False),
    }


def measure(plans: int, *, one_by_one: bool = False, checkout: Path = ROOT, changes: bool = True) -> dict[str, Any]:
    """Return the figures of a venue in the service of a checkout, with or without changes and a crash."""
    report: dict[str, Any] = {"plans": plans, "resident_mb": {}}
    with tempfile.TemporaryDirectory() as data:
        with _running(data, plans, checkout) as (service, client):
            resident = report["resident_mb"]
            resident["empty"] = round(harness.resident_mb(service.process))
            shown, watch = harness.upload_example_plan(service.url), Stopwatch(service)
            documents = [random_home(number) for number in range(plans - 1)]
            if one_by_one:
                venue_id = upload_one_by_one(client, shown, documents)
            else:
                venue_id = upload_files(service, shown, documents)
            report["uploaded"] = watch.figures()
            ready = wait_until_ready(client, venue_id)
            report["until_ready"] = watch.figures()
            resident["ready"] = round(harness.resident_mb(service.process))
            with Client(service.url) as paging:
                listed = [(plan.level, plan.floorplan_id) for plan in paging.venue_plans(venue_id, page_size=_PAGE)]
            venue = Venue(service, client, venue_id)
            report["queries"] = _queries(venue, shown)
            resident["localised"] = round(harness.resident_mb(service.process))
            if not changes:
                return report
            report["changes"] = _changes(venue, shown)
            again = harness.upload_example_plan(service.url)
            added = {"plans": [{"floorplan_id": again, "level": 0}]}
            report["changes"]["uploaded"] = venue.change(
                "PATCH", f"/venues/{venue_id}", again, is_found=True, json=added
            )
            service.process.kill()
        begin = time.perf_counter()
        with _running(data, plans, checkout) as (service, client):
            started = time.perf_counter()
            first = Venue(service, client, venue_id).localise(read_poses()[0], heading=True)
            report["after_kill"] = {"started_ms": round(1e3 * (started - begin)), "first_query": _times(first)}
            report["resident_mb"]["after_kill"] = round(harness.resident_mb(service.process))
    report["expected"] = {
        "all plans are ready": ready["plans_ready"] == plans,
        "pages list every plan once, in order": listed == sorted(set(listed)) and len(listed) == plans,
        "answers name the right plan": report["queries"]["right"],
        "changes take effect": all(change["right"] for change in report["changes"].values()),
        "the state outlives a crash": first["answer"]["floorplan_id"] == again,
    }
    return report


def main() -> int:
    """Measure; return 1 when a plan is missing or an answer is wrong."""
    parser = harness.argument_parser(__doc__)
    parser.add_argument("--plans", type=int, default=10_000)
    report = measure(parser.parse_args().plans)
    print(json.dumps(report, indent=2))
    return int(not all(report["expected"].values()))


if __name__ == "__main__":
    sys.exit(main())
