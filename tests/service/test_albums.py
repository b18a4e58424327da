"""Albums: photographs that are added once, solved together, corrected, and taken away."""

from __future__ import annotations

import asyncio
import csv
import io
import json
import logging
import threading
import time
import zipfile
from collections import Counter
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import httpx
import pypdfium2
import pytest
from PIL import ExifTags, Image
from sqlalchemy import func, select, update

from lalaloc_core import LaLaLoc
from lalaloc_core.bundle import Bundle, default_bundle
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.localise.album import solve as album_solve
from lalaloc_core.localise.album.pins import Album, Pin, PinPose, RoomShare, Suggestion
from lalaloc_core.localise.encode.features import FeatureEncoder
from lalaloc_core.localise.encode.photograph_encoder import sphere_size
from lalaloc_core.photograph import open_photograph
from service.albums import album_solver
from service.albums.album_solver import AlbumSolver
from service.errors import UnanchoredPlanError
from service.query import AlbumOutcome, AlbumProgress, album_search
from service.query.album_answers import compose_outcome
from service.query.album_search import AT_A_TIME
from service.routes import album_photographs
from service.schemas.albums import PinAnswer
from service.storage.album_rows import NewPhotograph
from service.storage.store import Store
from service.storage.stored_bytes import ROW_BYTES
from service.storage.tables import ALBUM_PHOTOGRAPHS, ALBUMS
from service.telemetry import LOGGER_NAME
from tests.core.filmed import turn
from tests.core.taken import EXAMPLES, jpeg
from tests.painted import picture_file
from tests.service.conftest import FLAT, HOME, StartApp, assert_problem, document_of, lines_of, pages, upload, wait_for
from tests.service.test_security import bearer, make_key
from tests.strategies import present

ANCHORED = {**HOME, "anchor": {"latitude": 48.0, "longitude": 11.0}, "north_deg": 0}
NAMES = ("living_room.jpg", "kitchen.jpg", "bedroom.jpg", "study.jpg")
ENTITIES = b'<!DOCTYPE x [<!ENTITY a "a"><!ENTITY b "&a;&a;">]><x:xmpmeta xmlns:x="adobe:ns:meta/">&b;</x:xmpmeta>'


@pytest.fixture(scope="module")
def start_app(start_app: StartApp) -> StartApp:
    """Start the app with the shipped model, as the tiny one gives no features."""
    return partial(start_app, bundle=default_bundle(), request_deadline_s=90.0, sweep_s=0.2)


@pytest.fixture(scope="module")
def pictures() -> list[bytes]:
    """Return spheres of four rooms, with times, a position, an owner and entities in their metadata."""
    found = []
    for number, name in enumerate(NAMES):
        exif = Image.Exif()
        exif[0x010F], exif[0x0110], exif[0x013B] = "Maker", "Model X", "Erika Mustermann"
        exif.get_ifd(0x8769)[0x9003] = f"2026:05:01 10:0{number}:00"
        exif.get_ifd(0x8825)[2] = (48.0, 8.0, 14.0)
        found.append(picture_file(Image.open(EXAMPLES / name), "JPEG", quality=95, exif=exif, xmp=ENTITIES))
    return found


@pytest.fixture(scope="module")
def plan_id(client: httpx.Client) -> str:
    return upload(client, ANCHORED)


@pytest.fixture(scope="module")
def solved(client: httpx.Client, plan_id: str, pictures: list[bytes]) -> str:
    """Return the id of an album with the pictures; tests that change it undo that."""
    album_id = create(client, plan_id)
    assert [line["status"] for line in add(client, album_id, pictures[:3])] == [201, 201, 201]
    wait_until_solved(client, album_id)
    return album_id


def create(client: httpx.Client, plan_id: str, **fields: Any) -> str:
    answer = client.post("/albums", json={"floorplan_id": plan_id} | fields)
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == f"/albums/{answer.json()['id']}"
    return answer.json()["id"]


def send(client: httpx.Client, album_id: str, files: list[bytes], part: str = "photo") -> httpx.Response:
    parts = [(part, (f"{number}.jpg", content, "image/jpeg")) for number, content in enumerate(files)]
    return client.post(f"/albums/{album_id}/photographs", files=parts)


def add(client: httpx.Client, album_id: str, files: list[bytes], part: str = "photo") -> list[dict[str, Any]]:
    """Add photographs; return the lines of the answer."""
    return lines_of(send(client, album_id, files, part))


def photographs(client: httpx.Client, album_id: str, **params: Any) -> list[dict[str, Any]]:
    return client.get(f"/albums/{album_id}/photographs", params=params).json()["photographs"]


def wait_until_solved(client: httpx.Client, album_id: str) -> dict[str, Any]:
    """Wait until the pins are those of the latest change; return the album."""
    wait_for(lambda: client.get(f"/albums/{album_id}").json()["state"] != "solving")
    album = client.get(f"/albums/{album_id}").json()
    assert album["state"] == "solved", album
    assert album["solved_revision_number"] == album["revision_number"]
    return album


def correct(client: httpx.Client, album_id: str, photograph_id: str, correction: Any, **headers: str) -> httpx.Response:
    path = f"/albums/{album_id}/photographs/{photograph_id}"
    return client.patch(path, json={"correction": correction}, headers=headers)


