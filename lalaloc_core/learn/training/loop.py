"""The training loop of all stages: schedule, mixed precision, averaging, log, checkpoints, resuming."""

from __future__ import annotations

import csv
import dataclasses
import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from tqdm import tqdm

from lalaloc_core.errors import CheckpointError
from lalaloc_core.learn.training.batches import Batch
from lalaloc_core.learn.training.checkpoint import BestCheckpoint, Checkpoint, Validate, best_path
from lalaloc_core.learn.training.config import OptimiserConfig, TrainConfig
from lalaloc_core.learn.training.stages import TrainingStage, build_optimiser

_LOG = logging.getLogger(__name__)
_LOG_EVERY = 20
_MINUTES_BAR = "{desc}: {percentage:3.0f}%|{bar}| {n:.2f}/{total:g} min [{elapsed}{postfix}]"


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
    """Train a stage to the end of its schedule, or resume an interrupted run.

    Writes `<stage>.pt` (the last checkpoint), `<stage>.best.pt` (the best by validation, if metrics rank it) and
    `<stage>.csv` (losses and validation by step) into `folder`. `workers` processes make batches. `validate` is a
    function of the modules (averaged if averaging is on) that returns metrics; it is called per checkpoint.
    `begun_from` is the origin of the initial weights, stored in checkpoints; a resumed run keeps its checkpoint's
    value.
    """
    path = folder / f"{stage.name}.pt"
    trainer = _Trainer(stage, device)
    trainer.begun_from = begun_from or {}
    if resume:
        trainer.restore(Checkpoint.load(path, stage=stage.name))
    best = BestCheckpoint(best_path(path), stage, validate, resume=resume)
    batches = stage.batches(trainer.step, workers)
    last_saved = time.monotonic()
    with _csv_log(folder / f"{stage.name}.csv", append=resume) as log, _progress_bar(trainer) as bar:
        while trainer.progress < 1.0:
            begin = time.monotonic()
            terms = trainer.train_step(next(batches))
            trainer.seconds += time.monotonic() - begin
            bar.update(min(trainer.spent, trainer.budget) - bar.n)
            if trainer.step % _LOG_EVERY == 0:
                log(trainer.step, trainer.seconds, terms)
                bar.set_postfix({name: f"{value:.3f}" for name, value in terms.items()}, refresh=False)
            finished = trainer.progress >= 1.0
            if finished or time.monotonic() - last_saved > 60.0 * checkpoint_minutes:
                if validate is not None:
                    trainer.metrics = validate(trainer.inference_modules)
                    log(trainer.step, trainer.seconds, trainer.metrics)
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
        # A processor needs matrices of bfloat16: without them, autocast is slower.
        self._mixed_precision = device.type == "cuda" or bool(torch.cpu.get_capabilities().get("amx_bf16", False))
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
        """Modules to validate: those with averaged weights if averaging is on."""
        return self.stage.modules if self._averaged is None else dict(self._averaged.module.named_children())

    @property
    def budget(self) -> int | float:
        return self.settings.steps if self.settings.minutes is None else self.settings.minutes

    @property
    def spent(self) -> int | float:
        return self.step if self.settings.minutes is None else self.seconds / 60.0

    @property
    def progress(self) -> float:
        return self.spent / self.budget

    def train_step(self, batch: Batch) -> dict[str, float]:
        """Update the networks once and return the losses by name."""
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
            parameters = [parameter for group in self.optimiser.param_groups for parameter in group["params"]]
            nn.utils.clip_grad_norm_(parameters, self.settings.optimiser.clip_norm)
        self.optimiser.step()
        self.step += 1
        if self._averaged is not None:
            self._averaged.update_parameters(self._trained)
        return {name: term.item() for name, term in terms.items()}

    def checkpoint(self) -> Checkpoint:
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
        """Continue from a checkpoint; its configuration can differ only in budgets and rays per pixel."""
        if _without_budgets(checkpoint.config) != _without_budgets(self.stage.config):
            raise CheckpointError(
                f"the checkpoint of stage '{checkpoint.stage}' has another configuration; resume with the preset, seed "
                "and settings of the run"
            )
        if checkpoint.data and checkpoint.data != self.stage.data:
            raise CheckpointError(
                f"the checkpoint was trained on {checkpoint.data}, not on {self.stage.data}; resume with the same data"
            )
        for name, module in self.stage.modules.items():
            module.load_state_dict(checkpoint.weights[name])
        if self._averaged is not None:
            for name, module in self.inference_modules.items():
                module.load_state_dict(checkpoint.averaged[name])
            _set_average_steps(self._averaged, checkpoint.step)
        self.optimiser.load_state_dict(checkpoint.optimiser)
        self.step, self.seconds, self.metrics = checkpoint.step, checkpoint.seconds, checkpoint.metrics
        self.begun_from = checkpoint.begun_from


