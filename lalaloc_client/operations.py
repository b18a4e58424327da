"""What the client does, without doing it: generators that yield what to send and how long to wait.

`Client` and `AsyncClient` run the same generators; they differ in nothing but how they send and wait.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from time import monotonic
from typing import Any, TypeVar

import httpx

from lalaloc_client.answers import GeoPoseAnswer, Localisation, Readiness, SequenceLocalisation
from lalaloc_client.errors import (
    ConnectionFailedError,
    FloorPlanFailedError,
    MalformedAnswerError,
    NotReadyError,
    ProblemError,
    problem_class,
)
from lalaloc_client.layout import Layout
from lalaloc_client.model import FloorPlan, FloorPlanPage, PlanEvent, Venue, VenuePage, VenuePlanPage
from lalaloc_client.parsing import parse
from lalaloc_client.requests import Request, limits_request, plan_request, ready_request
from lalaloc_client.retry import RetryPolicy, may_retry, retry_after_s

T = TypeVar("T")

_FIRST_POLL_S, _MAX_POLL_S = 0.1, 2.0
_SHOWN_CHARACTERS = 500
# Where the service does not say how many it takes: less than on any machine.
_DEFAULT_MAX_QUERIES = 3
# What fails before any of a request has left.
_UNSENT = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout)


@dataclass(frozen=True)
class Wait:
    """Do nothing for so long."""

    duration_s: float


@dataclass(frozen=True)
class Reply:
    """What came of sending a request: an answer, read to its end unless it is a stream, or the error."""

    response: httpx.Response | None = None
    failure: httpx.TransportError | None = None


Steps = Generator[Request | Wait, Reply, T]


@dataclass(frozen=True)
class Patience:
    """How requests are repeated, and the clock and the chance for it."""

    policy: RetryPolicy
    clock_s: Callable[[], float] = monotonic
    chance: Callable[[], float] = random.random

    def within(self, total_s: float) -> Patience:
        """No more patience than so long."""
        return replace(self, policy=replace(self.policy, total_s=min(self.policy.total_s, max(total_s, 0.0))))


@dataclass(frozen=True)
class Sent:
    """An answer, and whether an attempt before it may have been carried out as well."""

    response: httpx.Response
    maybe_before: bool


def send(request: Request, patience: Patience) -> Steps[Sent]:
    """Send a request until there is an answer that trying again does not better.

    Raises:
        ConnectionFailedError: there was none.
        ProblemError: it is a problem.
    """
    begin_s, attempt, maybe_before = patience.clock_s(), 0, False
    while True:
        attempt += 1
        reply = yield request
        response, failure = reply.response, reply.failure
        if response is not None and response.status_code in request.answers:
            return Sent(response, maybe_before)
        sent = not isinstance(failure, _UNSENT)
        status = None if response is None else response.status_code
        wait_s = None
        asked_s = None if response is None else _asked_s(response)
        if may_retry(request.safety, status, sent=sent, asked=asked_s is not None):
            wait_s = patience.policy.wait_s(attempt, patience.clock_s() - begin_s, asked_s, patience.chance())
        if wait_s is None:
            if response is not None:
                if maybe_before and request.method == "DELETE" and status == httpx.codes.NOT_FOUND:
                    # The attempt whose answer was lost has deleted it.
                    return Sent(response, maybe_before)
                raise problem_of(response)
            raise ConnectionFailedError(
                f"{request.method} {request.path} had no answer after {attempt} attempts: "
                f"{type(failure).__name__} {failure}".rstrip()
            ) from failure
        maybe_before = maybe_before or (response is None and sent)
        yield Wait(wait_s)


def plan(request: Request, patience: Patience) -> Steps[FloorPlan]:
    """Send a request that is answered with a floor plan."""
    response = (yield from send(request, patience)).response
    return replace(parse(FloorPlan, _json(response)), etag=response.headers.get("etag"))


def page(request: Request, patience: Patience) -> Steps[FloorPlanPage]:
    """Send a request for a page of plans."""
    return parse(FloorPlanPage, _json((yield from send(request, patience)).response))


def venue(request: Request, patience: Patience) -> Steps[Venue]:
    """Send a request that is answered with a venue."""
    response = (yield from send(request, patience)).response
    return replace(parse(Venue, _json(response)), etag=response.headers.get("etag"))


def venue_page(request: Request, patience: Patience) -> Steps[VenuePage]:
    """Send a request for a page of venues."""
    return parse(VenuePage, _json((yield from send(request, patience)).response))


def venue_plan_page(request: Request, patience: Patience) -> Steps[VenuePlanPage]:
    """Send a request for a page of the plans of a venue."""
    return parse(VenuePlanPage, _json((yield from send(request, patience)).response))


def layout(request: Request, patience: Patience) -> Steps[Layout]:
    """Send a request for the walls of a plan."""
    return parse(Layout, _json((yield from send(request, patience)).response))


def localisation(request: Request, patience: Patience) -> Steps[Localisation]:
    """Send a query."""
    return parse(Localisation, _json((yield from send(request, patience)).response))


def sequence(request: Request, patience: Patience) -> Steps[SequenceLocalisation]:
    """Send a query of several panoramas."""
    return parse(SequenceLocalisation, _json((yield from send(request, patience)).response))


def geopose(request: Request, patience: Patience) -> Steps[GeoPoseAnswer]:
    """Send a request of the OSCP GeoPose protocol."""
    return parse(GeoPoseAnswer, _json((yield from send(request, patience)).response))


def content(request: Request, patience: Patience) -> Steps[bytes]:
    """Send a request that is answered with a file."""
    return (yield from send(request, patience)).response.content


def stream(request: Request, patience: Patience) -> Steps[httpx.Response]:
    """Send a request whose answer is read as it comes; whoever gets it closes it."""
    return (yield from send(request, patience)).response


def delete(request: Request, patience: Patience) -> Steps[None]:
    """Send a request that is answered with nothing."""
    yield from send(request, patience)


def limits(patience: Patience) -> Steps[Mapping[str, Any]]:
    """Ask for the service's limits."""
    answer = _json((yield from send(limits_request(), patience)).response)
    if not isinstance(answer, dict):
        raise MalformedAnswerError(f"answer is {answer!r:.100}, not an object")
    return answer


