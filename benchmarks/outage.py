"""PostgreSQL stops for ten seconds: plans in memory are answered, others refused, and all is well after that.

    python -m benchmarks.outage --seconds 10

Needs PostgreSQL's server programs (Debian: `apt-get install postgresql`).
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any

import httpx

from benchmarks.load import Reply, ask, percentiles_ms, queries, upload_example_plan
from examples.launch import running_service
from examples.truth import PLAN_PATH
from tests.service.postgres import PostgresServer, postgres_programs, postgres_server

_RECOVERED_WITHIN_S, _GIVE_UP_S = 5.0, 30.0
_UNREAD = "0" * 32


def main() -> int:
    """Run; 1 when an answer is not what it should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="how long the database is away")
    options = parser.parse_args()
    programs = postgres_programs()
    if programs is None:
        parser.error("PostgreSQL is not installed")
    with postgres_server(programs) as server, tempfile.TemporaryDirectory() as data:
        settings = {"LALALOC_DATA_DIR": data, "LALALOC_DATABASE_URL": server.new_database()}
        with running_service(0, settings | {"LALALOC_LOG_LEVEL": "error"}) as service:
            known = upload_example_plan(service.url)
            report = asyncio.run(_through_an_outage(service.url, known, server, options.seconds))
    print(json.dumps(report, indent=2))
    return int(not all(report["holds"].values()))


async def _through_an_outage(url: str, known: str, server: PostgresServer, seconds: float) -> dict[str, Any]:
    plan, as_json = PLAN_PATH.read_bytes(), {"Content-Type": "application/json"}
    async with httpx.AsyncClient(base_url=url, timeout=30.0) as client:
        before = await _asked(client, known, 5.0)
        server.stop()
        during, listed, uploaded, unknown = await asyncio.gather(
            _asked(client, known, seconds),
            _repeated(seconds, lambda: client.get("/floorplans")),
            _repeated(seconds, lambda: client.post("/floorplans", content=plan, headers=as_json)),
            _repeated(seconds, lambda: client.get(f"/floorplans/{_UNREAD}")),
        )
        server.start()
        begin = time.perf_counter()
        while (await client.get("/floorplans")).status_code != httpx.codes.OK:
            if time.perf_counter() - begin > _GIVE_UP_S:
                break
            await asyncio.sleep(0.1)
        recovered_s = time.perf_counter() - begin
        after = await _asked(client, known, 5.0)
    away = listed + uploaded + unknown
    return {
        "seconds_away": seconds,
        "cached_plan": {
            name: {"queries": len(replies), "right": _right(replies), "milliseconds": percentiles_ms(replies)}
            for name, replies in (("before", before), ("during", during), ("after", after))
        },
        "all_else_during": dict(Counter(str(reply.status) for reply in away)),
        "slowest_refusal_s": round(max(reply.seconds for reply in away), 2),
        "recovered_after_s": round(recovered_s, 2),
        "holds": {
            "cached plans localise": _right(during) == len(during) > 0,
            "the rest is refused": all(reply.status == httpx.codes.SERVICE_UNAVAILABLE for reply in away),
            "recovers by itself": recovered_s <= _RECOVERED_WITHIN_S and _right(after) == len(after) > 0,
        },
    }


def _right(replies: list[Reply]) -> int:
    return sum(reply.answered and reply.fault is None for reply in replies)


async def _asked(client: httpx.AsyncClient, plan_id: str, seconds: float) -> list[Reply]:
    """One client's queries, one after the other."""
    end, replies, asked = time.perf_counter() + seconds, [], queries()
    while time.perf_counter() < end:
        replies.append(await ask(client, plan_id, asked[len(replies) % len(asked)]))
    return replies


async def _repeated(seconds: float, send: Callable[[], Awaitable[httpx.Response]]) -> list[Reply]:
    """The same request twice a second."""
    end, replies = time.perf_counter() + seconds, []
    while time.perf_counter() < end:
        begin = time.perf_counter()
        answer = await send()
        replies.append(Reply(begin, time.perf_counter() - begin, answer.status_code))
        await asyncio.sleep(0.5)
    return replies


if __name__ == "__main__":
    sys.exit(main())
