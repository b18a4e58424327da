"""Export of a training run, or of an existing bundle's weights, to a model bundle."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from lalaloc_core.bundle import IMAGE_ONNX, IMAGE_WEIGHTS, LAYOUT_WEIGHTS, Bundle
from lalaloc_core.errors import CheckpointError
from lalaloc_core.learn.export.bundle_export import (
    add_view_encoder,
    export_bundle,
    reexport_networks,
    replace_image_encoder,
    slim_weights,
)
from lalaloc_core.learn.training import warm_start
from lalaloc_core.learn.training.checkpoint import Checkpoint, best_path
from lalaloc_core.learn.training.stages import build_image_encoder
from lalaloc_core.nets import ImageEncoder, ViewNetwork, load_layout_encoder


def export_run(
    folder: Path,
    out: Path,
    *,
    name: str,
    version: str,
    notes: dict[str, Any] | None = None,
    layout_from: Path | None = None,
    layout_only: bool = False,
    last: bool = False,
) -> Bundle:
    """Export a training run to a bundle, with its decoder if it has one.

    `notes` are additional entries of the manifest's `training`, and `layout_from` is the run folder of the layout
    encoder used as teacher (default: `folder`). A `layout_only` bundle answers layout queries only. `last` exports the
    last weights instead of the best by validation; with two stages this applies to the image encoder, because its
    teacher was the best layout encoder.
    """
    teacher = layout_from or folder
    # Branches trained together are exported from the same step.
    last_layout = last and (layout_only or (teacher / f"{warm_start.JOINT}.pt").exists())
    layout = warm_start.find_checkpoint("layout", teacher, last=last_layout)
    image = None if layout_only else warm_start.find_checkpoint("image", folder, last=last)
    training: dict[str, Any] = {layout.stage: _summary(layout, teacher, last=last_layout)}
    image_encoder = None
    if image is not None:
        warm_start.check_same_networks("layout", image.config, layout.config, str(teacher))
        image_encoder = _image_encoder(image)
        training[image.stage] = {**_summary(image, folder, last=last), "spheres": warm_start.sphere_count(image)}
    return export_bundle(
        out,
        (image or layout).config,
        warm_start.trained_layout_encoder(layout),
        image_encoder,
        warm_start.trained_decoder(layout),
        name=name,
        version=version,
        training={**training, **(notes or {})},
    )


def export_into(
    bundle: Path, folder: Path, out: Path, *, version: str, notes: dict[str, Any] | None = None, last: bool = False
) -> Bundle:
    """Copy a bundle with the encoder of spheres, of views, or both, that were trained in `folder`, in place of its own.

    The copy keeps the fitted evidence and confidence, which should be fitted again.
    """
    stages = [stage for stage in ("image", "view") if (folder / f"{stage}.pt").exists()]
    if not stages:
        raise CheckpointError(f"'{folder}' has no checkpoint of stage 'image' or 'view'")
    origin = Bundle.open(bundle)
    layout = warm_start.bundle_weights(origin, "layout").checkpoint.config
    checkpoints = [warm_start.find_checkpoint(stage, folder, last=last) for stage in stages]
    for checkpoint in checkpoints:
        warm_start.check_same_networks("layout", checkpoint.config, layout, str(bundle))
    out.mkdir(parents=True, exist_ok=True)
    for name in origin.manifest.files:
        content = origin.read(name)
        # Bundles of earlier versions repeat the network's weights.
        (out / name).write_bytes(slim_weights(content, origin.read(IMAGE_ONNX)) if name == IMAGE_WEIGHTS else content)
    training = {**origin.manifest.training, **(notes or {})}
    manifest = dataclasses.replace(origin.manifest, version=version, training=training)
    made = dataclasses.replace(origin, folder=out, manifest=manifest)
    for checkpoint in checkpoints:
        config, summary = checkpoint.config, _summary(checkpoint, folder, last=last)
        if checkpoint.stage == "view":
            view_encoder = ViewNetwork(config.view, config.ring)
            view_encoder.load_state_dict(checkpoint.inference_weights["view_encoder"])
            made = add_view_encoder(made, config, view_encoder, summary)
        else:
            summary["spheres"] = warm_start.sphere_count(checkpoint)
            made = replace_image_encoder(made, config, _image_encoder(checkpoint), summary)
    return made


def reexport_bundle(folder: Path) -> Bundle:
    """Export the ONNX networks of the bundle in `folder` again, for example after the exporter has improved."""
    bundle = Bundle.open(folder)
    bundle.check()
    manifest, image_encoder = bundle.manifest, None
    stage = "image" if IMAGE_WEIGHTS in manifest.files else "layout"
    start = warm_start.bundle_weights(bundle, stage)
    if stage == "image":
        image_encoder = build_image_encoder(start.checkpoint.config)
        start.load_into({"image_encoder": image_encoder})
    layout_encoder = load_layout_encoder(manifest.architecture, manifest.layout_config, bundle.read(LAYOUT_WEIGHTS))
    return reexport_networks(bundle, start.checkpoint.config, layout_encoder, image_encoder)


def _image_encoder(checkpoint: Checkpoint) -> ImageEncoder:
    encoder = build_image_encoder(checkpoint.config)
    encoder.load_state_dict(checkpoint.inference_weights["image_encoder"])
    return encoder


def _summary(checkpoint: Checkpoint, folder: Path, *, last: bool) -> dict[str, Any]:
    """Return the manifest entry of a stage; steps and minutes are those of the exported checkpoint."""
    summary: dict[str, Any] = {"steps": checkpoint.step, "minutes": round(checkpoint.seconds / 60.0, 1)}
    summary |= checkpoint.metrics
    path = folder / f"{checkpoint.stage}.pt"
    if best_path(path).exists():
        chosen = {"checkpoint": "last" if last else "best by validation"}
        summary |= {**chosen, "minutes_of_run": round(Checkpoint.load(path).seconds / 60.0, 1)}
    if checkpoint.data:
        summary["data"] = checkpoint.data
    if checkpoint.begun_from:
        summary |= {"begun_from": checkpoint.begun_from, **warm_start.training_totals(checkpoint)}
    return summary
