"""Trained variants that the paper compares (section 6.2), by budget, and their training on a data set.

"full" is the paper's schedule. "small" fits a CPU: narrower ResNets, smaller inputs, fewer neighbours and a shorter
schedule, the same for every row of a table.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from lalaloc_core.bundle import MANIFEST_NAME, Bundle
from lalaloc_core.errors import ConfigError
from lalaloc_core.evaluate.reproduce.paper_tables import Budget
from lalaloc_core.learn.data.dataset import Dataset
from lalaloc_core.learn.export.run_export import export_run
from lalaloc_core.learn.training import PRESETS
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import ImageStageConfig, LayoutStageConfig, OptimiserConfig, TrainConfig
from lalaloc_core.learn.training.run import StageName, train_stage
from lalaloc_core.learn.training.training_data import TrainingData
from lalaloc_core.nets.paper_encoders import PaperConfig
from lalaloc_core.render.sampling import TripletSampling

BASE = "paper"
_BUNDLE = "bundle"
_VALIDATION_SCENES = 12


@dataclass(frozen=True, kw_only=True)
class Ablation:
    """Trained variant; `layout_from` is the variant whose layout encoder it uses, None for its own."""

    config: dict[Budget, TrainConfig]
    stages: tuple[StageName, ...]
    layout_from: str | None = None


_SMALL = TrainConfig(
    name="small",
    architecture="paper",
    turns="none",
    paper=PaperConfig(width=16, layout_height=32, profile_columns=64, image_height=64, image_width=128),
    layout=LayoutStageConfig(
        steps=700,
        homes_per_step=16,
        anchors_per_home=1,
        triplets=TripletSampling(positives=1, negatives=7),
        decode_anchors_only=True,
        cloud_rows=8,
        cloud_columns=32,
        optimiser=OptimiserConfig(learning_rate=2e-3),
    ),
    image=ImageStageConfig(steps=1500, batch=16, shots_per_home=1, optimiser=OptimiserConfig(learning_rate=1e-3)),
)
_BASES: dict[Budget, TrainConfig] = {
    "small": _SMALL,
    # The paper's queries have a known heading, so spheres are not turned.
    "full": dataclasses.replace(PRESETS["paper"], turns="none"),
}


def _varied(name: str, **parts: dict[str, Any]) -> dict[Budget, TrainConfig]:
    """Return the base of every budget with some settings of its parts replaced."""

    def varied(base: TrainConfig) -> TrainConfig:
        changed = {part: dataclasses.replace(getattr(base, part), **changes) for part, changes in parts.items()}
        return dataclasses.replace(base, name=name, **changed)

    return {budget: varied(base) for budget, base in _BASES.items()}


def _following_layout(name: str, **weights: float) -> dict[Budget, TrainConfig]:
    """Return variants with neighbours: trained as the layout branch (section A.1.3), or with the small routine."""
    configs = _varied(name, image=weights)
    full = configs["full"]
    routine = dataclasses.replace(
        full.image,
        steps=full.layout.steps,
        batch=full.layout.homes_per_step * full.layout.anchors_per_home,
        optimiser=full.layout.optimiser,
    )
    return {**configs, "full": dataclasses.replace(full, image=routine)}


def _layout(name: str, **parts: dict[str, Any]) -> Ablation:
    return Ablation(config=_varied(name, **parts), stages=("layout",))


def _image(name: str, **weights: float) -> Ablation:
    return Ablation(config=_following_layout(name, **weights), stages=("image",), layout_from=BASE)


ABLATIONS: dict[str, Ablation] = {
    BASE: Ablation(config=_varied(BASE), stages=("layout", "image")),
    "layout-log-ratio": _layout("layout-log-ratio", layout={"decode_weight": 0.0}),
    "layout-decode": _layout("layout-decode", layout={"log_ratio_weight": 0.0}),
    "layout-resnet50": _layout("layout-resnet50", paper={"layout_depth": 50}),
    "layout-mlp": _layout("layout-mlp", paper={"layout_predictor": "mlp"}),
    "image-log-ratio": _image("image-log-ratio", l2_weight=0.0, log_ratio_weight=1.0),
    "image-l2-log-ratio": _image("image-l2-log-ratio", log_ratio_weight=1.0),
    "image-l2-kd": _image("image-l2-kd", kd_weight=1.0),
    "end-to-end": Ablation(config=_following_layout("end-to-end"), stages=("end-to-end",)),
}


def train_ablation(
    name: str, budget: Budget, dataset: Dataset, out: Path, *, device: torch.device, workers: int = 1
) -> Bundle:
    """Train a variant, and the layout encoder of another that it uses, and export it; finished stages are kept."""
    ablation = ABLATIONS.get(name)
    if ablation is None:
        raise ConfigError(f"unknown variant '{name}'; choose one of: {', '.join(ABLATIONS)}")
    config, folder = ablation.config[budget], out / name
    data = TrainingData(dataset=dataset, validation_scenes=_VALIDATION_SCENES)
    common: dict[str, Any] = {"data": data, "device": device, "workers": workers}
    teacher = folder
    if ablation.layout_from is not None:
        teacher = out / ablation.layout_from
        _finish("layout", ABLATIONS[ablation.layout_from].config[budget], teacher, common)
    trained = False
    for stage in ablation.stages:
        trained |= _finish(stage, config, folder, common | ({"teacher": teacher} if stage == "image" else {}))
    bundle = folder / _BUNDLE
    if not trained and (bundle / MANIFEST_NAME).exists():
        return Bundle.open(bundle)
    return export_run(
        folder,
        bundle,
        name=name,
        version="1",
        notes={"budget": budget},
        layout_from=teacher,
        layout_only=ablation.stages == ("layout",),
        # Variants are compared after equal training, not at their best checkpoints.
        last=True,
    )


def _finish(stage: StageName, config: TrainConfig, folder: Path, arguments: dict[str, Any]) -> bool:
    """Train a stage to its end; return False if it already was."""
    path = folder / f"{stage}.pt"
    exists = path.exists()
    if exists:
        checkpoint = Checkpoint.load(path, stage=stage)
        steps = config.layout.steps if stage == "layout" else config.image.steps
        source = arguments["data"].source(config)
        if checkpoint.config == config and checkpoint.data == source.data and checkpoint.step >= steps:
            return False
    # The earlier export is out of date.
    (folder / _BUNDLE / MANIFEST_NAME).unlink(missing_ok=True)
    train_stage(stage, config, folder, resume=exists, **arguments)
    return True
