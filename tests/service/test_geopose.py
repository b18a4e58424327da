"""Tests of answers as OGC GeoPose and GeoJSON, of plan exports, and of plans at the poles and on the date line."""

from __future__ import annotations

import itertools
import json
import math
from types import SimpleNamespace
from typing import Any

import httpx
import jsonschema
import numpy as np
import pyproj
import pytest

from lalaloc_client import Client
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import Anchor, ImportOptions, import_plan
from service.query.geopose import geopose_at
from service.venues.venue_hints import distances_m
from tests.core.test_earth import PLACES
from tests.importers.conftest import FLAT as PLAN
from tests.importers.conftest import assert_same_plan
from tests.service.conftest import FLAT, assert_problem, document_of, localise, upload
from tests.strategies import present

ANCHOR = {"latitude": 48.1372, "longitude": 11.5756, "altitude_m": 519.5}
ORIGIN = Anchor(**ANCHOR, north_deg=25.0)


def strict(properties: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON schema of an object with these properties and no others, all required."""
    return {"type": "object", "properties": properties, "required": [*properties], "additionalProperties": False}


def geopose_schema(part: str, *names: str) -> dict[str, Any]:
    """Return the schema of a pose with a position and another part; all values are numbers."""
    parts = {"position": ("lat", "lon", "h"), part: names}
    return strict({key: strict({name: {"type": "number"} for name in values}) for key, values in parts.items()})


# GeoPose.Basic.YPR and GeoPose.Basic.Quaternion.Strict of OGC GeoPose 1.0 (21-056r11).
YPR = geopose_schema("angles", "yaw", "pitch", "roll")
QUATERNION = geopose_schema("quaternion", "x", "y", "z", "w")
GEOJSON, GEOPOSE, JSON = "application/geo+json", "application/geopose+json", "application/json"


@pytest.fixture(scope="module")
def placed(client: httpx.Client) -> str:
    """Return the id of `FLAT` at `ANCHOR`."""
    return upload(client, FLAT | {"anchor": ANCHOR, "north_deg": 25})


def ask(client: httpx.Client, sphere: bytes, media: str = JSON, *, key: str = "", **fields: str) -> httpx.Response:
    """Send a query, with `motion` that of two photographs, for an answer of a media type."""
    path, count = ("/localise/sequence", 2) if "motion" in fields else ("/localise", 1)
    headers = {"Accept": media} | ({"Idempotency-Key": key} if key else {})
    files = [("photo", sphere)] * count
    return client.post(path, data={"refine": "none"} | fields, files=files, headers=headers)


def point_at(geopose: dict[str, Any]) -> dict[str, Any]:
    """Return the geometry of GeoJSON of a geographic pose."""
    place = geopose["position"]
    return {"type": "Point", "coordinates": [place["lon"], place["lat"], place["h"]]}


def assert_quaternion(document: dict[str, Any], geopose: dict[str, Any]) -> None:
    """Check a Basic-Quaternion against the structure of the standard and the Basic-YPR of the same answer."""
    jsonschema.validate(document, QUATERNION)
    assert document["position"] == geopose["position"]
    x, y, z, w = document["quaternion"].values()
    assert math.hypot(x, y, z, w) == pytest.approx(1.0, abs=1e-8)
    # Where the camera's forward axis points in (east, north, up), from the quaternion and from the yaw.
    forward = (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x))
    yaw = math.radians(geopose["angles"]["yaw"])
    assert forward == pytest.approx((-math.sin(yaw), math.cos(yaw), 0.0), abs=1e-6)


def assert_at(geopose: dict[str, Any], pose: dict[str, Any], anchor: Anchor) -> None:
    """Check a geographic pose against the geodesic from the anchor."""
    geod, place = pyproj.Geod(ellps="WGS84"), geopose["position"]
    azimuth, _, distance = geod.inv(anchor.longitude, anchor.latitude, place["lon"], place["lat"])
    position = pose["position"]
    assert distance == pytest.approx(math.hypot(position["x_m"], position["y_m"]), abs=2e-3)
    bearing = azimuth + anchor.north_deg - math.degrees(math.atan2(position["x_m"], position["y_m"]))
    assert (bearing + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.1)
    turned = geopose["angles"]["yaw"] + pose["heading_deg"] - anchor.north_deg
    assert (turned + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.01)


def test_control_points_are_in_the_units_of_the_plan() -> None:
    places = [(1.0, 2.0), (9.0, 5.5)]
    points = [
        {"x": x / 0.3048, "y": y / 0.3048, "latitude": float(lat), "longitude": float(lon)}
        for (x, y), (lon, lat) in zip(places, ORIGIN.to_earth(np.array(places)), strict=True)
    ]
    in_feet = FLAT | {"units": "ft", "anchor": {"control_points": points}}
    converted = present(import_plan(json.dumps(in_feet).encode(), ImportOptions()).anchor)
    assert converted.latitude == pytest.approx(ORIGIN.latitude, abs=1e-9)


@pytest.mark.parametrize(
    ("anchor", "words"),
    [
        ({"latitude": 48.0, "longitude": 11.0}, "needs north_deg"),
        ({"latitude": 91.0, "longitude": 11.0, "north_deg": 0}, "latitude of the anchor is 91"),
        ({"latitude": "48", "longitude": 11.0, "north_deg": 0}, "must be a number"),
        ({"longitude": 11.0, "north_deg": 0}, "latitude of the anchor must be a number"),
        ({"latitude": 48.0, "longitude": 11.0, "north_deg": 0, "altitude_m": 1e9}, "altitude_m of the anchor"),
        ({"latitude": 48.0, "longitude": 11.0, "north": 0}, "unknown key 'north'"),
        ({"control_points": [{"x": 0, "y": 0, "latitude": 48.0, "longitude": 11.0}]}, "must be two"),
        ({"control_points": [{"x": 0, "y": 0, "latitude": 48.0, "longitude": 11.0}] * 2}, "0.00 m apart"),
        ([48.0, 11.0], "must be an object"),
    ],
)
def test_invalid_anchor_is_refused(client: httpx.Client, anchor: Any, words: str) -> None:
    response = client.post("/floorplans", json=FLAT | {"anchor": anchor})
    assert words in assert_problem(response, 422, "invalid-floorplan")["detail"]


def test_earth_hint_equals_plan_hint(client: httpx.Client, placed: str, sphere: bytes) -> None:
    ((lon, lat),) = ORIGIN.to_earth(np.array([[2.0, 1.0]]))
    on_earth = json.dumps({"latitude": lat, "longitude": lon})
    fields = {"radius_m": 1.0, "strict": "true", "refine": "none"}
    found = localise(client, placed, sphere, near=on_earth, **fields).json()
    in_plan = localise(client, placed, sphere, near='{"x_m": 2, "y_m": 1}', **fields).json()
    assert [pose["position"] for pose in found["candidates"]] == [pose["position"] for pose in in_plan["candidates"]]
    assert all(math.dist(pose["position"].values(), (2.0, 1.0)) <= 1.0 + 1e-3 for pose in found["candidates"])


@pytest.mark.parametrize(
    ("near", "slug", "words"),
    [
        ({"latitude": 48.1372, "longitude": 11.6}, "invalid-hint", "near: latitude 48.1372, longitude 11.6 is 1.81e"),
        ({"latitude": -48.1372, "longitude": -168.4}, "invalid-hint", "near: latitude -48.1372, longitude -168.4 is"),
        ({"latitude": 48.1}, "invalid-request", "near.longitude: is missing"),
        ({"latitude": 98.1, "longitude": 11}, "invalid-request", "near.latitude: is '98.1': must be at most 90"),
        ({"latitude": 48.1, "longitude": 11, "x_m": 1}, "invalid-request", "near.x_m: is '1'"),
    ],
)
def test_invalid_earth_hint_is_refused(
    client: httpx.Client, placed: str, sphere: bytes, near: dict[str, float], slug: str, words: str
) -> None:
    problem = assert_problem(localise(client, placed, sphere, near=json.dumps(near), radius_m=5), 422, slug)
    assert words in problem["detail"]


def test_plan_keeps_its_anchor_and_north(client: httpx.Client) -> None:
    twice = client.post("/floorplans", json=FLAT | {"north_deg": 10, "anchor": ANCHOR | {"north_deg": 25}})
    assert "give one of them" in assert_problem(twice, 422, "invalid-floorplan")["detail"]
    plan = client.get(f"/floorplans/{upload(client, FLAT | {'anchor': ANCHOR | {'north_deg': 25}})}").json()["plan"]
    assert (plan["anchor"], plan["north_deg"]) == (ANCHOR, 25.0)
    assert FloorPlan.from_dict(plan).to_dict() == plan


def test_answers_have_a_geopose(client: httpx.Client, placed: str, sphere: bytes) -> None:
    answer = ask(client, sphere, floorplan_id=placed, heading_deg="115").json()
    geopose = answer["geopose"]
    # 115° in the plan is due east.
    assert answer["heading_deg"] == 115.0
    assert geopose["angles"] == pytest.approx({"yaw": -90.0, "pitch": 0.0, "roll": 0.0}, abs=1e-3)
    assert geopose["position"]["h"] == pytest.approx(ANCHOR["altitude_m"] + answer["camera_height_m"], abs=1e-3)
    response = ask(client, sphere, GEOJSON, floorplan_id=placed, heading_deg="115")
    assert response.headers["content-type"] == GEOJSON
    feature = response.json()
    assert (feature["type"], feature["geometry"]) == ("Feature", point_at(geopose))
    assert feature["properties"]["room"] == answer["room"]
    response = ask(client, sphere, GEOPOSE, floorplan_id=placed, heading_deg="115")
    assert response.headers["content-type"] == GEOPOSE
    assert response.headers["vary"] == "Accept"
    assert_quaternion(response.json(), geopose)
    # East is a quarter turn clockwise.
    expected = {"x": 0.0, "y": 0.0, "z": -(0.5**0.5), "w": 0.5**0.5}
    assert response.json()["quaternion"] == pytest.approx(expected, abs=1e-5)


def test_sequences_have_geoposes(client: httpx.Client, placed: str, sphere: bytes) -> None:
    turn = {"floorplan_id": placed, "motion": "turn"}
    answer = ask(client, sphere, **turn).json()
    response = ask(client, sphere, GEOPOSE, **turn)
    assert response.headers["content-type"] == GEOPOSE
    for document, pose in zip(response.json(), answer["poses"], strict=True):
        assert_quaternion(document, pose["geopose"])
    response = ask(client, sphere, GEOJSON, **turn)
    assert response.headers["content-type"] == GEOJSON
    collection = response.json()
    assert collection["type"] == "FeatureCollection"
    assert (collection["floorplan_id"], collection["confidence"]) == (placed, answer["confidence"])
    assert not collection.keys() & {"poses", "geometry", "properties", "coordinates"}
    for pose, feature in zip(answer["poses"], collection["features"], strict=True):
        assert_at(pose["geopose"], pose, ORIGIN)
        assert (feature["geometry"], feature["properties"]) == (point_at(pose["geopose"]), pose)


@pytest.mark.parametrize("more", [{}, {"motion": "turn"}], ids=["photograph", "sequence"])
@pytest.mark.parametrize("media", [GEOPOSE, GEOJSON])
def test_places_on_earth_need_an_anchor_and_no_key(
    client: httpx.Client, placed: str, flat: str, sphere: bytes, media: str, more: dict[str, str]
) -> None:
    refused = ask(client, sphere, media, floorplan_id=flat, **more)
    assert "has no anchor" in assert_problem(refused, 409, "floorplan-unanchored")["detail"]
    assert_problem(ask(client, sphere, media, key="k", floorplan_id=placed, **more), 422, "invalid-request")


def test_session_as_geoposes(client: httpx.Client, placed: str, flat: str, sphere: bytes) -> None:
    made = [client.post("/sessions", json={"floorplan_id": plan_id}).json() for plan_id in (placed, flat)]
    path, unanchored = (f"/sessions/{session['id']}" for session in made)
    response = client.post(f"{path}/photographs", files={"photo": sphere}, headers={"Accept": GEOPOSE})
    assert response.headers["content-type"] == GEOPOSE
    assert_quaternion(response.json(), client.get(path).json()["pose"]["geopose"])
    refused = client.post(f"{unanchored}/photographs", files={"photo": sphere}, headers={"Accept": GEOPOSE})
    assert_problem(refused, 409, "floorplan-unanchored")
    # The refused photograph has not moved the camera.
    assert client.get(unanchored).json()["photographs"] == 0


def test_every_candidate_has_a_geopose(client: httpx.Client, placed: str, sphere: bytes) -> None:
    answer = localise(client, placed, sphere, refine="none", top_k=5).json()
    assert len(answer["candidates"]) > 1
    assert answer["candidates"][0]["geopose"] == answer["geopose"]
    for candidate in answer["candidates"]:
        jsonschema.validate(candidate["geopose"], YPR)
        assert_at(candidate["geopose"], candidate, ORIGIN)


def test_plan_anchor_precedes_venue_anchor(client: httpx.Client, placed: str, flat: str, sphere: bytes) -> None:
    venue_anchor = {"latitude": -33.86, "longitude": 151.21, "altitude_m": 3.0, "north_deg": 90.0}
    far = FLAT | {"rooms": [{"name": "far", "polygon": [[x + 2e4, y] for x, y in FLAT["rooms"][0]["polygon"]]}]}
    ids = [placed, flat, upload(client, far)]
    anchors = {placed: ORIGIN, flat: Anchor(**venue_anchor)}
    plans = [{"floorplan_id": plan_id} for plan_id in ids]
    venue_id = client.post("/venues", json={"plans": plans, "anchor": venue_anchor}).json()["id"]
    found = document_of(ask(client, sphere, venue_id=venue_id, top_k="10"))["candidates"]
    assert {candidate["floorplan_id"] for candidate in found} == set(ids)
    for candidate in found:
        if candidate["floorplan_id"] == ids[2]:
            # The plan is too far from the venue's origin.
            assert candidate["geopose"] is None
        else:
            assert_at(candidate["geopose"], candidate, anchors[candidate["floorplan_id"]])
    client.delete(f"/floorplans/{ids[2]}")
    feature = ask(client, sphere, GEOJSON, venue_id=venue_id, top_k="10").json()
    assert feature["geometry"] == point_at(feature["properties"]["geopose"])


def test_without_an_anchor_there_are_no_geoposes_and_earth_hints(
    client: httpx.Client, flat: str, sphere: bytes
) -> None:
    assert localise(client, flat, sphere, refine="none").json()["geopose"] is None
    assert_problem(client.get(f"/floorplans/{flat}/export", params={"format": "imdf"}), 409, "floorplan-unanchored")
    venue_id = client.post("/venues", json={"plans": [{"floorplan_id": flat}]}).json()["id"]
    response = ask(client, sphere, GEOJSON, venue_id=venue_id)
    assert "nor has venue" in assert_problem(response, 409, "floorplan-unanchored")["detail"]
    picture = ask(client, sphere, "image/png", venue_id=venue_id)
    assert "a picture shows one plan" in assert_problem(picture, 422, "invalid-request")["detail"]
    response = localise(client, flat, sphere, near='{"latitude": 48, "longitude": 11}', radius_m=5)
    assert "the plan has no anchor" in assert_problem(response, 422, "invalid-hint")["detail"]


@pytest.mark.parametrize(
    ("format", "media"),
    [
        ("native", "application/json"),
        ("geojson", "application/geo+json"),
        ("dxf", "image/vnd.dxf"),
        ("svg", "image/svg+xml"),
    ],
)
def test_exported_plan_can_be_uploaded_again(client: httpx.Client, format: str, media: str) -> None:
    plan_id = client.post("/floorplans", json=PLAN).json()["id"]
    response = client.get(f"/floorplans/{plan_id}/export", params={"format": format})
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == media
    again = client.post("/floorplans", files={"file": ("plan", response.content)}).json()
    expected = client.get(f"/floorplans/{plan_id}").json()["plan"]
    assert_same_plan(import_plan(json.dumps(again["plan"]).encode()), expected)
    unknown = client.get(f"/floorplans/{plan_id}/export", params={"format": "dwg"})
    assert_problem(unknown, 422, "invalid-request")


def test_client_uploads_with_options_and_exports(client: httpx.Client) -> None:
    with Client(str(client.base_url)) as service:
        plan = service.upload_floorplan(PLAN, options={"name": "named"})
        assert plan.name == "named"
        drawing = service.export(plan.id, "svg")
        again = service.replace_floorplan(plan.id, drawing, options={"ceiling_height_m": 3})
        assert present(again.import_report)["format"] == "svg"
        assert {room.ceiling_height_m for room in again.rooms} == {3.0}
        assert service.upload_floorplan(drawing).import_report == service.upload_floorplan(drawing).import_report


@pytest.mark.parametrize("place", PLACES)
def test_venue_anchor_places_plans_anywhere(place: tuple[float, float]) -> None:
    anchor = Anchor(latitude=place[1], longitude=place[0], north_deg=25.0)
    row = SimpleNamespace(centre_x_m=30.0, centre_y_m=-40.0, reach_m=5.0, latitude=None, longitude=None)
    assert distances_m([row], anchor, anchor.latitude, anchor.longitude) == pytest.approx([45.0], abs=1e-3)


@pytest.mark.parametrize("place", PLACES)
def test_geopose_is_valid_anywhere(place: tuple[float, float]) -> None:
    anchor = Anchor(latitude=place[1], longitude=place[0])
    headings_deg = (0.0, 123.0, 179.99999, 180.0, 180.00001, 359.99999)
    for position_m, heading_deg in itertools.product(((0.0, 0.0), (40.0, -30.0), (-40.0, 30.0)), headings_deg):
        pose = present(geopose_at(anchor, position_m, heading_deg, 1.5))
        distance_m = pyproj.Geod(ellps="WGS84").inv(*place, pose.position.lon, pose.position.lat)[2]
        assert distance_m == pytest.approx(np.hypot(*position_m), abs=1e-3)
        assert -180.0 < pose.angles.yaw <= 180.0
