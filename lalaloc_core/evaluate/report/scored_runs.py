"""Runs of a report, read from their folders, scored and timed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lalaloc_core.errors import RunError
from lalaloc_core.evaluate.runs.predictions import Prediction, RunInfo, read_runs
from lalaloc_core.evaluate.runs.score import Scores, score

_MAX_LABEL = 48


@dataclass(frozen=True, eq=False, kw_only=True)
class Run:
    """Run of a report.

    The shortened name begins with the number if there are several runs; `scores` is None without predictions.
    """

    name: str
    folder: Path
    info: RunInfo
    predictions: list[Prediction]
    scores: Scores | None

    @property
    def stages(self) -> list[str]:
        """Stages that any query passed, in order."""
        return list(self.scores.stages) if self.scores is not None else []


def open_runs(folders: Sequence[Path]) -> list[Run]:
    """Read and score runs."""
    if not folders:
        raise RunError("a report needs at least one run")
    several = len(folders) > 1
    return [
        Run(
            name=f"{number}. {_shortened(info.label)}" if several else _shortened(info.label),
            folder=folder,
            info=info,
            predictions=predictions,
            scores=score(predictions) if predictions else None,
        )
        for number, (folder, (info, predictions)) in enumerate(zip(folders, read_runs(folders), strict=True), start=1)
    ]


def _shortened(label: str) -> str:
    return label if len(label) <= _MAX_LABEL else label[: _MAX_LABEL - 1] + "…"


TOTAL = "total"


@dataclass(frozen=True, kw_only=True)
class StageTime:
    """Duration of one stage over the queries that passed it."""

    count: int
    median_ms: float
    p95_ms: float


def stage_times(predictions: Sequence[Prediction]) -> dict[str, StageTime]:
    """Return times by stage, and of whole queries under `TOTAL`; empty without times."""
    timed = [prediction.timings_ms for prediction in predictions if prediction.timings_ms]
    names = list(dict.fromkeys(name for timings in timed for name in timings))
    times = {name: _summary([timings[name] for timings in timed if name in timings]) for name in names}
    return {**times, TOTAL: _summary([sum(timings.values()) for timings in timed])} if timed else {}


def _summary(milliseconds: list[float]) -> StageTime:
    median, p95 = np.percentile(milliseconds, [50.0, 95.0])
    return StageTime(count=len(milliseconds), median_ms=float(median), p95_ms=float(p95))
