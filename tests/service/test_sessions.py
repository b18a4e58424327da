"""Sessions of tracked cameras: photographs in order, stored states, refusals, odometry that photographs contradict."""

from __future__ import annotations

import json
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from time import sleep
from typing import Any
from unittest.mock import Mock

import httpx
import numpy as np
import pytest
from sqlalchemy import update

from service.errors import StoreUnavailableError
from service.storage.kept_answers import IdempotencyKeys
from service.storage.store import Store
from service.storage.tables import IDEMPOTENCY
from service.venues import venue_plans
from tests.core.taken import sphere as taken_sphere
from tests.painted import picture_file
from tests.service.conftest import FLAT, DatabaseOf, StartApp, assert_problem, document_of, encode_picture, upload
from tests.service.test_venue_queries import venue_of
from tests.strategies import present


def begin(client: httpx.Client, plan_id: str, **fields: Any) -> str:
    answer = client.post("/sessions", json={"floorplan_id": plan_id} | fields)
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == f"/sessions/{answer.json()['id']}"
    return answer.json()["id"]


def _moved(covariance: str) -> dict[str, Any]:
    return {"forward_m": 1, "turn_deg": 0, "covariance": covariance}


def send(client: httpx.Client, session_id: str, picture: bytes, key: str = "", **fields: Any) -> httpx.Response:
    data = {name: str(value) for name, value in fields.items()}
    files = {"photo": ("p.jpg", picture, "image/jpeg")}
    headers = {"Idempotency-Key": key} if key else {}
    return client.post(f"/sessions/{session_id}/photographs", data=data, files=files, headers=headers)


def test_session_follows_photographs_until_it_is_deleted(client: httpx.Client, flat: str, sphere: bytes) -> None:
    session_id = begin(client, flat, camera_height_m=1.5)
    empty = client.get(f"/sessions/{session_id}").json()
    assert (empty["photographs"], empty["mode"], empty["pose"], empty["path"]) == (0, "searching", None, [])
    first = send(client, session_id, sphere, number=1).json()
    answer = document_of(send(client, session_id, sphere, number=2, forward_m=0, turn_deg=0))
    assert answer == client.get(f"/sessions/{session_id}").json()
    assert answer["photographs"] == answer["pose"]["number"] == 2
    assert [point["number"] for point in answer["path"]] == [1, 2]
    assert answer["path"][0]["position"] == first["pose"]["position"]
    pose = answer["pose"]
    assert pose["room"] in {room["name"] for room in FLAT["rooms"]}
    covariance = pose["covariance"]
    assert all(covariance[i][j] == covariance[j][i] for i in range(3) for j in range(3))
    assert min(covariance[i][i] for i in range(3)) > 0.0
    assert answer["expires_at"] > first["expires_at"]
    assert client.delete(f"/sessions/{session_id}").status_code == 204
    assert_problem(client.get(f"/sessions/{session_id}"), 404, "unknown-session")
    assert_problem(send(client, session_id, sphere), 404, "unknown-session")
    assert_problem(client.delete(f"/sessions/{session_id}"), 404, "unknown-session")


