"""Queries: validation, stages and waiting."""

from __future__ import annotations

import dataclasses
import re
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import monotonic
from typing import Any

import httpx
import numpy as np
import pytest
from shapely import Point

from lalaloc_core.bundle import Bundle, ConfidenceModel, LogisticModel, write_manifest
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.search import pipeline
from lalaloc_core.photograph.spheres import read_sphere
from service.grids import builder
from service.schemas import TimingsAnswer
from service.settings import Settings
from tests.service.conftest import FLAT, StartApp, assert_problem, encode_picture, localise, upload, wait_for
from tests.service.postgres import PostgresServer

# Large enough that its grid takes a while, small enough for the default limits.
_ROOM = {"name": "hall", "polygon": [[0, 0], [98, 0], [98, 98], [0, 98]]}
HALL: dict[str, Any] = {"name": "hall", "ceiling_height_m": 6.0, "rooms": [_ROOM]}


@pytest.mark.parametrize(
    ("heading", "refine", "stage"),
    [
        *((heading, "none", "retrieval") for heading in (None, 0.0, 90.0, -360.0, 360.0)),
        *((heading, refine, "vdr") for heading in (None, 123.456) for refine in ("vdr", "lpo")),
    ],
)
def test_answer_lies_in_the_plan_and_names_its_stage(
    client: httpx.Client, flat: str, sphere: bytes, heading: float | None, refine: str, stage: str
) -> None:
    fields = {} if heading is None else {"heading_deg": heading}
    response = localise(client, flat, sphere, refine=refine, **fields)
    assert response.status_code == 200, response.text
    answer = response.json()
    # This app has no LPO workers, so the best stage is VDR.
    assert answer["stage"] == stage
    assert answer["floorplan_id"] == flat
    plan = FloorPlan.from_dict(FLAT)
    for candidate in answer["candidates"]:
        point = Point(candidate["position"]["x_m"], candidate["position"]["y_m"])
        room = next(room for room in plan.rooms if room.name == candidate["room"])
        assert room.shape.distance(point) < 1e-3
    assert 0.0 <= answer["heading_deg"] < 360.0
    if heading is not None:
        assert abs((answer["heading_deg"] - heading + 180.0) % 360.0 - 180.0) < 1e-2


def test_candidates_are_distinct_and_sorted(client: httpx.Client, flat: str, sphere: bytes) -> None:
    answer = localise(client, flat, sphere, refine="none", top_k=10).json()
    candidates = answer["candidates"]
    assert 2 <= len(candidates) <= 10
    costs = [candidate["cost"] for candidate in candidates]
    assert costs == sorted(costs)
    assert costs[0] < costs[-1]
    positions = np.array([[c["position"]["x_m"], c["position"]["y_m"]] for c in candidates])
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + 10.0 * np.eye(len(positions))
    headings = np.array([c["heading_deg"] for c in candidates])
    turned = np.abs((headings[:, None] - headings[None] + 180.0) % 360.0 - 180.0)
    # Candidates at one place can differ in their heading only.
    assert ((gaps >= 1.0 - 1e-3) | (turned >= 25.0 - 0.1)).all()
    first = {**answer, "probability": candidates[0]["probability"]}
    assert {key: first[key] for key in candidates[0]} == candidates[0]
    for top_k in (1, 3, 10):
        assert localise(client, flat, sphere, refine="none", top_k=top_k).json()["candidates"] == candidates[:top_k]
    ids = {room["name"]: room["id"] for room in FloorPlan.from_dict(FLAT).to_dict()["rooms"]}
    assert all(pose["room_id"] == ids[pose["room"]] for pose in (answer, *candidates))
    assert answer["warnings"] == []
    # The model has no confidence.
    assert answer["confidence"] is None
    assert answer["covariance_m2"] is None
    assert answer["heading_std_deg"] is None


