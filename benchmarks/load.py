"""Clients of a running service that ask with the example panoramas and know the right answers."""

from __future__ import annotations

import asyncio
import itertools
import math
import random
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import httpx
import numpy as np

from examples.truth import PLAN_PATH, TruePose, read_poses

# An answer that is further off was not computed from this panorama and this plan.
RIGHT_WITHIN_M = 0.5
_TIMEOUT_S = 60.0
_BEGIN_WITHIN_S = 1.0


@dataclass(frozen=True)
class Query:
    """A panorama with what is known of it."""

    pose: TruePose
    picture: bytes


@dataclass(frozen=True)
class Reply:
    """One request: when it was sent, how long it took, and what came back.

    Attributes:
        sent_s: on the clock of `time.perf_counter`.
        status: of HTTP; 0 when the connection broke.
        stage: that answered.
        fault: what is wrong with the reply; None for a right answer, and for a refusal with `Retry-After`.
    """

    sent_s: float
    seconds: float
    status: int
    stage: str | None = None
    fault: str | None = None

    @property
    def answered(self) -> bool:
        """Whether it is an answer, be it right or wrong."""
        return self.status == httpx.codes.OK


@dataclass(frozen=True)
class Load:
    """So many clients, each of which asks, waits for the reply, and asks again.

    Attributes:
        clients: how many ask at the same time; they connect first, and begin within a second.
        seconds: how long new requests are made.
        after_refusal_s: how long a refused client waits before it asks again, give or take a half.
    """

    clients: int
    seconds: float
    after_refusal_s: float = 1.0


def queries() -> list[Query]:
    """The example panoramas."""
    return [Query(pose, pose.picture.read_bytes()) for pose in read_poses()]


def upload_example_plan(url: str, headers: dict[str, str] | None = None) -> str:
    """Store the example plan and wait until it is ready; gives its id."""
    with httpx.Client(base_url=url, timeout=_TIMEOUT_S, headers=headers) as client:
        answer = client.post("/floorplans", files={"file": (PLAN_PATH.name, PLAN_PATH.read_bytes())})
        answer.raise_for_status()
        plan_id: str = answer.json()["id"]
        while (status := client.get(f"/floorplans/{plan_id}").json()["status"]) == "preparing":
            time.sleep(0.1)
    if status != "ready":
        raise RuntimeError(f"the example plan is {status}")
    return plan_id


def ask_for(url: str, plan_id: str, load: Load, each: Callable[[Reply], None] | None = None) -> list[Reply]:
    """Put a load on the service; returns every request's reply.

    Args:
        each: called with every reply as it comes.
    """
    return asyncio.run(_ask_for(url, plan_id, load, each or (lambda _: None)))


async def _ask_for(url: str, plan_id: str, load: Load, each: Callable[[Reply], None]) -> list[Reply]:
    asked = queries()
    replies: list[Reply] = []
    limits = httpx.Limits(max_connections=None, max_keepalive_connections=None)
    async with httpx.AsyncClient(base_url=url, timeout=_TIMEOUT_S, limits=limits) as client:
        # Connecting takes these clients longer than it takes the service to refuse them.
        await asyncio.gather(*(client.get("/healthz") for _ in range(load.clients)))
        end = time.perf_counter() + load.seconds

        async def one(number: int) -> None:
            rng = random.Random(number)
            await asyncio.sleep(_BEGIN_WITHIN_S * number / load.clients)
            for query in itertools.islice(itertools.cycle(asked), number % len(asked), None):
                if time.perf_counter() >= end:
                    return
                reply = await ask(client, plan_id, query)
                replies.append(reply)
                each(reply)
                if not reply.answered:
                    await asyncio.sleep(load.after_refusal_s * rng.uniform(0.5, 1.5))

        await asyncio.gather(*(one(number) for number in range(load.clients)))
    return replies


async def ask(client: httpx.AsyncClient, plan_id: str, query: Query) -> Reply:
    """Send one query."""
    pose = query.pose
    fields = {
        "floorplan_id": plan_id,
        "heading_deg": f"{pose.heading_deg}",
        "camera_height_m": f"{pose.camera_height_m}",
    }
    begin = time.perf_counter()
    try:
        answer = await client.post("/localise", data=fields, files={"panorama": (pose.file, query.picture)})
    except httpx.TransportError as error:
        return Reply(begin, time.perf_counter() - begin, 0, fault=f"{type(error).__name__}: {error}")
    seconds = time.perf_counter() - begin
    if answer.status_code != httpx.codes.OK:
        return Reply(begin, seconds, answer.status_code, fault=_fault_of_refusal(answer))
    content = answer.json()
    off_m = math.dist((content["position"]["x_m"], content["position"]["y_m"]), (pose.x_m, pose.y_m))
    fault = None if off_m <= RIGHT_WITHIN_M else f"{pose.file}: {off_m:.2f} m off at stage {content['stage']}"
    return Reply(begin, seconds, answer.status_code, content["stage"], fault)


def _fault_of_refusal(answer: httpx.Response) -> str | None:
    """What is wrong with a refusal: only 503 and 429 that say when to come back are right."""
    if answer.status_code in (429, 503) and answer.headers.get("retry-after", "").isdecimal():
        return None
    return f"{answer.status_code}: {answer.text[:200]}"


def faults(replies: Sequence[Reply]) -> Counter[str]:
    """What was wrong, by how often."""
    return Counter(reply.fault for reply in replies if reply.fault is not None)


def percentiles_ms(replies: Sequence[Reply]) -> dict[str, float]:
    """Median, 95th and 99th percentile of how long replies took."""
    seconds = np.array([reply.seconds for reply in replies])
    return {f"p{q}": round(1e3 * float(np.percentile(seconds, q)), 1) for q in (50, 95, 99)} if len(seconds) else {}


def per_second(replies: Sequence[Reply]) -> float:
    """Replies per second between the first sent and the last received."""
    if not replies:
        return 0.0
    begin = min(reply.sent_s for reply in replies)
    return len(replies) / (max(reply.sent_s + reply.seconds for reply in replies) - begin)