@pytest.mark.parametrize(
    ("fields", "slug", "message"),
    [
        ({"forward_m": "nan", "turn_deg": 0}, "invalid-request", "forward_m"),
        ({"forward_m": 1, "right_m": "inf", "turn_deg": 0}, "invalid-request", "is 'inf': must be finite"),
        ({"forward_m": 1000, "turn_deg": 0}, "invalid-motion", "is 1000 m long; the limit is 50 m between two"),
        ({"forward_m": 0, "turn_deg": 900}, "invalid-motion", "the turn is 900\\u00b0; the limit is 720\\u00b0"),
        ({"forward_m": 40, "right_m": 40, "turn_deg": 0}, "invalid-motion", "the limit is 50 m"),
        ({"forward_m": 1, "turn_deg": 0, "forward_std_m": -1}, "invalid-motion", "forward_std_m is -1; it must not be"),
        ({"forward_m": 1, "turn_deg": 0, "right_std_m": 60}, "invalid-motion", "of right_m is 60 m; the limit is 50 m"),
        (_moved(json.dumps([[-1, 0, 0], [0, 1, 0], [0, 0, 1]])), "invalid-motion", "a variance must not be negative"),
        (
            _moved("[[1, 2, 0], [2, 1, 0], [0, 0, 1]]"),
            "invalid-motion",
            "not positive semidefinite: the smallest eigenvalue of its correlations is -1",
        ),
        (_moved("[[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]"), "invalid-motion", "not symmetric"),
        (_moved("[[NaN, 0, 0], [0, 1, 0], [0, 0, 1]]"), "invalid-request", "must be finite"),
        (_moved("[[1]]"), "invalid-request", "covariance"),
        ({"forward_m": 1}, "invalid-request", "forward_m and turn_deg are needed together"),
        ({"turn_std_deg": 1}, "invalid-request", "need forward_m and turn_deg"),
        ({"number": 0}, "invalid-request", "must be at least 1"),
    ],
)
def test_impossible_motion_is_refused(
    client: httpx.Client, flat: str, sphere: bytes, fields: dict[str, Any], slug: str, message: str
) -> None:
    session_id = begin(client, flat)
    assert message in json.dumps(assert_problem(send(client, session_id, sphere, **fields), 422, slug))
    # The session is free and unchanged.
    assert send(client, session_id, sphere, number=1).status_code == 200


def test_unreadable_photograph_and_one_out_of_order_leave_the_session_as_it_is(
    client: httpx.Client, flat: str, sphere: bytes
) -> None:
    session_id = begin(client, flat)
    assert_problem(send(client, session_id, b"no picture"), 422, "invalid-photograph")
    assert send(client, session_id, sphere, number=1).status_code == 200
    problem = assert_problem(send(client, session_id, sphere, number=1), 409, "photograph-out-of-order")
    assert "number is 1; the next photograph" in problem["detail"]
    assert client.get(f"/sessions/{session_id}").json()["photographs"] == 1
    assert send(client, session_id, sphere, number=2).status_code == 200


def test_two_photographs_at_once_move_the_camera_once_each(client: httpx.Client, flat: str, sphere: bytes) -> None:
    session_id = begin(client, flat)
    with ThreadPoolExecutor(4) as threads:
        answers = list(threads.map(lambda _: send(client, session_id, sphere), range(4)))
    accepted = [answer for answer in answers if answer.status_code == 200]
    for answer in answers:
        if answer not in accepted:
            assert_problem(answer, 409, "session-busy")
            assert answer.headers["retry-after"] == "1"
    assert sorted(answer.json()["photographs"] for answer in accepted) == list(range(1, len(accepted) + 1))
    assert client.get(f"/sessions/{session_id}").json()["photographs"] == len(accepted) >= 1


@pytest.mark.parametrize(
    ("fields", "slug"),
    [
        ({"near": {"x_m": 1, "y_m": 1}}, "invalid-request"),
        ({"near": {"x_m": 900, "y_m": 1}, "radius_m": 2}, "invalid-hint"),
        ({"rooms": ["attic"]}, "invalid-hint"),
        ({"camera_height_m": 9}, "invalid-pose"),
        ({"top_k": 1000}, "invalid-request"),
        ({"colour": "red"}, "invalid-request"),
    ],
)
def test_impossible_session_is_refused(client: httpx.Client, flat: str, fields: dict[str, Any], slug: str) -> None:
    assert_problem(client.post("/sessions", json={"floorplan_id": flat} | fields), 422, slug)


def test_hint_is_the_prior_of_the_first_photograph(client: httpx.Client, flat: str, sphere: bytes) -> None:
    assert send(client, begin(client, flat, rooms=["kitchen"]), sphere).json()["pose"]["room"] == "kitchen"


def test_replaced_plan_ends_its_sessions(client: httpx.Client, sphere: bytes) -> None:
    own = upload(client)
    session_id = begin(client, own)
    client.put(f"/floorplans/{own}", json=FLAT | {"name": "changed", "ceiling_height_m": 2.6}).raise_for_status()
    assert_problem(send(client, session_id, sphere), 409, "session-outdated")
    client.delete(f"/floorplans/{own}").raise_for_status()
    assert_problem(client.get(f"/sessions/{session_id}"), 404, "unknown-session")