def test_answer_has_timings_and_model(client: httpx.Client, flat: str, sphere: bytes, tiny_bundle: Path) -> None:
    answer = localise(client, flat, sphere, refine="vdr").json()
    timings = answer["timings_ms"]
    assert set(timings) == set(TimingsAnswer.model_fields)
    assert timings["lpo"] == 0.0
    assert all(timings[name] > 0.0 for name in ("decode", "encode", "retrieve", "vdr"))
    assert timings["total"] >= sum(value for name, value in timings.items() if name != "total")
    bundle = Bundle.open(tiny_bundle)
    assert answer["model"]["sha256"] == bundle.sha256
    assert answer["model"]["name"] == bundle.manifest.name


BAD_FIELDS = {
    "heading not a number": ({"heading_deg": "nan"}, "heading_deg", "finite"),
    "heading too large": ({"heading_deg": "360.1"}, "heading_deg", "360"),
    "heading a word": ({"heading_deg": "north"}, "heading_deg", "is 'north': not a number"),
    "heading with underscore": ({"heading_deg": "1_0"}, "heading_deg", "1_0"),
    "no candidates": ({"top_k": "0"}, "top_k", "1"),
    "too many candidates": ({"top_k": "11"}, "top_k", "is '11': the limit is 10 (max_top_k)"),
    "half a candidate": ({"top_k": "2.5"}, "top_k", "is '2.5': not a whole number"),
    "unknown stage": ({"refine": "magic"}, "refine", "'lpo'"),
    "unknown part": ({"include": "grid"}, "include", "'posterior'"),
    "tolerance without heading": ({"heading_tolerance_deg": "5"}, "heading_tolerance_deg", "heading_deg"),
    "tolerance negative": ({"heading_deg": "1", "heading_tolerance_deg": "-1"}, "heading_tolerance_deg", "0"),
    "tolerance too large": ({"heading_deg": "1", "heading_tolerance_deg": "46"}, "heading_tolerance_deg", "45"),
    "camera in the floor": ({"camera_height_m": "0"}, "camera_height_m", "must be at least 0.1"),
    "camera height in another unit": ({"camera_height_m": "1e-9"}, "camera_height_m", "is '1e-9': must be at least"),
    "camera height not a number": ({"camera_height_m": "nan"}, "camera_height_m", "finite"),
    "height deviation negative": ({"camera_height_std_m": "-0.1"}, "camera_height_std_m", "0"),
    "height deviation too large": ({"camera_height_std_m": "2.1"}, "camera_height_std_m", "2"),
    "unknown field": ({"headng_deg": "90"}, "headng_deg", "heading_deg"),
    "empty plan id": ({"floorplan_id": ""}, "floorplan_id", "missing"),
}


@pytest.mark.parametrize(("fields", "name", "message"), BAD_FIELDS.values(), ids=BAD_FIELDS.keys())
def test_invalid_field_is_rejected_with_its_limit(
    client: httpx.Client, flat: str, sphere: bytes, fields: dict[str, str], name: str, message: str
) -> None:
    response = localise(client, flat, sphere, **fields)
    faults = {fault["field"]: fault["message"] for fault in assert_problem(response, 422, "invalid-request")["errors"]}
    assert message in faults[name]
    assert not re.search("string|float|integer|parse|None|sys", faults[name])


def test_all_form_faults_are_reported_at_once(client: httpx.Client, sphere: bytes) -> None:
    fields = {"headng_deg": "1", "heading_deg": "361", "top_k": "1000", "camera_height_m": "nan", "refine": "all"}
    response = client.post("/localise", data=fields, files={"picture": ("p.jpg", sphere)})
    faults = [fault["field"] for fault in assert_problem(response, 422, "invalid-request")["errors"]]
    expected = {"headng_deg", "picture", "photo", "floorplan_id"} | (fields.keys() - {"headng_deg"})
    assert sorted(faults) == sorted(expected)


def test_empty_optional_field_counts_as_missing(client: httpx.Client, flat: str, sphere: bytes) -> None:
    empty = localise(client, flat, sphere, refine="none", heading_deg="", heading_tolerance_deg="", top_k="")
    assert empty.status_code == 200


