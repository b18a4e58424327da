"""Photographs of real rooms with targets for their walls and openings: annotated, or predicted by teachers.

Three sources give targets. Annotations are exact. A segmenter sees doors and windows, but no passages. An encoder of
spheres sees the whole room, so it reads walls far better than an encoder of views can from a part of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from lalaloc_core.bundle import MANIFEST_NAME, Bundle
from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import ConfigError, DatasetError, InvalidPhotographError
from lalaloc_core.learn.data.annotated import annotation_files
from lalaloc_core.learn.data.annotations import CAMERA_HEIGHT_M, AnnotatedPhotograph, read_annotation
from lalaloc_core.learn.training.photograph_batches import Photographs
from lalaloc_core.learn.training.segmenter import SPHERE_ROWS, load_segmenter, read_walls_and_openings
from lalaloc_core.learn.training.warm_start import bundle_weights
from lalaloc_core.nets.sphere_network import TrunkImageEncoder
from lalaloc_core.photograph.spheres import read_sphere

# Turns of a sphere whose predictions the teacher averages, each also mirrored.
_TURNS = 8


def load_photographs(folders: Sequence[Path], teachers: Sequence[Path], height: int, width: int) -> Photographs:
    """Read the spheres (`*.jpg`, `*.jpeg`, `*.png`) of folders with their targets.

    Spheres with an annotation beside them use that; the others need teachers: a TensorFlow Lite segmenter, a bundle
    whose encoder of spheres reads them, or both. With both the walls and passages are the encoder's, and doors and
    windows the mean of the two.
    """
    parts = []
    for folder in folders:
        annotated = {
            photograph.photograph.path.name: photograph for photograph in map(read_annotation, annotation_files(folder))
        }
        paths = sorted(path for pattern in ("*.jpg", "*.jpeg", "*.png") for path in folder.glob(pattern))
        if not paths:
            raise DatasetError("no photographs (*.jpg, *.jpeg, *.png)", path=folder)
        exact = [annotated[path.name] for path in paths if path.name in annotated]
        if exact:
            parts.append(_annotated(exact, folder, height, width))
        if len(exact) < len(paths):
            others = [path for path in paths if path.name not in annotated]
            parts.append(_taught(others, teachers, height, width))
    return Photographs(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(Photographs)))


def _annotated(photographs: Sequence[AnnotatedPhotograph], folder: Path, height: int, width: int) -> Photographs:
    images = _read([folder / photograph.photograph.path.name for photograph in photographs], height, width)
    kinds = torch.from_numpy(np.stack([photograph.classes(width) for photograph in photographs]))
    distance = np.stack([photograph.profile_m(0, width) for photograph in photographs]) / CAMERA_HEIGHT_M
    openings = torch.nn.functional.one_hot(kinds, len(OPENING_CLASSES))[..., 1:].float()
    return Photographs(images, openings, torch.from_numpy(np.log(distance)).float())


def _taught(paths: Sequence[Path], teachers: Sequence[Path], height: int, width: int) -> Photographs:
    bundles = [path for path in teachers if (path / MANIFEST_NAME).exists()]
    segmenters = [path for path in teachers if path not in bundles]
    if not teachers or max(len(bundles), len(segmenters)) > 1:
        raise ConfigError(
            f"{len(paths)} photographs without annotation need one segmenter (--teacher FILE), one bundle "
            f"(--teacher DIR), or one of each; {len(segmenters)} and {len(bundles)} are given"
        )
    targets = []
    for path in segmenters:
        segment = load_segmenter(path)
        large = _read(paths, SPHERE_ROWS, 2 * SPHERE_ROWS)
        readings = [read_walls_and_openings(picture.numpy(), segment, width) for picture in large]
        openings = torch.from_numpy(np.stack([reading.openings for reading in readings]))
        openings = torch.cat([openings, torch.full_like(openings[..., :1], torch.nan)], dim=2)
        distance = torch.from_numpy(np.stack([reading.log_distance for reading in readings]))
        targets.append((openings, distance))
    for path in bundles:
        encoder = _load_encoder(path)
        targets.append(read_by_encoder(encoder, _read(paths, *_size(encoder)), width))
    openings, log_distance = targets[-1]
    if len(targets) == 2:
        shared = 0.5 * (targets[0][0][..., :2] + openings[..., :2])
        openings = torch.cat([shared, openings[..., 2:]], dim=2)
    return Photographs(_read(paths, height, width), openings, log_distance)


@torch.no_grad()
def read_by_encoder(
    encoder: TrunkImageEncoder, spheres: UInt8[Tensor, "n h w 3"], width: int
) -> tuple[Float[Tensor, "n w 3"], Float[Tensor, "n w"]]:
    """Return openings and log distances of spheres in `width` columns, as `Photographs` has them.

    They are the medians and means over turned and mirrored pictures.
    """
    openings, distances = [], []
    for mirrored in (False, True):
        for turn in range(_TURNS):
            shift = turn * spheres.shape[2] // _TURNS
            shown = spheres.roll(shift, 2).flip(2) if mirrored else spheres.roll(shift, 2)
            features = encoder(shown, torch.ones(len(spheres)))
            assert features.structure is not None
            share = torch.softmax(features.structure.opening_logits, dim=2)[..., 1:]
            distance = features.walls.likeliest
            if mirrored:
                share, distance = share.flip(1), distance.flip(1)
            back = -turn * distance.shape[1] // _TURNS
            openings.append(share.roll(back, 1))
            distances.append(distance.roll(back, 1))
    repeats = width // distances[0].shape[1]
    mean, median = torch.stack(openings).mean(dim=0), torch.stack(distances).median(dim=0).values
    return mean.repeat_interleave(repeats, dim=1), median.repeat_interleave(repeats, dim=1)


def _load_encoder(folder: Path) -> TrunkImageEncoder:
    start = bundle_weights(Bundle.open(folder), "image")
    config = start.checkpoint.config
    if config.architecture != "trunk":
        raise ConfigError(f"teacher '{folder}' has architecture '{config.architecture}'; 'trunk' is required")
    encoder = TrunkImageEncoder(config.trunk, config.ring)
    start.load_into({"image_encoder": encoder})
    return encoder.eval()


def _size(encoder: TrunkImageEncoder) -> tuple[int, int]:
    return encoder.config.image_height, encoder.config.image_width


def _read(paths: Sequence[Path], height: int, width: int) -> UInt8[Tensor, "n h w 3"]:
    images = []
    for path in paths:
        try:
            images.append(read_sphere(path.read_bytes(), height=height, width=width))
        except (OSError, InvalidPhotographError) as error:
            raise DatasetError(f"cannot be read: {error}", path=path) from error
    return torch.from_numpy(np.stack(images))
