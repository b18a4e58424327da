"""Retries against a real server that fails as planned."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from typing import Any
from urllib.parse import parse_qs

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_client import (
    Client,
    ClientError,
    ConflictError,
    ConnectionFailedError,
    FloorPlanFailedError,
    ImportStep,
    MalformedAnswerError,
    NotFoundError,
    NotReadyError,
    OverloadedError,
    PlanEvent,
    ProblemError,
    RetryPolicy,
    UnauthorisedError,
)
from lalaloc_client.retry import Safety, may_retry, retry_after_s
from tests.client.conftest import FailingServer, MakeClient, Planned

QUICK = RetryPolicy(attempts=4, total_s=10.0, first_s=0.01)
LATER = Planned(503, {"type": "urn:lalaloc:problem:overloaded", "detail": "too much"}, {"X-Request-ID": "r-9"})
GONE = Planned(None)
READY: dict[str, Any] = {
    "ready": True,
    "model": {"name": "m", "version": "1", "sha256": "0"},
    "lpo_pool": {"workers": 1, "ready": 1, "warmed_up": True, "fault": None},
    "plans_preparing": 0,
}
PLAN: dict[str, Any] = {
    "id": "0" * 32,
    "name": "flat",
    "status": "ready",
    "progress": 1,
    "rooms": [{"name": "hall", "area_m2": 4, "ceiling_height_m": 2.5, "vertices": 4}],
    "area_m2": 4.0,
    "bounds": {"x_min_m": 0, "y_min_m": 0, "x_max_m": 2, "y_max_m": 2},
    "camera_height_m": 1.5,
    "grid": {"step_m": 0.5, "poses": 16},
    "warnings": [],
    "reason": None,
    "created_at": "2026-01-02T03:04:05Z",
}
LOCALISATION: dict[str, Any] = {
    "floorplan_id": "p",
    "floorplan_revision": "r",
    "position": {"x_m": 1.0, "y_m": 2.0},
    "heading_deg": 0.0,
    "room": "hall",
    "confidence": None,
    "stage": "vdr",
    "covariance_m2": [[1, 0.0], [0.0, 1.0]],
    "heading_std_deg": None,
    "cost": 0.1,
    "latent_distance": 0.2,
    "camera_height_m": 1.5,
    "candidates": [],
    "timings_ms": {"total": 3.0},
    "model": {"name": "m", "version": "1", "sha256": "0"},
}


def test_retried_upload_is_the_same_request(failing: FailingServer, make_client: MakeClient) -> None:
    failing.plan = [LATER, GONE, Planned(429), Planned(201, PLAN, {"ETag": '"r1"'})]
    with make_client(failing.url, retry=QUICK) as client:
        plan = client.upload_floorplan({"rooms": []})
    assert (plan.etag, plan.progress) == ('"r1"', 1.0)
    assert len(failing.requests) == 4
    assert len({(request.headers["idempotency-key"], request.body) for request in failing.requests}) == 1


def test_uploads_have_different_idempotency_keys(failing: FailingServer) -> None:
    failing.plan = [Planned(201, PLAN)] * 4
    with Client(failing.url) as client:
        for key in (None, None, "mine", "mine"):
            client.upload_floorplan({}, idempotency_key=key)
    keys = [request.headers["idempotency-key"] for request in failing.requests]
    assert len(set(keys[:2])) == 2
    assert keys[2:] == ["mine", "mine"]


def test_same_query_has_the_same_bytes(failing: FailingServer, make_client: MakeClient) -> None:
    failing.plan = [LATER, GONE, Planned(200, LOCALISATION), Planned(200, LOCALISATION)]
    with make_client(failing.url, retry=QUICK) as client:
        answer = client.localise("p", b"picture", heading_deg=1.5)
        client.localise("p", b"picture", heading_deg=1.5)
    assert answer.floorplan_revision == "r"
    assert answer.covariance_m2 == ((1.0, 0.0), (0.0, 1.0))
    assert len({(request.headers["content-type"], request.body) for request in failing.requests}) == 1
    assert failing.requests[0].body.count(b"picture") == 1


def test_retry_after_is_observed(failing: FailingServer, make_client: MakeClient) -> None:
    failing.plan = [Planned(503, headers={"Retry-After": "1"}), Planned(200, PLAN)]
    with make_client(failing.url, retry=QUICK) as client:
        client.floorplan("p")
    first, second = failing.requests
    assert second.received_s - first.received_s >= 1.0


@pytest.mark.parametrize(
    "retry_after",
    ["3600", format_datetime(datetime.now(UTC) + timedelta(hours=1), usegmt=True)],
    # The date of one process is not that of another.
    ids=["seconds", "date"],
)
def test_wait_beyond_the_total_is_not_started(
    failing: FailingServer, make_client: MakeClient, retry_after: str
) -> None:
    failing.plan = [Planned(503, {"detail": "not now"}, {"Retry-After": retry_after})]
    with make_client(failing.url, retry=QUICK) as client, pytest.raises(OverloadedError, match="not now"):
        client.floorplan("p")
    assert len(failing.requests) == 1


def test_last_problem_is_raised_after_all_attempts(failing: FailingServer, make_client: MakeClient) -> None:
    failing.plan = [LATER] * 10
    with make_client(failing.url, retry=QUICK) as client, pytest.raises(OverloadedError) as caught:
        client.localise("p", b"x")
    assert len(failing.requests) == QUICK.attempts
    problem = caught.value
    assert (problem.status, problem.type, problem.detail) == (503, "urn:lalaloc:problem:overloaded", "too much")
    assert problem.request_id == "r-9"


@pytest.mark.parametrize(
    ("status", "error"),
    [
        (404, NotFoundError),
        (401, UnauthorisedError),
        (403, UnauthorisedError),
        (412, ConflictError),
        (500, ProblemError),
    ],
)
def test_permanent_failure_is_not_retried(
    failing: FailingServer, make_client: MakeClient, status: int, error: type[ClientError]
) -> None:
    failing.plan = [Planned(status, b"<html>plain</html>")]
    with make_client(failing.url, retry=QUICK) as client, pytest.raises(error, match="about:blank: <html>plain"):
        client.upload_floorplan({})
    assert len(failing.requests) == 1


def test_conditional_replacement_is_not_repeated_blindly(failing: FailingServer, make_client: MakeClient) -> None:
    failing.plan = [LATER, GONE]
    with make_client(failing.url, retry=QUICK) as client:
        with pytest.raises(ConnectionFailedError, match=r"PUT /floorplans/p had no answer after 2 attempts"):
            client.replace_floorplan("p", {}, if_match='"r1"')
        assert failing.requests[-1].headers["if-match"] == '"r1"'
        failing.plan = [GONE, Planned(200, PLAN)]
        client.replace_floorplan("p", {})
    assert len(failing.requests) == 4


def test_deletion_with_a_lost_answer_succeeds(failing: FailingServer, make_client: MakeClient) -> None:
    failing.plan = [GONE, Planned(404), Planned(404)]
    with make_client(failing.url, retry=QUICK) as client:
        client.delete_floorplan("p")
        with pytest.raises(NotFoundError):
            client.delete_floorplan("p")


def test_unreachable_service_is_an_error_and_one_that_is_not_ready_is_none(
    failing: FailingServer, make_client: MakeClient
) -> None:
    connection_error = pytest.raises(ConnectionFailedError, match="after 4 attempts: ConnectError")
    with make_client("http://127.0.0.1:1", retry=QUICK) as client, connection_error:
        client.ready()
    failing.plan = [Planned(503, READY | {"ready": False}, {"Retry-After": "1"})]
    with make_client(failing.url) as client:
        assert client.ready().ready is False


def test_listings_are_requested_page_by_page(failing: FailingServer, make_client: MakeClient) -> None:
    summary = {name: PLAN[name] for name in ("id", "name", "status", "progress", "area_m2", "created_at")}
    pages = [[summary | {"rooms": 1, "id": f"{page}{index}"} for index in range(2)] for page in range(3)]
    failing.plan = [
        Planned(200, {"floorplans": pages[0], "next_cursor": "a+b"}),
        LATER,
        Planned(200, {"floorplans": pages[1], "next_cursor": "c"}),
        Planned(200, {"floorplans": pages[2], "next_cursor": None}),
    ]
    with make_client(failing.url, retry=QUICK) as client:
        ids = [plan.id for plan in client.floorplans("flat & co", page_size=2)]
    assert ids == ["00", "01", "10", "11", "20", "21"]
    queries = [parse_qs(request.path.partition("?")[2]) for request in failing.requests]
    assert queries[0] == {"name": ["flat & co"], "limit": ["2"]}
    assert queries[1] == queries[2] == queries[0] | {"cursor": ["a+b"]}


def test_waiting_for_a_plan_has_a_timeout(failing: FailingServer, make_client: MakeClient) -> None:
    failing.plan = [Planned(200, PLAN | {"status": "preparing", "progress": 0.25})] * 50
    with make_client(failing.url) as client, pytest.raises(NotReadyError, match=r"'p' is still preparing.*25% done"):
        client.wait_until_ready("p", timeout_s=0.4)
    # Polls become rarer, and the last one is at the timeout.
    assert 3 <= len(failing.requests) <= 6
    assert issubclass(NotReadyError, TimeoutError)


def test_failed_plan_ends_the_wait(failing: FailingServer, make_client: MakeClient) -> None:
    failing.plan = [
        Planned(200, PLAN | {"status": "preparing", "progress": 0.5}),
        LATER,
        Planned(200, PLAN | {"status": "failed", "reason": "too odd"}),
    ]
    with make_client(failing.url, retry=QUICK) as client, pytest.raises(FloorPlanFailedError, match="too odd"):
        client.wait_until_ready("p")


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (b"no json", "answer: Invalid JSON"),
        ([], "answer: Input should be an object"),
        ({name: value for name, value in PLAN.items() if name != "grid"}, "answer.grid: Field required"),
        (PLAN | {"progress": "1"}, "answer.progress: Input should be a valid number .got '1'"),
        (PLAN | {"progress": True}, "answer.progress: Input should be a valid number .got True"),
        (PLAN | {"rooms": [PLAN["rooms"][0], {}]}, "answer.rooms.1.name: Field required"),
        (PLAN | {"warnings": [1]}, "answer.warnings.0: Input should be a valid string .got 1"),
        (PLAN | {"created_at": "soon"}, "answer.created_at: Input should be a valid datetime"),
    ],
)
def test_malformed_answer_names_the_field(failing: FailingServer, answer: Any, message: str) -> None:
    failing.plan = [Planned(200, answer)]
    with Client(failing.url) as client, pytest.raises(MalformedAnswerError, match=message):
        client.floorplan("p")


def test_unknown_fields_are_ignored(failing: FailingServer, make_client: MakeClient) -> None:
    failing.plan = [Planned(200, PLAN | {"new": 1, "grid": PLAN["grid"] | {"new": []}}), Planned(200, {"top_k": 10})]
    with make_client(failing.url) as client:
        assert client.floorplan("p").grid.poses == 16
        assert client.limits() == {"top_k": 10}


def test_key_is_sent_but_not_shown(failing: FailingServer, make_client: MakeClient) -> None:
    failing.plan = [Planned(200, PLAN), Planned(302, b"", {"Location": "http://127.0.0.1:1/"})]
    with make_client(failing.url, api_key="very-secret") as client:
        client.floorplan("p")
        with pytest.raises(ProblemError, match="302") as caught:
            client.floorplan("p")
    assert [request.headers["authorization"] for request in failing.requests] == ["Bearer very-secret"] * 2
    assert "very-secret" not in repr(client) + str(caught.value)
    with pytest.raises(ValueError, match="api_key") as caught:
        Client(failing.url, api_key="very-secret\n")
    assert "very-secret" not in str(caught.value)


@pytest.mark.parametrize("address", ["localhost:8000", "ftp://x", "http://", ""])
def test_invalid_address_is_rejected(address: str) -> None:
    with pytest.raises(ValueError, match="base_url"):
        Client(address)


@given(
    st.integers(1, 12),
    st.floats(0.0, 100.0),
    st.none() | st.floats(0.0, 100.0),
    st.floats(0.0, 1.0),
    st.builds(RetryPolicy, attempts=st.integers(1, 9), total_s=st.floats(0.0, 90.0), first_s=st.floats(0.0, 9.0)),
)
def test_waits_are_bounded_and_follow_retry_after(
    attempt: int, spent_s: float, after_s: float | None, chance: float, policy: RetryPolicy
) -> None:
    wait_s = policy.wait_s(attempt, spent_s, after_s, chance)
    if wait_s is None:
        longest_s = policy.longest_s if after_s is None else after_s + policy.first_s
        assert attempt >= policy.attempts or spent_s + longest_s > policy.total_s
        return
    assert attempt < policy.attempts
    assert spent_s + wait_s <= policy.total_s
    assert wait_s >= (after_s or 0.0)
    assert after_s is not None or wait_s <= policy.longest_s


@given(st.integers(0, 10**6))
def test_retry_after_date_counts_from_the_answer_date(seconds: int) -> None:
    date = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)
    until = format_datetime(date + timedelta(seconds=seconds), usegmt=True)
    wrong_clock = date + timedelta(days=400)
    assert retry_after_s(until, format_datetime(date, usegmt=True), wrong_clock) == seconds
    assert retry_after_s(until, None, date) == seconds
    assert retry_after_s(until, None, wrong_clock) == 0.0
    assert retry_after_s(str(seconds), None, wrong_clock) == seconds


@given(st.text(max_size=40), st.none() | st.text(max_size=40))
def test_malformed_retry_after_is_ignored(value: str, date: str | None) -> None:
    wait_s = retry_after_s(value, date, datetime(2026, 1, 1, tzinfo=UTC))
    assert wait_s is None or wait_s >= 0.0


@pytest.mark.parametrize("status", [429, 503])
def test_unsafe_request_is_retried_only_if_unsent(status: int) -> None:
    assert may_retry(Safety.UNSENT, status, sent=True)
    assert may_retry(Safety.UNSENT, None, sent=False)
    assert not may_retry(Safety.UNSENT, None, sent=True)
    assert not may_retry(Safety.ANY, 504, sent=True)
    assert may_retry(Safety.ANY, 409, sent=True, has_retry_after=True)
    assert not may_retry(Safety.ANY, 409, sent=True)


@pytest.mark.parametrize("options", [{"attempts": 0}, {"total_s": float("nan")}, {"first_s": -1.0}])
def test_invalid_policy_is_rejected(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        RetryPolicy(**options)


def _lines(*lines: dict[str, Any]) -> Planned:
    body = "".join(f"{json.dumps(line)}\n" for line in lines).encode()
    return Planned(200, body, {"Content-Type": "application/x-ndjson"})


def test_import_whose_lines_break_off_or_end_with_overload_is_repeated(
    failing: FailingServer, make_client: MakeClient
) -> None:
    overloaded = {"status": 503, "problem": {"type": "urn:lalaloc:problem:overloaded"}, "retry_after_s": 0}
    failing.plan = [
        _lines({"step": "reading texts", "done": 1, "total": 3}),
        _lines({"step": "reading texts"}, overloaded),
        _lines({"status": 201, "etag": '"r.1"', "answer": PLAN}),
    ]
    steps: list[ImportStep] = []
    with make_client(failing.url, retry=QUICK) as client:
        plan = client.upload_floorplan(b"<svg/>", on_step=steps.append)
    assert (plan.id, plan.etag) == (PLAN["id"], '"r.1"')
    assert steps == [ImportStep("reading texts", 1, 3), ImportStep("reading texts")]
    assert len({request.headers["idempotency-key"] for request in failing.requests}) == 1
    assert all("application/x-ndjson" in request.headers["accept"] for request in failing.requests)
    # A service that tells no steps.
    failing.plan = [Planned(201, PLAN, {"Content-Type": "application/json", "ETag": '"r.1"'})]
    with make_client(failing.url, retry=QUICK) as client:
        assert client.upload_floorplan(b"<svg/>", on_step=lambda _step: None).etag == '"r.1"'


# Events of a plan over streams that end, break off, or are something else

_HALF, _DONE = {"status": "preparing", "progress": 0.5}, {"status": "ready", "progress": 1.0}


def _stream(*events: dict[str, Any], missing_bytes: int = 0) -> Planned:
    """Return a stream of events; with missing bytes it breaks off."""
    text = "retry: 1\n\n" + "".join(f"event: x\ndata: {json.dumps(event)}\n\n: heartbeat\n\n" for event in events)
    size = {"Content-Length": str(len(text) + missing_bytes)}
    return Planned(200, text.encode(), {"Content-Type": "text/event-stream; charset=utf-8", **size})


def _events(failing: FailingServer, make_client: MakeClient, *planned: Planned) -> list[PlanEvent]:
    failing.plan = list(planned)
    with make_client(failing.url, retry=RetryPolicy(attempts=2, first_s=0.0)) as client:
        return list(client.events("p"))


@pytest.mark.parametrize("missing_bytes", [0, 10], ids=["ends", "breaks off"])
def test_stream_that_ends_early_is_resumed(failing: FailingServer, make_client: MakeClient, missing_bytes: int) -> None:
    first = _stream(_HALF, missing_bytes=missing_bytes)
    first.headers["Connection"] = "close"
    events = _events(failing, make_client, first, Planned(503, {}, {"Retry-After": "0"}), _stream(_HALF, _DONE))
    assert events == [PlanEvent("preparing", 0.5), PlanEvent("ready", 1.0)]
    assert [request.path for request in failing.requests] == ["/floorplans/p/events"] * 3


def test_plan_deleted_between_streams(failing: FailingServer, make_client: MakeClient) -> None:
    events = _events(failing, make_client, _stream(_HALF), Planned(404, {}))
    assert events == [PlanEvent("preparing", 0.5), PlanEvent("deleted")]


@pytest.mark.parametrize(
    "planned",
    [Planned(200, b"<html>", {"Content-Type": "text/html"}), _stream({"progress": 0.5})],
    ids=["another page", "an event without status"],
)
def test_other_content_than_events_is_an_error(
    failing: FailingServer, make_client: MakeClient, planned: Planned
) -> None:
    with pytest.raises(MalformedAnswerError):
        _events(failing, make_client, planned)
