"""Faults of a running service: crashes, overload, workers that die, a database that stops, and what durability costs.

    python -m benchmarks.faults crash --plans 200 --kills 3
    python -m benchmarks.faults overload --seconds 30
    python -m benchmarks.faults soak --minutes 5 --every 3
    python -m benchmarks.faults outage --seconds 10
    python -m benchmarks.faults sessions --sessions 12
    python -m benchmarks.faults durability --writes 500 --folder /var/lib/lalaloc

`crash` kills the service while plans are uploaded and repeated with their `Idempotency-Key`: in the end every plan is
stored exactly once and usable, and no row is orphaned. `overload` sends ten times more clients than are accepted at
once: accepted queries must be nearly as fast as alone, and refusals come at once. `soak` kills workers for minutes: no
answer may be lost or wrong (stage `vdr` counts), and memory must not grow. `outage` stops PostgreSQL for some seconds
(Debian: `apt-get install postgresql`): cached plans localise, other requests get 503, all recovers. `sessions` follows
sessions in a venue at once: beyond the capacity they get 503 with `Retry-After`, not 504. `durability` measures storing
a plan and claiming a lease on SQLite with `synchronous=FULL`, as the service does, and `NORMAL`, in turns; the disk of
the folder decides.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sqlite3
import statistics
import sys
import tempfile
import threading
import time
import uuid
from collections import Counter, defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import psutil

from benchmarks import harness
from benchmarks.large_venues import make_venue, wait_until_ready
from examples.truth import PLAN_PATH, read_poses
from lalaloc_client import Client
from lalaloc_core.floorplan import FloorPlan
from service.storage import Store
from service.storage.records import GridKey, NewPlan, Original
from tests.service.postgres import postgres_programs, postgres_server

_CLIENTS, _TIMEOUT_S = 6, 120.0
# Rows of a table that no other row owns.
_ORPHANS = {
    "revisions": "plan_id NOT IN (SELECT id FROM floorplans)",
    "floorplans": "revision_id NOT IN (SELECT id FROM revisions)",
    "original_chunks": "revision_id NOT IN (SELECT id FROM revisions)",
    "latent_grids": "revision_id NOT IN (SELECT id FROM revisions)",
    "grid_chunks": "grid_id NOT IN (SELECT id FROM latent_grids)",
}
# Overload: clients as a multiple of those that are accepted, and limits of durations.
_CROWD = 10
_ACCEPTED_P99_RATIO, _REFUSED_P99_MS, _RECOVERED_P50_RATIO = 3.0, 50.0, 1.5
# Soak: growth after warm-up; less is noise of the allocator.
_MAX_GROWTH_MB = 40.0
_WARM_UP_SHARE = 0.2
_RESTART_TIMEOUT_S = 30.0
# Outage.
_MAX_RECOVERY_S, _OUTAGE_TIMEOUT_S = 5.0, 30.0
# Sessions: a refused photograph is told so early; its deadline is 10 s.
_PHOTOGRAPHS, _MAX_REFUSAL_S = 3, 5.0


def main() -> int:
    """Run one test and print its figures; return 1 when one is not as expected."""
    parser = harness.argument_parser(__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for test, defaults in _TESTS.items():
        command = commands.add_parser(test.__name__)
        command.set_defaults(test=test)
        for option, default in defaults.items():
            command.add_argument(f"--{option}", type=type(default), default=default, help="default: %(default)s")
    options = parser.parse_args()
    report = options.test(options)
    print(json.dumps(report, indent=2))
    return int(not all(report["expected"].values()))


class Uploads:
    """Uploads of plans by name, each repeated until it is answered; `url` changes with every start of the service."""

    def __init__(self) -> None:
        self.url = ""
        self.plan_ids: dict[str, str] = {}
        self.repeated = 0
        self.refused: Counter[str] = Counter()
        self._lock = threading.Lock()

    def upload(self, name: str) -> None:
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
        harness.wait_until(lambda: len(self.plan_ids) >= count, f"{count} uploads are answered", _TIMEOUT_S, 0.02)


def crash(options: argparse.Namespace) -> dict[str, Any]:
    """Kill the service while plans are uploaded; return the figures."""
    rng, names = random.Random(0), [f"plan {number:04d}" for number in range(options.plans)]
    with tempfile.TemporaryDirectory() as data, ThreadPoolExecutor(_CLIENTS) as clients:
        uploads, pending = Uploads(), []
        for life in range(options.kills + 1):
            with harness.started_service(Path(data), {"LALALOC_WORKERS": "0"}) as service:
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
                return _inspect(service.url, uploads, names, Path(data))
    raise AssertionError("the last life returns")


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
            response = client.post("/localise", **harness.query_of(pose, floorplan_id=plan_id))
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
    counts = {"uploads": len(names), "answered": len(uploads.plan_ids), "repeated": uploads.repeated}
    counts |= {"refused": dict(uploads.refused), "stored": len(stored), "usable": usable}
    return counts | {"orphaned_rows": orphans, "expected": expected}


def overload(options: argparse.Namespace) -> dict[str, Any]:
    """Compare a crowd of clients with one alone; return the figures."""
    seconds = options.seconds
    with harness.example_service() as service:
        limits = httpx.get(f"{service.url}/limits").json()
        capacity, waiting = limits["max_queries"], limits["max_waiting_queries"]

        def load(clients: int, duration_s: float) -> harness.LoadResult:
            return harness.run_load(service.url, [service.plan_id], clients, duration_s)

        load(1, 3.0)
        alone, crowd, after = load(1, seconds), load(_CROWD * capacity, seconds), load(1, seconds / 3.0)
    accepted, refused = crowd.answered, crowd.refused
    queue_ms = 1e3 * waiting / max(accepted.per_second, 1e-9)
    accepted_limit_ms = _ACCEPTED_P99_RATIO * alone.answered.percentile_ms(99) + queue_ms
    recovered_limit_ms = _RECOVERED_P50_RATIO * alone.answered.percentile_ms(50)
    expected = {
        "accepted p99 within 3 times alone, and the queue": accepted.percentile_ms(99) <= accepted_limit_ms,
        "refused within 50 ms": refused.percentile_ms(99) <= _REFUSED_P99_MS,
        "recovered": not after.refused.count and after.answered.percentile_ms(50) <= recovered_limit_ms,
        "no failures": not (alone.failures or crowd.failures or after.failures),
    }
    report = {"capacity": capacity, "waiting": waiting, "clients": _CROWD * capacity}
    parts = {"alone": alone.answered, "accepted": accepted, "refused": refused, "after": after.answered}
    return report | {name: requests.figures() for name, requests in parts.items()} | {"expected": expected}


def soak(options: argparse.Namespace) -> dict[str, Any]:
    """Localise while workers are killed; return the figures."""
    seconds, memory_mb, killed, stop = 60.0 * options.minutes, list[float](), list[int](), threading.Event()
    with harness.example_service() as service:

        def kill_workers() -> None:
            rng = random.Random(0)
            while not stop.wait(options.every):
                if workers := _worker_processes(service.process):
                    worker = rng.choice(workers)
                    with suppress(psutil.NoSuchProcess):
                        worker.kill()
                        killed.append(worker.pid)

        def sample_memory() -> None:
            while not stop.wait(seconds / 50.0):
                memory_mb.append(harness.resident_mb(service.process))

        threads = [threading.Thread(target=work) for work in (kill_workers, sample_memory)]
        for thread in threads:
            thread.start()
        result = harness.run_load(service.url, [service.plan_id], options.clients, seconds)
        stop.set()
        for thread in threads:
            thread.join()
        with suppress(TimeoutError):
            harness.wait_until(lambda: _all_are_ready(service.url), "workers restart", _RESTART_TIMEOUT_S, 0.2)
        restarted = _all_are_ready(service.url)
    warm = memory_mb[int(_WARM_UP_SHARE * len(memory_mb)) :]
    return {
        "answered": result.answered.figures(),
        "stages": result.stages,
        "refused": result.refused.count,
        "failed": result.failures,
        "workers_killed": len(killed),
        "resident_mb": {"start": warm[0], "middle": warm[len(warm) // 2], "end": warm[-1]},
        "expected": {
            "no answer is lost or wrong": not result.refused.count + result.failures,
            "workers were killed": len(killed) >= seconds / options.every / 2.0,
            "answers were refined": result.stages.get("lpo", 0) > 0,
            "workers restart": restarted,
            "memory does not grow": warm[-1] <= warm[0] + _MAX_GROWTH_MB,
        },
    }


def _worker_processes(process: psutil.Process) -> list[psutil.Process]:
    """Return the worker processes of a service, without Python's resource tracker."""
    workers = []
    for child in process.children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            workers += [child] if "spawn_main" in " ".join(child.cmdline()) else []
    return workers


