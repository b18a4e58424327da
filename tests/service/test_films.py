"""Films of a turn over HTTP, with an encoder of views whose weights are random."""

from __future__ import annotations

import multiprocessing
from pathlib import Path
from typing import Any

import httpx
import pytest

from lalaloc_client import Client
from tests.core.filmed import encode, needs_ffmpeg, turn
from tests.core.taken import jpeg
from tests.service.conftest import StartApp, assert_problem, upload
from tests.strategies import present

pytestmark = needs_ffmpeg
QUICK = {"refine": "none", "top_k": "1", "hfov_deg": "53", "motion": "turn"}
APP_SETTINGS = {"bundle": "tiny_view_bundle", "max_film_bytes": 2_000_000, "max_sequence_bytes": 3_000_000}


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return encode(turn()[:31], tmp_path_factory.mktemp("film") / "turn.mp4")


def send(
    client: httpx.Client, plan_id: str, *parts: tuple[str, bytes], key: str | None = None, **fields: Any
) -> httpx.Response:
    data = {"floorplan_id": plan_id} | QUICK | {name: str(value) for name, value in fields.items()}
    headers = {} if key is None else {"Idempotency-Key": key}
    files = [(name, ("p", content)) for name, content in parts]
    return client.post("/localise/sequence", data=data, files=files, headers=headers, timeout=200.0)


def test_frames_of_a_film_become_poses(client: httpx.Client, flat: str, film: bytes) -> None:
    response = send(client, flat, ("film", film), key="film-1")
    answer = response.json()
    assert response.status_code == 200, answer
    reading, poses = answer["film"], answer["poses"]
    assert reading["frames_read"] == 31
    assert reading["frames_kept"] == len(poses) > 10
    assert sum(drop["frames"] for drop in reading["dropped"]) == 31 - len(poses)
    assert reading["turned_deg"] == pytest.approx(180.0, abs=15.0)
    assert reading["duration_s"] == pytest.approx(3.0)
    assert reading["warnings"] == []
    times_s = [pose["time_s"] for pose in poses]
    assert times_s == sorted(times_s)
    for pose in poses[1:]:
        heading = pose["view"]["relative_heading"]
        assert heading["source"] == "estimated"
        assert (heading["value_deg"] - 60.0 * (pose["time_s"] - times_s[0]) + 180.0) % 360.0 == pytest.approx(
            180.0, abs=2.0
        )
    assert send(client, flat, ("film", film), key="film-1").json() == answer


@pytest.mark.parametrize(
    ("fields", "field", "message"),
    [
        ({"motion": "walk"}, "motion", "photographs of a walk are no query of their own"),
        ({"relative_heading_deg": "[0, 20]"}, "relative_heading_deg", "does not go with a film"),
        ({"headings_deg": "[0, 20]"}, "headings_deg", "does not go with a film"),
    ],
)
def test_fields_that_do_not_go_with_a_film_are_refused(
    client: httpx.Client, flat: str, film: bytes, fields: dict[str, str], field: str, message: str
) -> None:
    problem = assert_problem(send(client, flat, ("film", film), **fields), 422, "invalid-request")
    assert [(fault["field"], message in fault["message"]) for fault in problem["errors"]] == [(field, True)]


def test_film_excludes_photographs_features_and_films(client: httpx.Client, flat: str, film: bytes) -> None:
    photo = jpeg(turn()[0])
    for other, field, message in (
        ([("photo", photo)] * 2, "film", "is given beside photo; send one of the two"),
        ([("features", b"LLFT")] * 2, "film", "is given beside features; send one of the two"),
        ([("film", film)], "film", "is given 2 times; send one"),
    ):
        problem = assert_problem(send(client, flat, ("film", film), *other), 422, "invalid-request")
        assert {"field": field, "message": message} in problem["errors"]


def test_unusable_film_is_an_invalid_film(client: httpx.Client, flat: str, film: bytes) -> None:
    for content, reason in ((b"ffconcat version 1.0\nfile 'a.mp4'\n", "by its first bytes"), (film[:3000], "damaged")):
        problem = assert_problem(send(client, flat, ("film", content)), 422, "invalid-film")
        assert reason in problem["detail"]
        assert problem["detail"].endswith("see docs/how-to/take-photographs.md")
    problem = assert_problem(send(client, flat, ("film", film + bytes(2_000_000))), 413, "upload-too-large")
    assert "LALALOC_MAX_FILM_BYTES" in problem["detail"]


@pytest.mark.slow
def test_python_client_sends_films(client: httpx.Client, flat: str, film: bytes, tmp_path: Path) -> None:
    path = tmp_path / "turn.mp4"
    path.write_bytes(film)
    with Client(str(client.base_url), timeout_s=200.0) as service:
        found = service.localise_film(flat, path, hfov_deg=53.0, refine="none")
    assert present(found.film).frames_kept == len(found.poses)
    assert found.poses[0].time_s is not None
    assert present(found.poses[1].view).relative_heading is not None


def film_workers() -> set[int | None]:
    return {child.pid for child in multiprocessing.active_children() if child.name.startswith("lalaloc-film-")}


def test_angles_of_many_photographs_are_found_beside_the_decoders(
    start_app: StartApp, tiny_view_bundle: Path, tmp_path: Path
) -> None:
    photographs = [("photo", jpeg(frame)) for frame in turn(24, 15.0)]
    with start_app(tmp_path, bundle=tiny_view_bundle) as client:
        # Those of the module's app can run as well.
        plan_id, others = upload(client), film_workers()
        for count, started in ((3, 0), (24, 1)):
            assert len(send(client, plan_id, *photographs[:count]).json()["poses"]) == count
            assert len(film_workers() - others) == started
