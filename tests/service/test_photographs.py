"""Photographs that are no full spheres, over HTTP, with an encoder of views whose weights are random."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from lalaloc_core.photograph.cameras import Perspective
from tests.core.fault_photographs import FOLDER
from tests.core.taken import EXAMPLES, PHONE, jpeg, sphere, take
from tests.service.conftest import FLAT, StartApp, assert_problem, localise, localise_turn, upload
from tests.service.test_sessions import begin
from tests.service.test_sessions import send as photograph_of_session

MAIN = Perspective.of_hfov(640, 480, math.radians(67.3))
ANCHOR = {"latitude": 48.1, "longitude": 11.5, "north_deg": 0.0}
QUICK = {"refine": "none", "top_k": 1}
APP_SETTINGS = {"bundle": "tiny_view_bundle"}


@pytest.fixture(scope="module")
def flat(client: httpx.Client) -> str:
    return upload(client, FLAT | {"anchor": ANCHOR})


def shown(heading_deg: float = 0.0, **tilt: float) -> np.ndarray:
    return take(sphere("living_room"), MAIN, heading_deg=heading_deg, **tilt)


def ask(client: httpx.Client, plan_id: str, photo: bytes, **fields: Any) -> httpx.Response:
    return localise(client, plan_id, photo, **(QUICK | fields))


def turn(client: httpx.Client, plan_id: str, *photos: bytes, **fields: Any) -> httpx.Response:
    return localise_turn(client, plan_id, *photos, **(QUICK | fields))


def test_phone_photograph_is_localised(client: httpx.Client, flat: str) -> None:
    answer = ask(client, flat, jpeg(shown(), PHONE), include="posterior").json()
    view = answer["view"]
    assert (view["projection"], view["projection_source"], view["hfov"]["source"]) == ("perspective", "exif", "exif")
    assert view["hfov"]["value_deg"] == pytest.approx(67.3, abs=0.2)
    assert view["pitch"]["source"] == view["roll"]["source"] == "estimated"
    assert abs(view["pitch"]["value_deg"]) < 3.0
    # The walls of the flat run along the axes of the plan.
    walls_deg = answer["heading_deg"] + view["wall_direction"]["value_deg"]
    assert abs((walls_deg + 45.0) % 90.0 - 45.0) < 5.0
    (arc,) = view["seen"]
    assert arc["to_deg"] - arc["from_deg"] == pytest.approx(67.0, abs=4.0)
    focal = view["camera"]["fx"]
    assert 2.0 * math.degrees(math.atan(320.0 / focal)) == pytest.approx(view["hfov"]["value_deg"], abs=0.02)
    # The divergence of the posterior from the shares of area, as the answer itself has it.
    probability = np.array(answer["posterior"]["probability"])
    assert view["ruled_out"] == pytest.approx(1.0 - 2.0 ** -view["information_bits"], abs=1e-3)
    assert 0.0 <= view["information_bits"] <= math.log2(9.0 * 6.0 / 0.25)
    entropy_bits = -float((probability * np.log2(probability)).sum())
    assert view["information_bits"] + entropy_bits < math.log2(9.0 * 6.0 / 0.25) + 1.0
    assert (answer["confidence"] or 0.0) >= 0.5 or view["advice"].startswith("turn around: 6")


def test_spheres_and_heic_are_read(client: httpx.Client, flat: str) -> None:
    content = (EXAMPLES / "kitchen.jpg").read_bytes()
    data = {"floorplan_id": flat} | {name: str(value) for name, value in QUICK.items()}
    renamed, usual = (client.post("/localise", data=data, files={name: content}) for name in ("panorama", "photo"))
    assert renamed.json() | {"timings_ms": None} == usual.json() | {"timings_ms": None}
    view = usual.json()["view"]
    assert (view["projection"], view["hfov"]["value_deg"], view["camera"]) == ("equirectangular", 360.0, None)
    assert view["seen"] == [{"from_deg": -180.0, "to_deg": 180.0}]
    assert view["wall_direction"] is None
    assert view["advice"] is None
    both = client.post("/localise", data=data, files=[("panorama", content), ("photo", content)])
    assert assert_problem(both, 422, "invalid-request")["errors"][0]["field"] == "photo"
    heic = ask(client, flat, (FOLDER / "phone.heic").read_bytes()).json()["view"]
    assert heic["hfov"]["value_deg"] == pytest.approx(67.3, abs=0.2)


@pytest.mark.parametrize(
    ("fields", "projection", "hfov_deg"),
    [
        ({"hfov_deg": "80"}, "perspective", 80.0),
        ({"intrinsics": json.dumps({"fx": 400, "fy": 400, "k1": -0.05})}, "perspective", 79.8),
        ({"intrinsics": json.dumps({"fx": 300, "fy": 300}), "projection": "fisheye"}, "fisheye", 122.2),
        ({"hfov_deg": "200", "projection": "cylindrical"}, "cylindrical", 200.0),
    ],
)
def test_statements_are_used(
    client: httpx.Client, flat: str, fields: dict[str, str], projection: str, hfov_deg: float
) -> None:
    view = ask(client, flat, jpeg(shown(), PHONE), pitch_deg=2, roll_deg=-1, **fields).json()["view"]
    assert (view["projection"], view["hfov"]["source"]) == (projection, "given")
    assert view["hfov"]["value_deg"] == pytest.approx(hfov_deg, abs=3.0)
    tilt = {"std_deg": 0.5, "source": "given"}
    assert (view["pitch"], view["roll"]) == ({"value_deg": 2.0, **tilt}, {"value_deg": -1.0, **tilt})


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"intrinsics": '{"fx": 0, "fy": 400}'}, "intrinsics: fx is 0; it must be positive"),
        ({"hfov_deg": "0"}, "hfov_deg is 0; it must be between 10 and 360"),
    ],
)
def test_impossible_statements_are_refused(
    client: httpx.Client, flat: str, fields: dict[str, str], reason: str
) -> None:
    problem = assert_problem(ask(client, flat, jpeg(shown(), PHONE), **fields), 422, "invalid-photograph")
    assert reason in problem["detail"]
    assert problem["detail"].endswith("see docs/how-to/take-photographs.md")


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        ({"intrinsics": "fx=400"}, "intrinsics"),
        ({"intrinsics": '{"fx": 400}'}, "intrinsics.fy"),
        ({"intrinsics": '{"fx": NaN, "fy": 400}'}, "intrinsics.fx"),
        ({"projection": "flat"}, "projection"),
        ({"roll_deg": "1_0"}, "roll_deg"),
    ],
)
def test_malformed_statements_name_their_field(
    client: httpx.Client, flat: str, fields: dict[str, str], field: str
) -> None:
    problem = assert_problem(ask(client, flat, jpeg(shown(), PHONE), **fields), 422, "invalid-request")
    assert [fault["field"] for fault in problem["errors"]] == [field]


def test_venue_picture_and_feature_work(client: httpx.Client, flat: str) -> None:
    photo = jpeg(shown(), PHONE)
    data = {"floorplan_id": flat, "refine": "none"}
    for media in ("image/png", "application/geo+json"):
        response = client.post("/localise", data=data, files={"photo": photo}, headers={"Accept": media})
        assert response.headers["content-type"] == media, response.text
    assert response.json()["properties"]["view"]["projection"] == "perspective"
    venue = client.post("/venues", json={"plans": [{"floorplan_id": flat, "level": 0}]}).json()["id"]
    answer = client.post("/localise", data={"venue_id": venue, **QUICK}, files={"photo": photo}).json()
    assert answer["view"]["projection"] == "perspective"


class TestTurn:
    PHOTOS = tuple(jpeg(shown(heading_deg), PHONE) for heading_deg in (0.0, 60.0, 120.0))

    def test_known_angles_make_one_wide_view(self, client: httpx.Client, flat: str) -> None:
        answer = turn(client, flat, *self.PHOTOS, relative_heading_deg="[10, 70, 130]").json()
        headings = [pose["heading_deg"] for pose in answer["poses"]]
        assert [(heading - headings[0]) % 360.0 for heading in headings] == pytest.approx([0.0, 60.0, 120.0], abs=0.02)
        assert len({json.dumps(pose["position"]) for pose in answer["poses"]}) == 1
        given = [pose["view"]["relative_heading"] for pose in answer["poses"]]
        assert given[2] == {"value_deg": 120.0, "std_deg": 2.0, "source": "given"}
        for pose in answer["poses"]:
            (arc,) = pose["view"]["seen"]
            assert arc["to_deg"] - arc["from_deg"] == pytest.approx(187.0, abs=5.0)

    def test_known_heading_of_one_gives_those_of_all(self, client: httpx.Client, flat: str) -> None:
        fields = {"relative_heading_deg": "[0, 60, 120]", "headings_deg": "[null, 100, null]"}
        answer = turn(client, flat, *self.PHOTOS, heading_tolerance_deg=0, **fields).json()
        assert [pose["heading_deg"] for pose in answer["poses"]] == pytest.approx([40.0, 100.0, 160.0], abs=0.02)

    def test_overlap_gives_the_angles(self, client: httpx.Client, flat: str) -> None:
        tilts = (4.0, -5.0, 0.0)
        photos = [jpeg(shown(30.0 * index, pitch_deg=tilt), PHONE) for index, tilt in enumerate(tilts)]
        answer = turn(client, flat, *photos).json()
        assert answer["warnings"] == []
        headings = [pose["heading_deg"] for pose in answer["poses"]]
        assert [(heading - headings[0]) % 360.0 for heading in headings] == pytest.approx([0.0, 30.0, 60.0], abs=1.0)
        for pose, heading_deg, tilt in zip(answer["poses"], (0.0, 30.0, 60.0), tilts, strict=True):
            view = pose["view"]
            assert view["relative_heading"]["value_deg"] == pytest.approx(heading_deg, abs=1.0)
            assert view["relative_heading"]["source"] == "estimated"
            assert view["pitch"]["value_deg"] == pytest.approx(tilt, abs=1.0)
            assert (view["pitch"]["source"], view["hfov"]["source"]) == ("estimated", "exif")
        stds = [pose["view"]["relative_heading"]["std_deg"] for pose in answer["poses"]]
        assert stds[0] == 0.0
        assert all(0.0 < std < 5.0 for std in stds[1:])

    def test_photographs_that_do_not_overlap_are_named(self, client: httpx.Client, flat: str) -> None:
        photos = [jpeg(shown(heading_deg), PHONE) for heading_deg in (0.0, 30.0, 180.0)]
        answer = turn(client, flat, *photos).json()
        (warning,) = answer["warnings"]
        assert "2 groups (photo[0], photo[1]; photo[2])" in warning
        assert "at most half the field of view, 34°" in warning
        assert [pose["view"]["relative_heading"] is None for pose in answer["poses"]] == [False, False, True]

    @pytest.mark.parametrize("fields", [{}, {"relative_heading_deg": "[0, 60, null]"}])
    def test_unknown_angles_are_searched(self, client: httpx.Client, flat: str, fields: dict[str, str]) -> None:
        answer = turn(client, flat, *self.PHOTOS, **fields).json()
        places = np.array([[pose["position"][axis] for axis in ("x_m", "y_m")] for pose in answer["poses"]])
        assert np.linalg.norm(places - places[0], axis=1).max() < 1.0

    @pytest.mark.parametrize(
        ("fields", "field", "message"),
        [
            ({"relative_heading_deg": "[0, 60]"}, "relative_heading_deg", "has 2 items, 3 photographs need 3"),
            ({"motion": "fly"}, "motion", "must be 'turn'"),
        ],
    )
    def test_contradictory_fields_are_refused(
        self, client: httpx.Client, flat: str, fields: dict[str, str], field: str, message: str
    ) -> None:
        problem = assert_problem(turn(client, flat, *self.PHOTOS, **fields), 422, "invalid-request")
        (fault,) = problem["errors"]
        assert fault["field"] == field
        assert message in fault["message"]


def test_model_for_spheres_refuses_other_photographs(start_app: StartApp, tmp_path: Path) -> None:
    with start_app(tmp_path) as client:
        plan_id = upload(client)
        problem = assert_problem(ask(client, plan_id, jpeg(shown(), PHONE)), 422, "invalid-photograph")
    assert "reads full 360° spheres only; send an equirectangular picture" in problem["detail"]


def test_session_takes_photographs_of_any_projection(client: httpx.Client, flat: str) -> None:
    send = partial(photograph_of_session, client, begin(client, flat))
    phone = send(jpeg(shown(), PHONE)).json()["pose"]
    assert (phone["view"]["projection"], phone["view"]["hfov"]["source"]) == ("perspective", "exif")
    # Gravity of the device.
    level = send(jpeg(shown(roll_deg=3.0)), hfov_deg=67.3, pitch_deg=0, roll_deg=3, forward_m=0, turn_deg=0).json()
    assert [level["pose"]["view"][name]["source"] for name in ("hfov", "pitch", "roll")] == ["given"] * 3
    assert level["pose"]["view"]["roll"]["value_deg"] == 3.0
    intrinsics = json.dumps({"fx": 480.7, "fy": 480.7})
    assert send(jpeg(shown()), intrinsics=intrinsics).json()["pose"]["view"]["camera"]["fx"] == 480.7
    # A sphere has other sectors of the heading.
    sphere_file = (EXAMPLES / "living_room.jpg").read_bytes()
    assert send(sphere_file, forward_m=0, turn_deg=0).json()["pose"]["view"]["projection"] == "equirectangular"
    assert send(jpeg(shown(), PHONE)).json()["photographs"] == 5
    refused = assert_problem(send(jpeg(shown()), projection="fisheye"), 422, "invalid-photograph")
    assert "a fisheye photograph needs hfov_deg" in refused["detail"]
    refused = assert_problem(send(jpeg(shown(), PHONE), heading_tolerance_deg=5), 422, "invalid-request")
    assert refused["errors"] == [{"field": "heading_tolerance_deg", "message": "is '5': needs heading_deg"}]
