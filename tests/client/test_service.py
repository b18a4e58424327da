"""Both clients with the production app."""

from __future__ import annotations

import dataclasses
import io
import json
import math
from pathlib import Path
from typing import Any

import httpx
import pytest
from PIL import Image

from lalaloc_client import ConflictError, ImportStep, InvalidError, Localisation, NotFoundError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import export_plan
from tests.client.conftest import MakeClient
from tests.core.fault_photographs import FOLDER
from tests.service.conftest import FLAT, StartApp

APP_SETTINGS = {"bundle": "tiny_view_bundle"}


def test_plan_is_stored_listed_and_deleted(service: Any, tmp_path: Path) -> None:
    (tmp_path / "flat.json").write_text(json.dumps(FLAT))
    plan = service.wait_until_ready(service.upload_floorplan(tmp_path / "flat.json").id, timeout_s=60.0)
    assert (plan.status, plan.progress, plan.name) == ("ready", 1.0, FLAT["name"])
    assert [room.name for room in plan.rooms] == [room["name"] for room in FLAT["rooms"]]
    assert plan.rooms[0].area_m2 == 12.0
    assert plan.created_at.tzinfo is not None
    fetched = service.floorplan(plan.id)
    assert (fetched.id, fetched.rooms, fetched.grid) == (plan.id, plan.rooms, plan.grid)
    listed = {summary.id: summary for summary in service.floorplans()}
    assert (listed[plan.id].rooms, listed[plan.id].revision_number) == (2, 1)
    service.delete_floorplan(plan.id)
    with pytest.raises(NotFoundError) as caught:
        service.floorplan(plan.id)
    assert caught.value.type == "urn:lalaloc:problem:unknown-floorplan"
    assert caught.value.request_id


def test_plan_without_a_name_is_named_after_its_file(service: Any, tmp_path: Path) -> None:
    file = tmp_path / "Ground floor.json"
    file.write_text(json.dumps({key: value for key, value in FLAT.items() if key != "name"}))
    plan = service.upload_floorplan(file)
    assert (plan.name, service.replace_floorplan(plan.id, str(file)).name) == ("Ground floor", "Ground floor")


def test_steps_of_an_import_are_told(service: Any, tmp_path: Path) -> None:
    steps: list[ImportStep] = []
    (tmp_path / "flat.svg").write_bytes(export_plan(FloorPlan.from_dict(FLAT), "svg"))
    plan = service.upload_floorplan(tmp_path / "flat.svg", on_step=steps.append)
    assert steps[0] == ImportStep("waiting for a worker")
    assert (plan.etag, plan.rooms) == (service.floorplan(plan.id).etag, service.floorplan(plan.id).rooms)
    venue = service.upload_venue({"plans": [FLAT, FLAT | {"level": 1}]}, name="House", on_step=steps.append)
    assert (venue.name, venue.plans) == ("House", 2)
    with pytest.raises(InvalidError) as caught:
        service.upload_floorplan(b"%PDF-1.4", on_step=steps.append)
    assert "PDF" in str(caught.value)
    # Steps that end before the connection takes the next line are left out.
    assert {step.step for step in steps} & {"opening the file", "reading SVG", "placing names and openings"}


def test_plan_is_replaced_unless_it_has_changed(service: Any, sphere: bytes) -> None:
    first = service.upload_floorplan(FLAT)
    second = service.replace_floorplan(first.id, FLAT | {"name": "rebuilt"}, if_match=first.etag)
    assert (second.id, second.name, second.revision_number) == (first.id, "rebuilt", 2)
    with pytest.raises(ConflictError) as caught:
        service.replace_floorplan(first.id, FLAT, if_match=first.etag)
    assert caught.value.status == 412
    answer = service.localise(first.id, sphere, refine="none")
    assert answer.floorplan_revision == second.revision == service.floorplan(first.id).revision


def test_files_of_a_plan_are_downloaded(service: Any, tmp_path: Path) -> None:
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