def _progress_bar(trainer: _Trainer) -> tqdm[Any]:
    timed = trainer.settings.minutes is not None
    return tqdm(
        total=trainer.budget,
        initial=min(trainer.spent, trainer.budget),
        desc=trainer.stage.name,
        unit="step",
        bar_format=_MINUTES_BAR if timed else None,
        mininterval=10.0,
    )


def _states(modules: dict[str, nn.Module]) -> dict[str, dict[str, Tensor]]:
    return {name: module.state_dict() for name, module in modules.items()}


def _without_budgets(config: TrainConfig) -> TrainConfig:
    """Reset the settings that can change when a run resumes."""
    return dataclasses.replace(
        config,
        layout=dataclasses.replace(config.layout, steps=0, minutes=None),
        image=dataclasses.replace(config.image, steps=0, minutes=None, supersample=(1, 1)),
    )


def learning_rate(config: OptimiserConfig, progress: float) -> float:
    """Return the learning rate at a share (0 to 1) of the schedule."""
    if config.warmup and progress < config.warmup:
        return config.learning_rate * (0.05 + 0.95 * progress / config.warmup)
    if config.schedule == "steps":
        return config.learning_rate * config.gamma ** sum(progress >= milestone for milestone in config.milestones)
    if config.schedule == "trapezoid":
        fallen = max(0.0, progress - (1.0 - config.decay)) / config.decay
        return config.learning_rate * (0.01 + 0.99 * (1.0 - math.sqrt(fallen)))
    return config.learning_rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * progress)))


def moving_average(module: nn.Module, decay: float) -> AveragedModel:
    """Create an exponential moving average of a module from its current weights; early steps use a smaller decay."""

    def update(averaged: Iterable[Tensor], current: Iterable[Tensor], count: Tensor | int) -> None:
        # At full decay, the initial weights would dominate for too long.
        share = 1.0 - min(decay, (1.0 + int(count)) / (10.0 + int(count)))
        for average, value in zip(averaged, current, strict=True):
            if average.is_floating_point():
                average.lerp_(value, share)
            else:
                average.copy_(value)

    average = AveragedModel(module, multi_avg_fn=update, use_buffers=True).eval()
    _set_average_steps(average, 0)
    return average


def _set_average_steps(average: AveragedModel, step: int) -> None:
    """Set the number of steps of an average; the initial weights count as one step."""
    average.n_averaged.fill_(1 + step)


@contextmanager
def _csv_log(path: Path, *, append: bool) -> Iterator[Callable[[int, float, dict[str, float]], None]]:
    """Open a log in long format, and yield the function that appends a step's values, one row per value."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = not (append and path.exists())
    with path.open("w" if fresh else "a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        if fresh:
            writer.writerow(["step", "seconds", "name", "value"])

        def write(step: int, seconds: float, values: dict[str, float]) -> None:
            writer.writerows([step, f"{seconds:.1f}", name, f"{value:.6g}"] for name, value in values.items())
            file.flush()

        yield write