def test_session_survives_a_restart(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path) as client:
        session_id = begin(client, upload(client))
        before = send(client, session_id, sphere).json()
    with start_app(tmp_path) as client:
        assert client.get(f"/sessions/{session_id}").json() == before
        after = send(client, session_id, sphere, number=2, forward_m=0, turn_deg=0)
        assert after.json()["photographs"] == 2, after.text


@pytest.mark.slow
def test_sessions_expire_and_are_limited(start_app: StartApp, app_store: Store, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path, session_ttl_s=1.0, max_sessions=2) as client:
        own = upload(client)
        first, _ = begin(client, own), begin(client, own)
        assert_problem(client.post("/sessions", json={"floorplan_id": own}), 507, "too-many-sessions")
        assert client.get("/usage").json()["stored_bytes"]["by_kind"]["sessions"] > 0
        sleep(1.1)
        assert_problem(send(client, first, sphere), 404, "unknown-session")
        begin(client, own)
        sleep(1.1)
        assert app_store.sessions.purge() == 1
        assert app_store.quota.account("default").used.sessions == 0


@pytest.mark.slow
def test_claim_of_a_dead_process_expires(start_app: StartApp, database_of: DatabaseOf, tmp_path: Path) -> None:
    with start_app(tmp_path) as client:
        session_id = begin(client, upload(client))
        store = Store(database_of(tmp_path), claim_s=2.0)
        store.sessions.claim("default", session_id, None, "0" * 32)
        picture = encode_picture(512, 256, "JPEG")
        busy = send(client, session_id, picture)
        assert_problem(busy, 409, "session-busy")
        assert busy.headers["retry-after"] == "1"
        sleep(2.1)
        assert send(client, session_id, picture, number=1).status_code == 200
        assert_problem(client.get(f"/sessions/{'0' * 32}"), 404, "unknown-session")
        store.close()


def begin_in(client: httpx.Client, venue_id: str, **fields: Any) -> str:
    return document_of(client.post("/sessions", json={"venue_id": venue_id} | fields), 201)["id"]


STAIRS = {"name": "stairs", "type": "stairs", "polygon": [[20, 0], [22, 0], [22, 4], [20, 4]]}
UPPER = FLAT | {"name": "upper", "rooms": [STAIRS, {"name": "attic", "polygon": [[0, 0], [9, 0], [9, 7], [0, 3]]}]}


@pytest.mark.parametrize("chosen", [False, True], ids=["all plans", "chosen plans"])
@pytest.mark.one_replica
def test_session_in_a_venue_names_the_plan(
    client: httpx.Client, sphere: bytes, monkeypatch: pytest.MonkeyPatch, chosen: bool
) -> None:
    lower, upper = upload(client, FLAT | {"rooms": [*FLAT["rooms"], STAIRS]}), upload(client, UPPER)
    venue_id = venue_of(client, lower, upper)
    if chosen:
        monkeypatch.setattr(venue_plans, "MAX_SEARCHED", 1)
    session_id = begin_in(client, venue_id, rooms=["attic"], level=1, camera_height_m=1.5)
    empty = client.get(f"/sessions/{session_id}").json()
    assert (empty["venue_id"], empty["floorplan_id"], empty["floorplan_revision"]) == (venue_id, None, None)
    for number in (1, 2, 3):
        motion: dict[str, Any] = {} if number == 1 else {"forward_m": 0, "turn_deg": 0}
        answer = document_of(send(client, session_id, sphere, number=number, **motion))
    levels = {lower: 0.0, upper: 1.0}
    assert [point["number"] for point in answer["path"]] == [1, 2, 3]
    for place in (answer["pose"], *answer["pose"]["candidates"], *answer["path"]):
        assert place["level"] == levels[place["floorplan_id"]]
    assert sum(rival["probability"] for rival in answer["pose"]["candidates"]) <= 1.001
    assert client.get(f"/sessions/{session_id}").json() == answer


