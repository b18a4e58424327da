"""The export of a training run: the weights that its stages left, as one model bundle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lalaloc_core.learn.export.bundle_export import export_again, export_bundle
from lalaloc_core.learn.training.best import best_path
from lalaloc_core.learn.training.checkpoint import Checkpoint
from lalaloc_core.learn.training.stages import build_image_encoder
from lalaloc_core.learn.training.trained_networks import load_decoder_of, load_layout_encoder_of
from lalaloc_core.learn.training.warm_start import (
    JOINT,
    check_same_networks,
    checkpoint_with,
    panoramas,
    totals,
    weights_of_bundle,
)
from lalaloc_core.localise.bundle import IMAGE_WEIGHTS, LAYOUT_WEIGHTS, Bundle
from lalaloc_core.nets import load_layout_encoder


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
    """Export what training left in `folder` to a bundle at `out`, with the decoder where one was trained.

    Args:
        layout_from: folder of the run whose layout encoder the image encoder was trained against; default: `folder`.
        layout_only: there is no image encoder, and the bundle answers layout queries only.
        last: take the last weights of the run, not the best by validation. Of two stages this is the second: it has
            learnt to follow the best layout encoder.

    Raises:
        CheckpointError: a stage has not run there, or the branches do not belong together.
        ExportError: the exported networks differ from torch.
    """
    teacher = layout_from or folder
    # Branches that were trained together are taken from one moment.
    last_layout = last and (layout_only or (teacher / f"{JOINT}.pt").exists())
    layout = checkpoint_with("layout", teacher, last=last_layout)
    image = None if layout_only else checkpoint_with("image", folder, last=last)
    training: dict[str, Any] = {layout.stage: _summary(layout, teacher, last=last_layout)}
    image_encoder = None
    if image is not None:
        check_same_networks("layout", image.config, layout.config, str(teacher))
        image_encoder = build_image_encoder(image.config)
        image_encoder.load_state_dict(image.inference_weights["image_encoder"])
        training[image.stage] = {**_summary(image, folder, last=last), "panoramas": panoramas(image)}
    return export_bundle(
        out,
        (image or layout).config,
        load_layout_encoder_of(teacher, last=last_layout),
        image_encoder,
        load_decoder_of(teacher, last=last_layout),
        name=name,
        version=version,
        training={**training, **(notes or {})},
    )


def export_bundle_again(folder: Path) -> Bundle:
    """Write the ONNX networks of the bundle in `folder` anew, where the exporter has learnt something since.

    Raises:
        BundleError: there is none, or it is damaged.
        ExportError: the exported networks differ from torch; the bundle is untouched.
    """
    bundle = Bundle.open(folder)
    bundle.check()
    manifest, image_encoder = bundle.manifest, None
    stage = "image" if IMAGE_WEIGHTS in manifest.files else "layout"
    found = weights_of_bundle(bundle, stage)
    if stage == "image":
        image_encoder = build_image_encoder(found.checkpoint.config)
        found.load_into({"image_encoder": image_encoder})
    layout_encoder = load_layout_encoder(manifest.architecture, manifest.layout_config, bundle.read(LAYOUT_WEIGHTS))
    return export_again(bundle, found.checkpoint.config, layout_encoder, image_encoder)


def _summary(checkpoint: Checkpoint, folder: Path, *, last: bool) -> dict[str, Any]:
    """What a manifest says of a stage; steps and minutes are those until the chosen checkpoint."""
    summary: dict[str, Any] = {"steps": checkpoint.step, "minutes": round(checkpoint.seconds / 60.0, 1)}
    summary |= checkpoint.metrics
    path = folder / f"{checkpoint.stage}.pt"
    if best_path(path).exists():
        chosen = {"checkpoint": "last" if last else "best by validation"}
        summary |= {**chosen, "minutes_of_run": round(Checkpoint.load(path).seconds / 60.0, 1)}
    if checkpoint.data:
        summary["data"] = checkpoint.data
    if checkpoint.begun_from:
        summary |= {"begun_from": checkpoint.begun_from, **totals(checkpoint)}
    return summary
