"""Warm starts: training that begins with the weights of a bundle or of another run, instead of random ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
from torch import Tensor, nn

from lalaloc_core.configuration import build_config
from lalaloc_core.errors import BundleError, CheckpointError
from lalaloc_core.learn.training.best import best_path
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.localise.bundle import DECODER_WEIGHTS, IMAGE_WEIGHTS, LAYOUT_WEIGHTS, MANIFEST_NAME, Bundle

JOINT = "end-to-end"
_MODULES = {"layout": {"layout_encoder": LAYOUT_WEIGHTS, "decoder": DECODER_WEIGHTS}}
_MODULES["image"] = {"image_encoder": IMAGE_WEIGHTS}


@dataclass(frozen=True, kw_only=True)
class WarmStart:
    """Trained weights of one stage.

    Attributes:
        checkpoint: the weights, in the form of a stage that trained them.
        origin: what checkpoints and manifests say of their origin; its minutes and panoramas are all that were spent.
    """

    checkpoint: Checkpoint
    origin: dict[str, Any]

    def load_into(self, modules: dict[str, nn.Module]) -> None:
        """Give modules these weights; one that was not trained there stays as it is.

        Raises:
            CheckpointError: a module has other shapes.
        """
        for name, module in modules.items():
            if name in self.checkpoint.inference_weights:
                try:
                    module.load_state_dict(self.checkpoint.inference_weights[name])
                except RuntimeError as error:
                    raise CheckpointError(f"cannot begin with the {name} of {self.origin}: {error}") from error


def load_warm_start(folder: Path, stage: str, config: TrainConfig) -> WarmStart:
    """The weights of a stage, "layout" or "image", in a bundle or a run's folder (its best, where that was kept).

    Raises:
        CheckpointError: no such weights there, or of other networks than `config` has.
        BundleError: the bundle is damaged.
    """
    is_bundle = (folder / MANIFEST_NAME).exists()
    found = weights_of_bundle(Bundle.open(folder), stage) if is_bundle else _of_run(folder, stage)
    check_same_networks(stage, config, found.checkpoint.config, str(folder))
    return found


def weights_of_bundle(bundle: Bundle, stage: str) -> WarmStart:
    """Of what a bundle was trained with only its networks and totals are taken: older manifests know fewer settings."""
    manifest = bundle.manifest
    weights = {module: _state(bundle.read(file)) for module, file in _MODULES[stage].items() if file in manifest.files}
    if not weights:
        raise CheckpointError(f"bundle '{bundle.folder}' has no weights of stage '{stage}'")
    config = TrainConfig.from_dict({"name": manifest.name, "architecture": manifest.architecture})
    config = config.with_networks(build_config(type(config.layout_sizes), manifest.layout_config))
    if manifest.image_config:
        config = config.with_networks(build_config(type(config.image_sizes), manifest.image_config))
    spent = manifest.training.get(stage) or manifest.training.get(JOINT) or {}
    origin = {"name": manifest.name, "version": manifest.version, "sha256": bundle.sha256, **_totals_of(spent)}
    return WarmStart(
        checkpoint=Checkpoint(stage=stage, config=config, weights=weights, begun_from=origin), origin=origin
    )


def _of_run(folder: Path, stage: str) -> WarmStart:
    checkpoint = checkpoint_with(stage, folder)
    origin = {"run": folder.resolve().name, **totals(checkpoint)}
    if checkpoint.begun_from:
        origin["begun_from"] = checkpoint.begun_from
    return WarmStart(checkpoint=checkpoint, origin=origin)


def totals(checkpoint: Checkpoint) -> dict[str, float]:
    """Minutes, and for panoramas their number, that the weights of a stage were trained for, ancestors included."""
    before = checkpoint.begun_from
    minutes = checkpoint.seconds / 60.0 + before.get("minutes_in_all", 0.0)
    found: dict[str, float] = {"minutes_in_all": round(minutes, 1)}
    if checkpoint.stage != "layout":
        found["panoramas_in_all"] = panoramas(checkpoint) + before.get("panoramas_in_all", 0)
    return found


def panoramas(checkpoint: Checkpoint) -> int:
    """How many panoramas a stage has learnt from, repeated ones counted once."""
    image = checkpoint.config.image
    return checkpoint.step * image.batch // image.uses_per_panorama


def _totals_of(spent: dict[str, Any]) -> dict[str, float]:
    """What a manifest says of a stage, and of its ancestors where it had any."""
    found = {}
    for name in ("minutes", "panoramas"):
        in_all = spent.get(f"{name}_in_all", spent.get(name))
        found |= {} if in_all is None else {f"{name}_in_all": in_all}
    return found


def _state(weights: bytes) -> dict[str, Tensor]:
    """Half precision is how bundles store weights; training is in single precision."""
    try:
        state = safetensors.torch.load(weights)
    except safetensors.SafetensorError as error:
        raise BundleError(f"weights that are no safetensors: {error}") from error
    return {key: value.float() if value.is_floating_point() else value for key, value in state.items()}


def check_same_networks(stage: str, config: TrainConfig, other: TrainConfig, where: str) -> None:
    """Both must agree on the networks of a stage; the image stage has those of both branches.

    The layout branches of `ring` and `trunk` are the same.

    Raises:
        CheckpointError: names what differs.
    """
    told: dict[str, tuple[object, object]] = {"architecture": (config.architecture, other.architecture)}
    if stage == "layout" and config.has_ring == other.has_ring:
        told = {}
    told["ring" if config.has_ring else config.architecture] = (config.layout_sizes, other.layout_sizes)
    if stage != "layout":
        told[config.architecture] = (config.image_sizes, other.image_sizes)
    for part, (mine, theirs) in told.items():
        if mine != theirs:
            raise CheckpointError(f"'{where}' was trained with {part} {theirs}, this run is configured with {mine}")


def checkpoint_with(stage: str, folder: Path, *, last: bool = False) -> Checkpoint:
    """The checkpoint that holds what a stage trains: its own, or that of end-to-end training.

    Args:
        last: take the last one even where the best by validation was kept.

    Raises:
        CheckpointError: neither is there, or both are.
    """
    own, joint = folder / f"{stage}.pt", folder / f"{JOINT}.pt"
    if own.exists() and joint.exists():
        raise CheckpointError(f"'{folder}' holds both '{own.name}' and '{joint.name}': which one to take?")
    path = joint if joint.exists() else own
    best = best_path(path)
    return Checkpoint.load(best if best.exists() and not last else path, stage=path.stem)
