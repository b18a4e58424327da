"""Checkpoints: one file with weights, optimiser state, progress and the configuration they belong to."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from lalaloc_core.errors import CheckpointError
from lalaloc_core.files import replacing
from lalaloc_core.learn.training.config import TrainConfig


@dataclass(kw_only=True)
class Checkpoint:
    """State of a training stage.

    Attributes:
        stage: "layout", "image" or "end-to-end".
        weights: state dict of the stage's modules by name.
        averaged: averaged weights (EMA) in the same form, empty when averaging is off.
        optimiser: state of the optimiser.
        step, seconds: progress so far.
        metrics: the last validation.
        data: what the stage was trained on.
        begun_from: the model whose weights it began with, and how long that had been trained; empty for none.
    """

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
        """What to validate and ship: the averaged weights where there are any."""
        return self.averaged or self.weights

    def save(self, path: Path) -> None:
        """Write atomically: a crash leaves the previous file."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part:
            torch.save({**vars(self), "config": self.config.to_dict()}, part)

    @classmethod
    def load(cls, path: Path, *, stage: str | None = None) -> Checkpoint:
        """Read a checkpoint; nothing in the file is executed.

        Raises:
            CheckpointError: missing, damaged, or of another stage.
        """
        try:
            raw = torch.load(path, map_location="cpu", weights_only=True)
            raw["config"] = TrainConfig.from_dict(raw["config"])
            checkpoint = cls(**raw)
        except FileNotFoundError as error:
            raise CheckpointError(f"no checkpoint at '{path}'") from error
        except Exception as error:
            raise CheckpointError(f"cannot read checkpoint '{path}': {error}") from error
        if stage is not None and checkpoint.stage != stage:
            raise CheckpointError(f"'{path}' is a checkpoint of stage '{checkpoint.stage}', '{stage}' is wanted")
        return checkpoint
