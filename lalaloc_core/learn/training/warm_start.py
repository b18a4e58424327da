"""Trained weights from earlier runs and bundles: warm starts, the teacher of stage 2, and exports."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx
import safetensors.torch
import torch
from torch import Tensor, nn

from lalaloc_core.bundle import (
    DECODER_WEIGHTS,
    IMAGE_ONNX,
    IMAGE_WEIGHTS,
    LAYOUT_WEIGHTS,
    MANIFEST_NAME,
    VIEW_ONNX,
    VIEW_WEIGHTS,
    Bundle,
)
from lalaloc_core.configuration import build_config
from lalaloc_core.errors import BundleError, CheckpointError
from lalaloc_core.learn.training.checkpoint import Checkpoint, best_path
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.stages import build_layout_encoder
from lalaloc_core.nets import LayoutDecoder, LayoutNetwork, TrunkEncoderConfig

JOINT = "end-to-end"
_MODULES = {
    "layout": {"layout_encoder": LAYOUT_WEIGHTS, "decoder": DECODER_WEIGHTS},
    "image": {"image_encoder": IMAGE_WEIGHTS},
    "view": {"view_encoder": VIEW_WEIGHTS},
}
# ONNX files that hold the large weights of a network; bundles of earlier versions repeat them in the weights' file.
_NETWORKS = {IMAGE_WEIGHTS: IMAGE_ONNX, VIEW_WEIGHTS: VIEW_ONNX}
# Suffix of large weights in ONNX files, and prefix of the network in the exported module.
HALVED, _EXPORTED = ".half", "encoder."


@dataclass(frozen=True, kw_only=True)
class WarmStart:
    """Trained weights of one stage, and their origin for checkpoints and manifests, with the totals spent so far."""

    checkpoint: Checkpoint
    origin: dict[str, Any]

    def load_into(self, modules: dict[str, nn.Module]) -> None:
        """Load these weights into modules; modules without weights here stay unchanged."""
        for name, module in modules.items():
            if name in self.checkpoint.inference_weights:
                # Exported networks also hold constants that the module computes itself.
                constants = dict(module.named_buffers()).keys() - module.state_dict().keys()
                weights = self.checkpoint.inference_weights[name]
                try:
                    module.load_state_dict({key: weights[key] for key in weights.keys() - constants})
                except RuntimeError as error:
                    raise CheckpointError(f"cannot load the {name} of {self.origin}: {error}") from error


def has_views(folder: Path) -> bool:
    """Return whether a bundle or a run's folder has an encoder of views."""
    if (folder / MANIFEST_NAME).exists():
        return Bundle.open(folder).manifest.view is not None
    return (folder / "view.pt").exists()


def load_warm_start(folder: Path, stage: str, config: TrainConfig) -> WarmStart:
    """Load the weights of a stage from a bundle or a run's folder (its best checkpoint, if any)."""
    is_bundle = (folder / MANIFEST_NAME).exists()
    start = bundle_weights(Bundle.open(folder), stage) if is_bundle else _run_weights(folder, stage)
    check_same_networks(stage, config, start.checkpoint.config, str(folder))
    return start


def bundle_weights(bundle: Bundle, stage: str) -> WarmStart:
    """Load the weights of a stage from a bundle.

    Only networks and totals are read from the manifest, because manifests of older versions lack some settings.
    """
    manifest = bundle.manifest
    weights = {module: _state(bundle, file) for module, file in _MODULES[stage].items() if file in manifest.files}
    if not weights:
        raise CheckpointError(f"bundle '{bundle.folder}' has no weights of stage '{stage}'")
    config = TrainConfig.from_dict({"name": manifest.name, "architecture": manifest.architecture})
    config = config.with_networks(build_config(type(config.layout_sizes), manifest.layout_config))
    if manifest.image_config:
        config = config.with_networks(build_config(type(config.image_sizes), manifest.image_config))
    spent = manifest.training.get(stage) or manifest.training.get(JOINT) or {}
    origin = {"name": manifest.name, "version": manifest.version, "sha256": bundle.sha256, **_manifest_totals(spent)}
    return WarmStart(
        checkpoint=Checkpoint(stage=stage, config=config, weights=weights, begun_from=origin), origin=origin
    )


def _run_weights(folder: Path, stage: str) -> WarmStart:
    checkpoint = find_checkpoint(stage, folder)
    origin = {"run": folder.resolve().name, **training_totals(checkpoint)}
    if checkpoint.begun_from:
        origin["begun_from"] = checkpoint.begun_from
    return WarmStart(checkpoint=checkpoint, origin=origin)


def training_totals(checkpoint: Checkpoint) -> dict[str, float]:
    """Return the minutes, and for images the spheres, spent on the weights of a stage, ancestors included."""
    before = _with_new_names(checkpoint.begun_from)
    minutes = checkpoint.seconds / 60.0 + before.get("minutes_in_all", 0.0)
    totals: dict[str, float] = {"minutes_in_all": round(minutes, 1)}
    if checkpoint.stage != "layout":
        totals["spheres_in_all"] = sphere_count(checkpoint) + before.get("spheres_in_all", 0)
    return totals


