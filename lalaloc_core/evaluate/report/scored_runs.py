"""Runs of a report, read from their folders, scored and timed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lalaloc_core.errors import RunError
from lalaloc_core.evaluate.runs.predictions import Prediction, RunFolder, RunInfo
from lalaloc_core.evaluate.runs.score import Scores, score

_MAX_LABEL = 48
TOTAL = "total"


@dataclass(frozen=True, eq=False, kw_only=True)
class Run:
    """Run of a report.

    The shortened name begins with the number if there are several runs; `scores` is None without predictions.
    """

    name: str
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
    runs = []
    for number, folder in enumerate(map(RunFolder, folders), start=1):
        info, predictions = folder.read_info(), folder.read_predictions()
        name = info.label if len(info.label) <= _MAX_LABEL else info.label[: _MAX_LABEL - 1] + "…"
        name = f"{number}. {name}" if len(folders) > 1 else name
        scores = score(predictions) if predictions else None
        runs.append(Run(name=name, info=info, predictions=predictions, scores=scores))
    return runs


class StageTime(NamedTuple):
    """Number of queries that passed a stage, and its median and 95th percentile."""

    count: int
    median_ms: float
    p95_ms: float


def stage_times(predictions: Sequence[Prediction]) -> dict[str, StageTime]:
    """Return times by stage, and of whole queries under `TOTAL`; empty without times."""
    timed = [prediction.timings_ms for prediction in predictions if prediction.timings_ms]
    names = dict.fromkeys(name for timings in timed for name in timings)
    times_ms = {name: [timings[name] for timings in timed if name in timings] for name in names}
    if timed:
        times_ms[TOTAL] = [sum(timings.values()) for timings in timed]
    return {name: StageTime(len(ms), *map(float, np.percentile(ms, [50.0, 95.0]))) for name, ms in times_ms.items()}