@pytest.mark.parametrize("change", ["plan replaced", "plan deleted", "venue changed", "venue deleted"])
def test_change_of_the_venue_ends_its_sessions(client: httpx.Client, sphere: bytes, change: str) -> None:
    plan_ids = [upload(client), upload(client, UPPER)]
    venue_id = venue_of(client, *plan_ids)
    session_id = begin_in(client, venue_id)
    send(client, session_id, sphere).raise_for_status()
    stored = client.get("/usage").json()["stored_bytes"]["by_kind"]["sessions"]
    if change == "plan replaced":
        for plan_id in plan_ids:
            client.put(f"/floorplans/{plan_id}", json=FLAT | {"name": "changed"}).raise_for_status()
    elif change == "plan deleted":
        client.delete(f"/floorplans/{plan_ids[0]}").raise_for_status()
    elif change == "venue changed":
        client.patch(f"/venues/{venue_id}", json={"remove": [plan_ids[1]]}).raise_for_status()
    else:
        client.delete(f"/venues/{venue_id}").raise_for_status()
        assert_problem(send(client, session_id, sphere), 404, "unknown-session")
        assert client.get("/usage").json()["stored_bytes"]["by_kind"]["sessions"] < stored
        return
    assert venue_id in assert_problem(send(client, session_id, sphere), 409, "session-outdated")["detail"]


def test_impossible_session_in_a_venue_is_refused(client: httpx.Client, flat: str) -> None:
    venue_id = venue_of(client, flat)
    for document in ({}, {"floorplan_id": flat, "venue_id": venue_id}, {"floorplan_id": flat, "level": 0}):
        assert_problem(client.post("/sessions", json=document), 422, "invalid-request")
    assert_problem(client.post("/sessions", json={"venue_id": venue_id, "level": 7}), 422, "invalid-hint")
    assert_problem(client.post("/sessions", json={"venue_id": "0" * 32}), 404, "unknown-venue")
    empty = client.post("/venues", json={"name": "empty"}).json()["id"]
    assert_problem(client.post("/sessions", json={"venue_id": empty}), 409, "venue-unsearchable")


def test_session_of_an_earlier_version_goes_on(
    start_app: StartApp, app_store: Store, tmp_path: Path, sphere: bytes
) -> None:
    with start_app(tmp_path) as client:
        session_id = begin(client, upload(client))
        before = send(client, session_id, sphere).json()
        record = app_store.sessions.claim("default", session_id, None, "0" * 32)
        state, pose = present(record.state), json.loads(present(record.pose))
        for place in (pose["pose"], *pose["pose"]["candidates"], *pose["path"]):
            del place["floorplan_id"], place["level"]
        app_store.sessions.finish(record, "0" * 32, _first_version(state), json.dumps(pose), ttl_s=60.0)
        after = document_of(send(client, session_id, sphere, forward_m=0, turn_deg=0))
        # `finish` counted a photograph.
        assert after["photographs"] == 3
        assert after["path"][0] == before["path"][0] | {"floorplan_id": None, "level": None}


def _first_version(state: bytes) -> bytes:
    """Return a state in the format of version 1, with a path of one pose."""
    body = zlib.decompress(state[10:])
    (length,) = struct.unpack_from("<I", body)
    header = json.loads(body[4 : 4 + length])
    header |= {"poses": header.pop("plans")[0][1], "path": 1}
    del header["pose"]["plan"]
    text = json.dumps(header).encode()
    content = struct.pack("<I", len(text)) + text + body[4 + length :] + bytes(24)
    return struct.pack("<4sHI", b"LTRK", 1, zlib.crc32(content)) + zlib.compress(content)


@pytest.mark.slow
def test_stored_bytes_of_a_long_session_are_bounded(start_app: StartApp, tmp_path: Path, sphere: bytes) -> None:
    with start_app(tmp_path) as client:
        session_id = begin(client, upload(client))
        stored, answers = [], []
        for number in range(1, 241):
            motion: dict[str, Any] = {} if number == 1 else {"forward_m": 0, "turn_deg": 0}
            answer = send(client, session_id, sphere, number=number, **motion)
            answers.append(len(answer.content))
            stored.append(client.get("/usage").json()["stored_bytes"]["by_kind"]["sessions"])
        assert [point["number"] for point in answer.json()["path"]] == list(range(41, 241))
        # The path grows until it has 200 poses; later sizes differ by digits only.
        assert max(stored[200:]) < max(stored[:200]) + 2000
        assert max(answers[200:]) < max(answers[:200]) + 2000
        assert max(stored) < 200_000


