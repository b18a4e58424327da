"""The service on Ray: same answers as one process, and each plan in the memory of one replica.

`.venv/bin/pytest -m slow tests/service/test_on_ray.py` starts a cluster of its own, and `TEST_DATABASE=ray
.venv/bin/pytest tests/service` runs the other tests on one as well.
"""

from __future__ import annotations

import asyncio
import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from lalaloc_core.errors import ConfigError
from service.errors import PROBLEMS, DeadlineExceededError, InvalidRequestError, PlanNotReadyError, problem_kind
from service.query import QueryContext
from service.settings import Settings
from tests.service.conftest import FLAT, StartApp, assert_problem, localise, localise_turn, serving, upload, wait_for

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install -c constraints.txt -e '.[ray]'")

from ray import serve  # noqa: E402

from service.on_ray import app  # noqa: E402
from service.on_ray.remote import Failure, Success, returning_failures  # noqa: E402
from tests.service.ray_cluster import NAME  # noqa: E402
from tests.service.test_venue_queries import ask, venue_of  # noqa: E402

# Two plans of a venue are too many to search in full, so that their index chooses.
FEW_POSES: dict[str, Any] = {"max_grid_poses": 300}


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def on_ray(ray_address: str, tiny_bundle: Path, data_dir: Path) -> Iterator[httpx.Client]:
    """Yield the service on Ray with two search replicas."""
    # Deadlines as they would be on a machine that has nothing else to do are not what is tested.
    patient: dict[str, Any] = {"request_deadline_s": 50.0, "lpo_deadline_s": 30.0}
    processes: dict[str, Any] = {"decode_workers": 1, "import_workers": 1}
    settings = Settings(data_dir=data_dir, bundle=tiny_bundle, log_level="error", **patient, **processes, **FEW_POSES)
    with serving(settings), httpx.Client(base_url=ray_address, timeout=60.0) as client:
        yield client


@pytest.fixture(scope="module")
def plan_id(on_ray: httpx.Client) -> str:
    return upload(on_ray, FLAT)


def kill_replica(deployment: str) -> None:
    actors = ray.util.list_named_actors(all_namespaces=True)
    [replica] = [actor for actor in actors if actor["name"].startswith(f"SERVE_REPLICA::{NAME}#{deployment}#")]
    ray.kill(ray.get_actor(**replica), no_restart=True)


def wider(plan: dict[str, Any], factor: float) -> dict[str, Any]:
    """Return a plan stretched along x."""
    return plan | {
        "rooms": [room | {"polygon": [[factor * x, y] for x, y in room["polygon"]]} for room in plan["rooms"]]
    }


@pytest.mark.slow
def test_ray_answers_like_one_process(
    on_ray: httpx.Client, plan_id: str, start_app: StartApp, data_dir: Path, sphere: bytes
) -> None:
    assert on_ray.get("/readyz").status_code == 200
    answer = localise(on_ray, plan_id, sphere, refine="vdr", heading_deg=30).json()
    with start_app(data_dir) as alone:
        expected = localise(alone, plan_id, sphere, refine="vdr", heading_deg=30).json()
    for name in ("position", "heading_deg", "room", "cost", "stage", "model", "floorplan_revision"):
        assert answer[name] == pytest.approx(expected[name]), name
    optimised = localise(on_ray, plan_id, sphere, heading_deg=30).json()
    assert optimised["stage"] == "lpo"
    assert optimised["cost"] <= answer["cost"]


@pytest.mark.slow
def test_ray_answers_sequences_venues_and_pictures(on_ray: httpx.Client, plan_id: str, sphere: bytes) -> None:
    sequence = localise_turn(on_ray, plan_id, sphere, sphere)
    assert sequence.status_code == 200, sequence.text
    venue = on_ray.post("/venues", json={"plans": [{"floorplan_id": plan_id, "level": 1}]}).json()["id"]
    found = ask(on_ray, venue, sphere)
    assert found.json()["floorplan_id"] == plan_id, found.text
    accepted = {"Accept": "image/png"}
    files = {"photo": ("p.jpg", sphere, "image/jpeg")}
    drawn = on_ray.post("/localise", data={"floorplan_id": plan_id}, files=files, headers=accepted)
    assert drawn.content.startswith(b"\x89PNG"), drawn.text


@pytest.mark.slow
def test_replica_errors_reach_the_client(on_ray: httpx.Client, plan_id: str, sphere: bytes) -> None:
    assert_problem(localise(on_ray, plan_id, b"no picture"), 422, "invalid-photograph")
    assert_problem(localise(on_ray, plan_id, sphere, rooms=json.dumps(["nowhere"])), 422, "invalid-hint")
    assert_problem(localise(on_ray, "0" * 32, sphere), 404, "unknown-floorplan")
    assert_problem(localise(on_ray, plan_id, sphere, camera_height_m=2.6), 422, "invalid-pose")


