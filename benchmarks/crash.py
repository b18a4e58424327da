"""The service is killed while plans are uploaded and started again: what was answered is there, and nothing else is.

    python -m benchmarks.crash --plans 200 --kills 3

Clients repeat what was not answered with the same `Idempotency-Key`, as the client library does. In the end every plan
is there once, none is there that was not sent, all can be used, and the database has no rows that belong to nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sqlite3
import sys
import tempfile
import threading
import time
import uuid
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx

from benchmarks.load import queries
from examples.launch import running_service
from examples.truth import PLAN_PATH

_CLIENTS = 6
_TIMEOUT_S = 120.0
# What belongs to what; a row without its owner would be half of something.
_OWNERS = {
    "revisions": "plan_id NOT IN (SELECT id FROM floorplans)",
    "floorplans": "revision_id NOT IN (SELECT id FROM revisions)",
    "original_chunks": "revision_id NOT IN (SELECT id FROM revisions)",
    "latent_grids": "revision_id NOT IN (SELECT id FROM revisions)",
    "grid_chunks": "grid_id NOT IN (SELECT id FROM latent_grids)",
}


class Uploads:
    """Uploads plans of different names, again and again until each is answered."""

    def __init__(self, port_of: dict[str, int]) -> None:
        self.port_of = port_of
        self.answered: dict[str, str] = {}
        self.repeated = 0
        self.refused: Counter[str] = Counter()
        self._lock = threading.Lock()

    def upload(self, name: str) -> None:
        """Upload one plan."""
        document = json.loads(PLAN_PATH.read_bytes()) | {"name": name}
        key, deadline = uuid.uuid4().hex, time.monotonic() + _TIMEOUT_S
        while True:
            try:
                answer = httpx.post(
                    f"http://127.0.0.1:{self.port_of['port']}/floorplans",
                    json=document,
                    headers={"Idempotency-Key": key},
                    timeout=20.0,
                )
            except httpx.TransportError:
                answer = None
            with self._lock:
                if answer is not None and answer.status_code == httpx.codes.CREATED:
                    self.answered[name] = answer.json()["id"]
                    return
                self.repeated += 1
                if answer is not None:
                    self.refused[str(answer.status_code)] += 1
            if time.monotonic() > deadline:
                raise TimeoutError(f"plan '{name}' was not stored within {_TIMEOUT_S:g} s")
            time.sleep(0.2)


def main() -> int:
    """Run; 1 when something is missing, or there that should not be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=int, default=200)
    parser.add_argument("--kills", type=int, default=3)
    options = parser.parse_args()
    rng, names = random.Random(0), [f"plan {number:04d}" for number in range(options.plans)]
    with tempfile.TemporaryDirectory() as data, ThreadPoolExecutor(_CLIENTS) as clients:
        settings = {"LALALOC_DATA_DIR": data, "LALALOC_LOG_LEVEL": "error", "LALALOC_WORKERS": "0"}
        port_of: dict[str, int] = {}
        uploads = Uploads(port_of)
        work = []
        for life in range(options.kills + 1):
            with running_service(0, settings) as service:
                port_of["port"] = int(service.url.rpartition(":")[2])
                work = work or [clients.submit(uploads.upload, name) for name in names]
                if life < options.kills:
                    _wait_until_answered(uploads, (life + 1) * options.plans // (options.kills + 1))
                    time.sleep(rng.uniform(0.0, 0.2))
                    os.kill(service.process.pid, signal.SIGKILL)
                    service.process.wait()
                    continue
                try:
                    for one in work:
                        one.result()
                finally:
                    clients.shutdown(wait=False, cancel_futures=True)
                report = _look(service.url, uploads, names, Path(data))
    print(json.dumps(report, indent=2))
    return int(not all(report["holds"].values()))


def _look(url: str, uploads: Uploads, names: list[str], data: Path) -> dict[str, Any]:
    """What is stored, once all is quiet."""
    stored: dict[str, str] = {}
    doubled, usable, cursor = 0, 0, None
    query = queries()[0]
    with httpx.Client(base_url=url, timeout=60.0) as client:
        while True:
            page = client.get("/floorplans", params={"limit": 100} | ({"cursor": cursor} if cursor else {})).json()
            for plan in page["floorplans"]:
                doubled += plan["name"] in stored
                stored[plan["name"]] = plan["id"]
            cursor = page.get("next_cursor")
            if cursor is None:
                break
        for plan_id in uploads.answered.values():
            fields = {"floorplan_id": plan_id, "heading_deg": str(query.pose.heading_deg)}
            answer = client.post("/localise", data=fields, files={"panorama": (query.pose.file, query.picture)})
            usable += answer.status_code == httpx.codes.OK
    orphans = {}
    with sqlite3.connect(data / "lalaloc.sqlite3") as database:
        for table, condition in _OWNERS.items():
            orphans[table] = database.execute(f"SELECT count(*) FROM {table} WHERE {condition}").fetchone()[0]
        sound = database.execute("PRAGMA integrity_check").fetchone()[0]
    return {
        "uploads": len(names),
        "answered": len(uploads.answered),
        "repeated": uploads.repeated,
        "refused": dict(uploads.refused),
        "stored": len(stored),
        "usable": usable,
        "rows_without_owner": orphans,
        "holds": {
            "every answered plan is stored under its id": all(
                stored.get(name) == plan_id for name, plan_id in uploads.answered.items()
            ),
            "every answered plan is usable": usable == len(uploads.answered) == len(names),
            "nothing else is stored": stored.keys() == set(names) and not doubled,
            "uploads were cut off": uploads.repeated > 0,
            "nothing is half-written": not any(orphans.values()) and sound == "ok",
        },
    }


def _wait_until_answered(uploads: Uploads, count: int) -> None:
    deadline = time.monotonic() + _TIMEOUT_S
    while len(uploads.answered) < count:
        if time.monotonic() > deadline:
            raise TimeoutError(f"only {len(uploads.answered)} uploads were answered within {_TIMEOUT_S:g} s")
        time.sleep(0.02)


if __name__ == "__main__":
    sys.exit(main())
