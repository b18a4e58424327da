"""Executor of queries: CPU work and searches on the compute threads, with the refinement that needs no worker.

Poses of wall profiles are refined on numpy, on the thread of the search: that takes less time than the way to an LPO
worker and back.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator
from functools import partial
from time import monotonic
from typing import Any, Protocol, TypeVar

from lalaloc_core.localise.refine import RefinementJob, RefinementResult, refine_walls, refined_by_walls
from lalaloc_core.localise.search.pipeline import next_step
from service.capacity.fair_share import FairSemaphore, with_headroom
from service.capacity.threads import Threads
from service.pools import LostReason, PoolState
from service.query_context import QueryContext
from service.settings import Settings
from service.telemetry import LOGGER_NAME, Telemetry

# LPO stops this long (s) before the request's deadline; ranking and sending the answer need the rest.
_RESERVED_S = 0.25

T = TypeVar("T")
FoundT = TypeVar("FoundT")
SearchSteps = Generator[RefinementJob | None, Any, T]


class Optimiser(Protocol):
    """Pose refinement (LPO), by worker processes (`LpoPool`) or elsewhere."""

    @property
    def state(self) -> PoolState:
        """Numbers of workers, all and warm."""
        ...

    def start(self) -> None:
        """Start the workers and return at once."""
        ...

    async def refine(self, job: RefinementJob, timeout_s: float, client: str = "") -> RefinementResult | None:
        """Return the result of a client's job; None if it failed or took longer than `timeout_s`."""
        ...

    def close(self, drain_s: float = 0.0) -> None:
        """Stop the workers; running jobs have `drain_s` (s) to finish."""
        ...


def finish_with(steps: SearchSteps[FoundT], complete: Callable[[FoundT], T]) -> SearchSteps[T]:
    """Return the steps of a search that end with `complete(result)`, on the thread of the search."""
    return complete((yield from steps))


class Executor:
    """Compute threads of queries."""

    def __init__(self, settings: Settings, optimiser: Optimiser, telemetry: Telemetry, cores: FairSemaphore) -> None:
        self._lpo_deadline_s, self._optimiser, self._telemetry = settings.lpo.deadline_s, optimiser, telemetry
        self._steps = StepRunner(optimiser, telemetry)
        self._threads = Threads(
            "localise", with_headroom(settings.cores.compute_threads), telemetry.cpu_accounts, cores
        )

    async def compute(self, context: QueryContext, work: Callable[[], T]) -> T:
        """Run CPU work on a compute thread.

        After the query's deadline, waiting work is not started, and the result of running work is dropped.
        """
        async with context.bounded():
            return await self._threads.run(context.client, work)

    async def run_search(self, steps: SearchSteps[T], context: QueryContext) -> T:
        """Run a search on the compute threads; it holds no thread in its pauses and while a worker refines poses."""
        lpo_timeout_s = partial(self._lpo_timeout_s, context)
        step = await self.compute(context, partial(self._steps.next, steps, None, lpo_timeout_s))
        while step is None or isinstance(step, RefinementJob):
            result = None
            if step is not None:
                result = await self._optimiser.refine(step, self._lpo_timeout_s(context), context.client)
            step = await self.compute(context, partial(self._steps.next, steps, result, lpo_timeout_s))
        return step

    def observe(self, context: QueryContext, stage: str) -> dict[str, float]:
        """Record an answer in the metrics; return the duration (ms) of each stage, and their `total`."""
        timings_ms = context.clock.timings_ms | {"total": context.spent_s * 1e3}
        self._telemetry.observe_answer(timings_ms, stage)
        return timings_ms

    def observe_stage(self, context: QueryContext, name: str) -> None:
        """Record a stage that ran after `observe`."""
        self._telemetry.stage_seconds.labels(name).observe(context.clock.timings_ms[name] / 1e3)

    def close(self) -> None:
        """Wait for the computations in progress, and stop the threads."""
        self._threads.close()

    def _lpo_timeout_s(self, context: QueryContext) -> float:
        return min(self._lpo_deadline_s, context.left_s - _RESERVED_S)


class StepRunner:
    """Runner of steps up to a pause, to a job for an LPO worker, or to the result."""

    def __init__(self, optimiser: Optimiser, telemetry: Telemetry) -> None:
        self._optimiser, self._telemetry = optimiser, telemetry

    def next(self, steps: SearchSteps[T], result: object, timeout_s: Callable[[], float]) -> RefinementJob | T | None:
        """Continue a search after the result of its last job; `timeout_s` returns the time left for refinement."""
        step = next_step(steps, result)
        # Without workers LPO is off.
        while isinstance(step, RefinementJob) and refined_by_walls(step) and self._optimiser.state.workers:
            step = next_step(steps, self._refined(step, timeout_s()))
        return step

    def _refined(self, job: RefinementJob, timeout_s: float) -> RefinementResult | None:
        """Return the result of a job, or None if it failed or took longer than `timeout_s`, as a worker's."""
        if timeout_s <= 0.0:
            return None
        deadline = monotonic() + timeout_s
        try:
            result = refine_walls(job, wanted=lambda: monotonic() < deadline)
        except (ArithmeticError, ValueError) as error:
            fields = {"reason": f"{type(error).__name__}: {error}"}
            logging.getLogger(LOGGER_NAME).error("pose refinement failed", extra={"fields": fields})
            return self._missed("fault")
        return self._missed("deadline") if result is None else result

    def _missed(self, reason: LostReason) -> None:
        self._telemetry.lpo_missed.labels(reason).inc()
