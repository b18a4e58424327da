"""Database outage: PostgreSQL stops for some seconds. Cached plans localise, other requests get 503, all recovers.

    python -m benchmarks.outage --seconds 10

Needs PostgreSQL's server programs (Debian: `apt-get install postgresql`).
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import httpx

from benchmarks.harness import LoadResult, argument_parser, example_service, run_load
from examples.truth import PLAN_PATH
from tests.service.postgres import postgres_programs, postgres_server

_MAX_RECOVERY_S, _TIMEOUT_S = 5.0, 30.0


def main() -> int:
    """Run; return 1 when an answer is not as expected."""
    parser = argument_parser(__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of the outage")
    seconds = parser.parse_args().seconds
    programs = postgres_programs()
    if programs is None:
        parser.error("PostgreSQL is not installed (Debian: apt-get install postgresql)")
    with (
        postgres_server(programs) as server,
        example_service({"LALALOC_DATABASE_URL": server.new_database()}) as service,
        httpx.Client(base_url=service.url, timeout=_TIMEOUT_S) as client,
        ThreadPoolExecutor(3) as threads,
    ):

        def localise(duration_s: float) -> LoadResult:
            return run_load(service.url, [service.plan_id], 1, duration_s)

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
        while client.get("/floorplans").status_code != httpx.codes.OK and time.perf_counter() - begin < _TIMEOUT_S:
            time.sleep(0.1)
        recovery_s = time.perf_counter() - begin
        after = localise(5.0)
    expected = {
        "cached plans localise": _is_right(during),
        "other requests get 503": all(status == httpx.codes.SERVICE_UNAVAILABLE for status, _ in refused),
        "recovers by itself": recovery_s <= _MAX_RECOVERY_S and _is_right(before) and _is_right(after),
    }
    report = {
        "outage_s": seconds,
        "cached_plan": {
            name: {"answered": result.answered.count, "milliseconds": result.answered.percentiles_ms()}
            for name, result in (("before", before), ("during", during), ("after", after))
        },
        "other_statuses": dict(Counter(str(status) for status, _ in refused)),
        "slowest_refusal_s": round(max(duration_s for _, duration_s in refused), 2),
        "recovery_s": round(recovery_s, 2),
        "expected": expected,
    }
    print(json.dumps(report, indent=2))
    return int(not all(expected.values()))


def _is_right(result: LoadResult) -> bool:
    return result.answered.count > 0 and not result.failures + result.refused.count


if __name__ == "__main__":
    sys.exit(main())
