"""Cost of durable commits on SQLite: time to store a plan, and to claim a lease, with `synchronous=FULL` and `NORMAL`.

    python -m benchmarks.durability --folder /var/lib/lalaloc --writes 500

The folder decides: with FULL its disk confirms every commit. NORMAL leaves that to the operating system, which can lose
the last commits in a power failure; the service uses FULL. Both take turns, so that other load on the disk hits both.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
import uuid
from pathlib import Path

from benchmarks.harness import argument_parser
from examples.truth import PLAN_PATH
from lalaloc_core.floorplan import FloorPlan
from service.storage import Store
from service.storage.records import GridKey, NewPlan, Original

_MODES = ("NORMAL", "FULL")
_KINDS = ("plan", "lease")


def open_store(folder: Path, mode: str) -> Store:
    """Open a new database in a mode; the pool has one connection, which keeps it."""
    store = Store(f"sqlite:///{folder / f'{mode}.sqlite3'}", connections=1)
    with store._database._driver_cursor() as cursor:
        cursor.execute(f"PRAGMA synchronous={mode}")
    return store


def write(store: Store, content: bytes, plan: FloorPlan) -> tuple[float, float]:
    """Store a plan and claim a lease; return the times (ms)."""
    begin_s = time.perf_counter()
    stored = store.plans.add("t", uuid.uuid4().hex, NewPlan(plan, Original(content)), limit=10**9)
    between_s = time.perf_counter()
    key = GridKey(revision_id=stored.revision_id, model_sha256="m", step_m=0.5, camera_height_mm=1500)
    store.leases.claim(key, "owner", 60.0)
    return 1000.0 * (between_s - begin_s), 1000.0 * (time.perf_counter() - between_s)


def main() -> int:
    """Measure and print a table."""
    parser = argument_parser(__doc__)
    parser.add_argument("--folder", type=Path, default=Path.cwd(), help="folder on the disk to measure")
    parser.add_argument("--writes", type=int, default=500, help="plans per mode (default: %(default)s)")
    arguments = parser.parse_args()
    content = PLAN_PATH.read_bytes()
    plan = FloorPlan.from_dict(json.loads(content))
    times_ms: dict[str, list[tuple[float, float]]] = {mode: [] for mode in _MODES}
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        stores = {mode: open_store(Path(folder), mode) for mode in _MODES}
        for _ in range(arguments.writes):
            for mode, store in stores.items():
                times_ms[mode].append(write(store, content, plan))
        for store in stores.values():
            store.close()
    print(f"{'write':8}{'synchronous':>12}{'p50 ms':>10}{'p99 ms':>10}")
    for number, kind in enumerate(_KINDS):
        for mode in _MODES:
            values = sorted(pair[number] for pair in times_ms[mode])
            p99_ms = values[min(int(0.99 * len(values)), len(values) - 1)]
            print(f"{kind:8}{mode:>12}{statistics.median(values):10.2f}{p99_ms:10.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