def test_photographs_get_pins_together(client: httpx.Client, solved: str, plan_id: str) -> None:
    album = client.get(f"/albums/{solved}").json()
    assert (album["floorplan_id"], album["venue_id"], album["photographs"]) == (plan_id, None, 3)
    assert album["place_revision"] == client.get(f"/floorplans/{plan_id}").json()["revision"]
    counts = album["solution"]["pins"]
    assert sum(counts[state] for state in ("sure", "uncertain", "set_aside", "corrected")) == 3
    found = photographs(client, solved)
    assert [row["number"] for row in found] == [1, 2, 3]
    rooms = {room["name"] for room in HOME["rooms"]}
    for number, row in enumerate(found):
        assert row["view"]["taken_at"] == f"2026-05-01T10:0{number}:00"
        assert row["view"]["make"] == "Maker"
        assert 0.0 <= row["pin"]["confidence"] <= 1.0
        assert 1 <= len(row["pin"]["suggestions"]) <= 5
        assert {place["room"] for place in row["pin"]["suggestions"]} <= rooms


def test_pins_are_those_of_the_command_line(client: httpx.Client, plan_id: str, tmp_path: Path) -> None:
    files = [jpeg(frame) for frame in turn()[::10]]
    album_id = create(client, plan_id)
    add(client, album_id, files)
    wait_until_solved(client, album_id)
    for number, content in enumerate(files):
        (tmp_path / f"{number}.jpg").write_bytes(content)
    pinned = LaLaLoc().pin(json.dumps(ANCHORED).encode(), tmp_path)
    found = [row["pin"]["room_confidence"] for row in photographs(client, album_id)]
    assert found == pytest.approx([present(each.pin).confidence for each in pinned.photographs], abs=1e-3)


def test_pictures_are_added_once_and_unreadable_files_left_out(
    client: httpx.Client, plan_id: str, pictures: list[bytes]
) -> None:
    album_id = create(client, plan_id)
    strip = picture_file(Image.new("RGB", (900, 100)), "JPEG")
    unreadable, *first, empty = add(client, album_id, [strip, *pictures[:2], b""])
    assert [line["status"] for line in (unreadable, *first, empty)] == [422, 201, 201, 422]
    assert unreadable["problem"]["type"] == "urn:lalaloc:problem:invalid-photograph"
    assert "is a strip; state projection=cylindrical and hfov_deg" in unreadable["problem"]["detail"]
    assert (unreadable["name"], first[0]["photograph"]["name"]) == ("0.jpg", "1.jpg")
    again = add(client, album_id, [pictures[1], pictures[0], pictures[2], pictures[2]])
    assert [line["status"] for line in again] == [200, 200, 201, 200]
    assert [line["photograph"]["id"] for line in again[:2]] == [row["photograph"]["id"] for row in first[::-1]]
    assert client.get(f"/albums/{album_id}").json()["photographs"] == 3
    # Names of files are no formulas.
    files = [("photo", ('=cmd|"x".jpg', pictures[3], "image/jpeg"))]
    assert client.post(f"/albums/{album_id}/photographs", files=files).status_code == 200
    table = client.get(f"/albums/{album_id}/photographs", headers={"Accept": "text/csv"}).text
    assert list(csv.DictReader(io.StringIO(table)))[-1]["name"].startswith("'=cmd")


def test_pages_of_photographs_have_each_once(client: httpx.Client, solved: str) -> None:
    path = f"/albums/{solved}/photographs"
    assert [row["number"] for page in pages(client, path, limit=2) for row in page["photographs"]] == [1, 2, 3]
    assert ["link" in client.get(path, params={"limit": limit}).headers for limit in (2, 3)] == [True, False]
    for wrong in ({"cursor": "x"}, {"limit": 501}):
        assert_problem(client.get(path, params=wrong), 422, "invalid-request")


def test_pins_as_geojson_csv_and_svg(client: httpx.Client, solved: str, plan_id: str) -> None:
    path = f"/albums/{solved}/photographs"
    found = photographs(client, solved)
    geojson = client.get(path, headers={"Accept": "application/geo+json"})
    assert geojson.headers["content-type"] == "application/geo+json"
    features = geojson.json()["features"]
    assert [feature["id"] for feature in features] == [row["id"] for row in found]
    longitude, latitude, _ = features[0]["geometry"]["coordinates"]
    assert (longitude, latitude) == pytest.approx((11.0, 48.0), abs=0.01)
    table = client.get(path, headers={"Accept": "text/csv"})
    assert table.headers["content-type"] == "text/csv; charset=utf-8"
    rows = list(csv.DictReader(io.StringIO(table.text)))
    assert [row["room"] for row in rows] == [row["pin"]["place"]["room"] for row in found]
    assert float(rows[0]["x_m"]) == found[0]["pin"]["place"]["position"]["x_m"]
    drawing = client.get(path, headers={"Accept": "image/svg+xml"})
    assert drawing.headers["content-type"] == "image/svg+xml"
    assert drawing.text.count('<g class="pin ') == 3
    assert "kitchen" in drawing.text
    assert "script" not in drawing.text
    row = album_photographs.AlbumPhotographAnswer.model_validate_json(json.dumps(found[0]))
    _, drawn = album_photographs.pins_svg("plan", (0.0, 0.0, 9.0, 9.0), [row, row])
    # Those of one spot are drawn apart.
    assert len({pin.partition(" fill")[0] for pin in drawn.split('class="pin ')[1:]}) == 2
    bare = create(client, upload(client, FLAT))
    assert client.get(f"/albums/{bare}/photographs", headers={"Accept": "text/csv"}).text.count("\n") == 1