def halved(checkpoint: Checkpoint) -> Checkpoint:
    """Return a checkpoint with its inference weights alone, in half precision, to start other runs from."""
    weights = {
        module: {name: value.half() if value.is_floating_point() else value for name, value in state.items()}
        for module, state in checkpoint.inference_weights.items()
    }
    return dataclasses.replace(checkpoint, weights=weights, averaged={}, optimiser={})


def mean_with(checkpoint: Checkpoint, earlier: Checkpoint, share: float) -> Checkpoint:
    """Return a checkpoint with the mean of its inference weights, which count by `share`, and those of an earlier one.

    A network that was trained further often reads other pictures best half way (Wortsman et al., CVPR 2022). Weights
    that the earlier one lacks, and counters, stay.
    """
    weights = {module: dict(state) for module, state in checkpoint.inference_weights.items()}
    for module, state in weights.items():
        for name, before in earlier.inference_weights[module].items():
            if name in state and before.shape != state[name].shape:
                raise CheckpointError(
                    f"'{name}' has the shape {tuple(state[name].shape)}, before {tuple(before.shape)}"
                )
            if name in state and before.is_floating_point():
                state[name] = torch.lerp(before.float(), state[name].float(), share)
    return dataclasses.replace(checkpoint, weights=weights, averaged={}, optimiser={})


def sphere_count(checkpoint: Checkpoint) -> int:
    """Return the number of distinct spheres used by a stage."""
    image = checkpoint.config.image
    return checkpoint.step * image.batch // image.uses_per_sphere


def _manifest_totals(spent: dict[str, Any]) -> dict[str, float]:
    """Return a stage's totals from its manifest entry, ancestors included."""
    totals, spent = {}, _with_new_names(spent)
    for name in ("minutes", "spheres"):
        in_all = spent.get(f"{name}_in_all", spent.get(name))
        totals |= {} if in_all is None else {f"{name}_in_all": in_all}
    return totals


def _with_new_names(spent: dict[str, Any]) -> dict[str, Any]:
    return {_EARLIER_KEYS.get(name, name): value for name, value in spent.items()}


_EARLIER_KEYS = {"panoramas": "spheres", "panoramas_in_all": "spheres_in_all"}


def halved_weights(network: bytes) -> dict[str, Tensor]:
    """Return the weights that an exported network holds in half precision, by their names in torch."""
    return {
        tensor.name.removeprefix(_EXPORTED).removesuffix(HALVED): torch.from_numpy(
            onnx.numpy_helper.to_array(tensor).copy()
        )
        for tensor in onnx.load_from_string(network).graph.initializer
        if tensor.name.endswith(HALVED)
    }


def _state(bundle: Bundle, file: str) -> dict[str, Tensor]:
    state = halved_weights(bundle.read(_NETWORKS[file])) if file in _NETWORKS else {}
    try:
        state |= safetensors.torch.load(bundle.read(file))
    except safetensors.SafetensorError as error:
        raise BundleError(f"weights are not valid safetensors: {error}") from error
    return {key: value.float() if value.is_floating_point() else value for key, value in state.items()}


def check_same_networks(stage: str, config: TrainConfig, trained: TrainConfig, where: str) -> None:
    """Check that the networks of a stage are the same; the layout branches of `ring` and `trunk` are."""
    parts: dict[str, tuple[object, object]] = {"architecture": (config.architecture, trained.architecture)}
    if stage == "layout" and config.has_ring == trained.has_ring:
        parts = {}
    parts["ring" if config.has_ring else config.architecture] = (config.layout_sizes, trained.layout_sizes)
    if stage != "layout":
        found, modes = trained.image_sizes, getattr(config.image_sizes, "modes", 1)
        if isinstance(found, TrunkEncoderConfig) and found.modes == 1:
            # A single mode can start several.
            found = dataclasses.replace(found, modes=modes)
        parts[config.architecture] = (config.image_sizes, found)
    for part, (configured, found) in parts.items():
        if configured != found:
            raise CheckpointError(
                f"'{where}' was trained with {part} {found}; this run is configured with {configured}"
            )


def find_checkpoint(stage: str, folder: Path, *, last: bool = False) -> Checkpoint:
    """Load the best checkpoint, or the last one, with the networks of a stage, possibly that of end-to-end training."""
    own, joint = folder / f"{stage}.pt", folder / f"{JOINT}.pt"
    if own.exists() and joint.exists():
        raise CheckpointError(f"'{folder}' holds both '{own.name}' and '{joint.name}'; remove one of them")
    path = joint if joint.exists() else own
    best = best_path(path)
    return Checkpoint.load(best if best.exists() and not last else path, stage=path.stem)


def trained_layout_encoder(checkpoint: Checkpoint) -> LayoutNetwork:
    """Return the layout encoder of a checkpoint."""
    encoder = build_layout_encoder(checkpoint.config)
    encoder.load_state_dict(checkpoint.inference_weights["layout_encoder"])
    return encoder


def trained_decoder(checkpoint: Checkpoint) -> LayoutDecoder | None:
    """Return the decoder that was trained with the layout encoder of a checkpoint; None if there is none."""
    if "decoder" not in checkpoint.inference_weights:
        return None
    decoder = LayoutDecoder(checkpoint.config.layout_sizes.latent_size)
    decoder.load_state_dict(checkpoint.inference_weights["decoder"])
    return decoder
