"""Cost of commits that reach the disk before they are acknowledged.

    python -m benchmarks.durability --writes 500 --folder /var/lib/lalaloc

Stores a plan and claims a lease on SQLite with `synchronous=FULL`, as the service does, and `NORMAL`, in turns, and
prints a Markdown table. The disk of the folder decides.
"""

from __future__ import annotations

import json
import tempfile
import time
import uuid
from collections import defaultdict

from benchmarks import harness
from examples.truth import PLAN_PATH
from lalaloc_core.floorplan import FloorPlan
from service.storage import Store
from service.storage.records import GridKey, NewPlan, Original

_MODES = ("NORMAL", "FULL")
_PERCENTS = (50, 95, 99)


def main() -> None:
    parser = harness.argument_parser(__doc__)
    parser.add_argument("--writes", type=int, default=500, help="plans and leases of each mode")
    parser.add_argument("--folder", default=".", help="folder on the disk to measure")
    options = parser.parse_args()
    harness.print_table_head("write", *(f"p{percent}" for percent in _PERCENTS))
    for write, times_ms in measure(options.folder, options.writes).items():
        print(harness.table_row(write, *(f"{harness.percentile(times_ms, percent):.1f} ms" for percent in _PERCENTS)))


def measure(folder: str, writes: int) -> dict[str, list[float]]:
    """Return the times (ms) of storing plans and claiming leases, by write and mode."""
    content = PLAN_PATH.read_bytes()
    plan = FloorPlan.from_dict(json.loads(content))
    times_ms: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory(dir=folder) as data:
        # The pool has one connection, which keeps the mode.
        stores = {mode: Store(f"sqlite:///{data}/{mode}.sqlite3", connections=1) for mode in _MODES}
        for mode, store in stores.items():
            with store.database._driver_cursor() as cursor:
                cursor.execute(f"PRAGMA synchronous={mode}")
        for _ in range(writes):
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
    return times_ms


if __name__ == "__main__":
    main()