@pytest.mark.slow
def test_localisability_is_read_and_drawn(service: Any) -> None:
    plan = service.upload_floorplan(FLAT)
    found = service.localisability(plan.id)
    assert (found.floorplan_id, found.revision, found.spacing_m) == (plan.id, plan.revision, 0.5)
    assert [room.id for room in found.rooms] == [room.id for room in plan.rooms]
    assert 0.0 <= found.places[0].probability["phone_unknown_heading"] <= 1.0
    assert (service.localisability(plan.id, coarse=True).coarse, found.coarse) == (True, False)
    drawing = service.localisability_map(plan.id, "three_phone", "known")
    assert "three phone photographs of one spot are found" in drawing


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"x_m": 1.0}, "x_m is 1.0 and y_m is None"),
        ({"heading_deg": 20.0}, "need a position"),
        ({"x_m": 1.0, "y_m": float("nan")}, "y_m is nan"),
    ],
)
def test_incomplete_camera_is_rejected(service: Any, options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        service.preview("p", **options)


def test_events_end_when_the_plan_is_ready(service: Any) -> None:
    plan = service.upload_floorplan(FLAT)
    last = list(service.events(plan.id))[-1]
    assert (last.status, last.progress, last.revision, last.final) == ("ready", 1.0, plan.revision, True)
    with pytest.raises(NotFoundError):
        list(service.events("0" * 32))


def test_answer_has_every_field_and_the_posterior_on_request(
    service: Any, plan_id: str, app: httpx.Client, sphere: bytes
) -> None:
    options = {"heading_deg": 90.0, "heading_tolerance_deg": 10.0, "refine": "vdr", "top_k": 2}
    answer = service.localise(plan_id, sphere, **options)
    data = {"floorplan_id": plan_id} | {name: str(value) for name, value in options.items()}
    document = app.post("/localise", data=data, files={"photo": sphere}).json()
    # Only the times differ between the two answers.
    known = dataclasses.asdict(answer) | {"timings_ms": document["timings_ms"]}
    assert {name: value for name, value in json.loads(json.dumps(known)).items() if name in document} == document
    assert answer.stage == "vdr"
    assert answer.candidates[0].position == answer.position
    posterior = service.localise(plan_id, sphere, refine="none", posterior=True).posterior
    assert len(posterior.x_m) == len(posterior.y_m) == len(posterior.probability) > 10
    assert sum(posterior.probability) == pytest.approx(1.0, abs=1e-4)
    assert service.localise(plan_id, sphere, refine="none").posterior is None


def test_layout_of_an_older_revision(service: Any, app: httpx.Client) -> None:
    plan = service.upload_floorplan(FLAT)
    service.replace_floorplan(plan.id, FLAT | {"rooms": FLAT["rooms"][:1], "openings": []})
    assert len(service.layout(plan.id).rooms) == 1
    layout = service.layout(plan.id, revision=plan.revision)
    document = app.get(f"/floorplans/{plan.id}/layout", params={"revision": plan.revision}).json()
    assert json.loads(json.dumps(dataclasses.asdict(layout))) == document
    with pytest.raises(NotFoundError, match="unknown-revision"):
        service.layout(plan.id, revision="0" * 32)


def test_stored_answers_are_fetched_and_deleted(
    start_app: StartApp, make_client: MakeClient, sphere: bytes, tmp_path: Path
) -> None:
    with start_app(tmp_path, keep_answers_s=3600.0) as app, make_client(str(app.base_url)) as service:
        plan_id = service.wait_until_ready(service.upload_floorplan(FLAT).id).id
        answer = service.localise(plan_id, sphere, refine="none", posterior=True)
        assert service.get_answer(answer.answer_id) == answer
        service.forget_answer(answer.answer_id)
        with pytest.raises(NotFoundError, match="unknown-answer"):
            service.get_answer(answer.answer_id)
        with pytest.raises(ValueError, match="answer_id is"):
            service.get_answer("../floorplans")


def test_sphere_is_bytes_a_file_or_an_image(service: Any, sphere: bytes, tmp_path: Path) -> None:
    plan_id = service.wait_until_ready(service.upload_floorplan(json.dumps(FLAT).encode()).id).id
    (tmp_path / "p.jpg").write_bytes(sphere)
    spheres = [sphere, tmp_path / "p.jpg", str(tmp_path / "p.jpg")]
    answers = [service.localise(plan_id, source, heading_deg=0, refine="none") for source in spheres]
    assert len({(answer.position, answer.cost) for answer in answers}) == 1
    picture = Image.open(io.BytesIO(sphere)).convert("RGBA")
    answer: Localisation = service.localise(plan_id, picture, heading_deg=0, refine="none")
    assert answer.cost == pytest.approx(answers[0].cost, rel=0.1)


def test_invalid_request_names_the_fields(service: Any, plan_id: str, sphere: bytes) -> None:
    with pytest.raises(InvalidError, match="top_k") as caught:
        service.localise(plan_id, sphere, top_k=99)
    assert caught.value.status == 422
    assert [field for field, _ in caught.value.faults] == ["top_k"]
    with pytest.raises(InvalidError, match="rooms"):
        service.upload_floorplan({"rooms": []})
    with pytest.raises(ValueError, match="heading_deg is nan"):
        service.localise(plan_id, sphere, heading_deg=float("nan"))


def test_malformed_ids_reach_no_other_route(service: Any) -> None:
    for malformed in ("../healthz", "a/original", "a%2Foriginal", "?x", "#", "..", ".", "", "é", "a" * 129):
        with pytest.raises(ValueError, match="floorplan_id"):
            service.delete_floorplan(malformed)
    with pytest.raises(NotFoundError):
        service.floorplan("healthz")


def test_readiness(service: Any, app: httpx.Client) -> None:
    state = service.ready()
    assert state.ready is True
    assert state.lpo_pool.workers == 0
    assert state.model.sha256 == app.get("/readyz").json()["model"]["sha256"]


def test_sequence_is_one_query(service: Any, plan_id: str, app: httpx.Client, sphere: bytes) -> None:
    answer = service.localise_sequence(
        plan_id, [sphere, sphere], motion="turn", headings_deg=[90.0, None], refine="none", top_k=2
    )
    data = {"floorplan_id": plan_id, "motion": "turn", "headings_deg": "[90, null]", "refine": "none", "top_k": "2"}
    document = app.post("/localise/sequence", data=data, files=[("photo", sphere), ("photo", sphere)]).json()
    assert len(answer.poses) == 2
    assert json.loads(json.dumps(dataclasses.asdict(answer))) == document | {"timings_ms": dict(answer.timings_ms)}
    with pytest.raises(InvalidError, match="to a session"):
        service.localise_sequence(plan_id, [sphere, sphere])
    with pytest.raises(ValueError, match=r"headings_deg\[0\] is nan"):
        service.localise_sequence(plan_id, [sphere, sphere], motion="turn", headings_deg=[float("nan"), None])


def test_options_are_sent(service: Any, plan_id: str, sphere: bytes) -> None:
    assert service.localise(plan_id, sphere, rooms="kitchen", strict=True, refine="none").room == "kitchen"
    near = {"x_m": 2.0, "y_m": 1.0}
    answer = service.localise(plan_id, sphere, near=near, radius_m=1.0, strict=True, refine="none")
    assert math.dist((answer.position.x_m, answer.position.y_m), near.values()) <= 1.0 + 1e-3
    with pytest.raises(InvalidError, match="no room 'attic'"):
        service.localise(plan_id, sphere, rooms=["attic"])
    with pytest.raises(ValueError, match=r"near\['x_m'\] is inf"):
        service.localise(plan_id, sphere, near={"x_m": float("inf"), "y_m": 0.0}, radius_m=1.0)
    with pytest.raises(TypeError, match="unknown options: headng_deg"):
        service.localise(plan_id, sphere, headng_deg=90.0)


def test_batch_yields_an_answer_per_photograph(service: Any, plan_id: str, sphere: bytes, tmp_path: Path) -> None:
    (tmp_path / "hall.jpg").write_bytes(sphere)
    answers = list(service.localise_batch(plan_id, [tmp_path / "hall.jpg", b"no picture", sphere], refine="none"))
    found = [(answer.index, answer.name, answer.status) for answer in answers]
    assert found == [(0, "hall.jpg", 200), (1, "photo", 422), (2, "photo", 200)]
    assert answers[0].result().floorplan_id == plan_id
    with pytest.raises(InvalidError) as caught:
        answers[1].result()
    assert caught.value.type == "urn:lalaloc:problem:invalid-photograph"
    with pytest.raises(NotFoundError):
        list(service.localise_batch("f" * 32, [sphere]))


def test_damaged_photograph_gives_its_warning_and_another_picture_a_named_error(service: Any, plan_id: str) -> None:
    answer = service.localise(plan_id, FOLDER / "jpeg_no_eoi.jpg", refine="none")
    assert any("the file ends before its picture does" in text for text in answer.warnings)
    with pytest.raises(InvalidError, match="dual fisheye picture of a 360° camera") as caught:
        service.localise(plan_id, FOLDER / "dual_fisheye.jpg")
    assert caught.value.type == "urn:lalaloc:problem:invalid-photograph"


def test_earlier_names_of_arguments_are_accepted(service: Any, plan_id: str, sphere: bytes) -> None:
    with pytest.warns(DeprecationWarning, match="'panorama' is now 'photograph'"):
        earlier = service.localise(plan_id, panorama=sphere, refine="none")
    assert earlier.position == service.localise(plan_id, photograph=sphere, refine="none").position
