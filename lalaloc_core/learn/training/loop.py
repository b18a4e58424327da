"""The training loop both stages share: schedule, mixed precision, averaging, log, checkpoints, resuming."""

from __future__ import annotations

import csv
import dataclasses
import logging
import math
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from lalaloc_core.errors import CheckpointError
from lalaloc_core.learn.training.averaging import moving_average, resume_average
from lalaloc_core.learn.training.batches import Batch
from lalaloc_core.learn.training.best import BestCheckpoint, Validate, best_path
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import OptimiserConfig, TrainConfig
from lalaloc_core.learn.training.stages import TrainingStage, build_optimiser

_LOG = logging.getLogger(__name__)
_LOG_EVERY = 20


def run_stage(
    stage: TrainingStage,
    folder: Path,
    *,
    device: torch.device,
    workers: int = 1,
    resume: bool = False,
    checkpoint_minutes: float = 5.0,
    validate: Validate | None = None,
    begun_from: dict[str, Any] | None = None,
) -> Checkpoint:
    """Train a stage to the end of its schedule, or resume one that was interrupted.

    Writes `<stage>.pt` (the last checkpoint), `<stage>.best.pt` (the best by validation, where that tells accuracies)
    and `<stage>.csv` (losses and validation by step) into `folder`.

    Args:
        workers: processes that make batches.
        begun_from: what checkpoints say of the origin of the weights that the stage's modules have now; a resumed run
            keeps what its checkpoint says.
        validate: called with the modules (averaged where averaging is on) whenever a checkpoint is written.

    Raises:
        CheckpointError: `resume` without a checkpoint, or of another configuration or data.
    """
    path = folder / f"{stage.name}.pt"
    trainer = _Trainer(stage, device)
    trainer.begun_from = begun_from or {}
    if resume:
        trainer.restore(Checkpoint.load(path, stage=stage.name))
    best = BestCheckpoint(best_path(path), stage, validate, resume=resume)
    batches = stage.batches(trainer.step, workers)
    last_saved = time.monotonic()
    with (
        _CsvLog(folder / f"{stage.name}.csv", append=resume) as log,
        tqdm(total=stage.settings.steps, initial=trainer.step, desc=stage.name, mininterval=10.0) as bar,
    ):
        while trainer.progress < 1.0:
            begin = time.monotonic()
            terms = trainer.train_step(next(batches))
            trainer.seconds += time.monotonic() - begin
            bar.update()
            if trainer.step % _LOG_EVERY == 0:
                log.write(trainer.step, trainer.seconds, terms)
                bar.set_postfix({name: f"{value:.3f}" for name, value in terms.items()}, refresh=False)
            finished = trainer.progress >= 1.0
            if finished or time.monotonic() - last_saved > 60.0 * checkpoint_minutes:
                if validate is not None:
                    trainer.metrics = validate(trainer.inference_modules)
                    log.write(trainer.step, trainer.seconds, trainer.metrics)
                    _LOG.info("step %d: %s", trainer.step, trainer.metrics)
                checkpoint = trainer.checkpoint()
                checkpoint.save(path)
                best.consider(checkpoint)
                last_saved = time.monotonic()
    return trainer.checkpoint()