@pytest.mark.one_replica
def test_pins_are_read_and_written_beside_the_event_loop(
    client: httpx.Client, solved: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = set[str]()

    def noted(work: Any, *args: Any, **options: Any) -> Any:
        threads.add(threading.current_thread().name.partition("_")[0])
        return work(*args, **options)

    for name in ("photograph_answer", "AlbumPhotographList", "pins_csv", "pins_geojson", "pins_svg"):
        monkeypatch.setattr(album_photographs, name, partial(noted, getattr(album_photographs, name)))
    for media in ("application/json", "text/csv", "application/geo+json", "image/svg+xml"):
        assert client.get(f"/albums/{solved}/photographs", headers={"Accept": media}).status_code == 200
    assert threads == {"lalaloc-reads"}


def copies(client: httpx.Client, album_id: str, files: list[tuple[str, bytes]]) -> zipfile.ZipFile:
    answer = client.post(f"/albums/{album_id}/copies", files=[("photo", file) for file in files])
    assert (answer.status_code, answer.headers["content-type"]) == (200, "application/zip"), answer.text
    return zipfile.ZipFile(io.BytesIO(answer.content))


def test_copies_have_their_place_and_come_with_a_report(
    client: httpx.Client, solved: str, pictures: list[bytes]
) -> None:
    first, second, _, foreign = pictures
    files = [("../../1.jpg", first), ("b/1.jpg", second), ("again.jpg", first), ("foreign.jpg", foreign)]
    archive = copies(client, solved, files)
    assert archive.namelist() == ["photographs/1.jpg", "photographs/1 (2).jpg", "report.pdf", "notes.txt"]
    assert b"ENTITY" in first
    assert b"ENTITY" not in archive.read("photographs/1.jpg")
    room = photographs(client, solved)[0]["pin"]["place"]["room"]
    with Image.open(archive.open("photographs/1.jpg")) as copy:
        assert copy.getxmp()["xmpmeta"]["RDF"]["Description"]["Location"] == room
        gps = copy.getexif().get_ifd(ExifTags.IFD.GPSInfo)
    # At the anchor, not where the file said.
    assert (gps[ExifTags.GPS.GPSLatitude][0], gps[ExifTags.GPS.GPSLatitude][1] < 1) == (48, True)
    pages = [page.get_textpage().get_text_range() for page in pypdfium2.PdfDocument(archive.read("report.pdf"))]
    assert any(page.startswith(room) and "1.jpg" in page for page in pages[1:])
    notes = archive.read("notes.txt").decode()
    assert notes.startswith("'again.jpg' is sent twice: copied once\n'foreign.jpg' is not in the album")
    refused = client.post(f"/albums/{solved}/copies", files={"features": ("1.jpg", first)})
    assert "have no picture to copy" in json.dumps(assert_problem(refused, 422, "invalid-request"))


@pytest.mark.parametrize(
    ("correction", "room"),
    [
        ({"room_id": "kitchen"}, "kitchen"),
        pytest.param({"position": {"x_m": 2.0, "y_m": 2.0}, "heading_deg": 90}, "living room", marks=pytest.mark.slow),
        pytest.param({"position": {"x_m": 7.0, "y_m": 2.0}}, "kitchen", marks=pytest.mark.slow),
        ({"elsewhere": True}, None),
        pytest.param({"confirmed": True}, ..., marks=pytest.mark.slow),
    ],
)
def test_correction_is_certain_and_can_be_undone(
    client: httpx.Client, solved: str, plan_id: str, correction: dict[str, Any], room: Any
) -> None:
    before = photographs(client, solved)[1]
    if "room_id" in correction:
        rooms = client.get(f"/floorplans/{plan_id}").json()["plan"]["rooms"]
        correction = {"room_id": next(row["id"] for row in rooms if row["name"] == room)}
    changed = document_of(correct(client, solved, before["id"], correction))
    given = {name: value for name, value in changed["correction"].items() if value is not None}
    assert correction.items() <= given.items()
    assert changed["revision"] != before["revision"]
    wait_until_solved(client, solved)
    after = client.get(f"/albums/{solved}/photographs/{before['id']}").json()
    if room is None:
        assert (after["pin"]["state"], after["pin"]["place"]) == ("set_aside", None)
    else:
        expected = before["pin"]["place"]["room"] if room is ... else room
        assert (after["pin"]["state"], after["pin"]["place"]["room"]) == ("corrected", expected)
        assert after["pin"]["confidence"] == 1.0
    if "position" in correction:
        assert after["pin"]["place"]["position"] == correction["position"]
    if "heading_deg" in correction:
        assert after["pin"]["place"]["heading_deg"] == correction["heading_deg"]
    assert correct(client, solved, before["id"], None).json()["correction"] is None
    wait_until_solved(client, solved)
    assert client.get(f"/albums/{solved}/photographs/{before['id']}").json()["pin"]["state"] != "corrected"


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({}, "correction"),
        ({"correction": {}}, "give one of room_id, position, elsewhere, confirmed"),
        ({"correction": {"room_id": "r", "elsewhere": True}}, "give one of"),
        ({"correction": {"elsewhere": False}}, "elsewhere"),
        ({"correction": {"room_id": "attic"}}, "has no room of this id"),
        ({"correction": {"room_id": "kitchen", "heading_deg": 1}}, "heading_deg goes with position"),
        ({"correction": {"position": {"x_m": 100, "y_m": 0}}}, "lies in no room"),
        ({"correction": {"position": {"x_m": 1}}}, "y_m"),
        ({"correction": {"position": {"x_m": 1, "y_m": 1}, "heading_deg": 400}}, "heading_deg"),
        (
            {"correction": {"position": {"x_m": 1, "y_m": 1}, "floorplan_id": "f" * 32}},
            "not the floor plan of the album",
        ),
        ({"correction": None, "pin": 1}, "pin"),
    ],
)
def test_invalid_correction_is_refused(
    client: httpx.Client, solved: str, document: dict[str, Any], message: str
) -> None:
    row = photographs(client, solved)[0]
    response = client.patch(f"/albums/{solved}/photographs/{row['id']}", json=document)
    assert message in json.dumps(assert_problem(response, 422, "invalid-request"))
    assert photographs(client, solved)[0]["revision"] == row["revision"]