def test_heading_is_searched_within_its_tolerance(client: httpx.Client, flat: str, sphere: bytes) -> None:
    def headings(**fields: Any) -> np.ndarray:
        candidates = localise(client, flat, sphere, refine="none", top_k=10, heading_deg=30, **fields)
        found = np.array([candidate["heading_deg"] for candidate in candidates.json()["candidates"]])
        return np.abs((found - 30.0 + 180.0) % 360.0 - 180.0)

    assert headings().max() < 1e-2
    assert headings(heading_tolerance_deg=0).max() < 1e-2
    # The tiny model's ring has sectors of 22.5°.
    assert 1.0 < headings(heading_tolerance_deg=25).max() <= 45.01


def test_every_part_and_a_known_plan_are_required(client: httpx.Client, flat: str, sphere: bytes) -> None:
    picture = {"photo": ("p.jpg", sphere, "image/jpeg")}
    no_plan = assert_problem(client.post("/localise", files=picture), 422, "invalid-request")
    assert no_plan["errors"] == [{"field": "floorplan_id", "message": "is missing"}]
    no_picture = client.post("/localise", files={"floorplan_id": (None, flat)})
    assert assert_problem(no_picture, 422, "invalid-request")["errors"][0]["field"] == "photo"
    not_a_file = client.post("/localise", files={"floorplan_id": (None, flat), "photo": (None, "x")})
    assert "file" in assert_problem(not_a_file, 422, "invalid-request")["detail"]
    assert_problem(client.post("/localise", json={"floorplan_id": flat}), 415, "unsupported-media")
    assert_problem(client.post("/localise"), 415, "unsupported-media")
    assert "'nowhere'" in assert_problem(localise(client, "nowhere", sphere), 404, "unknown-floorplan")["detail"]


def test_camera_height_is_solved_unless_exact(client: httpx.Client, flat: str, sphere: bytes) -> None:
    exact = localise(client, flat, sphere, refine="vdr", camera_height_m=1.713, camera_height_std_m=0).json()
    assert exact["camera_height_m"] == 1.713
    inexact = localise(client, flat, sphere, refine="none", camera_height_m=1.713, camera_height_std_m=0.3).json()
    assert inexact["candidates"] != exact["candidates"]
    assert abs(inexact["camera_height_m"] - 1.713) <= 0.5
    at_most = localise(client, flat, sphere, refine="none", camera_height_m=2.399, camera_height_std_m=0).json()
    assert at_most["camera_height_m"] == 2.399
    above = assert_problem(localise(client, flat, sphere, camera_height_m=2.4), 422, "invalid-pose")
    assert "2.4 m" in above["detail"]


def test_unknown_camera_height_is_searched(client: httpx.Client, sphere: bytes) -> None:
    document = {key: value for key, value in FLAT.items() if key != "camera_height_m"}
    plan = client.post("/floorplans", json=document).json()["id"]
    found = localise(client, plan, sphere, refine="none", top_k=10).json()
    stated = localise(client, plan, sphere, refine="none", top_k=10, camera_height_m=1.5).json()
    assert 0.8 <= found["camera_height_m"] <= 2.2
    # More heights to choose from can only lower the cost.
    assert found["candidates"][0]["cost"] <= stated["candidates"][0]["cost"] + 1e-6


