"""The runs of a report, read and scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lalaloc_core.errors import RunError
from lalaloc_core.evaluate.runs.predictions import Prediction, RunInfo, read_runs
from lalaloc_core.evaluate.runs.score import Scores, score

_MAX_LABEL = 48


@dataclass(frozen=True, eq=False, kw_only=True)
class Run:
    """One run of a report.

    Attributes:
        number: its place in the report, from 1.
        name: what tables and figures call it: its label, shortened, with its number where there are several runs.
        scores: None where nothing was answered yet.
    """

    number: int
    name: str
    folder: Path
    info: RunInfo
    predictions: list[Prediction]
    scores: Scores | None

    @property
    def stages(self) -> list[str]:
        """Stages that any of its queries went through, in order."""
        return list(self.scores.stages) if self.scores is not None else []

    @property
    def key(self) -> str:
        """A name for files and anchors."""
        return f"run-{self.number}"


def open_runs(folders: Sequence[Path]) -> list[Run]:
    """Read and score runs.

    Raises:
        RunError: no folder given, or one that holds no run.
    """
    if not folders:
        raise RunError("a report needs at least one run")
    several = len(folders) > 1
    return [
        Run(
            number=number,
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