def test_events_follow_a_solve_and_changes_respect_preconditions(
    client: httpx.Client, plan_id: str, pictures: list[bytes]
) -> None:
    album_id = create(client, plan_id)
    (line,) = add(client, album_id, pictures[:1])
    with client.stream("GET", f"/albums/{album_id}/events") as response:
        assert response.headers["content-type"].startswith("text/event-stream")
        text = "".join(response.iter_text())
    assert "event: solved" in text
    last = json.loads([event for event in text.splitlines() if event.startswith("data: ")][-1][6:])
    assert (last["status"], last["photographs"]) == ("solved", 1)
    path = f"/albums/{album_id}/photographs/{line['photograph']['id']}"
    etag = client.get(path).headers["etag"]
    assert client.get(path, headers={"If-None-Match": etag}).status_code == 304
    changed = correct(client, album_id, line["photograph"]["id"], {"elsewhere": True}, **{"If-Match": etag})
    assert (changed.status_code, changed.headers["content-location"]) == (200, path)
    stale = correct(client, album_id, line["photograph"]["id"], None, **{"If-Match": etag})
    assert "photograph" in assert_problem(stale, 412, "revision-mismatch")["detail"]
    assert_problem(client.delete(path, headers={"If-Match": etag}), 412, "revision-mismatch")
    album = client.get(f"/albums/{album_id}")
    assert client.get(f"/albums/{album_id}", headers={"If-None-Match": album.headers["etag"]}).status_code == 304
    assert_problem(client.delete(f"/albums/{album_id}", headers={"If-Match": '"0"'}), 412, "revision-mismatch")
    assert client.delete(path, headers={"If-Match": changed.headers["etag"]}).status_code == 204
    assert_problem(client.get(path), 404, "unknown-photograph")
    assert client.get(f"/albums/{album_id}").json()["state"] == "empty"
    now = client.get(f"/albums/{album_id}").headers["etag"]
    assert client.delete(f"/albums/{album_id}", headers={"If-Match": now}).status_code == 204
    assert_problem(client.get(f"/albums/{album_id}"), 404, "unknown-album")


def test_unknown_albums_and_places_are_refused(client: httpx.Client, solved: str, pictures: list[bytes]) -> None:
    for album_id in ("f" * 32, "x"):
        assert_problem(client.get(f"/albums/{album_id}"), 404, "unknown-album")
        assert_problem(client.delete(f"/albums/{album_id}"), 404, "unknown-album")
        assert_problem(send(client, album_id, pictures[:1]), 404, "unknown-album")
        assert_problem(client.get(f"/albums/{album_id}/events"), 404, "unknown-album")
        assert_problem(correct(client, album_id, "f" * 32, None), 404, "unknown-album")
    assert_problem(correct(client, solved, "f" * 32, None), 404, "unknown-photograph")
    assert_problem(client.post("/albums", json={"floorplan_id": "f" * 32}), 404, "unknown-floorplan")
    assert_problem(client.post("/albums", json={"venue_id": "f" * 32}), 404, "unknown-venue")
    assert_problem(client.post("/albums", json={}), 422, "invalid-request")
    problem = assert_problem(client.post("/albums", json={"floorplan_id": "f" * 32, "hfov": 1}), 422, "invalid-request")
    assert "hfov" in json.dumps(problem)
    files = [("photo", ("p.jpg", pictures[0]))]
    response = client.post(f"/albums/{solved}/photographs", data={"hfov_deg": "60"}, files=files)
    assert_problem(response, 422, "invalid-request")


def test_repeated_creation_makes_one_album(client: httpx.Client, plan_id: str) -> None:
    headers, document = {"Idempotency-Key": "album-1"}, {"floorplan_id": plan_id, "name": "Twice"}
    first, second = (client.post("/albums", json=document, headers=headers) for _ in range(2))
    assert first.json() == second.json()
    assert second.headers["idempotency-replayed"] == "true"
    names = [album["name"] for album in client.get("/albums", params={"name": "twIC"}).json()["albums"]]
    assert names == ["Twice"]
    reused = client.post("/albums", json=document | {"name": "Other"}, headers=headers)
    assert_problem(reused, 422, "idempotency-key-reused")


