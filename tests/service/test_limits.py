"""Limits of requests: reported, configurable, and named in errors."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.capacity.fair_share import max_per_client
from service.schemas.service_state import LimitsAnswer
from service.settings import Settings
from tests.service.conftest import StartApp, assert_problem, document_of, encode_picture, localise, upload

LIMITS = {
    "max_rooms": 2,
    "max_vertices": 8,
    "max_plan_vertices": 12,
    "max_extent_m": 30.0,
    "max_area_m2": 50.0,
    "max_grid_poses": 60,
    "max_plan_bytes": 2000,
    "max_floorplans": 1,
}


def room(x: float, width: float = 3.0, corners: int = 4) -> dict[str, Any]:
    """Return a room of 3 m depth; corners beyond four lie on one of its walls."""
    wall = [[x + width * k / (corners - 3), 0.0] for k in range(corners - 2)]
    return {"polygon": [*wall, [x + width, 3.0], [x, 3.0]], "ceiling_height_m": 2.5}


@pytest.fixture(scope="module")
def limited(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """Yield an app with `LIMITS`."""
    with start_app(tmp_path_factory.mktemp("limited"), **LIMITS) as client:
        yield client


def test_limits_match_the_settings(client: httpx.Client) -> None:
    limits = client.get("/limits").json()
    assert limits.keys() == LimitsAnswer.model_fields.keys()
    settings = Settings()
    # Left to the number of cores; this app has no LPO workers.
    resolved = Settings(workers=0, onnx_threads=1)
    assert limits.pop("max_queries") == resolved.query_limit > 0
    assert limits.pop("max_queries_per_tenant") == max_per_client(resolved.query_limit) < resolved.query_limit
    assert limits.pop("max_pending_requests") == resolved.pending_limit > resolved.query_limit
    assert limits == {name: settings.value(name) for name in limits}


@pytest.mark.parametrize(
    ("name", "rooms", "status", "slug"),
    [
        ("max_rooms", [room(0.0), room(4.0), room(8.0)], 422, "invalid-floorplan"),
        ("max_vertices", [room(0.0, corners=9)], 422, "invalid-floorplan"),
        ("max_plan_vertices", [room(0.0, corners=7), room(4.0, corners=6)], 422, "invalid-floorplan"),
        ("max_extent_m", [room(0.0), room(28.0)], 422, "invalid-floorplan"),
        ("max_area_m2", [room(0.0, width=17.0)], 422, "invalid-floorplan"),
        ("max_grid_poses", [room(0.0, width=9.0)], 422, "floorplan-too-large"),
        ("max_plan_bytes", [room(0.0) | {"name": "x" * 2000}], 413, "upload-too-large"),
    ],
)
def test_plan_over_a_limit_is_refused(
    limited: httpx.Client, name: str, rooms: list[dict[str, Any]], status: int, slug: str
) -> None:
    assert limited.get("/limits").json()[name] == LIMITS[name]
    detail = assert_problem(limited.post("/floorplans", json={"rooms": rooms}), status, slug)["detail"]
    assert re.search(rf"\((LALALOC_)?{name}\)", detail, re.IGNORECASE)
    assert re.search(rf"(at most|limit is) {LIMITS[name]:g}", detail)
    assert limited.get("/floorplans").json()["floorplans"] == []


def test_plan_quota_is_enforced(limited: httpx.Client) -> None:
    plan = {"rooms": [room(0.0)]}
    plan_id = upload(limited, plan)
    problem = assert_problem(limited.post("/floorplans", json=plan), 507, "too-many-floorplans")
    assert re.search(r"\((LALALOC_)?max_floorplans\)", problem["detail"], re.IGNORECASE)
    assert limited.delete(f"/floorplans/{plan_id}").status_code == 204


def test_query_over_a_limit_is_refused(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    many_scans = encode_picture(256, 128, "JPEG", progressive=True)
    with start_app(tmp_path, max_pixels=100_000, max_scans=9, max_top_k=3, max_photograph_bytes=100_000) as client:
        plan_id = upload(client)
        # A request without top_k gets no more candidates than allowed.
        allowed = document_of(localise(client, plan_id, encode_picture(256, 128, "JPEG")))
        assert len(allowed["candidates"]) <= 3
        refusals = {
            "max_pixels": localise(client, plan_id, sphere, top_k=3),
            "max_scans": localise(client, plan_id, many_scans, top_k=3),
            "max_top_k": localise(client, plan_id, sphere, top_k=4),
            "max_photograph_bytes": localise(client, plan_id, bytes(100_001), top_k=3),
        }
        for name, response in refusals.items():
            assert 400 <= response.status_code < 500
            assert re.search(rf"\((LALALOC_)?{name}\)", response.json()["detail"], re.IGNORECASE), name