@pytest.mark.parametrize("heading", [None, 30.0])
def test_confidence_does_not_depend_on_top_k(
    start_app: StartApp, tiny_bundle: Path, tmp_path: Path, sphere: bytes, heading: float | None
) -> None:
    copy = tmp_path / "bundle"
    shutil.copytree(tiny_bundle, copy)
    known = LogisticModel(bias=0.4, log_odds=0.3, cost=-1.5, uncertainty=-0.2, latent_distance=-0.5)
    model = ConfidenceModel(
        known_heading={"retrieval": known}, searched_heading={"retrieval": dataclasses.replace(known, bias=0.9)}
    )
    write_manifest(copy, dataclasses.replace(Bundle.open(copy).manifest, confidence=model))
    fields = {} if heading is None else {"heading_deg": heading}
    with start_app(tmp_path / "data", bundle=copy) as client:
        plan_id = upload(client)
        answers = [localise(client, plan_id, sphere, refine="none", top_k=k, **fields).json() for k in (1, 2, 10)]
        unfitted = localise(client, plan_id, sphere, refine="vdr", **fields).json()
    found = _retrieved(tiny_bundle, sphere, heading)
    expected = found.confidence(model)
    assert expected is not None
    assert 0.0 < expected.position < 1.0
    # Opposite places of a rectangular room tie up to rounding, and their order changes a few per cent.
    values = {"confidence": expected.position, "heading_confidence": expected.heading}
    for name, value in (values | {"probability_elsewhere": 1.0 - expected.fit}).items():
        assert len({answer[name] for answer in answers}) == 1
        assert answers[0][name] == pytest.approx(value, rel=0.05, abs=1e-4)
    shares = [candidate["probability"] for candidate in answers[-1]["candidates"]]
    # Confidence is about the place, for any heading.
    assert 0.0 < shares[0] <= answers[-1]["confidence"]
    assert sum(shares) + answers[-1]["probability_elsewhere"] <= 1.0 + 1e-6
    assert unfitted["confidence"] is None
    assert unfitted["probability_elsewhere"] is None
    assert unfitted["candidates"][0]["probability"] is None


def _retrieved(bundle: Path, content: bytes, heading_deg: float | None) -> pipeline.Localisation:
    """Return the core's retrieval result for a query of the flat."""
    encoders = PhotographEncoder(Bundle.open(bundle), threads=1)
    manifest, limits = encoders.manifest, Settings().photographs.photograph_limits
    image = read_sphere(content, height=manifest.image_height, width=manifest.image_width, limits=limits)
    query = encoders.spheres.query(image, None if heading_deg is None else np.radians(heading_deg), CameraHeight(1.5))
    plan = FloorPlan.from_dict(FLAT)
    grid = build_grid(plan, encoders.layouts, step_m=Settings().grids.grid_step_m, camera_height_m=1.5)
    return pipeline.localise(plan, grid, encoders.layouts, query, refine="none")


def test_posterior_is_included_on_request(client: httpx.Client, flat: str, sphere: bytes) -> None:
    answer = localise(client, flat, sphere, include="posterior", heading_deg=10.0).json()
    posterior = answer["posterior"]
    assert posterior["step_m"] == client.get(f"/floorplans/{flat}").json()["grid"]["step_m"]
    assert len(posterior["x_m"]) == len(posterior["y_m"]) == len(posterior["probability"]) > 0
    assert sum(posterior["probability"]) == pytest.approx(1.0, abs=1e-3)
    assert min(posterior["probability"]) > 0.0
    plan = FloorPlan.from_dict(FLAT)
    places = np.array([posterior["x_m"], posterior["y_m"]]).T
    assert all(any(room.shape.covers(Point(place)) for room in plan.rooms) for place in places)
    assert localise(client, flat, sphere, heading_deg=10.0).json()["posterior"] is None


def test_query_waits_for_a_preparing_plan(client: httpx.Client, sphere: bytes) -> None:
    plan_id = upload(client, HALL, wait=False)
    assert client.get(f"/floorplans/{plan_id}").json()["status"] == "preparing"
    assert localise(client, plan_id, sphere, refine="none").status_code == 200
    client.delete(f"/floorplans/{plan_id}")


