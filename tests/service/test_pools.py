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

import numpy as np
import pytest

from service.pools import supervisor
from service.pools.job_queue import JobLostError, JobQueue
from service.pools.pool import WorkerPool
from service.pools.supervisor import WorkerSpec
from tests.service import worker_jobs
from tests.service.conftest import end_time_limits, wait_for

Pool = WorkerPool[tuple[str, Any], Any]
# Time limit of jobs that must not end by theirs, also on a busy machine.
_LONG_S = 120.0


@contextmanager
def _pool(
    log: Path, *, workers: int = 1, queue_limit: int = 4, keep_spare: bool = False, target: Any = None, **spec: Any
) -> Iterator[Pool]:
    log.touch()
    arguments = spec.pop("arguments", (str(log),))
    settings: dict[str, Any] = {"stall_s": 600.0, "start_s": 1.0, **spec}
    pool: Pool = WorkerPool(
        WorkerSpec("test", target or worker_jobs.run, arguments, **settings),
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


@pytest.fixture
def gate(tmp_path: Path) -> Path:
    """Return the path of a file; "wait" jobs run until it exists."""
    return tmp_path / "gate"


@pytest.fixture
def start_gate(tmp_path: Path) -> Path:
    """Return the path of a file that exists; workers of `run_after_gate` start while it does."""
    path = tmp_path / "start-gate"
    path.touch()
    return path


def _begin_wait(pool: Pool, log: Path, gate: Path, client: str = "") -> Future[Any]:
    """Keep a worker busy until `gate` exists."""
    busy = pool.submit(("wait", str(gate)), _LONG_S, client)
    wait_for(lambda: _count(log, "wait") == 1)
    return busy


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
        future.result(_LONG_S)
    return lost.value.reason


def test_each_caller_gets_its_own_result(log: Path) -> None:
    with _warm_pool(log, workers=2, queue_limit=100) as pool, ThreadPoolExecutor(8) as threads:
        answers = [threads.submit(_run, pool, ("echo", index), _LONG_S) for index in range(50)]
        broken = [threads.submit(_run, pool, ("raise", "on purpose"), _LONG_S) for _ in range(5)]
        assert [answer.result() for answer in answers] == list(range(50))
        assert {_reason(future) for future in broken} == {"fault"}
        assert _count(log, "start") == 2
        picture = np.random.default_rng(0).integers(0, 256, (200, 300, 3), dtype=np.uint8)
        np.testing.assert_array_equal(_run(pool, ("echo", picture), _LONG_S), picture)


def test_job_of_killed_worker_is_retried(log: Path, gate: Path) -> None:
    with _warm_pool(log) as pool:
        answer = _begin_wait(pool, log, gate)
        killed = _pids()
        _kill(killed)
        wait_for(lambda: _count(log, "wait") == 2)
        gate.touch()
        assert answer.result(_LONG_S) not in killed
        assert _count(log, "wait") == 2


def test_job_is_not_retried_past_its_deadline(log: Path, gate: Path, start_gate: Path) -> None:
    with _warm_pool(log, target=worker_jobs.run_after_gate, arguments=(str(log), str(start_gate))) as pool:
        # A start takes longer than jobs may wait; a job that waited for it would be lost by its deadline.
        pool._supervisors[0]._start_s = 10.0 * _LONG_S
        start_gate.unlink()
        answer = _begin_wait(pool, log, gate)
        _kill(_pids())
        assert _reason(answer) == "died"
        with pytest.raises(JobLostError, match="not-ready"):
            pool.submit(("echo", 1), _LONG_S)


def test_job_that_kills_two_workers_is_poisoned(log: Path) -> None:
    with _warm_pool(log, workers=2) as pool:
        assert _reason(pool.submit(("die", 1), _LONG_S)) == "poisoned"
        with pytest.raises(JobLostError, match="poisoned"):
            pool.submit(("die", 1), _LONG_S)
        assert _count(log, "die") == 2
        # Other jobs are not affected.
        assert _run(pool, ("echo", 2), _LONG_S) == 2


def test_stalled_job_fails_and_can_be_resubmitted(log: Path, gate: Path) -> None:
    with _warm_pool(log, workers=2) as pool:
        for tries in (1, 2):
            stalled = pool.submit(("wait", str(gate)), _LONG_S)
            wait_for(lambda tries=tries: _count(log, "wait") == tries)
            end_time_limits()
            assert _reason(stalled) == "stalled"
            wait_for(lambda: pool.state.ready == 2)


def test_limit_of_a_job_is_cpu_time(log: Path, gate: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # However busy the machine is.
    monkeypatch.setattr(supervisor, "_PATIENCE", 1000.0)
    with _warm_pool(log, stall_s=0.5) as pool:
        waiting = pool.submit(("wait", str(gate)), _LONG_S)
        sleep(0.8)
        gate.touch()
        # Waiting for something uses next to no CPU time.
        assert waiting.result(_LONG_S) in _pids()
        assert _reason(pool.submit(("spin", 600.0), _LONG_S)) == "stalled"


def test_job_of_a_stopped_worker_is_tried_once_more(log: Path, gate: Path) -> None:
    with _warm_pool(log, workers=2) as pool:
        stopped = pool.submit(("wait", str(gate)), _LONG_S)
        wait_for(lambda: _count(log, "wait") == 1)
        end_time_limits("stopped")
        wait_for(lambda: _count(log, "wait") == 2)
        gate.touch()
        assert stopped.result(_LONG_S) is not None
        gate.unlink()
        wait_for(lambda: pool.state.ready == 2)
        stopped = pool.submit(("wait", str(gate)), _LONG_S)
        for tries in (3, 4):
            wait_for(lambda tries=tries: _count(log, "wait") == tries)
            end_time_limits("stopped")
        assert _reason(stopped) == "stopped"


@pytest.mark.slow
def test_random_kills_lose_and_mix_up_no_result(log: Path) -> None:
    """Results are larger than a pipe's buffer, so that workers also die in the middle of a message."""
    rng = random.Random(5)
    stop = threading.Event()

    def kill_now_and_then(pool: Pool) -> None:
        while not stop.wait(rng.uniform(0.0, 0.8)):
            # Sometimes all at once, including workers that are starting.
            _kill(rng.sample(pids, rng.randint(1, len(pids))) if (pids := _pids()) else [])

    def ask(pool: Pool, size: int, timeout_s: float = 5.0) -> str:
        try:
            return "right" if len(_run(pool, ("bytes", size), timeout_s)) == size else "wrong"
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
        assert ask(pool, 20_000_000, _LONG_S) == "right"


@pytest.mark.slow
def test_stalled_worker_is_replaced_mid_message(log: Path) -> None:
    with _warm_pool(log, stall_s=3.0) as pool:
        (stalled,) = _pids()
        os.kill(stalled, signal.SIGSTOP)
        # Larger than the pipe's buffer, so that the supervisor cannot finish sending it.
        assert _run(pool, ("echo", b"x" * 10_000_000), _LONG_S) == b"x" * 10_000_000
        assert stalled not in _pids()


def test_cancelled_jobs_are_not_started(log: Path, gate: Path) -> None:
    with _warm_pool(log) as pool:
        busy = _begin_wait(pool, log, gate)
        cancelled, late_s = pool.submit(("echo", 1), _LONG_S), monotonic() + 1.0
        late = pool.submit(("raise", 1), 1.0)
        assert cancelled.cancel()
        wait_for(lambda: monotonic() > late_s + 0.1)
        gate.touch()
        busy.result(_LONG_S)
        assert _reason(late) == "deadline"
        assert _run(pool, ("bytes", 1), _LONG_S) == b"\0"
        assert _count(log, "echo") == _count(log, "raise") == 0


# Copying and hashing the large content takes so long that the job is not submitted yet when it is cancelled.
@pytest.mark.parametrize("content", [1, bytes(200_000_000)], ids=["waiting", "during submission"])
def test_cancelling_the_await_cancels_the_job(log: Path, gate: Path, content: object) -> None:
    async def give_up(pool: Pool) -> None:
        waiting = asyncio.create_task(pool.run_job(("echo", content), _LONG_S))
        await asyncio.sleep(0.05)
        while content == 1 and not pool.waiting:
            await asyncio.sleep(0.01)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting

    with _warm_pool(log) as pool:
        busy = _begin_wait(pool, log, gate)
        asyncio.run(give_up(pool))
        gate.touch()
        busy.result(_LONG_S)
        assert _run(pool, ("bytes", 1), _LONG_S) == b"\0"
        assert _count(log, "echo") == 0


def test_deadline_is_kept_and_worker_continues(log: Path, gate: Path) -> None:
    with _warm_pool(log) as pool:
        # The job itself does not end.
        with pytest.raises(JobLostError, match="deadline"):
            _run(pool, ("wait", str(gate)), 0.5)
        gate.touch()
        assert _run(pool, ("echo", 1), _LONG_S) == 1
        assert _count(log, "start") == 1


def test_full_queue_refuses_and_frees_cancelled_places(log: Path, gate: Path) -> None:
    with _warm_pool(log, queue_limit=3) as pool:
        _begin_wait(pool, log, gate)
        first, second = pool.submit(("echo", 1), _LONG_S), pool.submit(("echo", 2), _LONG_S)
        with pytest.raises(JobLostError, match="queue-full"):
            pool.submit(("echo", 3), _LONG_S)
        first.cancel()
        third = pool.submit(("echo", 4), _LONG_S)
        gate.touch()
        assert third.result(_LONG_S) == 4
        assert second.result(_LONG_S) == 2


def test_clients_take_turns(log: Path, gate: Path) -> None:
    done: list[str] = []
    with _warm_pool(log, queue_limit=20) as pool:
        _begin_wait(pool, log, gate, "many")
        for client in ("many", "many", "many", "many", "few", "few", "one"):
            job = pool.submit(("echo", client), _LONG_S, client)
            job.add_done_callback(lambda future: done.append(future.result()))
        gate.touch()
        wait_for(lambda: len(done) == 7)
    assert done == ["many", "few", "one", "many", "few", "many", "many"]


def test_one_client_cannot_fill_the_queue(log: Path, gate: Path) -> None:
    with _warm_pool(log, queue_limit=4) as pool:
        _begin_wait(pool, log, gate, "many")
        for _ in range(3):
            pool.submit(("echo", 1), _LONG_S, "many")
        with pytest.raises(JobLostError, match="queue-full"):
            pool.submit(("echo", 1), _LONG_S, "many")
        other = pool.submit(("echo", 2), _LONG_S, "other")
        gate.touch()
        assert other.result(_LONG_S) == 2


def test_spare_worker_is_kept_during_a_restart(log: Path, gate: Path, start_gate: Path) -> None:
    slow = {"target": worker_jobs.run_after_gate, "arguments": (str(log), str(start_gate))}
    with _warm_pool(log, workers=2, queue_limit=20, keep_spare=True, **slow) as pool:
        lost = [pool.submit(("wait", str(gate)), _LONG_S, "worst") for _ in range(4)]
        for stalled in range(2):
            wait_for(lambda stalled=stalled: _count(log, "wait") == stalled + 1 and pool.state.ready == 2)
            # During the job, and then while its worker is replaced.
            assert pool.submit(("echo", 1), _LONG_S, "other").result(_LONG_S) == 1
            assert not lost[stalled].done()
            start_gate.unlink()
            end_time_limits()
            assert _reason(lost[stalled]) == "stalled"
            assert pool.submit(("echo", 2), _LONG_S, "other").result(_LONG_S) == 2
            assert _count(log, "wait") == stalled + 1
            start_gate.touch()
        for future in lost:
            future.cancel()


def test_close_finishes_running_jobs_only(log: Path, gate: Path) -> None:
    with _warm_pool(log) as pool, ThreadPoolExecutor(1) as threads:
        at_work = _begin_wait(pool, log, gate)
        waiting = pool.submit(("echo", 1), _LONG_S)
        closed = threads.submit(pool.close, drain_s=_LONG_S)
        assert _reason(waiting) == "closing"
        gate.touch()
        closed.result(_LONG_S)
        assert isinstance(at_work.result(0.0), int)
        with pytest.raises(JobLostError, match="closing"):
            pool.submit(("echo", 1), _LONG_S)
        with pytest.raises(JobLostError, match="closing"):
            _run(pool, ("echo", 1), _LONG_S)


def test_close_waits_no_longer_than_drain_s(log: Path, gate: Path) -> None:
    with _warm_pool(log) as pool:
        at_work = _begin_wait(pool, log, gate)
        pool.close(drain_s=0.2)
        assert _reason(at_work) == "closing"


def test_failing_starts_back_off(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pauses_s: list[float] = []
    monkeypatch.setattr(JobQueue, "rest", lambda _queue, duration_s: pauses_s.append(duration_s))
    # A start that took longer than `start_s` and 5 s would count as a life.
    with _pool(log, target=worker_jobs.run_broken, start_s=_LONG_S) as pool:
        wait_for(lambda: len(pauses_s) >= 5)
        assert pauses_s[:5] == [0.0, 0.25, 0.5, 1.0, 2.0]
        assert pool.state.fault == "the worker died starting"
        assert not pool.state.warmed_up


@pytest.mark.slow
def test_worker_that_never_gets_ready_is_killed(log: Path, gate: Path) -> None:
    slow = {"target": worker_jobs.run_after_gate, "arguments": (str(log), str(gate))}
    with _pool(log, max_start_s=1.0, **slow) as pool:
        wait_for(lambda: pool.state.fault is not None)
        assert pool.state.fault == "the worker did not start within 1 s"


def test_kill_during_start_only_delays_a_job(log: Path, gate: Path) -> None:
    gate.touch()
    slow = {"target": worker_jobs.run_after_gate, "arguments": (str(log), str(gate))}
    with _pool(log, start_s=2.0, **slow) as pool:
        assert pool.submit(("echo", 1), _LONG_S).result(_LONG_S) == 1
        gate.unlink()
        _kill(_pids())
        answer = pool.submit(("echo", 2), _LONG_S)
        for starts in (2, 3):
            # The worker waits for the gate.
            wait_for(lambda starts=starts: _count(log, "start") == starts)
            _kill(_pids())
        gate.touch()
        assert answer.result(_LONG_S) == 2