@pytest.mark.slow
def test_each_plan_stays_in_one_replica(on_ray: httpx.Client, sphere: bytes) -> None:
    plans = [upload(on_ray, FLAT | {"name": f"flat {number}"}) for number in range(8)]
    revisions = {localise(on_ray, plan, sphere, refine="none").json()["floorplan_revision"] for plan in plans * 2}
    search = serve.get_deployment_handle("search", NAME)
    # Enough requests to reach both replicas.
    kept = {search.options(session_id=str(number)).revisions.remote().result(timeout_s=30) for number in range(16)}
    shares = [replica_revisions & revisions for replica_revisions in kept]
    assert len(shares) == 2
    assert all(shares)
    assert sum(len(share) for share in shares) == len(revisions) == len(plans)


@pytest.mark.slow
def test_dead_lpo_replica_is_replaced(on_ray: httpx.Client, plan_id: str, sphere: bytes) -> None:
    kill_replica("lpo")

    def ask() -> httpx.Response:
        # Single photographs are refined by the search replicas.
        return localise_turn(on_ray, plan_id, sphere, sphere)

    assert ask().status_code == 200
    wait_for(lambda: ask().json()["stage"] == "lpo", timeout_s=120.0)


@pytest.mark.slow
def test_index_in_shards_chooses_the_same_plans(
    on_ray: httpx.Client, start_app: StartApp, data_dir: Path, sphere: bytes
) -> None:
    plans = [upload(on_ray, wider(FLAT, 1.0 + 0.04 * number)) for number in range(7)]
    venue = venue_of(on_ray, *plans)

    def answers(client: httpx.Client) -> list[dict[str, Any]]:
        stated: list[dict[str, Any]] = [{}, {"heading_deg": 30}]
        found = [ask(client, venue, sphere, refine="none", top_k=10, **fields) for fields in stated]
        return [{name: one.json()[name] for name in ("position", "plans")} for one in found]

    found = answers(on_ray)
    with start_app(data_dir, **FEW_POSES) as alone:
        expected = answers(alone)
    # Not all plans were searched.
    assert len(found[0]["plans"]) < len(plans)
    assert [answer["plans"] for answer in found] == [answer["plans"] for answer in expected]
    assert [answer["position"] for answer in found] == [pytest.approx(answer["position"]) for answer in expected]
    # A shard that dies is indexed anew, and a change reaches the shards.
    kill_replica("index-0")
    assert answers(on_ray) == found
    best = found[0]["plans"][0]["floorplan_id"]
    on_ray.patch(f"/venues/{venue}", json={"remove": [best]}).raise_for_status()
    assert best not in {plan["floorplan_id"] for answer in answers(on_ray) for plan in answer["plans"]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"index_shards": "-1"}, "index_shards is '-1': .*greater than or equal to 0"),
        ({"search_max": "0"}, "search_max is '0': .*greater than or equal to 1"),
        ({"searchers": "2"}, "searchers is '2': .*known: ingress_min, ingress_max"),
        ({"lpo_min": "3", "lpo_max": "2"}, "lpo_max is 2, less than lpo_min, which is 3"),
    ],
)
def test_invalid_replica_numbers_are_refused(
    arguments: dict[str, str], message: str, tiny_bundle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LALALOC_BUNDLE", str(tiny_bundle))
    assert isinstance(app({"search_max": "2"}), serve.Application)
    with pytest.raises(ConfigError, match=message):
        app(arguments)


@pytest.mark.parametrize(
    "error",
    [
        PlanNotReadyError("p", 1.5, 0.25),
        DeadlineExceededError(10.0),
        InvalidRequestError([("top_k", "is 0, at least 1 is needed")]),
    ],
)
def test_errors_keep_their_attributes(error: Any) -> None:
    arrived = pickle.loads(pickle.dumps(Failure(error))).error
    assert type(arrived) is type(error)
    assert str(arrived) == str(error)
    assert vars(arrived) == vars(error)
    assert problem_kind(arrived) is problem_kind(error)
    assert type(error) in PROBLEMS


def test_context_keeps_the_spent_time() -> None:
    sent = QueryContext.starting("tenant", 10.0, spent_s=4.0)
    arrived = pickle.loads(pickle.dumps(sent))
    assert arrived.client == "tenant"
    assert arrived.spent_s == pytest.approx(sent.spent_s, abs=1.0)
    assert arrived.deadline - arrived.begin == pytest.approx(10.0)
    assert arrived.clock is not sent.clock


def test_replica_returns_errors_and_raises_bugs() -> None:
    class Replica:
        @returning_failures
        async def half(self, number: int) -> int:
            if number < 0:
                raise DeadlineExceededError(10.0)
            if number % 2:
                raise AssertionError(number)
            return number // 2

    assert asyncio.run(Replica().half(4)) == Success(2)
    refused = asyncio.run(Replica().half(-1))
    assert isinstance(refused, Failure)
    assert str(refused.error) == str(DeadlineExceededError(10.0))
    with pytest.raises(AssertionError):
        asyncio.run(Replica().half(3))
