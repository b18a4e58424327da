"""Crash safety: the service is killed while plans are uploaded, and started again.

    python -m benchmarks.crash --plans 200 --kills 3

Clients repeat unanswered uploads with the same `Idempotency-Key`, as the client library does. In the end every plan is
stored exactly once and usable, no other plan is stored, and the database has no orphaned rows.
"""

from __future__ import annotations

import json
import random
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

from benchmarks.harness import argument_parser, query_of, started_service, wait_until
from examples.truth import PLAN_PATH, read_poses
from lalaloc_client import Client

_CLIENTS = 6
_TIMEOUT_S = 120.0
# Rows of a table that no other row owns.
_ORPHANS = {
    "revisions": "plan_id NOT IN (SELECT id FROM floorplans)",
    "floorplans": "revision_id NOT IN (SELECT id FROM revisions)",
    "original_chunks": "revision_id NOT IN (SELECT id FROM revisions)",
    "latent_grids": "revision_id NOT IN (SELECT id FROM revisions)",
    "grid_chunks": "grid_id NOT IN (SELECT id FROM latent_grids)",
}


class Uploads:
    """Uploads of plans by name, each repeated until it is answered.

    `url` changes when the service is started again; `plan_ids` are those of the answered uploads by name; `refused`
    counts refusals by status.
    """

    def __init__(self) -> None:
        self.url = ""
        self.plan_ids: dict[str, str] = {}
        self.repeated = 0
        self.refused: Counter[str] = Counter()
        self._lock = threading.Lock()

    def upload(self, name: str) -> None:
        """Upload one plan."""
        document = json.loads(PLAN_PATH.read_bytes()) | {"name": name}
        headers, deadline = {"Idempotency-Key": uuid.uuid4().hex}, time.monotonic() + _TIMEOUT_S
        while True:
            try:
                response = httpx.post(f"{self.url}/floorplans", json=document, headers=headers, timeout=20.0)
            except httpx.TransportError:
                response = None
            with self._lock:
                if response is not None and response.status_code == httpx.codes.CREATED:
                    self.plan_ids[name] = response.json()["id"]
                    return
                self.repeated += 1
                if response is not None:
                    self.refused[str(response.status_code)] += 1
            if time.monotonic() > deadline:
                raise TimeoutError(f"plan '{name}' is not stored after {_TIMEOUT_S:g} s")
            time.sleep(0.2)

    def wait_for(self, count: int) -> None:
        """Wait until a number of uploads are answered."""
        wait_until(lambda: len(self.plan_ids) >= count, f"{count} uploads are answered", _TIMEOUT_S, 0.02)


def main() -> int:
    """Run; return 1 when a plan is missing, doubled, unusable or unexpected."""
    parser = argument_parser(__doc__)
    parser.add_argument("--plans", type=int, default=200)
    parser.add_argument("--kills", type=int, default=3)
    options = parser.parse_args()
    rng, names = random.Random(0), [f"plan {number:04d}" for number in range(options.plans)]
    with tempfile.TemporaryDirectory() as data, ThreadPoolExecutor(_CLIENTS) as clients:
        uploads, pending = Uploads(), []
        for life in range(options.kills + 1):
            with started_service(Path(data), {"LALALOC_WORKERS": "0"}) as service:
                uploads.url = service.url
                pending = pending or [clients.submit(uploads.upload, name) for name in names]
                if life < options.kills:
                    uploads.wait_for((life + 1) * options.plans // (options.kills + 1))
                    time.sleep(rng.uniform(0.0, 0.2))
                    service.process.kill()
                    service.process.wait()
                    continue
                try:
                    for upload in pending:
                        upload.result()
                finally:
                    clients.shutdown(wait=False, cancel_futures=True)
                report = _inspect(service.url, uploads, names, Path(data))
    print(json.dumps(report, indent=2))
    return int(not all(report["expected"].values()))


def _inspect(url: str, uploads: Uploads, names: list[str], data: Path) -> dict[str, Any]:
    """Compare the stored plans with the uploads."""
    stored: dict[str, str] = {}
    doubled, usable = 0, 0
    pose = read_poses()[0]
    with Client(url) as client:
        for plan in client.floorplans():
            doubled += plan.name in stored
            stored[plan.name] = plan.id
    with httpx.Client(base_url=url, timeout=60.0) as client:
        for plan_id in uploads.plan_ids.values():
            response = client.post("/localise", **query_of(pose, floorplan_id=plan_id))
            usable += response.status_code == httpx.codes.OK
    orphans = {}
    with sqlite3.connect(data / "lalaloc.sqlite3") as database:
        for table, condition in _ORPHANS.items():
            orphans[table] = database.execute(f"SELECT count(*) FROM {table} WHERE {condition}").fetchone()[0]
        integrity = database.execute("PRAGMA integrity_check").fetchone()[0]
    expected = {
        "answered plans are stored under their ids": uploads.plan_ids.items() <= stored.items(),
        "answered plans are usable": usable == len(uploads.plan_ids) == len(names),
        "no other plans are stored": stored.keys() == set(names) and not doubled,
        "uploads were interrupted": uploads.repeated > 0,
        "no rows are orphaned": not any(orphans.values()) and integrity == "ok",
    }
    return {
        "uploads": len(names),
        "answered": len(uploads.plan_ids),
        "repeated": uploads.repeated,
        "refused": dict(uploads.refused),
        "stored": len(stored),
        "usable": usable,
        "orphaned_rows": orphans,
        "expected": expected,
    }


if __name__ == "__main__":
    sys.exit(main())
