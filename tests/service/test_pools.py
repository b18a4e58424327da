"""Pools of worker processes: a dead or stalled worker costs its callers at most a prompt `JobLostError`."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import random
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import pytest

from service.pools.job_queue import JobLostError
from service.pools.pool import WorkerPool
from service.pools.supervisor import WorkerSpec
from tests.service import worker_jobs
from tests.service.conftest import wait_for

Pool = WorkerPool[tuple[str, Any], Any]


@contextmanager
def _pool(
    log: Path, *, workers: int = 1, queue_limit: int = 4, keep_spare: bool = False, target: Any = None, **spec: Any
) -> Iterator[Pool]:
    log.touch()
    arguments = spec.pop("arguments", (str(log),))
    pool: Pool = WorkerPool(
        WorkerSpec("test", target or worker_jobs.run, arguments, **{"stall_s": 5.0, "start_s": 1.0} | spec),
        workers=workers,
        queue_limit=queue_limit,
        keep_spare=keep_spare,
    )
    pool.start()
    try:
        yield pool
    finally:
        pool.close()
    assert _pids() == []


@contextmanager
def _warm_pool(log: Path, *, workers: int = 1, **options: Any) -> Iterator[Pool]:
    with _pool(log, workers=workers, **options) as pool:
        wait_for(lambda: pool.state.ready == workers)
        yield pool


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "log"


def _pids() -> list[int]:
    return [child.pid for child in multiprocessing.active_children() if child.pid and "-test-" in child.name]


def _count(log: Path, line: str) -> int:
    return log.read_text(encoding="utf-8").split().count(line)


def _kill(pids: list[int]) -> None:
    for pid in pids:
        # The worker can just have been replaced.
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _run(pool: Pool, job: tuple[str, Any], timeout_s: float) -> Any:
    return asyncio.run(pool.run_job(job, timeout_s))


def _reason(future: Future[Any]) -> str:
    with pytest.raises(JobLostError) as lost:
        future.result(20.0)
    return lost.value.reason


def test_each_caller_gets_its_own_result(log: Path) -> None:
    with _warm_pool(log, workers=2, queue_limit=100) as pool, ThreadPoolExecutor(8) as threads:
        answers = [threads.submit(_run, pool, ("echo", index), 20.0) for index in range(50)]
        broken = [threads.submit(_run, pool, ("raise", "on purpose"), 20.0) for _ in range(5)]
        assert [answer.result() for answer in answers] == list(range(50))
        assert {_reason(future) for future in broken} == {"fault"}
        assert _count(log, "start") == 2


def test_job_of_killed_worker_is_retried(log: Path) -> None:
    with _warm_pool(log) as pool:
        answer = pool.submit(("sleep", 0.5), 20.0)
        wait_for(lambda: _count(log, "sleep") == 1)
        killed = _pids()
        _kill(killed)
        assert answer.result(20.0) not in killed
        assert _count(log, "sleep") == 2


def test_job_is_not_retried_past_its_deadline(log: Path) -> None:
    with _warm_pool(log) as pool:
        pool._supervisors[0]._start_s = 60.0
        begin = monotonic()
        answer = pool.submit(("sleep", 30.0), 10.0)
        wait_for(lambda: _count(log, "sleep") == 1)
        _kill(_pids())
        assert _reason(answer) == "died"
        with pytest.raises(JobLostError, match="not-ready"):
            pool.submit(("echo", 1), 10.0)
        assert monotonic() - begin < 5.0


def test_job_that_kills_two_workers_is_poisoned(log: Path) -> None:
    with _warm_pool(log, workers=2) as pool:
        assert _reason(pool.submit(("die", 1), 30.0)) == "poisoned"
        with pytest.raises(JobLostError, match="poisoned"):
            pool.submit(("die", 1), 30.0)
        assert _count(log, "die") == 2
        # Other jobs are not affected.
        assert _run(pool, ("echo", 2), 30.0) == 2


def test_stalled_job_fails_and_can_be_resubmitted(log: Path) -> None:
    with _warm_pool(log, workers=2, stall_s=0.5) as pool:
        for tries in (1, 2):
            assert _reason(pool.submit(("sleep", 5.0), 30.0)) == "stalled"
            assert _count(log, "sleep") == tries
            wait_for(lambda: pool.state.ready == 2)


def test_job_cancelled_during_submission_is_not_started(log: Path) -> None:
    async def leave_at_once(pool: Pool) -> None:
        # Large enough that copying and hashing it takes a while.
        waiting = asyncio.create_task(pool.run_job(("echo", bytes(200_000_000)), 20.0))
        await asyncio.sleep(0.05)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting

    with _warm_pool(log) as pool:
        busy = pool.submit(("sleep", 2.0), 20.0)
        wait_for(lambda: _count(log, "sleep") == 1)
        asyncio.run(leave_at_once(pool))
        busy.result(20.0)
        assert _run(pool, ("bytes", 1), 20.0) == b"\0"
        assert _count(log, "echo") == 0


def test_random_kills_lose_and_mix_up_no_result(log: Path) -> None:
    """Results are larger than a pipe's buffer, so that workers also die in the middle of a message."""
    rng = random.Random(5)
    stop = threading.Event()

    def kill_now_and_then(pool: Pool) -> None:
        while not stop.wait(rng.uniform(0.0, 0.8)):
            # Sometimes all at once, including workers that are starting.
            _kill(rng.sample(pids, rng.randint(1, len(pids))) if (pids := _pids()) else [])

    def ask(pool: Pool, size: int) -> str:
        try:
            return "right" if len(_run(pool, ("bytes", size), 5.0)) == size else "wrong"
        except JobLostError as lost:
            return lost.reason

    with _warm_pool(log, workers=2, queue_limit=16) as pool:
        killer = threading.Thread(target=kill_now_and_then, args=(pool,))
        killer.start()
        end, outcomes = monotonic() + 4.0, set[str]()
        with ThreadPoolExecutor(4) as threads:
            while monotonic() < end:
                sizes = [rng.randint(1, 20_000_000) for _ in range(4)]
                outcomes |= set(threads.map(lambda size: ask(pool, size), sizes))
        stop.set()
        killer.join()
        # On a busy machine it is possible that no worker lives long enough for a right result.
        assert outcomes <= {"right", "poisoned", "died", "deadline", "not-ready"}
        assert _count(log, "start") > 4
        wait_for(lambda: pool.state.ready == 2)
        assert ask(pool, 20_000_000) == "right"