@pytest.mark.slow
def test_limits_of_albums(start_app: StartApp, tmp_path: Path, pictures: list[bytes]) -> None:
    with start_app(tmp_path, max_albums=2, max_album_photographs=2) as client:
        plan_id = upload(client)
        first = create(client, plan_id)
        create(client, plan_id)
        problem = assert_problem(client.post("/albums", json={"floorplan_id": plan_id}), 507, "too-many-albums")
        assert "max_albums" in problem["detail"]
        lines = add(client, first, pictures)
        assert [line["status"] for line in lines] == [201, 201, 507, 507]
        full = next(line for line in lines if line["status"] == 507)
        assert full["problem"]["type"] == "urn:lalaloc:problem:too-many-photographs"
        assert "max_album_photographs" in full["problem"]["detail"]
        limits = client.get("/limits").json()
        assert (limits["max_albums"], limits["max_album_photographs"]) == (2, 2)


@pytest.mark.slow
def test_features_take_the_place_of_photographs(client: httpx.Client, plan_id: str, pictures: list[bytes]) -> None:
    bundle = Bundle.open(default_bundle())
    opened = [open_photograph(picture, sphere_size=sphere_size(bundle.manifest)) for picture in pictures]
    encoder, album_id = FeatureEncoder(bundle, threads=1), create(client, plan_id)
    line, *_ = add(client, album_id, [encoder.features(photograph) for photograph in opened], "features")
    assert (line["status"], line["photograph"]["view"]["width"]) == (201, None)
    # Features have no time.
    warnings = wait_until_solved(client, album_id)["solution"]["warnings"]
    assert any("4 are in the order of the numbers in their names, from '0.jpg' to '3.jpg'" in text for text in warnings)
    assert photographs(client, album_id)[0]["pin"]["place"] is not None
    (damaged,) = add(client, album_id, [b"LLFT"], "features")
    assert damaged["problem"]["type"] == "urn:lalaloc:problem:invalid-features"


def test_stored_album_has_no_picture_position_or_owner_and_counts_against_the_quota(
    start_app: StartApp, app_store: Store, tmp_path: Path, pictures: list[bytes]
) -> None:
    with start_app(tmp_path) as client:
        album_id = create(client, upload(client, HOME))
        (first,) = add(client, album_id, pictures[:1])
        wait_until_solved(client, album_id)
        assert "Mustermann" not in json.dumps(photographs(client, album_id))
        app_store.album_jobs.release(album_id, "")
        with app_store.database.writing() as connection:
            connection.execute(update(ALBUMS).values(solved_number=0))
        (part,) = present(app_store.album_jobs.claim(album_id, "test", 10.0)).photographs
        assert len(part.entry) <= 20_000
        for secret in (b"Mustermann", b"\xff\xd8\xff", b"GPS"):
            assert secret not in part.entry
        used = client.get("/usage").json()["stored_bytes"]["used"]
        app_store.tenants.change_limits("default", stored_bytes=used + 3000)
        wait_for(lambda: client.get("/usage").json()["stored_bytes"]["limit"] == used + 3000)
        kept, refused = add(client, album_id, pictures[:2])
        assert (kept["status"], refused["status"]) == (200, 507)
        assert refused["problem"]["type"] == "urn:lalaloc:problem:storage-quota"
        assert client.get("/usage").json()["stored_bytes"]["used"] == used
        # A deleted photograph makes room for another one.
        assert client.delete(f"/albums/{album_id}/photographs/{first['photograph']['id']}").status_code == 204
        assert [line["status"] for line in add(client, album_id, pictures[1:2])] == [201]


def test_model_without_features_has_no_albums(tiny_bundle: Path, start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, bundle=tiny_bundle) as client:
        response = client.post("/albums", json={"floorplan_id": upload(client)})
        assert_problem(response, 501, "model-without-features")


def test_albums_of_another_tenant_do_not_exist(
    start_app: StartApp, app_store: Store, tmp_path: Path, pictures: list[bytes]
) -> None:
    with start_app(tmp_path, api_keys=True) as client:
        own, other = bearer(make_key(app_store, tenant="one")), bearer(make_key(app_store, tenant="two"))
        reader = bearer(make_key(app_store, tenant="one", scopes=("read",)))
        client.headers.update(own)
        album_id = create(client, upload(client, HOME))
        (line,) = add(client, album_id, pictures[:1])
        path = f"/albums/{album_id}/photographs/{line['photograph']['id']}"
        album = f"/albums/{album_id}"
        both = [(method, address) for method in ("GET", "DELETE") for address in (album, path)]
        more = ("GET", f"{album}/events"), ("GET", f"{album}/photographs"), ("POST", f"{album}/copies")
        for method, address in (*both, *more):
            assert_problem(client.request(method, address, headers=other), 404, "unknown-album")
            assert_problem(client.request(method, address, headers=reader), 403, "insufficient-scope")
        assert client.get("/albums", headers=other).json()["albums"] == []
        used = client.get("/usage").json()["stored_bytes"]["by_kind"]["albums"]
        assert used > 0
        assert client.get("/usage", headers=other).json()["stored_bytes"]["by_kind"]["albums"] == 0
        app_store.quota.recount()
        assert client.get("/usage").json()["stored_bytes"]["by_kind"]["albums"] == used
        assert client.delete(f"/albums/{album_id}").status_code == 204
        assert client.get("/usage").json()["stored_bytes"]["by_kind"]["albums"] == 0
        assert "DELETE /albums/{album_id}" in [entry.action for entry in app_store.audit_log.page(limit=50)]


