"""The best checkpoint of a stage by validation, kept beside the last one."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from pathlib import Path

from torch import nn

from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.stages import TrainingStage

Validate = Callable[[dict[str, nn.Module]], dict[str, float]]
_LIKELIHOOD, _ACCURACY, _TIE_BREAKER = "val_nll", "val_within_1m", "val_median_cm"


def best_path(path: Path) -> Path:
    """Where the best checkpoint lies, beside the last one at `path`."""
    return path.with_suffix(".best.pt")


class BestCheckpoint:
    """Keeps the best checkpoint: with the most likely wall profiles, because poses are compared by that likelihood.

    Of networks that predict none it is the one with the most validation queries within 1 m, of several such that with
    the smallest median. Without either among the metrics nothing is kept.

    Args:
        path: where it is kept; what an earlier run left there is deleted unless this one resumes it.
        stage: its modules say how to rebuild what was kept.
        validate: scores what was kept once more, because validation scenes may have changed when a run resumes.
    """

    def __init__(self, path: Path, stage: TrainingStage, validate: Validate | None, *, resume: bool) -> None:
        self._path = path
        self._score: tuple[float, ...] | None = None
        if not resume:
            path.unlink(missing_ok=True)
        elif validate is not None and path.exists():
            kept = Checkpoint.load(path, stage=stage.name)
            modules = {name: copy.deepcopy(module).eval() for name, module in stage.modules.items()}
            for name, module in modules.items():
                module.load_state_dict(kept.inference_weights[name])
            self._score = _score(validate(modules))

    def consider(self, checkpoint: Checkpoint) -> None:
        """Keep a checkpoint that was just validated if it is the best so far."""
        score = _score(checkpoint.metrics)
        if score is not None and (self._score is None or score > self._score):
            checkpoint.save(self._path)
            self._score = score


def _score(metrics: dict[str, float]) -> tuple[float, ...] | None:
    """Orders validations; None for one that tells no accuracy, or no number."""
    if not all(math.isfinite(value) for value in metrics.values()):
        return None
    if _LIKELIHOOD in metrics:
        return (-metrics[_LIKELIHOOD],)
    return (metrics[_ACCURACY], -metrics[_TIE_BREAKER]) if _ACCURACY in metrics else None
