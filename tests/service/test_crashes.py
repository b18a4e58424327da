"""Plans, sessions and albums of a service that is killed: real processes, on SQLite and PostgreSQL."""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from time import sleep
from typing import Any

import httpx
import pytest
from PIL import Image

from lalaloc_core.bundle import default_bundle
from service.storage.store import Store
from tests.core.taken import EXAMPLES
from tests.painted import picture_file
from tests.service import test_albums as albums
from tests.service.conftest import FLAT, upload, wait_for
from tests.service.test_process import children
from tests.service.test_sessions import begin, send
from tests.service.test_stopping import running_service


@pytest.fixture(params=["sqlite", "postgresql"])
def settings(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, str]:
    """Return the settings of a service that is started again on the same database."""
    usual = {"DECODE_STALL_S": "100", "DECODE_WORKERS": "1"}
    if request.param == "sqlite":
        return usual
    return usual | {"DATABASE_URL": request.getfixturevalue("postgres").new_database()}


def database_of(settings: dict[str, str], tmp_path: Path) -> str:
    return settings.get("DATABASE_URL", f"sqlite:///{tmp_path / 'data' / 'lalaloc.sqlite3'}")


@pytest.mark.slow
def test_photograph_in_work_at_a_kill_did_not_move_the_camera(
    tiny_bundle: Path, tmp_path: Path, settings: dict[str, str], sphere: bytes
) -> None:
    with running_service(tiny_bundle, tmp_path / "data", **settings) as service:
        session_id = begin(service.client, upload(service.client))
        assert send(service.client, session_id, sphere, number=1).status_code == 200
        before = service.client.get(f"/sessions/{session_id}").json()
        for decoder in children(service.process.pid):
            os.kill(decoder, signal.SIGSTOP)

        def send_second() -> httpx.Response:
            with httpx.Client(base_url=service.client.base_url, timeout=120.0) as client:
                return send(client, session_id, sphere, number=2, forward_m=0, turn_deg=0)

        with ThreadPoolExecutor(1) as threads:
            sending = threads.submit(send_second)
            # A number out of order claims nothing, and is refused differently while the photograph holds the claim.
            probe = partial(send, service.client, session_id, sphere, number=9)
            wait_for(lambda: probe().json()["type"] == "urn:lalaloc:problem:session-busy")
            service.process.kill()
            service.process.wait(60.0)
            assert isinstance(sending.exception(60.0), httpx.TransportError)
    with running_service(tiny_bundle, tmp_path / "data", **settings) as service:
        assert service.client.get(f"/sessions/{session_id}").json() == before
        # The claim of the killed process ends with its lease.
        answers: list[httpx.Response] = []

        def accepted() -> bool:
            answers.append(send(service.client, session_id, sphere, number=2, forward_m=0, turn_deg=0))
            assert answers[-1].status_code in (200, 409), answers[-1].text
            return answers[-1].status_code == 200

        wait_for(accepted, 120.0)
        after = answers[-1].json()
        assert (after["photographs"], [point["number"] for point in after["path"]]) == (2, [1, 2])


@pytest.mark.slow
def test_session_survives_kills_at_any_moment(
    tiny_bundle: Path, tmp_path: Path, settings: dict[str, str], sphere: bytes
) -> None:
    rng, answered, session_id = random.Random(5), 0, ""
    for _ in range(5):
        with running_service(tiny_bundle, tmp_path / "data", **settings) as service:
            if not session_id:
                session_id = begin(service.client, upload(service.client))
            stored = service.client.get(f"/sessions/{session_id}").json()["photographs"]
            # An answered photograph is stored; the one in work at the kill either counted or did not.
            assert stored in (answered, answered + 1)
            answered = stored
            killer = threading.Timer(rng.uniform(0.0, 1.0), service.process.kill)
            try:
                while True:
                    answer = send(service.client, session_id, sphere, number=answered + 1)
                    if answer.status_code == 200:
                        answered += 1
                        assert answer.json()["photographs"] == answered
                        if killer.ident is None:
                            killer.start()
                    else:
                        # Claimed by the process that was killed before.
                        assert answer.status_code == 409, answer.text
                        sleep(0.2)
            except httpx.TransportError:
                killer.join()
            service.process.wait(60.0)
    store = Store(database_of(settings, tmp_path))
    record = store.sessions.get("default", session_id)
    assert record.photographs in (answered, answered + 1)
    # What the quota counts is what is stored.
    used = store.quota.account("default").used.sessions
    assert used >= len(record.state or b"") + len(record.pose or "")
    store.close()