def _all_are_ready(url: str) -> bool:
    pools = httpx.get(f"{url}/readyz").json()
    return all(pools[pool]["ready"] == pools[pool]["workers"] for pool in ("lpo_pool", "decode_pool"))


def outage(options: argparse.Namespace) -> dict[str, Any]:
    """Stop the database for a while; return the figures."""
    programs, seconds = postgres_programs(), options.seconds
    if programs is None:
        raise SystemExit("PostgreSQL is not installed (Debian: apt-get install postgresql)")
    with (
        postgres_server(programs) as server,
        harness.example_service({"LALALOC_DATABASE_URL": server.new_database()}) as service,
        httpx.Client(base_url=service.url, timeout=_OUTAGE_TIMEOUT_S) as client,
        ThreadPoolExecutor(3) as threads,
    ):

        def localise(duration_s: float) -> harness.LoadResult:
            return harness.run_load(service.url, [service.plan_id], 1, duration_s)

        requests = (
            client.build_request("GET", "/floorplans"),
            client.build_request("POST", "/floorplans", json=json.loads(PLAN_PATH.read_bytes())),
            client.build_request("GET", f"/floorplans/{'0' * 32}"),
        )

        def repeat(request: httpx.Request) -> list[tuple[int, float]]:
            """Send a request twice a second; return statuses and durations (s)."""
            results, end = [], time.perf_counter() + seconds
            while time.perf_counter() < end:
                begin = time.perf_counter()
                results.append((client.send(request).status_code, time.perf_counter() - begin))
                time.sleep(0.5)
            return results

        before = localise(5.0)
        server.stop()
        refusals = [threads.submit(repeat, request) for request in requests]
        during = localise(seconds)
        refused = [result for future in refusals for result in future.result()]
        server.start()
        begin = time.perf_counter()
        with suppress(TimeoutError):
            harness.wait_until(lambda: client.get("/floorplans").is_success, "plans are listed", _OUTAGE_TIMEOUT_S, 0.1)
        recovery_s = time.perf_counter() - begin
        after = localise(5.0)
    expected = {
        "cached plans localise": _is_right(during),
        "other requests get 503": all(status == httpx.codes.SERVICE_UNAVAILABLE for status, _ in refused),
        "recovers by itself": recovery_s <= _MAX_RECOVERY_S and _is_right(before) and _is_right(after),
    }
    return {
        "outage_s": seconds,
        "cached_plan": {
            name: result.answered.figures()
            for name, result in (("before", before), ("during", during), ("after", after))
        },
        "other_statuses": dict(Counter(str(status) for status, _ in refused)),
        "slowest_refusal_s": round(max(duration_s for _, duration_s in refused), 2),
        "recovery_s": round(recovery_s, 2),
        "expected": expected,
    }


