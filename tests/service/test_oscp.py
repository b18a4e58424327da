"""Tests of the GeoPose protocol of the Open Spatial Computing Platform, version 2, with the shipped model."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from lalaloc_core.bundle import default_bundle
from lalaloc_core.floorplan.earth import Anchor, LocalFrame
from tests.core.taken import EXAMPLES
from tests.service.conftest import FLAT, HOME, StartApp, assert_problem, upload

POSES = {pose["file"]: pose for pose in json.loads((EXAMPLES / "poses.json").read_text())}
ANCHOR = {"latitude": 48.1372, "longitude": 11.5756, "altitude_m": 519.5}
NORTH_DEG = 25.0
PRIVACY = {name: [] for name in ("dataRetention", "dataAcceptableUse", "dataSanitizationApplied",
                                 "dataSanitizationRequested")}  # fmt: skip


def oscp_request(picture: bytes, place: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return a GeoPoseReq with every required member."""
    camera = {
        "timestamp": 1732266000000,
        "sensorId": "camera",
        "privacy": PRIVACY,
        "sequenceNumber": 0,
        "imageFormat": "JPG",
        "size": [512, 256],
        "imageBytes": base64.b64encode(picture).decode(),
        "imageOrientation": {"mirrored": False, "rotation": 0},
    }
    sensors, readings = [{"type": "camera", "id": "camera"}], {"cameraReadings": [camera]}
    if place is not None:
        rest = {"altitude": None, "altitudeAccuracy": None, "heading": None, "speed": 0}
        sensors.append({"type": "geolocation", "id": "gps"})
        reading = {"timestamp": 1732266000000, "sensorId": "gps", "privacy": PRIVACY, **rest, **place}
        readings["geolocationReadings"] = [reading]
    return {"id": "r1", "timestamp": 1732266000123, "type": "geopose", "sensors": sensors, "sensorReadings": readings}


def gps(east_m: float, north_m: float, accuracy_m: float) -> dict[str, float]:
    """Return a geolocation reading at an offset from the anchor."""
    frame = LocalFrame(ANCHOR["longitude"], ANCHOR["latitude"])
    ((longitude, latitude),) = frame.to_earth(np.array([[east_m, north_m]]))
    return {"latitude": float(latitude), "longitude": float(longitude), "accuracy": accuracy_m}


@pytest.fixture(scope="module")
def app_settings() -> dict[str, Any]:
    return {"bundle": default_bundle(), "request_deadline_s": 90.0, "max_top_k": 3}


@pytest.fixture(scope="module")
def home(client: httpx.Client) -> str:
    """Id of the anchored example flat; another lies 400 m north, a third has no anchor."""
    upload(client, FLAT)
    north = {name: value for name, value in gps(0.0, 400.0, 0.0).items() if name != "accuracy"}
    upload(client, FLAT | {"anchor": north, "north_deg": 0})
    return upload(client, HOME | {"anchor": ANCHOR, "north_deg": NORTH_DEG})


def check_answer(answer: dict[str, Any], home: str, name: str) -> None:
    """Check that an answer is a GeoPoseResp at the photograph's pose."""
    assert answer.keys() == {"id", "timestamp", "type", "accuracy", "geopose", "lalaloc"}
    assert (answer["id"], answer["timestamp"], answer["type"]) == ("r1", 1732266000123, "geopose")
    assert answer["accuracy"].keys() == {"position", "orientation"}
    pose, position = POSES[name], answer["geopose"]["position"]
    anchor = Anchor(**ANCHOR, north_deg=NORTH_DEG)
    ((x_m, y_m),) = anchor.to_plan(np.array([[position["lon"], position["lat"]]]))
    error_m = math.dist((x_m, y_m), (pose["x_m"], pose["y_m"]))
    assert error_m < 0.5
    assert error_m < 5.0 * answer["accuracy"]["position"] + 0.2
    quaternion = answer["geopose"]["quaternion"]
    assert (quaternion["x"], quaternion["y"]) == (0.0, 0.0)
    assert math.hypot(quaternion["z"], quaternion["w"]) == pytest.approx(1.0)
    # The camera's y axis, (0, 1, 0), rotated to east and north.
    z, w = quaternion["z"], quaternion["w"]
    true_deg = math.degrees(math.atan2(-2.0 * z * w, w * w - z * z))
    assert (true_deg - (pose["heading_deg"] - NORTH_DEG) + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=5.0)
    assert answer["lalaloc"]["floorplan_id"] == home
    assert position["h"] == pytest.approx(519.5 + pose.get("camera_height_m", 1.5), abs=0.3)


def test_query_by_plan_id(client: httpx.Client, home: str) -> None:
    body = oscp_request((EXAMPLES / "kitchen.jpg").read_bytes())
    response = client.post("/geopose", params={"floorplan_id": home}, json=body)
    assert response.status_code == 200, response.text
    check_answer(response.json(), home, "kitchen.jpg")
    assert response.json()["lalaloc"]["warnings"] == []