def queries_at_a_time(patience: Patience) -> Steps[int]:
    """How many queries the service takes of one client at a time, by its limits."""
    try:
        told = yield from limits(patience)
    except ProblemError:
        # A key that may ask, but not read.
        return _DEFAULT_MAX_QUERIES
    own = told.get("max_queries_per_tenant")
    return own if isinstance(own, int) and own > 0 else _DEFAULT_MAX_QUERIES


def readiness(patience: Patience) -> Steps[Readiness]:
    """Ask whether the service is ready."""
    return parse(Readiness, _json((yield from send(ready_request(), patience)).response))


def ready_plan(floorplan_id: str, timeout_s: float, patience: Patience) -> Steps[FloorPlan]:
    """Look at a plan, ever more rarely, until it is ready.

    Raises:
        FloorPlanFailedError: it will not be.
        NotReadyError: it was not in time.
    """
    begin_s, pause_s = patience.clock_s(), _FIRST_POLL_S
    while True:
        left_s = timeout_s - (patience.clock_s() - begin_s)
        found = yield from plan(plan_request(floorplan_id), patience.within(left_s))
        if found.status == "ready":
            return found
        if found.status == "failed":
            raise FloorPlanFailedError(floorplan_id, found.reason)
        spent_s = patience.clock_s() - begin_s
        if spent_s >= timeout_s:
            raise NotReadyError(floorplan_id, spent_s, found.progress)
        # The last look is at the very end.
        yield Wait(min(pause_s, timeout_s - spent_s))
        pause_s = min(1.5 * pause_s, _MAX_POLL_S)


def problem_of(response: httpx.Response) -> ProblemError:
    """The error that an answer stands for; whoever stands before the service may answer without a document."""
    try:
        document = json.loads(response.content)
    except ValueError:
        document = None
    if not isinstance(document, dict):
        document = {}
    shown = response.text.strip()[:_SHOWN_CHARACTERS] or response.reason_phrase
    faults = document.get("errors") if isinstance(document.get("errors"), list) else []
    return problem_class(response.status_code)(
        str(document.get("type", "about:blank")),
        response.status_code,
        str(document.get("detail", shown)),
        request_id=document.get("request_id") or response.headers.get("x-request-id"),
        faults=[(str(one.get("field")), str(one.get("message"))) for one in faults or [] if isinstance(one, dict)],
    )


def plan_event(data: str) -> PlanEvent:
    """What a message of a plan's event stream says."""
    try:
        document = json.loads(data)
    except ValueError as error:
        raise MalformedAnswerError(f"the event is not JSON: {data[:_SHOWN_CHARACTERS]!r}") from error
    return parse(PlanEvent, document, "event")


def _asked_s(response: httpx.Response) -> float | None:
    headers = response.headers
    return retry_after_s(headers.get("retry-after"), headers.get("date"), datetime.now(UTC))


def _json(response: httpx.Response) -> object:
    try:
        return json.loads(response.content)
    except ValueError as error:
        raise MalformedAnswerError(f"the answer is not JSON: {response.text[:_SHOWN_CHARACTERS]!r}") from error
