"""Fuzzing: thousands of invalid requests must cause no internal error, no hang and no lost worker.

    python -m benchmarks.fuzz --requests 10000

schemathesis makes half of the requests from the API's description. A quarter are panoramas and a quarter floor plans
with changed bytes or values. The seed is fixed, so every finding can be reproduced.
"""

from __future__ import annotations

import io
import itertools
import json
import random
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import httpx
import hypothesis
import hypothesis.errors
import numpy as np
import schemathesis
from PIL import Image

from benchmarks.harness import argument_parser, example_service
from examples.truth import PLAN_PATH, read_poses

_HANG_S = 5.0
# A line of a stack trace. A single word would also match answers that quote a request.
_TRACE = re.compile(r"line \d+, in ")
_CLIENTS = 4
# Requests to one operation in a row.
_EXAMPLES = 60
# The answer to a valid request for events is endless.
_EXCLUDED = r"/events$"


@dataclass
class Outcome:
    """Answers by kind of request and status; `bad` ones show a defect of the service."""

    statuses: dict[str, Counter[str]] = field(default_factory=dict)
    bad: list[str] = field(default_factory=list)
    slowest_s: float = 0.0

    def sent(self, kind: str) -> int:
        """Return the number of requests of a kind."""
        return sum(self.statuses.get(kind, Counter()).values())

    @property
    def most_processed(self) -> bool:
        """True if the service processed most requests of every kind instead of refusing them as busy."""
        return all(2 * found["503"] < sum(found.values()) for found in self.statuses.values())

    def note(self, kind: str, send: Callable[[], httpx.Response]) -> None:
        """Send a request and check the answer."""
        begin = time.perf_counter()
        try:
            answer = send()
        except httpx.HTTPError as error:
            self.statuses.setdefault(kind, Counter())[type(error).__name__] += 1
            self.bad.append(f"{kind}: {type(error).__name__} {error}")
            return
        seconds = time.perf_counter() - begin
        self.slowest_s = max(self.slowest_s, seconds)
        self.statuses.setdefault(kind, Counter())[str(answer.status_code)] += 1
        deliberate = answer.status_code == httpx.codes.SERVICE_UNAVAILABLE and "retry-after" in answer.headers
        if (answer.status_code >= 500 and not deliberate) or _TRACE.search(answer.text):
            self.bad.append(f"{kind}: {answer.status_code} {answer.text[:300]}")
        if seconds > _HANG_S:
            self.bad.append(f"{kind}: took {seconds:.1f} s")


def main() -> int:
    """Run; return 1 when the service failed, hung or lost a worker."""
    parser = argument_parser(__doc__)
    parser.add_argument("--requests", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    outcome = Outcome()
    with example_service() as service, httpx.Client(base_url=service.url, timeout=30.0) as client:
        before, quarter = replaced_workers(client), options.requests // 4
        with ThreadPoolExecutor(_CLIENTS) as threads:
            panoramas = _panoramas(client, service.plan_id, quarter, options.seed)
            list(
                threads.map(
                    lambda request: outcome.note(*request), [*panoramas, *_plans(client, quarter, options.seed)]
                )
            )
        _send_described(service.url, service.plan_id, options.requests - 2 * quarter, options.seed, outcome)
        after = replaced_workers(client)
        is_healthy = client.get("/healthz").status_code == httpx.codes.OK and service.process.is_running()
    report = {
        "requests": sum(sum(found.values()) for found in outcome.statuses.values()),
        "statuses": {kind: dict(sorted(found.items())) for kind, found in sorted(outcome.statuses.items())},
        "slowest_s": round(outcome.slowest_s, 2),
        "workers_replaced": after - before,
        "bad": dict(Counter(outcome.bad).most_common(20)),
    }
    print(json.dumps(report, indent=2))
    return int(bool(outcome.bad) or after > before or not is_healthy or not outcome.most_processed)


def replaced_workers(client: httpx.Client) -> int:
    """Return the number of workers that the service has restarted."""
    found = re.findall(r"^lalaloc_pool_restarts_total{.*} (\S+)$", client.get("/metrics").text, re.MULTILINE)
    return int(sum(map(float, found)))


def _send_described(url: str, plan_id: str, requests: int, seed: int, outcome: Outcome) -> None:
    """Send requests that follow the API's description and requests that violate it; most name an existing plan."""
    schema = schemathesis.openapi.from_url(f"{url}/openapi.json").exclude(path_regex=_EXCLUDED)
    operations = [found.ok() for found in schema.get_all_operations()]  # pyright: ignore[reportAttributeAccessIssue]
    before_round = 0
    strategies = [
        operation.as_strategy(generation_mode=mode) for operation in operations for mode in schemathesis.GenerationMode
    ]
    for round_seed in itertools.count(seed):
        sent = outcome.sent("described")
        if round_seed > seed and sent == before_round:
            raise RuntimeError("schemathesis makes no requests from the API's description at /openapi.json")
        before_round = sent
        for strategy in strategies:
            if outcome.sent("described") >= requests:
                return

            @hypothesis.seed(round_seed)
            @hypothesis.settings(
                max_examples=_EXAMPLES,
                database=None,
                deadline=None,
                phases=[hypothesis.Phase.generate],
                suppress_health_check=[*hypothesis.HealthCheck],  # pyright: ignore[reportArgumentType]
            )
            @hypothesis.given(case=strategy)
            def send(case: Any) -> None:
                # Random ids never exist; requests that delete keep them, so that the plan stays.
                if outcome.sent("described") % 4 and case.method != "DELETE" and "floorplan_id" in case.path_parameters:
                    case.path_parameters["floorplan_id"] = plan_id
                outcome.note("described", lambda: _sent(case, url))

            # Operations without parameters have no invalid requests.
            with suppress(hypothesis.errors.Unsatisfiable):
                send()


def _sent(case: Any, url: str) -> httpx.Response:
    answer = case.call(base_url=url, timeout=30.0)
    headers = [(name, value) for name, values in answer.headers.items() for value in values]
    # The body is already decoded.
    kept = [(name, value) for name, value in headers if name.lower() != "content-encoding"]
    return httpx.Response(answer.status_code, headers=kept, content=answer.content or b"")


def _panoramas(
    client: httpx.Client, plan_id: str, count: int, seed: int
) -> Iterator[tuple[str, Callable[[], httpx.Response]]]:
    rng = random.Random(seed)
    with Image.open(io.BytesIO(read_poses()[0].picture.read_bytes())) as opened:
        picture = opened.convert("RGB").resize((256, 128))
    valid = {name: _encoded(picture, name) for name in ("JPEG", "PNG", "WEBP")}
    for _ in range(count):
        name = rng.choice(list(valid))
        content = mutated(valid[name], rng)

        def send(content: bytes = content) -> httpx.Response:
            return client.post("/localise", data={"floorplan_id": plan_id}, files={"panorama": ("p", content)})

        yield f"mutated {name}", send


def _encoded(picture: Image.Image, name: str) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, name)
    return buffer.getvalue()


