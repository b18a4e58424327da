"""Steps of searches: refinement by walls without a worker, and the same fallback as with one."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from lalaloc_core.bundle import Bundle
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from service.capacity.cpu_accounts import CpuAccounts
from service.capacity.fair_share import FairSemaphore
from service.query import executor
from service.query.executor import StepRunner, finish_with
from service.query.lpo_pool import LpoPool
from service.settings import Settings
from service.telemetry import Telemetry
from service.workers.lpo import warm_up_job

Steps = Generator[RefinementJob | None, RefinementResult | None, RefinementResult | None]


def _search(job: RefinementJob) -> Steps:
    """Return a search whose result is that of its one job."""
    return (yield job)


@pytest.fixture
def job(bundle: Bundle) -> RefinementJob:
    return warm_up_job(bundle.manifest, optimise_heading=True, by_profile=True)


@pytest.fixture
def telemetry() -> Telemetry:
    return Telemetry()


@pytest.fixture
def runner_of(bundle: Bundle, telemetry: Telemetry) -> Callable[[int], StepRunner]:
    """Build a runner beside a number of workers that never start: a job for them would stay without a result."""

    def build(workers: int) -> StepRunner:
        pool = LpoPool(bundle, Settings(workers=workers), telemetry, FairSemaphore(4, CpuAccounts()))
        return StepRunner(pool, telemetry)

    return build


def _missed(telemetry: Telemetry, reason: str) -> float:
    return telemetry.lpo_missed.labels(reason)._value.get()


def test_walls_are_refined_without_a_worker(runner_of: Callable[[int], StepRunner], job: RefinementJob) -> None:
    result = runner_of(1).next(_search(job), None, lambda: 1e3)
    assert isinstance(result, RefinementResult)
    assert not np.array_equal(result.position_m, job.position_m)


@pytest.mark.parametrize(("workers", "changes"), [(1, {"log_profile": None}), (1, {"latent_weight": 0.5}), (0, {})])
def test_latents_are_left_to_a_worker_and_lpo_is_off_without_workers(
    runner_of: Callable[[int], StepRunner], job: RefinementJob, workers: int, changes: dict[str, float | None]
) -> None:
    job = replace(job, **changes)  # pyright: ignore[reportArgumentType]
    assert runner_of(workers).next(_search(job), None, lambda: 1e3) is job


def test_late_refinement_stops_without_a_result(
    runner_of: Callable[[int], StepRunner], job: RefinementJob, telemetry: Telemetry, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert runner_of(1).next(_search(job), None, lambda: 0.0) is None
    assert _missed(telemetry, "deadline") == 0
    assert runner_of(1).next(_search(job), None, lambda: 1e-9) is None
    assert _missed(telemetry, "deadline") == 1
    # A clock that passes a second whenever it is read.
    seconds = iter(range(1000))
    monkeypatch.setattr(executor, "monotonic", lambda: float(next(seconds)))
    assert runner_of(1).next(_search(job), None, lambda: 1.5) is None
    assert _missed(telemetry, "deadline") == 2


def test_failed_refinement_has_no_result(
    runner_of: Callable[[int], StepRunner],
    job: RefinementJob,
    telemetry: Telemetry,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(executor, "refine_walls", Mock(side_effect=np.linalg.LinAlgError("singular matrix")))
    assert runner_of(1).next(_search(job), None, lambda: 1e3) is None
    assert _missed(telemetry, "fault") == 1
    assert "pose refinement failed" in caplog.text


def test_what_follows_a_search_gets_its_result(runner_of: Callable[[int], StepRunner], job: RefinementJob) -> None:
    def complete(found: RefinementResult | None) -> str:
        return "refined" if found is not None else "not refined"

    assert runner_of(1).next(finish_with(_search(job), complete), None, lambda: 1e3) == "refined"