def test_album_goes_with_its_plan_and_expires(
    start_app: StartApp, app_store: Store, tmp_path: Path, pictures: list[bytes]
) -> None:
    with start_app(tmp_path, album_ttl_s=1.0) as client:
        plan_id = upload(client)
        expiring = create(client, plan_id)
        add(client, expiring, pictures[:1])
        wait_for(lambda: client.get(f"/albums/{expiring}").status_code == 404)
        assert client.get("/albums").json()["albums"] == []
        assert app_store.albums.purge() == 1
        with_plan = create(client, plan_id)
        assert client.delete(f"/floorplans/{plan_id}").status_code == 204
        assert_problem(client.get(f"/albums/{with_plan}"), 404, "unknown-album")
        assert app_store.quota.account("default").used.albums == 0


@pytest.mark.slow
def test_album_in_a_venue_names_plan_and_level(client: httpx.Client, plan_id: str, pictures: list[bytes]) -> None:
    upper = upload(client, {**HOME, "name": "Upper"})
    plans = [{"floorplan_id": plan_id, "level": 0}, {"floorplan_id": upper, "level": 1}]
    venue = client.post("/venues", json={"plans": plans}).json()
    album_id = document_of(client.post("/albums", json={"venue_id": venue["id"]}), 201)["id"]
    (line,) = add(client, album_id, pictures[:1])
    wait_until_solved(client, album_id)
    (row,) = photographs(client, album_id)
    place = row["pin"]["place"]
    assert place["level"] == {plan_id: 0.0, upper: 1.0}[place["floorplan_id"]]
    correction = {"position": {"x_m": 1, "y_m": 1}, "floorplan_id": upper}
    document_of(correct(client, album_id, line["photograph"]["id"], correction))
    wait_until_solved(client, album_id)
    (row,) = photographs(client, album_id, floorplan_id=upper)
    assert (row["pin"]["place"]["level"], row["pin"]["place"]["room"]) == (1.0, "living room")
    drawing = {"Accept": "image/svg+xml"}
    path = f"/albums/{album_id}/photographs"
    assert_problem(client.get(path, headers=drawing), 422, "invalid-request")
    assert client.get(path, headers=drawing, params={"floorplan_id": upper}).text.count('class="pin ') == 1
    assert client.delete(f"/venues/{venue['id']}").status_code == 204
    assert_problem(client.get(f"/albums/{album_id}"), 404, "unknown-album")


@pytest.mark.slow
def test_pins_move_with_a_new_revision_of_the_plan(client: httpx.Client, pictures: list[bytes]) -> None:
    plan_id = upload(client, HOME)
    album_id = create(client, plan_id)
    add(client, album_id, pictures[:2])
    before = wait_until_solved(client, album_id)
    old = {row["id"]: row["pin"]["place"] for row in photographs(client, album_id)}
    rooms = [{**room, "polygon": [[x + 5, y] for x, y in room["polygon"]]} for room in HOME["rooms"]]
    doors = [{**opening, "line": [[x + 5, y] for x, y in opening["line"]]} for opening in HOME["openings"]]
    answer = client.put(f"/floorplans/{plan_id}", json={**HOME, "rooms": rooms, "openings": doors})
    assert answer.status_code == 200
    wait_for(lambda: client.get(f"/albums/{album_id}").json()["place_revision"] != before["place_revision"])
    album = wait_until_solved(client, album_id)
    assert album["revision"] == before["revision"]
    assert album["solution"]["pins"]["moved"] == 2
    for row in photographs(client, album_id):
        moved = row["pin"]["moved"]
        assert moved["before"] == old[row["id"]]
        assert moved["distance_m"] > 0.5


@pytest.mark.slow
def test_correction_of_a_room_that_is_gone_is_left_out(client: httpx.Client, pictures: list[bytes]) -> None:
    plan_id = upload(client, HOME)
    album_id = create(client, plan_id)
    (line,) = add(client, album_id, pictures[:1])
    kitchen = client.get(f"/floorplans/{plan_id}").json()["plan"]["rooms"][0]["id"]
    assert correct(client, album_id, line["photograph"]["id"], {"room_id": kitchen}).status_code == 200
    before = wait_until_solved(client, album_id)
    rooms = [{**HOME["rooms"][1], "id": "only"}]
    assert client.put(f"/floorplans/{plan_id}", json={**HOME, "rooms": rooms, "openings": []}).status_code == 200
    wait_for(lambda: client.get(f"/albums/{album_id}").json()["place_revision"] != before["place_revision"])
    wait_until_solved(client, album_id)
    (row,) = photographs(client, album_id)
    assert row["pin"]["state"] != "corrected"
    assert "its correction was left out" in row["pin"]["warnings"][-1]


