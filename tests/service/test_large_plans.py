"""Large plans: parsed, validated and described by worker processes, not by the service."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import numpy as np
import pytest

from lalaloc_core.floorplan import FloorPlan, json_values
from service.plan_documents import LARGE, PackedPlan, PlanDocument
from service.plan_files.converter import Converter
from service.settings import Settings
from service.telemetry import Telemetry
from tests.service.conftest import StartApp, document_of, tiled_plan
from tests.strategies import present

_SIDE = 45


def large_plan() -> dict[str, Any]:
    return tiled_plan(_SIDE, openings=True)


@pytest.fixture
def client(start_app: StartApp, tmp_path: Path) -> Iterator[httpx.Client]:
    with start_app(tmp_path) as client:
        yield client


@pytest.fixture
def no_parsing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail if this process, which is the service's, parses or validates a plan."""
    refuse = Mock(side_effect=AssertionError("parsed in the service"))
    monkeypatch.setattr("lalaloc_core.floorplan.plan.read_plan", refuse)
    monkeypatch.setattr(json_values, "_check_size", refuse)


@pytest.mark.slow
@pytest.mark.usefixtures("no_parsing")
def test_service_does_not_parse_large_plans(client: httpx.Client) -> None:
    document = large_plan()
    content = json.dumps(document)
    assert len(content) > LARGE
    created = client.post("/floorplans", content=content, headers={"Content-Type": "application/json"})
    assert created.status_code == 201, created.text
    replaced = document_of(client.put(created.headers["Location"], json={**document, "name": "second"}))
    assert replaced["name"] == "second"
    assert len(replaced["rooms"]) == _SIDE**2
    # The answer is the same as that of a GET.
    fetched = client.get(created.headers["Location"]).json()
    state = dict.fromkeys(("status", "progress", "grid"))
    assert replaced | state == fetched | state


@pytest.mark.usefixtures("no_parsing")
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b'{"rooms": [' + b"[]," * 4_200_000 + b"[]]}", "the limit is 3000000"),
        (b'{"rooms": [' + b'{"polygon":0},' * 40_000 + b"0]}", "40001 rooms; the limit is 10000"),
        (b"[" * 300_000, "nested 300000 levels"),
    ],
    ids=["lists", "rooms", "depth"],
)
def test_hostile_json_is_refused_by_a_worker(client: httpx.Client, content: bytes, reason: str) -> None:
    answer = client.post("/floorplans", content=content, headers={"Content-Type": "application/json"})
    assert reason in document_of(answer, 422)["detail"]


@pytest.mark.parametrize("method", ["POST", "PUT", "PATCH"])
def test_values_of_venue_documents_are_counted_before_parsing(
    client: httpx.Client, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    path = "/venues"
    if method != "POST":
        path = client.post("/venues", json={"name": "campus"}).headers["Content-Location"]
    monkeypatch.setattr(json_values.json, "loads", None)
    content = b'{"plans": [' + b"[]," * 1_000_000 + b"[]]}"
    answer = client.request(method, path, content=content, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422, answer.text
    assert "the limit is 51000" in answer.text


@pytest.mark.slow
def test_packed_plan_is_the_same() -> None:
    document = large_plan()
    document["rooms"][0] |= {"holes": [[[1, 1], [1.2, 1], [1.2, 1.2]]], "walls": [[[0.5, 0.5], [0.7, 0.5]]]}
    plan = FloorPlan.from_dict(document)
    unpacked = PackedPlan.of(plan).plan()
    assert unpacked.to_dict() == plan.to_dict()
    assert unpacked.opening_faces == plan.opening_faces
    assert unpacked.warnings == plan.warnings
    np.testing.assert_array_equal(unpacked.wall_table.start_m, plan.wall_table.start_m)
    # Unpickling holds the interpreter, so no piece is large.
    packed = PackedPlan.of(plan)
    assert max(len(piece) for pieces in packed.pieces for piece in pieces) < 64 * 1024


@pytest.mark.slow
def test_stored_large_plan_is_parsed_by_a_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = FloorPlan.from_dict(large_plan())
    stored = PlanDocument.from_plan(plan)
    converter = Converter(Settings(import_workers=1), Telemetry())
    try:
        with monkeypatch.context() as patched:
            patched.setattr("lalaloc_core.floorplan.plan.read_plan", None)
            found = converter.parse(stored)
            assert converter.parse(PlanDocument(stored.document, "0" * 64, stored.warnings)) is None
    finally:
        converter.close()
    assert present(found).to_dict() == plan.to_dict()
    # Without workers the service parses it.
    assert present(converter.parse(stored)).to_dict() == plan.to_dict()