def _is_right(result: harness.LoadResult) -> bool:
    return result.answered.count > 0 and not result.failures + result.refused.count


def sessions(options: argparse.Namespace) -> dict[str, Any]:
    """Follow several sessions in a venue at once; return the waits for answers by status."""
    waits: dict[int, list[float]] = defaultdict(list)
    with harness.example_service() as service, httpx.Client(base_url=service.url, timeout=60.0) as client:
        venue_id = make_venue(service, options.homes)
        wait_until_ready(client, venue_id)

        def follow(_number: int) -> None:
            session = client.post("/sessions", json={"venue_id": venue_id}).raise_for_status().json()["id"]
            for pose in read_poses()[:_PHOTOGRAPHS]:
                begin = time.perf_counter()
                files = {"photo": pose.picture.read_bytes()}
                answer = client.post(f"/sessions/{session}/photographs", files=files)
                waits[answer.status_code].append(time.perf_counter() - begin)
                if answer.status_code == httpx.codes.SERVICE_UNAVAILABLE:
                    time.sleep(float(answer.headers["Retry-After"]))

        with ThreadPoolExecutor(options.sessions) as threads:
            list(threads.map(follow, range(options.sessions)))
    return {
        "waits": {
            str(status): {"count": len(waited), "median_s": statistics.median(waited), "longest_s": max(waited)}
            for status, waited in waits.items()
        },
        "expected": {
            "answers or refusals": waits.keys() <= {httpx.codes.OK, httpx.codes.SERVICE_UNAVAILABLE},
            "refused within 5 s": max(waits[503], default=0.0) <= _MAX_REFUSAL_S,
        },
    }


def durability(options: argparse.Namespace) -> dict[str, Any]:
    """Store plans and claim leases with durable commits and without; return the times."""
    content = PLAN_PATH.read_bytes()
    plan = FloorPlan.from_dict(json.loads(content))
    times_ms: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        # The pool has one connection, which keeps the mode.
        stores = {mode: Store(f"sqlite:///{folder}/{mode}.sqlite3", connections=1) for mode in ("NORMAL", "FULL")}
        for mode, store in stores.items():
            with store.database._driver_cursor() as cursor:
                cursor.execute(f"PRAGMA synchronous={mode}")
        for _ in range(options.writes):
            for mode, store in stores.items():
                begin_s = time.perf_counter()
                stored = store.plans.add("t", uuid.uuid4().hex, NewPlan(plan, Original(content)), limit=10**9)
                between_s = time.perf_counter()
                key = GridKey(revision_id=stored.revision_id, model_sha256="m", step_m=0.5, camera_height_mm=1500)
                store.leases.claim(key, "owner", 60.0)
                times_ms[f"plan, {mode}"].append(1e3 * (between_s - begin_s))
                times_ms[f"lease, {mode}"].append(1e3 * (time.perf_counter() - between_s))
        for store in stores.values():
            store.close()
    return {name: harness.Requests(times, math.nan).percentiles_ms() for name, times in times_ms.items()} | {
        "expected": {}
    }


# Tests with the defaults of their options.
_TESTS: dict[Callable[[argparse.Namespace], dict[str, Any]], dict[str, int | float | str]] = {
    crash: {"plans": 200, "kills": 3},
    overload: {"seconds": 30.0},
    soak: {"minutes": 5.0, "clients": 4, "every": 3.0},
    outage: {"seconds": 10.0},
    sessions: {"sessions": 12, "homes": 61},
    durability: {"writes": 500, "folder": "."},
}


if __name__ == "__main__":
    sys.exit(main())
