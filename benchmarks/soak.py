"""Soak test: clients for minutes while workers are killed. No answer may be lost or wrong, and memory must not grow.

    python -m benchmarks.soak --minutes 5 --every 3

Memory is that of the service's own process. Answers at stage `vdr` count: the service falls back to them when a worker
dies late in a query.
"""

from __future__ import annotations

import json
import random
import sys
import threading
import time

import httpx
import psutil

from benchmarks.harness import argument_parser, example_service, resident_mb, run_load, worker_processes

# Growth after warm-up; less is noise of the allocator.
_MAX_GROWTH_MB = 40.0
_WARM_UP_SHARE = 0.2
_RESTART_TIMEOUT_S = 30.0


def main() -> int:
    """Run; return 1 when an answer was lost or wrong, memory grew, or the test did not test anything."""
    parser = argument_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--clients", type=int, default=4)
    parser.add_argument("--every", type=float, default=3.0, help="seconds between kills")
    options = parser.parse_args()
    seconds, memory_mb, killed, stop = 60.0 * options.minutes, list[float](), list[int](), threading.Event()
    with example_service() as service:

        def kill_workers() -> None:
            rng = random.Random(0)
            while not stop.wait(options.every):
                if workers := worker_processes(service.process):
                    worker = rng.choice(workers)
                    try:
                        worker.kill()
                    except psutil.NoSuchProcess:
                        continue
                    killed.append(worker.pid)

        def sample_memory() -> None:
            while not stop.wait(seconds / 50.0):
                memory_mb.append(resident_mb(service.process))

        threads = [threading.Thread(target=work) for work in (kill_workers, sample_memory)]
        for thread in threads:
            thread.start()
        result = run_load(service.url, [service.plan_id], options.clients, seconds)
        stop.set()
        for thread in threads:
            thread.join()
        restarted = _workers_restart(service.url)
    warm = memory_mb[int(_WARM_UP_SHARE * len(memory_mb)) :]
    answered = result.answered
    report = {
        "answered": answered.count,
        "per_second": round(answered.per_second, 1),
        "stages": result.stages,
        "milliseconds": answered.percentiles_ms(),
        "refused": result.refused.count,
        "failed": result.failures,
        "workers_killed": len(killed),
        "workers_restarted": restarted,
        "resident_mb": {"start": warm[0], "middle": warm[len(warm) // 2], "end": warm[-1]},
    }
    print(json.dumps(report, indent=2))
    # Without kills or without LPO the test would pass and show nothing.
    is_valid = len(killed) >= seconds / options.every / 2.0 and result.stages.get("lpo", 0) > 0
    lost = result.refused.count + result.failures
    return int(lost > 0 or not is_valid or not restarted or warm[-1] > warm[0] + _MAX_GROWTH_MB)


def _workers_restart(url: str) -> bool:
    """Return whether all workers are ready again within the timeout."""
    deadline = time.monotonic() + _RESTART_TIMEOUT_S
    while time.monotonic() < deadline:
        pools = httpx.get(f"{url}/readyz").json()
        if all(pools[pool]["ready"] == pools[pool]["workers"] for pool in ("lpo_pool", "decode_pool")):
            return True
        time.sleep(0.2)
    return False


if __name__ == "__main__":
    sys.exit(main())