@pytest.mark.slow
def test_album_of_another_model_can_only_be_read(
    client: httpx.Client, app_store: Store, start_app: StartApp, tmp_path: Path, pictures: list[bytes]
) -> None:
    with start_app(tmp_path) as own:
        album_id = create(own, upload(own, HOME))
        (line,) = add(own, album_id, pictures[:1])
        wait_until_solved(own, album_id)
        with app_store.database.writing() as connection:
            connection.execute(update(ALBUMS).values(model_sha256="0" * 64))
        assert own.get(f"/albums/{album_id}").json()["state"] == "outdated"
        assert photographs(own, album_id)[0]["pin"]["place"] is not None
        problem = assert_problem(send(own, album_id, pictures[1:2]), 409, "album-outdated")
        assert "create a new album" in problem["detail"]
        assert_problem(correct(own, album_id, line["photograph"]["id"], None), 409, "album-outdated")
        assert own.delete(f"/albums/{album_id}").status_code == 204


@pytest.mark.slow
@pytest.mark.one_replica
def test_solve_holds_up_no_other_tenant_and_its_expired_lease_is_taken_over(
    start_app: StartApp, app_store: Store, tmp_path: Path, pictures: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = threading.Event(), threading.Event()
    solve = album_search.solve_album

    def slow(*args: Any, **options: Any) -> Any:
        if not begun.is_set():
            begun.set()
            while not go_on.is_set():
                options["pause"]()
        return solve(*args, **options)

    monkeypatch.setattr(album_search, "solve_album", slow)
    keys = [make_key(app_store, tenant=tenant) for tenant in ("one", "two")]
    with start_app(tmp_path, api_keys=True) as client:
        albums = []
        for key in keys:
            client.headers.update(bearer(key))
            albums.append(create(client, upload(client, HOME)))
            add(client, albums[-1], pictures[:1])
            assert begun.wait(60.0)
        wait_until_solved(client, albums[1])
        client.headers.update(bearer(keys[0]))
        album_id = albums[0]
        # Held by the app: another replica gets nothing, nor does it store what it found.
        assert app_store.album_jobs.due(client.get(f"/albums/{album_id}").json()["model_sha256"], [], 9) == []
        assert app_store.album_jobs.claim(album_id, "other", 10.0) is None
        with app_store.database.writing() as connection:
            connection.execute(update(ALBUMS).values(lease_until_s=0.0))
        job = present(app_store.album_jobs.claim(album_id, "other", 10.0))
        assert job.attempts == 2
        go_on.set()
        # The app lost the lease, so its result is dropped until the other one releases it.
        pins = {part.id: '{"state": "set_aside"}' for part in job.photographs}
        assert not app_store.album_jobs.finish(job, "third", "0" * 32, pins=pins, solution=None)
        app_store.album_jobs.release(album_id, "other")
        wait_until_solved(client, album_id)


@pytest.mark.slow
@pytest.mark.one_replica
def test_solve_goes_on_after_the_service_was_killed(
    start_app: StartApp, app_store: Store, tmp_path: Path, pictures: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    solve = album_search.solve_album

    def stops_after_one(*args: Any, **options: Any) -> Any:
        def pause() -> None:
            while True:
                options["pause"]()
                time.sleep(0.05)

        return solve(*args, **options | {"pause": pause})

    def stored() -> int:
        found = ALBUM_PHOTOGRAPHS.c.evidence.is_not(None)
        return app_store.database.value(select(func.count()).where(found)) or 0

    with monkeypatch.context() as patch, start_app(tmp_path) as client:
        patch.setattr(album_search, "solve_album", stops_after_one)
        album_id = create(client, upload(client, HOME))
        add(client, album_id, pictures[:2])
        wait_for(lambda: stored() == 1)
    compared = Mock(wraps=album_solve.single_evidence)
    monkeypatch.setattr(album_solve, "single_evidence", compared)
    with start_app(tmp_path) as client:
        wait_until_solved(client, album_id)
    assert compared.call_count == 1
    assert stored() == 0


@pytest.mark.slow
@pytest.mark.one_replica
def test_album_that_cannot_be_solved_states_why(
    start_app: StartApp, tmp_path: Path, pictures: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    with start_app(tmp_path) as client:
        album_id = create(client, upload(client, HOME))
        with monkeypatch.context() as patch:
            patch.setattr(album_search, "solve_album", Mock(side_effect=InvalidInputError("the album is impossible")))
            add(client, album_id, pictures[:1])
            wait_for(lambda: client.get(f"/albums/{album_id}").json()["state"] == "failed")
            assert client.get(f"/albums/{album_id}").json()["reason"] == "the album is impossible"
            patch.undo()
            patch.setattr(album_search, "_MAX_CPU_S", 0.0)
            add(client, album_id, pictures[2:3])
            wait_for(lambda: "divide the album" in client.get(f"/albums/{album_id}").text)
        add(client, album_id, pictures[1:2])
        wait_until_solved(client, album_id)
        assert client.get(f"/albums/{album_id}").json()["reason"] is None


@pytest.mark.parametrize("is_same_place", [True, False])
def test_pin_in_a_plan_that_is_not_searched_now_moved_only_if_the_venue_changed(is_same_place: bool) -> None:
    def outcome(plan_id: str, before: dict[str, str | None], *, is_same: bool) -> AlbumOutcome:
        pose = PinPose(plan_id=plan_id, room_id="r", room="R", x_m=0.0, y_m=0.0, heading=None)
        pin = Pin(photograph_id="p", state="sure", pose=pose, confidence=1.0, within_1m=1.0)
        record: Any = SimpleNamespace(id=plan_id, revision_id="revision")
        ground: Any = SimpleNamespace(records=[record], levels=[0.0], anchors=[None], warnings=[])
        return compose_outcome(Album(pins=(pin,)), ground, before, {}, 1.5, is_same_place=is_same)

    first = outcome("a", {}, is_same=False)
    moved = PinAnswer.model_validate_json(outcome("b", dict(first.pins), is_same=is_same_place).pins["p"]).moved
    assert (moved is None) == is_same_place


def solver_of(**jobs: Any) -> AlbumSolver:
    """Return a solver with stand-ins for the rest of the service."""

    async def run(_: str, work: Any, *args: Any, **options: Any) -> Any:
        return work(*args, **options)

    rest: Any = SimpleNamespace(album_jobs=SimpleNamespace(**jobs), run=run, model=SimpleNamespace(sha256=""))
    rest.grids, rest.album_seconds = SimpleNamespace(grid_lease_s=0.1, sweep_s=0.1), SimpleNamespace(time=nullcontext)
    return AlbumSolver(rest, rest, rest, rest, rest, rest)


def job_of(tenant: str, *_: object) -> Any:
    return SimpleNamespace(album=SimpleNamespace(id=tenant, tenant=tenant))


def test_albums_take_turns_and_a_deleted_one_does_not_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    compared, tenants = Counter[str](), [str(number) for number in range(AT_A_TIME + 3)]

    async def until_stopped(_: Any, job: Any, progress: Any) -> None:
        while not progress.stopped:
            await asyncio.sleep(0.001)
            compared[job.album.tenant] += 1
            progress.share = 0.5
        raise ValueError("stopped")

    async def until_all_advanced() -> None:
        solving = asyncio.create_task(solver_of(due=due, claim=job_of, renew=lambda *_: True, release=release).run())
        while min(compared[tenant] for tenant in tenants) < 100:
            await asyncio.sleep(0.01)
        solving.cancel()

    def due(_: str, begun: list[str], limit: int, later: list[str]) -> list[tuple[str, str]]:
        return [(one, one) for one in sorted(tenants, key=later.__contains__) if one not in begun][:limit]

    release = Mock()
    monkeypatch.setattr(AlbumSolver, "_pin", until_stopped)
    monkeypatch.setattr(album_solver, "_TURN_S", 0.02)
    asyncio.run(asyncio.wait_for(until_all_advanced(), 60.0))
    # The lease of a deleted album is lost.
    asyncio.run(solver_of(renew=lambda *_: False, release=release)._attempt(job_of("deleted")))
    assert not any(call.kwargs["failed"] for call in release.call_args_list)


def test_solver_and_its_heartbeat_log_an_error_and_go_on(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger(LOGGER_NAME), "propagate", True)
    renew = Mock(side_effect=[ValueError("damaged"), False])
    progress = AlbumProgress()
    asyncio.run(asyncio.wait_for(solver_of(renew=renew)._renew(job_of("a"), progress), 10.0))
    assert progress.stopped
    assert "renewing a lease failed" in caplog.text
    due = Mock(side_effect=[ValueError("damaged"), asyncio.CancelledError()])
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(solver_of(due=due).run())
    assert "looking for albums to solve failed" in caplog.text


def test_pin_with_all_suggestions_takes_no_more_than_counts_as_stored() -> None:
    place = {"plan_id": "f" * 32, "room_id": "living-room", "room": "living room"}
    pose, rooms = PinPose(**place, x_m=1.25, y_m=2.25, heading=1.0), (RoomShare(**place, probability=0.1),) * 8
    found = (Suggestion(pose=pose, probability=0.2),) * 5
    pin = Pin(photograph_id="p", state="sure", pose=pose, confidence=1.0, within_1m=1.0, rooms=rooms, suggestions=found)
    record: Any = SimpleNamespace(id=pose.plan_id, revision_id="e" * 32)
    ground: Any = SimpleNamespace(records=[record], levels=[0.0], anchors=[None], warnings=[])
    text = compose_outcome(Album(pins=(pin,)), ground, {}, {}, 1.5, is_same_place=True).pins["p"]
    assert len(text) <= NewPhotograph(sha256="", name=None, facts="", entry=b"").stored_bytes - ROW_BYTES


def test_plan_without_an_anchor_is_named_beside_a_pin_set_aside(monkeypatch: pytest.MonkeyPatch) -> None:
    places = None, SimpleNamespace(floorplan_id="f")
    pins = [SimpleNamespace(place=place, geopose=None) for place in places]
    rows = [SimpleNamespace(id="photograph", pin=pin, model_dump=dict) for pin in pins]
    monkeypatch.setattr(album_photographs, "_answers", lambda *_: rows)
    album: Any = SimpleNamespace(venue_id=None)
    with pytest.raises(UnanchoredPlanError, match="'f'"):
        album_photographs._content("application/geo+json", album, [], None, None)