def test_stalled_worker_is_replaced_mid_message(log: Path) -> None:
    with _warm_pool(log, stall_s=1.0) as pool:
        (stalled,) = _pids()
        os.kill(stalled, signal.SIGSTOP)
        # Larger than the pipe's buffer, so that the supervisor cannot finish sending it.
        begin = monotonic()
        assert _run(pool, ("echo", b"x" * 10_000_000), 20.0) == b"x" * 10_000_000
        assert monotonic() - begin > 1.0
        assert stalled not in _pids()


def test_cancelled_jobs_are_not_started(log: Path) -> None:
    with _warm_pool(log) as pool:
        busy = pool.submit(("sleep", 1.0), 20.0)
        wait_for(lambda: _count(log, "sleep") == 1)
        cancelled, late = pool.submit(("echo", 1), 20.0), pool.submit(("raise", 1), 0.2)
        assert cancelled.cancel()
        busy.result(20.0)
        assert _reason(late) == "deadline"
        assert _run(pool, ("bytes", 1), 20.0) == b"\0"
        assert _count(log, "echo") == _count(log, "raise") == 0


def test_cancelling_the_await_cancels_the_job(log: Path) -> None:
    async def give_up(pool: Pool) -> None:
        waiting = asyncio.create_task(pool.run_job(("echo", 1), 20.0))
        await asyncio.sleep(0.1)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting

    with _warm_pool(log) as pool:
        busy = pool.submit(("sleep", 1.0), 20.0)
        wait_for(lambda: _count(log, "sleep") == 1)
        asyncio.run(give_up(pool))
        busy.result(20.0)
        assert _run(pool, ("bytes", 1), 20.0) == b"\0"
        assert _count(log, "echo") == 0


def test_deadline_is_kept_and_worker_continues(log: Path) -> None:
    with _warm_pool(log) as pool:
        begin = monotonic()
        with pytest.raises(JobLostError, match="deadline"):
            _run(pool, ("sleep", 1.0), 0.2)
        assert monotonic() - begin < 0.7
        assert _run(pool, ("echo", 1), 20.0) == 1
        assert _count(log, "start") == 1


def test_full_queue_refuses_and_frees_cancelled_places(log: Path) -> None:
    with _warm_pool(log, queue_limit=3) as pool:
        pool.submit(("sleep", 1.5), 20.0)
        wait_for(lambda: _count(log, "sleep") == 1)
        first, second = pool.submit(("echo", 1), 20.0), pool.submit(("echo", 2), 20.0)
        begin = monotonic()
        with pytest.raises(JobLostError, match="queue-full"):
            pool.submit(("echo", 3), 20.0)
        assert monotonic() - begin < 0.5
        first.cancel()
        assert pool.submit(("echo", 4), 20.0).result(20.0) == 4
        assert second.result(20.0) == 2