def test_repeated_request_moves_the_camera_once(client: httpx.Client, flat: str, sphere: bytes) -> None:
    session_id = begin(client, flat)
    keyed = partial(send, client, session_id, sphere)
    first, again = keyed("first"), keyed("first")
    assert first.status_code == again.status_code == 200, first.text
    assert again.json() == first.json()
    assert "idempotency-replayed" not in first.headers
    assert again.headers["idempotency-replayed"] == "true"
    assert client.get(f"/sessions/{session_id}").json()["photographs"] == 1
    assert_problem(keyed("first", number="1"), 422, "idempotency-key-reused")
    assert keyed("second").json()["photographs"] == 2
    # A broken picture gets the same answer again.
    for _ in range(2):
        assert send(client, session_id, b"broken", "third").status_code == 422
    assert keyed("fourth", number="3").json()["photographs"] == 3


@pytest.mark.one_replica
def test_request_whose_answer_was_not_kept_moves_the_camera_once(
    start_app: StartApp, app_store: Store, tmp_path: Path, sphere: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    with start_app(tmp_path) as client:
        session_id = begin(client, upload(client))
        photograph = partial(send, client, session_id, sphere, "key")
        with monkeypatch.context() as patch:
            patch.setattr(IdempotencyKeys, "finish", Mock(side_effect=StoreUnavailableError))
            first = photograph()
        assert first.status_code == 200
        assert_problem(photograph(), 409, "idempotency-in-progress")
        with app_store.database.writing() as connection:
            connection.execute(update(IDEMPOTENCY).values(lease_until_s=0.0))
        assert photograph().json() == first.json()
        assert client.get(f"/sessions/{session_id}").json()["photographs"] == 1
        assert send(client, session_id, sphere).json()["photographs"] == 2


# Contradicted odometry, with the shipped model


# The robot turns on the spot.
TURN_DEG = 45.0


@pytest.fixture(scope="module")
def turning() -> list[bytes]:
    """Return photographs of a camera that turns clockwise on the spot."""
    files, pixels = [], taken_sphere("kitchen")
    for number in range(6):
        turned = np.roll(pixels, -round(number * TURN_DEG / 360.0 * pixels.shape[1]), axis=1)
        files.append(picture_file(turned, "JPEG"))
    return files


def follow(client: httpx.Client, plan_id: str, photos: list[bytes], **motion: Any) -> list[dict[str, Any]]:
    """Return the poses of photographs with the same stated motion between all of them."""
    session_id = begin(client, plan_id, camera_height_m=1.5)
    answers = [send(client, session_id, photo, **(motion if number else {})) for number, photo in enumerate(photos)]
    return [document_of(answer)["pose"] for answer in answers]


def test_right_odometry_is_not_contradicted(shipped: httpx.Client, home: str, turning: list[bytes]) -> None:
    poses = follow(shipped, home, turning, forward_m=0, turn_deg=TURN_DEG)
    assert [pose["motion_contradicted"] for pose in poses] == [[]] * len(poses)
    assert all(pose["probability"] > 0.5 for pose in poses[2:])
    assert [pose["warnings"] for pose in poses] == [[]] * len(poses)


@pytest.mark.parametrize(
    ("motion", "component"),
    [
        ({"forward_m": 0, "turn_deg": -TURN_DEG}, "turn_deg"),
        ({"forward_m": 2.5, "turn_deg": TURN_DEG}, "forward_m"),
        ({"forward_m": 0, "right_m": -2.5, "turn_deg": TURN_DEG}, "right_m"),
    ],
    ids=["sign of the turn", "slipping wheels", "sideways"],
)
def test_wrong_odometry_is_named(
    shipped: httpx.Client, home: str, turning: list[bytes], motion: dict[str, Any], component: str
) -> None:
    poses = follow(shipped, home, turning, **motion)
    # The photographs are believed.
    assert {pose["room"] for pose in poses} == {"kitchen"}
    assert [component in pose["motion_contradicted"] for pose in poses[1:]] == [True] * (len(poses) - 1)
    stated = (
        f"{component} is {motion[component]:g}, which the photographs contradict by more than 4 standard deviations"
    )
    assert stated in poses[1]["warnings"]
    assert len(poses[1]["warnings"]) == len(poses[1]["motion_contradicted"])
    again = f"{component} contradicts at least 3 of the last 8 photographs: check its sign, unit and standard deviation"
    assert again in poses[-1]["warnings"]
