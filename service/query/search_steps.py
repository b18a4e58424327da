"""Steps of a search on the compute threads, with the refinement that needs no worker, and with what follows the search.

Poses of wall profiles are refined on numpy, on the thread of the search: that takes less time than the way to an LPO
worker and back.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator
from time import monotonic
from typing import Any, TypeVar

from lalaloc_core.localise.refine import RefinementJob, RefinementResult, refine_walls, refined_by_walls
from lalaloc_core.localise.search.pipeline import next_step
from lalaloc_core.localise.sequence import SequenceJob
from service.pools import LostReason
from service.query.queries import OptimiserBackend
from service.telemetry import LOGGER_NAME, Telemetry

T = TypeVar("T")
FoundT = TypeVar("FoundT")
SearchSteps = Generator[RefinementJob | SequenceJob | None, Any, T]


def completed(steps: SearchSteps[FoundT], complete: Callable[[FoundT], T]) -> SearchSteps[T]:
    """Return the steps of a search that end with `complete(result)`, on the thread of the search."""
    return complete((yield from steps))


class StepRunner:
    """Runner of steps up to a pause, to a job for an LPO worker, or to the result."""

    def __init__(self, optimiser: OptimiserBackend, telemetry: Telemetry) -> None:
        self._optimiser = optimiser
        self._telemetry = telemetry

    def next(
        self, steps: SearchSteps[T], result: object, timeout_s: Callable[[], float]
    ) -> RefinementJob | SequenceJob | T | None:
        """Continue a search.

        Args:
            steps: the search.
            result: of its last job; None at first, and if there is none.
            timeout_s: returns the time (s) left for pose refinement.
        """
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
