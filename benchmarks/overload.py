"""Overload: ten times more clients than the service accepts at once.

    python -m benchmarks.overload --seconds 30

First one client alone, then the crowd, whose refused clients retry after about a second, then one client again.
Accepted queries must be nearly as fast as alone, refusals must come at once, and the service must recover.
"""

from __future__ import annotations

import json
import sys

import httpx

from benchmarks.harness import LoadResult, argument_parser, example_service, run_load

_CROWD = 10
_ACCEPTED_P99_RATIO, _REFUSED_P99_MS, _RECOVERED_P50_RATIO = 3.0, 50.0, 1.5


def main() -> int:
    """Measure; return 1 when a limit is exceeded."""
    parser = argument_parser(__doc__)
    parser.add_argument("--seconds", type=float, default=30.0, help="duration of each part")
    seconds = parser.parse_args().seconds
    with example_service() as service:
        limits = httpx.get(f"{service.url}/limits").json()
        capacity, waiting = limits["max_queries"], limits["max_waiting_queries"]

        def load(clients: int, duration_s: float) -> LoadResult:
            return run_load(service.url, [service.plan_id], clients, duration_s)

        load(1, 3.0)
        alone, crowd, after = load(1, seconds), load(_CROWD * capacity, seconds), load(1, seconds / 3.0)
    accepted, refused = crowd.answered, crowd.refused
    queue_ms = 1e3 * waiting / max(accepted.per_second, 1e-9)
    accepted_limit_ms = _ACCEPTED_P99_RATIO * alone.answered.percentile_ms(99) + queue_ms
    recovered_limit_ms = _RECOVERED_P50_RATIO * alone.answered.percentile_ms(50)
    limits_kept = {
        "accepted p99 within 3 times alone, and the queue": accepted.percentile_ms(99) <= accepted_limit_ms,
        "refused within 50 ms": refused.percentile_ms(99) <= _REFUSED_P99_MS,
        "recovered": not after.refused.count and after.answered.percentile_ms(50) <= recovered_limit_ms,
        "no failures": not (alone.failures or crowd.failures or after.failures),
    }
    report = {"capacity": capacity, "waiting": waiting, "clients": _CROWD * capacity}
    parts = {"alone": alone.answered, "accepted": accepted, "refused": refused, "after": after.answered}
    for name, requests in parts.items():
        report[name] = {"count": requests.count, "per_second": round(requests.per_second, 1)}
        report[name]["milliseconds"] = requests.percentiles_ms()
    print(json.dumps(report | {"limits": limits_kept}, indent=2))
    return int(not all(limits_kept.values()))


if __name__ == "__main__":
    sys.exit(main())