class _Trainer:
    """Parameters, optimiser, averages and progress of one stage."""

    def __init__(self, stage: TrainingStage, device: torch.device) -> None:
        self.stage = stage
        self.device = device
        self.settings = stage.settings
        self._mixed_precision = device.type == "cuda" or _multiplies_bfloat16()
        for module in stage.modules.values():
            module.to(device).train()
        if stage.teacher is not None:
            stage.teacher.to(device)
        self.optimiser = build_optimiser(stage.modules, self.settings.optimiser)
        self._trained = nn.ModuleDict(stage.modules)
        self._averaged = moving_average(self._trained, stage.ema_decay) if stage.ema_decay else None
        self.step = 0
        self.seconds = 0.0
        self.metrics: dict[str, float] = {}
        self.begun_from: dict[str, Any] = {}

    @property
    def inference_modules(self) -> dict[str, nn.Module]:
        """What to validate: the modules with averaged weights where averaging is on."""
        return self.stage.modules if self._averaged is None else dict(self._averaged.module.named_children())

    @property
    def progress(self) -> float:
        """Share of the schedule done, by time where a time budget is set, else by steps."""
        if self.settings.minutes is not None:
            return self.seconds / (60.0 * self.settings.minutes)
        return self.step / self.settings.steps

    def train_step(self, batch: Batch) -> dict[str, float]:
        """One update; returns the losses by name.

        Raises:
            FloatingPointError: the loss is not finite; the last checkpoint is still good.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = group.get("factor", 1.0) * learning_rate(self.settings.optimiser, min(self.progress, 1.0))
        batch = {key: value.to(self.device, non_blocking=True) for key, value in batch.items()}
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._mixed_precision):
            terms = self.stage.losses(batch)
        total: Tensor = torch.stack(list(terms.values())).sum()
        if not torch.isfinite(total):
            raise FloatingPointError(f"loss at step {self.step} is {total.item()}: {terms}")
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()
        if self.settings.optimiser.clip_norm:
            parameters = [p for group in self.optimiser.param_groups for p in group["params"]]
            nn.utils.clip_grad_norm_(parameters, self.settings.optimiser.clip_norm)
        self.optimiser.step()
        self.step += 1
        if self._averaged is not None:
            self._averaged.update_parameters(self._trained)
        return {name: term.item() for name, term in terms.items()}

    def checkpoint(self) -> Checkpoint:
        """The present state."""
        return Checkpoint(
            stage=self.stage.name,
            config=self.stage.config,
            weights=_states(self.stage.modules),
            averaged={} if self._averaged is None else _states(self.inference_modules),
            optimiser=self.optimiser.state_dict(),
            step=self.step,
            seconds=self.seconds,
            metrics=self.metrics,
            data=self.stage.data,
            begun_from=self.begun_from,
        )

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint of the same configuration; only budgets and the rays per pixel may change."""
        if _lasting(checkpoint.config) != _lasting(self.stage.config):
            raise CheckpointError(f"the checkpoint of stage '{checkpoint.stage}' has another configuration")
        if checkpoint.data and checkpoint.data != self.stage.data:
            raise CheckpointError(f"the checkpoint was trained on {checkpoint.data}, not on {self.stage.data}")
        for name, module in self.stage.modules.items():
            module.load_state_dict(checkpoint.weights[name])
        if self._averaged is not None:
            for name, module in self.inference_modules.items():
                module.load_state_dict(checkpoint.averaged[name])
            resume_average(self._averaged, checkpoint.step)
        self.optimiser.load_state_dict(checkpoint.optimiser)
        self.step, self.seconds, self.metrics = checkpoint.step, checkpoint.seconds, checkpoint.metrics
        self.begun_from = checkpoint.begun_from


def _multiplies_bfloat16() -> bool:
    """Whether the processor multiplies matrices in bfloat16 itself; where it does not, autocast only costs time."""
    return bool(torch.cpu.get_capabilities().get("amx_bf16", False))


def _states(modules: dict[str, nn.Module]) -> dict[str, dict[str, Tensor]]:
    return {name: module.state_dict() for name, module in modules.items()}


def _lasting(config: TrainConfig) -> TrainConfig:
    """A configuration without what may change when a run resumes."""
    return dataclasses.replace(
        config,
        layout=dataclasses.replace(config.layout, steps=0, minutes=None),
        image=dataclasses.replace(config.image, steps=0, minutes=None, supersample=(1, 1)),
    )


def learning_rate(config: OptimiserConfig, progress: float) -> float:
    """Learning rate at a share (0 to 1) of the schedule."""
    if config.warmup and progress < config.warmup:
        return config.learning_rate * (0.05 + 0.95 * progress / config.warmup)
    if config.schedule == "steps":
        return config.learning_rate * config.gamma ** sum(progress >= milestone for milestone in config.milestones)
    if config.schedule == "trapezoid":
        fallen = max(0.0, progress - (1.0 - config.decay)) / config.decay
        return config.learning_rate * (0.01 + 0.99 * (1.0 - math.sqrt(fallen)))
    return config.learning_rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * progress)))


class _CsvLog:
    """Long-format log: one row per step and value, so that any tool can plot it."""

    def __init__(self, path: Path, *, append: bool) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = not (append and path.exists())
        self._file = path.open("w" if fresh else "a", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file)
        if fresh:
            self._writer.writerow(["step", "seconds", "name", "value"])

    def __enter__(self) -> _CsvLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, step: int, seconds: float, values: dict[str, float]) -> None:
        """Append one row per value."""
        self._writer.writerows([step, f"{seconds:.1f}", name, f"{value:.6g}"] for name, value in values.items())
        self._file.flush()