def test_clients_take_turns(log: Path) -> None:
    done: list[str] = []
    with _warm_pool(log, queue_limit=20) as pool:
        busy = pool.submit(("sleep", 1.0), 20.0, "many")
        wait_for(lambda: _count(log, "sleep") == 1)
        for client in ("many", "many", "many", "many", "few", "few", "one"):
            job = pool.submit(("echo", client), 20.0, client)
            job.add_done_callback(lambda future: done.append(future.result()))
        busy.result(20.0)
        wait_for(lambda: len(done) == 7)
    assert done == ["many", "few", "one", "many", "few", "many", "many"]


def test_one_client_cannot_fill_the_queue(log: Path) -> None:
    with _warm_pool(log, queue_limit=4) as pool:
        busy = pool.submit(("sleep", 1.0), 20.0, "many")
        wait_for(lambda: _count(log, "sleep") == 1)
        for _ in range(3):
            pool.submit(("echo", 1), 20.0, "many")
        with pytest.raises(JobLostError, match="queue-full"):
            pool.submit(("echo", 1), 20.0, "many")
        assert pool.submit(("echo", 2), 20.0, "other").result(20.0) == 2
        busy.result(20.0)


def test_spare_worker_is_kept_during_a_restart(log: Path) -> None:
    slow = {"target": worker_jobs.run_slow_start, "arguments": (str(log), 1.0)}
    with _warm_pool(log, workers=2, queue_limit=20, stall_s=1.5, keep_spare=True, **slow) as pool:
        lost = [pool.submit(("sleep", 20.0), 60.0, "worst") for _ in range(4)]
        for stalled in range(2):
            wait_for(lambda stalled=stalled: _count(log, "sleep") == stalled + 1)
            # During the job, and then while its worker is replaced.
            assert pool.submit(("echo", 1), 20.0, "other").result(20.0) == 1
            assert not lost[stalled].done()
            assert _reason(lost[stalled]) == "stalled"
            assert pool.submit(("echo", 2), 20.0, "other").result(20.0) == 2
            assert _count(log, "sleep") == stalled + 1
        for future in lost:
            future.cancel()


def test_close_finishes_running_jobs_only(log: Path) -> None:
    with _warm_pool(log) as pool:
        at_work = pool.submit(("sleep", 0.5), 20.0)
        wait_for(lambda: _count(log, "sleep") == 1)
        waiting = pool.submit(("echo", 1), 20.0)
        pool.close(drain_s=10.0)
        assert isinstance(at_work.result(0.0), int)
        assert _reason(waiting) == "closing"
        with pytest.raises(JobLostError, match="closing"):
            pool.submit(("echo", 1), 20.0)
        with pytest.raises(JobLostError, match="closing"):
            _run(pool, ("echo", 1), 20.0)


def test_close_waits_no_longer_than_drain_s(log: Path) -> None:
    with _warm_pool(log) as pool:
        at_work = pool.submit(("sleep", 30.0), 60.0)
        wait_for(lambda: _count(log, "sleep") == 1)
        begin = monotonic()
        pool.close(drain_s=0.2)
        assert monotonic() - begin < 2.0
        assert _reason(at_work) == "closing"


def test_failing_starts_back_off(log: Path) -> None:
    with _pool(log, target=worker_jobs.run_broken) as pool:
        wait_for(lambda: _count(log, "start") == 3)
        begin = monotonic()
        wait_for(lambda: _count(log, "start") == 5)
        # Pauses of 0.5 and 1 s.
        assert monotonic() - begin > 1.4
        assert pool.state.fault == "the worker died starting"
        assert not pool.state.warmed_up


def test_worker_that_never_gets_ready_is_killed(log: Path) -> None:
    slow = {"target": worker_jobs.run_slow_start, "arguments": (str(log), 60.0)}
    with _pool(log, max_start_s=1.0, **slow) as pool:
        wait_for(lambda: pool.state.fault is not None)
        assert pool.state.fault == "the worker did not start within 1 s"


def test_kill_during_start_only_delays_a_job(log: Path) -> None:
    with _pool(log, start_s=2.0) as pool:
        answer = pool.submit(("echo", 1), 30.0)
        wait_for(lambda: pool.state.warmed_up)
        assert answer.result(30.0) == 1
        _kill(_pids())
        answer = pool.submit(("echo", 2), 30.0)
        for _ in range(2):
            # Polled often, because an idle machine starts a worker within a tenth of a second.
            while not (len(_pids()) == 1 and not pool.state.ready):
                sleep(0.002)
            _kill(_pids())
        assert answer.result(30.0) == 2
