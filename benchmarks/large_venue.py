"""Venue with the largest number of floor plans: upload, paging and localisation over HTTP.

    python -m benchmarks.large_venue --plans 10000

The plans are random homes of two rooms and the example flat. All example panoramas are localised in the venue, whose
answer must name the flat. The pages of the venue must list every plan once and in order. Times of queries, and of the
state check that each of them makes, are meaningful on an idle machine only.
"""

from __future__ import annotations

import json
import random
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.harness import argument_parser, example_service, query_of, resident_mb
from examples.truth import TruePose, read_poses
from lalaloc_client import Client
from lalaloc_core.localise.bundle import Bundle
from service.settings import Settings
from service.storage import open_store

_CLIENTS, _PAGE, _STATE_CHECKS = 4, 500, 20
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


def state_check_ms(data: Path, venue_id: str) -> float:
    """Return the median duration (ms) of the check whether a venue has changed."""
    settings, bundle = Settings(data_dir=data), Bundle.open(Path("models/default"))
    store, times_ms = open_store(settings), []
    for _ in range(_STATE_CHECKS):
        begin = time.perf_counter()
        store.venues.state(venue_id, bundle.sha256, settings.grids.grid_step_m)
        times_ms.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(times_ms))


def main() -> int:
    """Measure; return 1 when a plan is missing or an answer names another plan."""
    parser = argument_parser(__doc__)
    parser.add_argument("--plans", type=int, default=10_000)
    plans = parser.parse_args().plans
    report: dict[str, Any] = {"plans": plans}
    with example_service() as service, httpx.Client(base_url=service.url, timeout=120.0) as client:
        report["resident_mb"] = {"empty": resident_mb(service.process)}
        begin = time.perf_counter()
        ids = [service.plan_id, *upload(client, [random_home(number) for number in range(plans - 1)])]
        report["uploaded_s"] = round(time.perf_counter() - begin, 1)
        members = [{"floorplan_id": plan_id, "level": number % 5} for number, plan_id in enumerate(ids)]
        venue_id = client.post("/venues", json={"plans": members}).raise_for_status().json()["id"]
        venue = wait_until_ready(client, venue_id)
        report["ready_s"] = round(time.perf_counter() - begin, 1)
        report["resident_mb"]["ready"] = resident_mb(service.process)
        with Client(service.url) as paging:
            listed = [(plan.level, plan.floorplan_id) for plan in paging.venue_plans(venue_id, page_size=_PAGE)]
        report["queries"] = [_localise(client, venue_id, service.plan_id, pose) for pose in read_poses()]
        report["resident_mb"]["localised"] = resident_mb(service.process)
        report["state_check_ms"] = round(state_check_ms(service.data, venue_id), 1)
    report["expected"] = {
        "all plans are ready": venue["plans_ready"] == len(ids),
        "pages list every plan once, in order": listed
        == sorted((plan["level"], plan["floorplan_id"]) for plan in members),
        "answers name the right plan": all(query["right"] for query in report["queries"]),
    }
    print(json.dumps(report, indent=2))
    return int(not all(report["expected"].values()))


def _localise(client: httpx.Client, venue_id: str, plan_id: str, pose: TruePose) -> dict[str, Any]:
    begin = time.perf_counter()
    answer = client.post("/localise", **query_of(pose, venue_id=venue_id)).raise_for_status().json()
    return {
        "picture": pose.file,
        "right": answer["floorplan_id"] == plan_id,
        "confidence": answer["confidence"],
        "ms": round(1e3 * (time.perf_counter() - begin)),
    }


if __name__ == "__main__":
    sys.exit(main())
