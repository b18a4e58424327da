"""Ten times more clients than the service takes: a few wait, those let in are served as before, the rest is refused.

    python -m benchmarks.overload --seconds 30

One client first, for what a query takes without load; then the crowd, whose refused clients wait for about a second, as
they are told; then one client again.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile

import httpx

from benchmarks.load import Load, ask_for, faults, per_second, percentiles_ms, upload_example_plan
from examples.launch import running_service

_TIMES = 10
_ACCEPTED_P99_RATIO, _REFUSED_MS, _RECOVERED_RATIO = 3.0, 50.0, 1.5


def main() -> int:
    """Run; 1 when an aim is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each part")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as data:
        settings = {"LALALOC_DATA_DIR": data, "LALALOC_LOG_LEVEL": "error"}
        with running_service(0, settings) as service:
            plan_id = upload_example_plan(service.url)
            limits = httpx.get(f"{service.url}/limits").json()
            capacity, waiting = limits["max_queries"], limits["max_waiting_queries"]
            ask_for(service.url, plan_id, Load(1, 3.0))
            alone = ask_for(service.url, plan_id, Load(1, options.seconds))
            crowd = ask_for(service.url, plan_id, Load(_TIMES * capacity, options.seconds))
            after = ask_for(service.url, plan_id, Load(1, options.seconds / 3.0))
    accepted = [reply for reply in crowd if reply.answered]
    refused = [reply for reply in crowd if reply.status == httpx.codes.SERVICE_UNAVAILABLE]
    report = {
        "capacity": capacity,
        "waiting": waiting,
        "clients": _TIMES * capacity,
        "alone": {"per_second": round(per_second(alone), 1), "milliseconds": percentiles_ms(alone)},
        "accepted": {
            "count": len(accepted),
            "per_second": round(per_second(accepted), 1),
            "milliseconds": percentiles_ms(accepted),
        },
        "refused": {"count": len(refused), "milliseconds": percentiles_ms(refused)},
        "after": {"milliseconds": percentiles_ms(after), "refused": sum(not reply.answered for reply in after)},
        "wrong": dict(faults([*alone, *crowd, *after])),
    }
    p99 = percentiles_ms(alone)["p99"]
    report["accepted_p99_over_alone_p99"] = round(percentiles_ms(accepted)["p99"] / p99, 2)
    queue_ms = 1e3 * waiting / per_second(accepted)
    aims = {
        "accepted within 3 times, and the queue": percentiles_ms(accepted)["p99"]
        <= _ACCEPTED_P99_RATIO * p99 + queue_ms,
        "refused within 50 ms": bool(refused) and percentiles_ms(refused)["p99"] <= _REFUSED_MS,
        "recovered": all(reply.answered for reply in after)
        and percentiles_ms(after)["p50"] <= _RECOVERED_RATIO * percentiles_ms(alone)["p50"],
        "nothing wrong": not report["wrong"],
    }
    print(json.dumps(report | {"aims": aims}, indent=2))
    return int(not all(aims.values()))


if __name__ == "__main__":
    sys.exit(main())