def mutated(content: bytes, rng: random.Random) -> bytes:
    """Return the bytes with some of them changed, removed, doubled or cut off."""
    found = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        place = rng.randrange(len(found)) if len(found) > 1 else 0
        # Half of the changes hit the header, which decides more than pixels.
        place = place if rng.random() < 0.5 else min(place, rng.randrange(1, 200))
        kind = rng.randrange(5)
        if kind == 0:
            found[place : place + 1] = bytes([rng.randrange(256)])
        elif kind == 1:
            found[place : place + 4] = rng.choice((b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x7f\xff\xff\xff"))
        elif kind == 2:
            del found[place : place + rng.randrange(1, 64)]
        elif kind == 3:
            found[place:place] = found[place : place + rng.randrange(1, 64)]
        else:
            del found[max(place, 1) :]
    return bytes(found)


def _plans(client: httpx.Client, count: int, seed: int) -> Iterator[tuple[str, Callable[[], httpx.Response]]]:
    rng = random.Random(seed + 1)
    text = PLAN_PATH.read_bytes()
    for number in range(count):
        if number % 2:
            kind, content = "mutated bytes of a plan", mutated(text, rng)
        else:
            kind, content = "mutated values of a plan", json.dumps(_bent(json.loads(text), rng)).encode()

        def send(content: bytes = content) -> httpx.Response:
            return client.post("/floorplans", content=content, headers={"Content-Type": "application/json"})

        yield kind, send


_ODD: tuple[Any, ...] = (
    *(None, True, "", "x" * 10_000, [], {}, [[[[]]]], 0, -1, 1e308, -1e308, 1e-308, 2**63, float("nan"), float("inf")),
    *("\0", "\ud800", "<script>", {"a": {"b": []}}, list(range(1000)), np.pi),
)


def _bent(value: Any, rng: random.Random) -> Any:
    """Return the JSON value with one of its parts replaced, removed or doubled."""
    if isinstance(value, dict | list) and value and rng.random() < 0.85:
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        key, kind = rng.choice(keys), rng.random()
        if kind < 0.1:
            del value[key]
        elif kind < 0.2 and isinstance(value, list):
            value.insert(key, value[key])
        else:
            value[key] = _bent(value[key], rng)
        return value
    if isinstance(value, int | float) and rng.random() < 0.5:
        return value * rng.choice((-1, 0, 1e-6, 1e6, 1 + 1e-9)) + rng.choice((0, 0, 1e-9, 0.1))
    return rng.choice(_ODD)


if __name__ == "__main__":
    sys.exit(main())
