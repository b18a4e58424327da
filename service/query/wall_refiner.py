"""Pose refinement by wall profiles on the thread of the search, which is cheaper than the way to an LPO worker."""

from __future__ import annotations

import logging
from time import monotonic

from lalaloc_core.localise.descent import refine_walls
from lalaloc_core.localise.poses import RefinementJob, RefinementResult
from service.pools import LostReason
from service.telemetry import LOGGER_NAME, Telemetry


class WallRefiner:
    """Refiner of jobs that compare wall profiles alone; as with `LpoPool`, a failed job has no result."""

    def __init__(self, telemetry: Telemetry) -> None:
        self._telemetry = telemetry

    def refine(self, job: RefinementJob, timeout_s: float) -> RefinementResult | None:
        """Return the result of a job, or None if it failed or took longer than `timeout_s`."""
        deadline = monotonic() + timeout_s
        if timeout_s <= 0.0:
            return None
        try:
            result = refine_walls(job, wanted=lambda: monotonic() < deadline)
        except (ArithmeticError, ValueError) as error:
            fields = {"reason": f"{type(error).__name__}: {error}"}
            logging.getLogger(LOGGER_NAME).error("refinement failed", extra={"fields": fields})
            return self._missed("fault")
        return self._missed("deadline") if result is None else result

    def _missed(self, reason: LostReason) -> None:
        self._telemetry.lpo_missed.labels(reason).inc()
