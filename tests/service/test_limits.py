"""Limits of requests: reported, configurable, and named in errors."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.capacity.fair_share import max_per_client
from service.schemas.service_state import LimitsAnswer
from service.settings import Settings
from tests.service.conftest import FLAT, StartApp, assert_problem, document_of, encode_picture, localise, upload


def room(x: float, width: float = 3.0) -> dict[str, Any]:
    return {"polygon": [[x, 0], [x + width, 0], [x + width, 3], [x, 3]], "ceiling_height_m": 2.5}


TWO_ROOMS = {"rooms": [room(0.0), room(4.0)]}


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
    ("name", "value", "status", "slug"),
    [
        ("max_rooms", 1, 422, "invalid-floorplan"),
        ("max_vertices", 3, 422, "invalid-floorplan"),
        ("max_plan_vertices", 7, 422, "invalid-floorplan"),
        ("max_extent_m", 6.5, 422, "invalid-floorplan"),
        ("max_area_m2", 17.5, 422, "invalid-floorplan"),
        ("max_grid_poses", 3, 422, "floorplan-too-large"),
        ("max_plan_bytes", 100, 413, "upload-too-large"),
    ],
)
def test_plan_over_a_limit_is_refused(
    start_app: StartApp, tmp_path: Path, name: str, value: float, status: int, slug: str
) -> None:
    with start_app(tmp_path, **{name: value}) as client:
        assert client.get("/limits").json()[name] == value
        detail = assert_problem(client.post("/floorplans", json=TWO_ROOMS), status, slug)["detail"]
        assert re.search(rf"\((LALALOC_)?{name}\)", detail, re.IGNORECASE)
        assert re.search(rf"(at most|limit is) {value:g}", detail)
        assert client.get("/floorplans").json()["floorplans"] == []


def test_plan_quota_is_enforced(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, max_floorplans=1) as client:
        upload(client)
        problem = assert_problem(client.post("/floorplans", json=FLAT), 507, "too-many-floorplans")
        assert re.search(r"\((LALALOC_)?max_floorplans\)", problem["detail"], re.IGNORECASE)


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