@pytest.mark.slow
def test_plans_that_are_sent_again_after_kills_are_stored_once(
    tiny_bundle: Path, tmp_path: Path, settings: dict[str, str]
) -> None:
    rng, names, stored = random.Random(3), [f"plan-{number}" for number in range(80)], dict[str, str]()
    interrupted = 0
    for life in range(4):
        with running_service(tiny_bundle, tmp_path / "data", **settings) as service, ThreadPoolExecutor(4) as threads:

            def send_plan(name: str, client: httpx.Client = service.client) -> None:
                while name not in stored:
                    plan, headers = FLAT | {"name": name}, {"Idempotency-Key": name}
                    answer = client.post("/floorplans", json=plan, headers=headers)
                    if answer.status_code == 201:
                        stored[name] = answer.json()["id"]
                    else:
                        # Claimed by a process that was killed, or too many at once.
                        assert answer.status_code in (409, 503), answer.text
                        sleep(0.2)

            killer = threading.Timer(rng.uniform(0.05, 0.3), service.process.kill)
            if life < 3:
                killer.start()
            faults = [sent.exception() for sent in [threads.submit(send_plan, name) for name in names]]
            killer.cancel()
            lost = [fault for fault in faults if fault is not None]
            assert all(isinstance(fault, httpx.TransportError) for fault in lost), lost
            assert life < 3 or not lost
            interrupted += len(lost)
    assert interrupted
    store = Store(database_of(settings, tmp_path))
    summaries = store.plans.list_plans("default", limit=1000)
    assert sorted((summary.name, summary.id) for summary in summaries) == sorted(stored.items())
    used = store.quota.account("default").used.plans
    store.quota.recount()
    assert store.quota.account("default").used.plans == used > 0
    store.close()


def small_pictures(count: int) -> list[bytes]:
    names, found = ("kitchen", "bedroom", "study", "living_room"), []
    for number in range(count):
        with Image.open(EXAMPLES / f"{names[number % len(names)]}.jpg") as picture:
            small = picture.resize((512 + 2 * (number // len(names)), 256))
        found.append(picture_file(small, "JPEG", quality=90))
    return found


@pytest.mark.slow
def test_album_keeps_everything_acknowledged_before_kills(tmp_path: Path, settings: dict[str, str]) -> None:
    rng, pictures, album_id = random.Random(7), small_pictures(12), ""
    stored: dict[str, str] = {}
    corrected: dict[str, Any] = {}
    options = settings | {"GRID_LEASE_S": "2", "SWEEP_S": "0.5"}

    def check(client: httpx.Client) -> list[dict[str, Any]]:
        rows = albums.photographs(client, album_id)
        ids = {row["sha256"]: row["id"] for row in rows}
        assert stored.items() <= ids.items()
        assert len(ids) == len(rows) == client.get(f"/albums/{album_id}").json()["photographs"]
        assert [row["number"] for row in rows] == list(range(1, len(rows) + 1))
        for row in rows:
            if row["id"] in corrected:
                assert row["correction"]["position"] == corrected[row["id"]]["position"]
        return rows

    def send(client: httpx.Client) -> None:
        """Send all pictures, and correct those that are acknowledged, until the service dies."""
        parts = [("photo", (f"{number}.jpg", content)) for number, content in enumerate(pictures)]
        with client.stream("POST", f"/albums/{album_id}/photographs", files=parts) as response:
            for text in response.iter_lines():
                line = json.loads(text)
                # A photograph whose answer was lost can be stored already.
                assert line["status"] == 200 or line["photograph"]["sha256"] not in stored, text
                stored[line["photograph"]["sha256"]] = line["photograph"]["id"]
        for number, id in enumerate(stored.values()):
            correction = {"position": {"x_m": 1.0 + 0.1 * number, "y_m": 2.0}}
            if albums.correct(client, album_id, id, correction).status_code == 200:
                corrected[id] = correction

    for longest_s in (1.0, 2.0, 4.0, 6.0):
        with running_service(default_bundle(), tmp_path / "data", **options) as service:
            if not album_id:
                album_id = albums.create(service.client, upload(service.client, albums.HOME))
            check(service.client)
            killer = threading.Timer(rng.uniform(0.3, 1.0) * longest_s, service.process.kill)
            killer.start()
            try:
                while True:
                    send(service.client)
            except httpx.TransportError:
                killer.join()
            service.process.wait(60.0)
    assert stored
    with running_service(default_bundle(), tmp_path / "data", **options) as service:
        # An album that a killed process solved is taken over when its lease ends.
        send(service.client)
        assert stored.keys() == {hashlib.sha256(picture).hexdigest() for picture in pictures}
        albums.wait_until_solved(service.client, album_id)
        assert {row["pin"]["state"] for row in check(service.client)} == {"corrected"}
        assert not service.client.get(f"/albums/{album_id}").json()["reason"]
    store = Store(database_of(settings, tmp_path))
    used = store.quota.account("default").used.albums
    store.quota.recount()
    assert store.quota.account("default").used.albums == used > 0
    store.close()
