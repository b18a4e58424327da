"""Checkpoints: one file with weights, optimiser state, progress and configuration; the best one is kept apart."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

from lalaloc_core.errors import CheckpointError
from lalaloc_core.files import replacing
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.stages import TrainingStage

# Scores networks by name; returns metrics by name.
Validate = Callable[[dict[str, nn.Module]], dict[str, float]]
_LIKELIHOOD, _ACCURACY, _TIE_BREAKER = "val_nll", "val_within_1m", "val_median_cm"


@dataclass(kw_only=True)
class Checkpoint:
    """State of a training stage; `averaged` weights are empty if averaging is off, `begun_from` for random weights."""

    stage: str
    config: TrainConfig
    weights: dict[str, dict[str, torch.Tensor]]
    averaged: dict[str, dict[str, torch.Tensor]] = field(default_factory=dict)
    optimiser: dict[str, Any] = field(default_factory=dict)
    step: int = 0
    seconds: float = 0.0
    metrics: dict[str, float] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)
    begun_from: dict[str, Any] = field(default_factory=dict)

    @property
    def inference_weights(self) -> dict[str, dict[str, torch.Tensor]]:
        """Weights to validate and ship: the averaged ones if there are any."""
        return self.averaged or self.weights

    def save(self, path: Path) -> None:
        """Write atomically: a crash leaves the previous file."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            torch.save({**vars(self), "config": self.config.to_dict()}, part)

    @classmethod
    def load(cls, path: Path, *, stage: str | None = None) -> Checkpoint:
        """Read a checkpoint, optionally of a required stage, without executing anything in the file."""
        try:
            raw = torch.load(path, map_location="cpu", weights_only=True)
            raw["config"] = TrainConfig.from_dict(raw["config"])
            checkpoint = cls(**raw)
        except FileNotFoundError as error:
            raise CheckpointError(f"no checkpoint at '{path}'") from error
        except Exception as error:
            raise CheckpointError(f"cannot read checkpoint '{path}': {error}") from error
        if stage is not None and checkpoint.stage != stage:
            raise CheckpointError(f"'{path}' is a checkpoint of stage '{checkpoint.stage}'; '{stage}' is required")
        return checkpoint


def best_path(path: Path) -> Path:
    """Return the path of the best checkpoint, beside the last one at `path`."""
    return path.with_suffix(".best.pt")


class BestCheckpoint:
    """Keeper of the best checkpoint: the lowest negative log likelihood of wall profiles, which also ranks poses.

    Networks without a likelihood are ranked by the validation queries within 1 m, ties by the smaller median. Metrics
    without either are not ranked, and nothing is kept. The file of an earlier run is deleted unless this run resumes
    it. `validate` then scores the kept weights again, because validation scenes may have changed; `stage` provides the
    modules for them.
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
        """Keep a validated checkpoint if it is the best so far."""
        score = _score(checkpoint.metrics)
        if score is not None and (self._score is None or score > self._score):
            checkpoint.save(self._path)
            self._score = score


def _score(metrics: dict[str, float]) -> tuple[float, ...] | None:
    """Return a sort key of validation metrics; None if a value is not finite or no metric ranks them."""
    if not all(math.isfinite(value) for value in metrics.values()):
        return None
    if _LIKELIHOOD in metrics:
        return (-metrics[_LIKELIHOOD],)
    return (metrics[_ACCURACY], -metrics[_TIE_BREAKER]) if _ACCURACY in metrics else None
