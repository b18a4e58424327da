"""Latent grids: the same as the core's, computed once, kept within bounds, replaced with the model."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import httpx
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from lalaloc_core.bundle import Bundle, write_manifest
from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.retrieval import build_grid
from service.errors import UnknownFloorPlanError
from service.grids import Grids, query_height_m
from service.settings import Settings
from service.store import PlanRecord, Store
from service.telemetry import Telemetry
from tests.service.conftest import FLAT, StartApp, localise, upload, wait_for


@pytest.fixture(scope="module")
def encoders(tiny_bundle: Path) -> Encoders:
    return Encoders(Bundle.open(tiny_bundle), threads=1)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store(f"sqlite:///{tmp_path / 'test.sqlite3'}")
    opened.add_plan("p", FloorPlan.from_dict(FLAT), original=b"{}", limit=10)
    yield opened
    opened.close()


def _grids(store: Store, encoders: Encoders, cache_bytes: int = 2**20) -> Grids:
    return Grids(store, encoders, "m1", Settings(grid_cache_bytes=cache_bytes), Telemetry())


def test_chunks_make_the_same_grid_as_the_core_does_at_once(store: Store, encoders: Encoders) -> None:
    grids = _grids(store, encoders)
    computed = grids.compute(grids.key("p", 1.5)).result(30.0)
    grids.close()
    expected = build_grid(FloorPlan.from_dict(FLAT), encoders, step_m=0.5, camera_height_m=1.5)
    np.testing.assert_array_equal(computed.poses.position_m, expected.poses.position_m)
    np.testing.assert_allclose(computed.latents, expected.latents, atol=1e-5)
    np.testing.assert_array_equal(computed.profile_m, expected.profile_m)
    assert computed.profile_m.dtype == np.float32


def test_asking_twice_computes_once(store: Store, encoders: Encoders) -> None:
    grids = _grids(store, encoders)
    key = grids.key("p", 1.5)
    futures = [grids.compute(key) for _ in range(5)]
    results = [future.result(30.0) for future in futures]
    assert all(result is results[0] for result in results)
    assert grids.find(key) is results[0]
    grids.close()


@pytest.mark.parametrize("cache_bytes", [0, 100_000])
def test_the_cache_never_holds_more_than_its_limit(store: Store, encoders: Encoders, cache_bytes: int) -> None:
    grids = _grids(store, encoders, cache_bytes)
    for height_m in (1.5, 1.6, 1.7):
        grids.compute(grids.key("p", height_m)).result(30.0)
        assert grids._cache.bytes <= cache_bytes
        kept = grids._cache._grids.values()
        arrays = [a for g in kept for a in (g.latents, g.profile_m, g.poses.position_m, g.poses.room_index)]
        assert grids._cache.bytes == sum(array.nbytes for array in arrays)
    # What fell out of memory is still in the store.
    assert all(grids.find(grids.key("p", height_m)) is not None for height_m in (1.5, 1.6, 1.7))
    grids.close()


def test_the_grid_of_an_unknown_plan_is_an_error(store: Store, encoders: Encoders) -> None:
    grids = _grids(store, encoders)
    with pytest.raises(UnknownFloorPlanError):
        grids.compute(grids.key("q", 1.5)).result(30.0)
    assert grids.pending == 0
    grids.close()


@given(st.floats(0.001, 3.0))
@example(2.399)
@example(0.001)
def test_a_rounded_height_is_near_and_always_below_the_ceiling(asked_m: float) -> None:
    record = PlanRecord(id="p", created_at=datetime.now(UTC), plan=FloorPlan.from_dict(FLAT), failure=None)
    if asked_m >= 2.4:
        with pytest.raises(InvalidPoseError, match=r"2\.4"):
            query_height_m(record, asked_m)
        return
    height_m = query_height_m(record, asked_m)
    assert 0.0 < height_m < 2.4
    assert abs(height_m - asked_m) <= 0.0201
    assert query_height_m(record, height_m) == pytest.approx(height_m)


def test_a_new_model_recomputes_the_grids(
    start_app: StartApp, tiny_bundle: Path, tmp_path: Path, panorama: bytes
) -> None:
    with start_app(tmp_path / "data") as client:
        plan_id = upload(client)
        old = localise(client, plan_id, panorama, refine="none").json()["model"]["sha256"]
    other = tmp_path / "other"
    shutil.copytree(tiny_bundle, other)
    (other / "note.txt").write_text("another model")
    bundle = write_manifest(other, Bundle.open(tiny_bundle).manifest)
    assert bundle.sha256 != old
    with start_app(tmp_path / "data", bundle=other) as client:
        wait_for(lambda: client.get(f"/floorplans/{plan_id}").json()["status"] == "ready")
        assert "lalaloc_grid_seconds_count 1.0" in client.get("/metrics").text
        assert localise(client, plan_id, panorama, refine="none").json()["model"]["sha256"] == bundle.sha256


def test_grids_of_other_camera_heights_are_bounded(start_app: StartApp, tmp_path: Path, panorama: bytes) -> None:
    with start_app(tmp_path, max_grids_per_plan=3) as client:
        plan_id = upload(client)
        for height_m in (1.6, 1.7, 1.8, 1.9):
            _localise_at(client, plan_id, panorama, height_m)
    store = Store(f"sqlite:///{tmp_path / 'lalaloc.sqlite3'}")
    with start_app(tmp_path) as client:
        sha256 = client.get("/readyz").json()["model"]["sha256"]
    assert {height for _, height in store.grid_poses(sha256, 0.5)} == {1500, 1800, 1900}
    store.close()


def _localise_at(client: httpx.Client, plan_id: str, panorama: bytes, height_m: float) -> None:
    answer = localise(client, plan_id, panorama, refine="none", camera_height_m=height_m)
    assert answer.json()["camera_height_m"] == height_m
