"""Progress events of a plan over streams that end, break off, or are something else."""

from __future__ import annotations

import json
from typing import Any

import pytest

from lalaloc_client import MalformedAnswerError, PlanEvent, RetryPolicy
from tests.client.conftest import FailingServer, MakeClient, Planned

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
