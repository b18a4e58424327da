"""How long the stages of a run's queries took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lalaloc_core.evaluate.runs.predictions import Prediction

TOTAL = "total"


@dataclass(frozen=True, kw_only=True)
class StageTime:
    """Milliseconds of one stage over the queries that went through it."""

    count: int
    median_ms: float
    p95_ms: float


def stage_times(predictions: Sequence[Prediction]) -> dict[str, StageTime]:
    """Times by stage, and under `TOTAL` of whole queries; empty where nothing was timed."""
    timed = [prediction.timings_ms for prediction in predictions if prediction.timings_ms]
    names = list(dict.fromkeys(name for timings in timed for name in timings))
    times = {name: _summary([timings[name] for timings in timed if name in timings]) for name in names}
    return {**times, TOTAL: _summary([sum(timings.values()) for timings in timed])} if timed else {}


def _summary(milliseconds: list[float]) -> StageTime:
    median, p95 = np.percentile(milliseconds, [50.0, 95.0])
    return StageTime(count=len(milliseconds), median_ms=float(median), p95_ms=float(p95))
