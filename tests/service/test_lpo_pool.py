"""The LPO pool: right results, and a prompt None if workers fail; `test_pools` covers the pool itself."""

from __future__ import annotations

import asyncio
import multiprocessing
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from lalaloc_core.bundle import LAYOUT_WEIGHTS, Bundle
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from service.capacity.cpu_accounts import CpuAccounts
from service.capacity.fair_share import FairSemaphore
from service.pools import supervisor
from service.query.lpo_pool import LpoPool
from service.settings import CONSTANTS, Settings
from service.telemetry import Telemetry
from service.workers.lpo import warm_up_job
from tests.service.conftest import constants, wait_for

# Time limit of jobs that must not end by it, also on a busy machine.
_LONG_S = 120.0


@contextmanager
def _pool(bundle: Bundle, *, by_latents: bool = True, **overrides: Any) -> Iterator[LpoPool]:
    with constants({name: overrides.pop(name) for name in CONSTANTS if name in overrides}):
        pool = LpoPool(bundle, Settings(**overrides), Telemetry(), FairSemaphore(100, CpuAccounts()), by_latents)
        pool.start()
        try:
            yield pool
        finally:
            pool.close()


@pytest.fixture(scope="module")
def pool(bundle: Bundle) -> Iterator[LpoPool]:
    with _pool(bundle, workers=1, lpo_stall_s=600.0) as started:
        wait_for(lambda: started.state.ready == 1, 120.0)
        yield started


@pytest.fixture
def job(bundle: Bundle) -> RefinementJob:
    return warm_up_job(bundle.manifest, optimise_heading=True, by_profile=False)


def _refine(pool: LpoPool, job: RefinementJob, timeout_s: float) -> RefinementResult | None:
    """Refine on an event loop of its own."""
    return asyncio.run(pool.refine(job, timeout_s))


def _missed(pool: LpoPool, reason: str) -> float:
    """Return the number of jobs that were lost for a reason."""
    return pool._telemetry.lpo_missed.labels(reason)._value.get()


def _workers() -> list[int]:
    return [child.pid for child in multiprocessing.active_children() if child.pid and "lpo" in child.name]


@pytest.mark.slow
@pytest.mark.parametrize("by_profile", [False, True])
def test_worker_result_equals_the_refiner(pool: LpoPool, bundle: Bundle, by_profile: bool) -> None:
    from lalaloc_core.localise.refine.latent_refiner import PoseRefiner

    job = warm_up_job(bundle.manifest, optimise_heading=True, by_profile=by_profile)
    expected = PoseRefiner.from_bundle(bundle).refine(job)
    result = _refine(pool, job, _LONG_S)
    assert result is not None
    np.testing.assert_allclose(result.position_m, expected.position_m, atol=1e-4)
    assert (result.latent_distance is None) == (expected.latent_distance is None) == by_profile
    if result.latent_distance is not None and expected.latent_distance is not None:
        np.testing.assert_allclose(result.latent_distance, expected.latent_distance, atol=1e-4)
    np.testing.assert_allclose(result.cost, expected.cost, atol=1e-4)
    np.testing.assert_allclose(result.information, expected.information, rtol=1e-2, atol=1e-2)


@pytest.mark.slow
def test_torch_is_loaded_with_the_first_job_by_latents(
    bundle: Bundle, job: RefinementJob, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The process that tests fork workers from has loaded torch.
    monkeypatch.setattr(supervisor, "_START_METHOD", "spawn")

    def loaded() -> bool:
        (worker,) = set(_workers()) - others
        return any("libtorch" in entry.path for entry in psutil.Process(worker).memory_maps())

    others = set(_workers())
    with _pool(bundle, by_latents=False, workers=1) as pool:
        wait_for(lambda: pool.state.ready == 1, 120.0)
        assert not loaded()
        assert _refine(pool, job, _LONG_S) is not None
        assert loaded()


def test_failing_job_and_one_without_time_leave_the_worker_alive(pool: LpoPool, job: RefinementJob) -> None:
    workers = set(_workers())
    assert _refine(pool, replace(job, targets=np.ones((2, 3), np.float32)), _LONG_S) is None
    assert _refine(pool, job, _LONG_S) is not None
    assert set(_workers()) == workers
    assert _refine(pool, job, 0.0) is None
    assert _refine(pool, job, -1.0) is None


def test_cold_pool_returns_none_and_closes(bundle: Bundle, job: RefinementJob) -> None:
    others = set(_workers())
    with _pool(bundle, workers=1) as cold:
        # Less than a start usually takes.
        assert _refine(cold, job, 2.0) is None
        assert _missed(cold, "not-ready") == 1
        assert not cold.state.warmed_up
        wait_for(lambda: bool(set(_workers()) - others))
    assert not set(_workers()) - others


def test_pool_without_workers_returns_none(bundle: Bundle, job: RefinementJob) -> None:
    with _pool(bundle, workers=0) as none:
        assert _refine(none, job, _LONG_S) is None
        assert none.state.warmed_up


@pytest.mark.slow
def test_changed_bundle_is_not_used(tiny_bundle: Path, tmp_path: Path, job: RefinementJob) -> None:
    copy = tmp_path / "bundle"
    shutil.copytree(tiny_bundle, copy)
    bundle = Bundle.open(copy)
    (copy / LAYOUT_WEIGHTS).write_bytes(b"not the weights of before")
    with _pool(bundle, workers=1) as broken:
        wait_for(lambda: broken.state.fault is not None, 120.0)
        assert "SHA-256" in str(broken.state.fault)
        assert not broken.state.warmed_up
        assert _refine(broken, job, 5.0) is None
