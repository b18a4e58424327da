"""Both clients against the production app."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from PIL import Image

from lalaloc_client import ConflictError, InvalidError, Localisation, NotFoundError
from tests.client.conftest import MakeClient
from tests.service.conftest import FLAT, StartApp


@pytest.fixture(scope="module")
def app(start_app: StartApp, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """One app for all tests here."""
    with start_app(tmp_path_factory.mktemp("data")) as started:
        yield started


@pytest.fixture
def service(app: httpx.Client, make_client: MakeClient) -> Iterator[Any]:
    """A client of that app."""
    with make_client(str(app.base_url)) as client:
        yield client


def test_a_plan_is_stored_found_looked_at_and_deleted(service: Any, tmp_path: Path) -> None:
    (tmp_path / "flat.json").write_text(json.dumps(FLAT))
    plan = service.wait_until_ready(service.upload_floorplan(tmp_path / "flat.json").id, timeout_s=60.0)
    assert (plan.status, plan.progress, plan.name) == ("ready", 1.0, FLAT["name"])
    assert [room.name for room in plan.rooms] == [room["name"] for room in FLAT["rooms"]]
    assert plan.rooms[0].area_m2 == 12.0
    assert plan.created_at.tzinfo is not None
    looked_at = service.floorplan(plan.id)
    assert (looked_at.id, looked_at.rooms, looked_at.grid) == (plan.id, plan.rooms, plan.grid)
    listed = {summary.id: summary for summary in service.floorplans()}
    assert listed[plan.id].rooms == 2
    service.delete_floorplan(plan.id)
    with pytest.raises(NotFoundError) as refused:
        service.floorplan(plan.id)
    assert refused.value.type == "urn:lalaloc:problem:unknown-floorplan"
    assert refused.value.request_id


def test_a_plan_is_replaced_unless_it_has_changed(service: Any, panorama: bytes) -> None:
    first = service.upload_floorplan(FLAT)
    second = service.replace_floorplan(first.id, FLAT | {"name": "rebuilt"}, if_match=first.etag)
    assert (second.id, second.name, second.revision_number) == (first.id, "rebuilt", 2)
    with pytest.raises(ConflictError) as refused:
        service.replace_floorplan(first.id, FLAT, if_match=first.etag)
    assert refused.value.status == 412
    answer = service.localise(first.id, panorama, refine="none")
    assert answer.floorplan_revision == second.revision == service.floorplan(first.id).revision


def test_what_there_is_of_a_plan_is_downloaded(service: Any, tmp_path: Path) -> None:
    (tmp_path / "flat.json").write_text(json.dumps(FLAT, indent=3))
    plan_id = service.upload_floorplan(tmp_path / "flat.json").id
    assert service.original(plan_id) == (tmp_path / "flat.json").read_bytes()
    assert service.mesh(plan_id).startswith(b"glTF")
    empty = service.preview(plan_id)
    assert empty.startswith("<svg")
    assert "camera" not in empty
    marked = service.preview(plan_id, x_m=1.25, y_m=2.0, heading_deg=90.0, covariance_m2=((0.2, 0.01), (0.01, 0.1)))
    assert 'class="camera" transform="translate(1.2500 -2.0000)"' in marked
    assert "rotate(90.000)" in marked
    assert "<ellipse" in marked


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"x_m": 1.0}, "x_m is 1.0 and y_m is None"),
        ({"heading_deg": 20.0}, "need a position"),
        ({"x_m": 1.0, "y_m": float("nan")}, "y_m is nan"),
    ],
)
def test_half_a_camera_is_not_drawn(service: Any, options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        service.preview("p", **options)


def test_a_plan_is_followed_until_it_is_ready(service: Any) -> None:
    plan = service.upload_floorplan(FLAT)
    last = list(service.events(plan.id))[-1]
    assert (last.status, last.progress, last.revision, last.final) == ("ready", 1.0, plan.revision, True)
    with pytest.raises(NotFoundError):
        list(service.events("0" * 32))


def test_the_same_upload_twice_is_one_plan(service: Any) -> None:
    key = uuid.uuid4().hex
    one, other = (service.upload_floorplan(FLAT, idempotency_key=key) for _ in range(2))
    assert one == other
    with pytest.raises(InvalidError, match="idempotency-key-reused"):
        service.upload_floorplan(FLAT | {"name": "other"}, idempotency_key=key)


def test_listings_are_walked_page_by_page_and_searched_by_name(service: Any) -> None:
    name = uuid.uuid4().hex
    ids = [service.upload_floorplan(FLAT | {"name": f"{number} {name}"}).id for number in range(3)]
    assert [plan.id for plan in service.floorplans(name.upper(), page_size=2)] == ids[::-1]


def test_an_answer_has_all_that_the_service_says(service: Any, app: httpx.Client, panorama: bytes) -> None:
    plan_id = service.wait_until_ready(service.upload_floorplan(FLAT).id).id
    options = {"heading_deg": 90.0, "heading_tolerance_deg": 10.0, "refine": "vdr", "top_k": 2}
    answer = service.localise(plan_id, panorama, **options)
    said = app.post(
        "/localise",
        data={"floorplan_id": plan_id} | {name: str(value) for name, value in options.items()},
        files={"panorama": panorama},
    ).json()
    # Whatever the service says, the client knows; only the times are others.
    known = dataclasses.asdict(answer) | {"timings_ms": said["timings_ms"]}
    assert {name: value for name, value in json.loads(json.dumps(known)).items() if name in said} == said
    assert answer.stage == "vdr"
    assert answer.candidates[0].position == answer.position


def test_how_probable_every_place_is_comes_where_it_is_asked_for(service: Any, panorama: bytes) -> None:
    plan_id = service.wait_until_ready(service.upload_floorplan(FLAT).id).id
    posterior = service.localise(plan_id, panorama, refine="none", posterior=True).posterior
    assert len(posterior.x_m) == len(posterior.y_m) == len(posterior.probability) > 10
    assert sum(posterior.probability) == pytest.approx(1.0, abs=1e-4)
    assert service.localise(plan_id, panorama, refine="none").posterior is None


def test_the_layout_of_a_revision_is_told_room_by_room(service: Any, app: httpx.Client) -> None:
    plan = service.upload_floorplan(FLAT)
    service.replace_floorplan(plan.id, FLAT | {"rooms": FLAT["rooms"][:1], "openings": []})
    assert len(service.layout(plan.id).rooms) == 1
    layout = service.layout(plan.id, revision=plan.revision)
    said = app.get(f"/floorplans/{plan.id}/layout", params={"revision": plan.revision}).json()
    assert json.loads(json.dumps(dataclasses.asdict(layout))) == said
    with pytest.raises(NotFoundError, match="unknown-revision"):
        service.layout(plan.id, revision="0" * 32)


def test_kept_answers_are_told_again_and_forgotten(
    start_app: StartApp, make_client: MakeClient, panorama: bytes, tmp_path: Path
) -> None:
    with start_app(tmp_path, keep_answers_s=3600.0) as app, make_client(str(app.base_url)) as service:
        plan_id = service.wait_until_ready(service.upload_floorplan(FLAT).id).id
        answer = service.localise(plan_id, panorama, refine="none", posterior=True)
        assert service.answer(answer.answer_id) == answer
        service.forget_answer(answer.answer_id)
        with pytest.raises(NotFoundError, match="unknown-answer"):
            service.answer(answer.answer_id)
        with pytest.raises(ValueError, match="answer_id is"):
            service.answer("../floorplans")


def test_a_panorama_may_be_bytes_a_file_or_a_picture(service: Any, panorama: bytes, tmp_path: Path) -> None:
    plan_id = service.wait_until_ready(service.upload_floorplan(json.dumps(FLAT).encode()).id).id
    (tmp_path / "p.jpg").write_bytes(panorama)
    given = [panorama, tmp_path / "p.jpg", str(tmp_path / "p.jpg")]
    answers = [service.localise(plan_id, one, heading_deg=0, refine="none") for one in given]
    assert len({(answer.position, answer.cost) for answer in answers}) == 1
    picture = Image.open(io.BytesIO(panorama)).convert("RGBA")
    answer: Localisation = service.localise(plan_id, picture, heading_deg=0, refine="none")
    assert answer.cost == pytest.approx(answers[0].cost, rel=0.1)


def test_what_is_wrong_is_told_field_by_field(service: Any, panorama: bytes) -> None:
    plan_id = service.upload_floorplan(FLAT).id
    with pytest.raises(InvalidError, match="top_k") as refused:
        service.localise(plan_id, panorama, top_k=99)
    assert refused.value.status == 422
    assert [field for field, _ in refused.value.faults] == ["top_k"]
    with pytest.raises(InvalidError, match="rooms"):
        service.upload_floorplan({"rooms": []})
    with pytest.raises(ValueError, match="heading_deg is nan"):
        service.localise(plan_id, panorama, heading_deg=float("nan"))


def test_odd_ids_reach_no_other_route(service: Any) -> None:
    for odd in ("../healthz", "a/original", "a%2Foriginal", "?x", "#", "..", ".", "", "é", "a" * 129):
        with pytest.raises(ValueError, match="floorplan_id"):
            service.delete_floorplan(odd)
    with pytest.raises(NotFoundError):
        service.floorplan("healthz")


def test_the_service_tells_whether_it_is_ready(service: Any, app: httpx.Client) -> None:
    state = service.ready()
    assert state.ready is True
    assert state.lpo_pool.workers == 0
    assert state.model.sha256 == app.get("/readyz").json()["model"]["sha256"]


def test_several_panoramas_of_one_visit_are_one_query(service: Any, app: httpx.Client, panorama: bytes) -> None:
    plan_id = service.wait_until_ready(service.upload_floorplan(FLAT).id).id
    motions = [{"distance_m": 1.5, "distance_std_m": 0.2, "turn_deg": 20.0}]
    answer = service.localise_sequence(
        plan_id, [panorama, panorama], motions=motions, headings_deg=[90.0, None], refine="none", top_k=2
    )
    said = app.post(
        "/localise/sequence",
        data={
            "floorplan_id": plan_id,
            "motions": json.dumps(motions),
            "headings_deg": "[90, null]",
            "refine": "none",
            "top_k": "2",
        },
        files=[("panorama", panorama), ("panorama", panorama)],
    ).json()
    assert len(answer.poses) == 2
    assert json.loads(json.dumps(dataclasses.asdict(answer))) == said | {"timings_ms": dict(answer.timings_ms)}
    with pytest.raises(InvalidError, match="motions"):
        service.localise_sequence(plan_id, [panorama, panorama], motions=[])
    with pytest.raises(ValueError, match=r"headings_deg\[0\] is nan"):
        service.localise_sequence(plan_id, [panorama, panorama], headings_deg=[float("nan"), None])


def test_hints_are_sent(service: Any, panorama: bytes) -> None:
    plan_id = service.wait_until_ready(service.upload_floorplan(FLAT).id).id
    assert service.localise(plan_id, panorama, rooms="kitchen", strict=True, refine="none").room == "kitchen"
    near = {"x_m": 2.0, "y_m": 1.0}
    answer = service.localise(plan_id, panorama, near=near, radius_m=1.0, strict=True, refine="none")
    assert math.dist((answer.position.x_m, answer.position.y_m), near.values()) <= 1.0 + 1e-3
    with pytest.raises(InvalidError, match="no room 'attic'"):
        service.localise(plan_id, panorama, rooms=["attic"])
    with pytest.raises(ValueError, match=r"near\['x_m'\] is inf"):
        service.localise(plan_id, panorama, near={"x_m": float("inf"), "y_m": 0.0}, radius_m=1.0)