def test_query_by_geolocation(client: httpx.Client, home: str) -> None:
    # Storeys of a house share its anchor.
    upper = upload(client, FLAT | {"anchor": ANCHOR, "north_deg": NORTH_DEG})
    body = oscp_request((EXAMPLES / "kitchen.jpg").read_bytes(), gps(12.0, 8.0, 30.0))
    body["sensorReadings"]["wiFiReadings"] = [{"SSID": "x"}]
    response = client.post("/geopose", json=body)
    assert response.status_code == 200, response.text
    check_answer(response.json(), home, "kitchen.jpg")
    assert "wiFiReadings are not used" in response.json()["lalaloc"]["warnings"]
    client.delete(f"/floorplans/{upper}")
    nowhere = client.post("/geopose", json=oscp_request(b"x", gps(0.0, -3000.0, 50.0)))
    assert "within 50 m of latitude" in assert_problem(nowhere, 404, "no-floorplan-nearby")["detail"]


def test_query_in_a_venue_ignores_a_wrong_reading(client: httpx.Client, home: str) -> None:
    plain = upload(client, HOME)
    anchor = ANCHOR | {"north_deg": NORTH_DEG}
    venue = client.post("/venues", json={"plans": [{"floorplan_id": plain, "level": 2}], "anchor": anchor}).json()
    body = oscp_request((EXAMPLES / "kitchen.jpg").read_bytes(), gps(900.0, 0.0, 20.0))
    response = client.post("/geopose", params={"venue_id": venue["id"]}, json=body)
    assert response.status_code == 200, response.text
    check_answer(response.json(), plain, "kitchen.jpg")
    assert response.json()["lalaloc"]["level"] == 2.0
    [warning] = response.json()["lalaloc"]["warnings"]
    assert "geolocation reading" in warning
    in_plan = client.post("/geopose", params={"floorplan_id": home}, json=body).json()
    assert "its accuracy is 20 m: it was not used" in in_plan["lalaloc"]["warnings"][0]
    bare = client.post("/geopose", params={"floorplan_id": plain}, json=body)
    assert_problem(bare, 409, "floorplan-unanchored")


def _camera(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda request: request["sensorReadings"]["cameraReadings"][0].update(changes)


def _request(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda request: request.update(changes)


WRONG: dict[str, tuple[Callable[[dict[str, Any]], None], str, str]] = {
    "no id": (lambda request: request.pop("id"), "id", "is missing"),
    "another type": (_request(type="vps"), "type", "must be 'geopose'"),
    "no readings": (lambda request: request.pop("sensorReadings"), "sensorReadings", "is missing"),
    "no camera reading": (_request(sensorReadings={}), "sensorReadings.cameraReadings", "is missing"),
    "no picture": (_request(sensorReadings={"cameraReadings": []}), "sensorReadings.cameraReadings", "1 are needed"),
    "no base64": (_camera(imageBytes="***"), "sensorReadings.cameraReadings.0.imageBytes", "is not Base64"),
    "depth": (_camera(imageFormat="DEPTH"), "sensorReadings.cameraReadings.0.imageFormat", "colours"),
    "no parameters": (
        _camera(params={"model": "PINHOLE"}),
        "sensorReadings.cameraReadings.0.params.modelParams",
        "has 0 items, PINHOLE needs 4: fx, fy, cx, cy",
    ),
    "a lidar": (_camera(params={"model": "LIDAR"}), "sensorReadings.cameraReadings.0.params.model", "known models"),
    "mirrored": (
        _camera(imageOrientation={"mirrored": True, "rotation": 0}),
        "sensorReadings.cameraReadings.0.imageOrientation",
        "upright",
    ),
    "no sensor": (_request(sensors=[]), "sensorReadings.cameraReadings.0.sensorId", "no camera with this id"),
    "no place": (lambda _: None, "sensorReadings.geolocationReadings", "without floorplan_id and venue_id"),
}


@pytest.mark.parametrize(("change", "field", "words"), WRONG.values(), ids=WRONG.keys())
def test_missing_and_invalid_members_are_refused(
    client: httpx.Client, panorama: bytes, change: Callable[[dict[str, Any]], None], field: str, words: str
) -> None:
    body = oscp_request(panorama)
    change(body)
    problem = assert_problem(client.post("/geopose", json=body), 422, "invalid-request")
    assert [fault["field"] for fault in problem["errors"]] == [field]
    assert words in problem["detail"]


def test_invalid_and_large_pictures_are_refused(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path, max_photograph_bytes=2000) as client:
        plan_id = upload(client, FLAT | {"anchor": ANCHOR, "north_deg": 0})
        params = {"floorplan_id": plan_id}
        picture = client.post("/geopose", params=params, json=oscp_request(b"no picture"))
        assert_problem(picture, 422, "invalid-panorama")
        large = client.post("/geopose", params=params, json=oscp_request(bytes(2001)))
        assert "LALALOC_MAX_PHOTOGRAPH_BYTES" in assert_problem(large, 413, "upload-too-large")["detail"]
        larger = client.post("/geopose", params=params, json=oscp_request(bytes(90_000)))
        assert_problem(larger, 413, "upload-too-large")
        both = client.post("/geopose", params={**params, "venue_id": "v"}, json=oscp_request(b"x"))
        assert "at most one of the two" in assert_problem(both, 422, "invalid-request")["detail"]
        form = client.post("/geopose", params=params, data={"id": "r"})
        assert_problem(form, 415, "unsupported-media")
