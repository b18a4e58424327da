"""A venue of as many floor plans as one may have, over HTTP: uploaded, paged through, asked about.

    python -m benchmarks.large_venue --plans 10000

Small homes of two rooms are drawn at random, and the example flat is one of them: all example panoramas are asked about
in the venue, which must name it. The pages of the venue must give what was put into it, once and in order. Ends with 1
where something is wrong. The times of queries, and of the look at whether a venue is still what it was which each of
them takes, mean something only on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.load import Query, queries
from benchmarks.processes import resident_mb
from examples.launch import running_service
from examples.truth import PLAN_PATH
from lalaloc_core.localise.bundle import Bundle
from service.settings import Settings
from service.storage import open_store

_CLIENTS = 4
_PAGE = 500
_READY_WITHIN_S = 7200.0
_LOOKS = 20


def home(number: int) -> dict[str, Any]:
    """A plan of two rooms with a door between them; the same for the same number."""
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
    """Ids of the plans, in order."""

    def one(document: dict[str, Any]) -> str:
        answer = client.post("/floorplans", json=document)
        answer.raise_for_status()
        return answer.json()["id"]

    with ThreadPoolExecutor(_CLIENTS) as clients:
        return list(clients.map(one, documents))


def pages(client: httpx.Client, venue_id: str) -> Iterator[dict[str, Any]]:
    """All plans of a venue, page by page."""
    cursor = None
    while True:
        given = {"limit": _PAGE} | ({"cursor": cursor} if cursor else {})
        page = client.get(f"/venues/{venue_id}/plans", params=given).raise_for_status().json()
        yield from page["plans"]
        cursor = page["next_cursor"]
        if cursor is None:
            return


def wait_until_ready(client: httpx.Client, venue_id: str) -> dict[str, Any]:
    """The venue once all of its plans can be asked about."""
    deadline = time.monotonic() + _READY_WITHIN_S
    while True:
        venue = client.get(f"/venues/{venue_id}").raise_for_status().json()
        if venue["plans_ready"] + venue["plans_failed"] == venue["plans"]:
            return venue
        if time.monotonic() > deadline:
            raise TimeoutError(f"{venue['plans_ready']} plans are ready after {_READY_WITHIN_S:g} s")
        time.sleep(1.0)


def looks_ms(data: Path, venue_id: str) -> float:
    """Milliseconds that a look at the state of a venue takes in the database, the median."""
    settings, bundle = Settings(data_dir=data), Bundle.open(Path("models/default"))
    store, spent_ms = open_store(settings), []
    for _ in range(_LOOKS):
        begin = time.perf_counter()
        store.venues.state(venue_id, bundle.sha256, settings.grids.grid_step_m)
        spent_ms.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(spent_ms))


def main() -> int:
    """Run; 1 when something is missing or wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=int, default=10_000)
    options = parser.parse_args()
    documents = [json.loads(PLAN_PATH.read_bytes()), *map(home, range(options.plans - 1))]
    report: dict[str, Any] = {"plans": len(documents)}
    with tempfile.TemporaryDirectory() as data:
        settings = {"LALALOC_DATA_DIR": data, "LALALOC_LOG_LEVEL": "error"}
        with running_service(0, settings) as service, httpx.Client(base_url=service.url, timeout=120.0) as client:
            report["resident_mb"] = {"empty": resident_mb(service.process.pid)}
            begun = time.perf_counter()
            ids = upload(client, documents)
            report["uploaded_s"] = round(time.perf_counter() - begun, 1)
            members = [{"floorplan_id": one, "level": number % 5} for number, one in enumerate(ids)]
            venue_id = client.post("/venues", json={"plans": members}).raise_for_status().json()["id"]
            venue = wait_until_ready(client, venue_id)
            report["ready_s"] = round(time.perf_counter() - begun, 1)
            report["resident_mb"]["ready"] = resident_mb(service.process.pid)
            paged = [(one["level"], one["floorplan_id"]) for one in pages(client, venue_id)]
            report["queries"] = [_asked(client, venue_id, ids[0], query) for query in queries()]
            report["resident_mb"]["asked"] = resident_mb(service.process.pid)
        report["look_ms"] = round(looks_ms(Path(data), venue_id), 1)
    report["holds"] = {
        "all plans can be asked about": venue["plans_ready"] == len(ids),
        "pages give every plan once, in order": paged == sorted((one["level"], one["floorplan_id"]) for one in members),
        "queries name the right plan": all(one["right"] for one in report["queries"]),
    }
    print(json.dumps(report, indent=2))
    return int(not all(report["holds"].values()))


def _asked(client: httpx.Client, venue_id: str, plan_id: str, query: Query) -> dict[str, Any]:
    begin = time.perf_counter()
    fields = {"venue_id": venue_id, "heading_deg": str(query.pose.heading_deg)}
    answer = client.post("/localise", data=fields, files={"panorama": (query.pose.file, query.picture)})
    told = answer.raise_for_status().json()
    return {
        "picture": query.pose.file,
        "right": told["floorplan_id"] == plan_id,
        "confidence": told["confidence"],
        "ms": round(1e3 * (time.perf_counter() - begin)),
    }


if __name__ == "__main__":
    sys.exit(main())
