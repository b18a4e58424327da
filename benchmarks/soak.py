"""Four clients for minutes while workers are killed: every answer is right, none is lost, memory does not grow.

    python -m benchmarks.soak --minutes 5 --every 3

The service's own process is measured at the start, in the middle and at the end. Answers at stage `vdr` are answers:
it is what is left when a worker dies late in a query.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import threading
import time
from collections import Counter

import httpx

from benchmarks.load import Load, Reply, ask_for, faults, per_second, percentiles_ms, upload_example_plan
from benchmarks.processes import kill, resident_mb, workers
from examples.launch import running_service

# After warm-up; what is less is noise of the allocator.
_GROWTH_MB = 40.0
_WARM_UP_SHARE = 0.2
_BACK_WITHIN_S = 30.0


def main() -> int:
    """Run; 1 when something was lost, wrong, or grew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--clients", type=int, default=4)
    parser.add_argument("--every", type=float, default=3.0, help="seconds between kills")
    options = parser.parse_args()
    seconds = 60.0 * options.minutes
    with tempfile.TemporaryDirectory() as data:
        settings = {"LALALOC_DATA_DIR": data, "LALALOC_LOG_LEVEL": "error"}
        with running_service(0, settings) as service:
            plan_id = upload_example_plan(service.url)
            memory: list[float] = []
            killed: Counter[str] = Counter()
            stop = threading.Event()

            def reap() -> None:
                rng = random.Random(0)
                while not stop.wait(options.every):
                    alive = workers(service.process.pid)
                    if alive:
                        killed[str(kill(rng.choice(alive)))] += 1

            def watch() -> None:
                while not stop.wait(seconds / 50.0):
                    memory.append(resident_mb(service.process.pid))

            threads = [threading.Thread(target=work) for work in (reap, watch)]
            for thread in threads:
                thread.start()
            replies: list[Reply] = ask_for(service.url, plan_id, Load(options.clients, seconds))
            stop.set()
            for thread in threads:
                thread.join()
            back = _all_back(service.url)
    warm = memory[int(_WARM_UP_SHARE * len(memory)) :]
    lost = [reply for reply in replies if not reply.answered]
    report = {
        "requests": len(replies),
        "per_second": round(per_second(replies), 1),
        "stages": dict(Counter(reply.stage for reply in replies)),
        "milliseconds": percentiles_ms(replies),
        "workers_killed": killed["True"],
        "without_answer": len(lost),
        "wrong": dict(faults(replies)),
        "all_workers_back": back,
        "resident_mb": {"start": warm[0], "middle": warm[len(warm) // 2], "end": warm[-1]},
    }
    print(json.dumps(report, indent=2))
    # It would all be well also if nothing had been killed, or LPO were given up.
    real = killed["True"] >= seconds / options.every / 2.0 and report["stages"].get("lpo", 0) > 0 and back
    return int(bool(lost) or bool(report["wrong"]) or not real or warm[-1] > warm[0] + _GROWTH_MB)


def _all_back(url: str) -> bool:
    """Whether all workers are warm again soon after the last was killed."""
    deadline = time.monotonic() + _BACK_WITHIN_S
    while time.monotonic() < deadline:
        told = httpx.get(f"{url}/readyz").json()
        if all(told[pool]["ready"] == told[pool]["workers"] for pool in ("lpo_pool", "decode_pool")):
            return True
        time.sleep(0.2)
    return False


if __name__ == "__main__":
    sys.exit(main())