@pytest.mark.slow
def test_waiting_ends_at_the_deadline(
    start_app: StartApp, tmp_path: Path, sphere: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    released, embed = threading.Event(), builder.embed
    monkeypatch.setattr(builder, "embed", lambda *args, **options: (released.wait(60.0), embed(*args, **options))[1])
    # A busy machine needs longer for everything before the plan is waited for.
    with start_app(tmp_path, request_deadline_s=5.0) as client:
        # Otherwise the query can wait for the decoder instead.
        wait_for(lambda: client.get("/readyz").status_code == 200)
        plan_id = upload(client, HALL, wait=False)
        response = localise(client, plan_id, sphere, refine="none")
        assert "still preparing" in assert_problem(response, 503, "floorplan-not-ready")["detail"]
        assert int(response.headers["retry-after"]) > 0
        released.set()
        wait_for(lambda: client.get(f"/floorplans/{plan_id}").json()["status"] == "ready")
    with start_app(tmp_path) as client:
        assert localise(client, plan_id, sphere, refine="none").status_code == 200


def test_slow_query_ends_at_its_deadline(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path, request_deadline_s=1e-6) as client:
        assert_problem(localise(client, upload(client), sphere), 504, "deadline-exceeded")


@pytest.mark.slow
@pytest.mark.one_replica
def test_hanging_database_does_not_block_known_plans(
    start_app: StartApp, postgres: PostgresServer, tmp_path: Path, sphere: bytes
) -> None:
    with start_app(tmp_path, database_url=postgres.new_database(), database_wait_s=4.0) as client:
        known, unknown = upload(client), "0" * 32
        assert localise(client, known, sphere, refine="none").status_code == 200
        with postgres.silent():
            begin = monotonic()
            for _ in range(8):
                assert localise(client, known, sphere, refine="none").status_code == 200
            # Not every query waits 4 s, and waiting queries leave threads free.
            assert monotonic() - begin < 28.0
            assert_problem(localise(client, unknown, sphere, refine="none"), 503, "store-unavailable")
            form, headers = {"data": {"floorplan_id": known}, "files": {"photo": sphere}}, {"Idempotency-Key": "silent"}
            assert_problem(client.post("/localise", headers=headers, **form), 503, "store-unavailable")
        wait_for(lambda: localise(client, unknown, sphere, refine="none").status_code == 404)


@pytest.mark.slow
def test_uploads_do_not_block_queries(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    plan = {"ceiling_height_m": 3.0, "rooms": [{"polygon": [[0, 0], [40, 0], [40, 40], [0, 40]]}]}
    with start_app(tmp_path, inline_grid_poses=10**6) as client:
        plan_id = upload(client)
        stop = threading.Event()

        def keep_uploading() -> None:
            while not stop.is_set():
                client.post("/floorplans", json=plan)

        with ThreadPoolExecutor(12) as uploaders:
            for _ in range(12):
                uploaders.submit(keep_uploading)
            try:
                wait_for(lambda: "lalaloc_requests_in_flight 12.0" in client.get("/metrics").text)
                begin = monotonic()
                for _ in range(8):
                    assert localise(client, plan_id, sphere, refine="none").status_code == 200
                assert monotonic() - begin < 6.0
            finally:
                stop.set()


def test_deleting_a_plan_ends_waiting_queries(client: httpx.Client, sphere: bytes) -> None:
    plan_id = upload(client, HALL, wait=False)
    with ThreadPoolExecutor(1) as threads:
        waiting = threads.submit(localise, client, plan_id, sphere, refine="none")
        wait_for(lambda: "lalaloc_requests_in_flight 1.0" in client.get("/metrics").text)
        assert client.delete(f"/floorplans/{plan_id}").status_code == 204
    assert_problem(waiting.result(), 404, "unknown-floorplan")


def test_event_loop_stays_free_during_queries(client: httpx.Client, flat: str) -> None:
    picture = encode_picture(2048, 1024, "PNG")
    with ThreadPoolExecutor(4) as threads:
        queries = [threads.submit(localise, client, flat, picture, refine="vdr") for _ in range(8)]
        slowest = 0.0
        while not all(query.done() for query in queries):
            begin = monotonic()
            assert client.get("/healthz").status_code == 200
            slowest = max(slowest, monotonic() - begin)
        total_ms = max(query.result().json()["timings_ms"]["total"] for query in queries)
    assert total_ms > 100.0, "the queries were too easy to tell"
    assert slowest < 1.0
