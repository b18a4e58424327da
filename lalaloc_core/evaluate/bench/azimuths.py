"""Accuracy of the image encoder by azimuth: walls and openings, in homes that training never draws."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.evaluate.runs.photograph_reading import read_azimuths
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Camera, Dataset
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.metrics import AzimuthMeasures, measure_azimuths, summarise_azimuths
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.render.profile import render_layout

_MAX_HOMES = 100


def bench_azimuths(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Measure walls and openings in furnished test and out-of-distribution homes, 4 spheres per home."""
    # Needs embree, from the extra `oracle`.
    from lalaloc_core.learn.data.synthetic.heldout import HeldoutScenes

    encoders = PhotographEncoder(bundle, threads=1)
    homes = min(homes, _MAX_HOMES)
    datasets = {"test": GeneratedScenes(homes=homes, textures=textures), "heldout": HeldoutScenes(homes=homes)}
    return {family: azimuth_figures(encoders, dataset) for family, dataset in datasets.items()}


def azimuth_figures(encoders: PhotographEncoder, dataset: Dataset) -> dict[str, Any]:
    """Return the `AzimuthSummary` of a test split, and its `confusion`: shares by true and predicted class."""
    (appearance,) = dataset.appearances
    measures = []
    for name in dataset.scenes("test"):
        scene = dataset.load(name)
        for camera in scene.cameras:
            image = camera.photographs[appearance].image(encoders.manifest.image_height, encoders.manifest.image_width)
            measures.append(_measure(encoders, scene.plan, camera, image))
    confusions = [measure.confusion for measure in measures if measure.confusion is not None]
    confusion = None
    if confusions:
        counts = np.sum(confusions, axis=0)
        shares = (counts / counts.sum(axis=1, keepdims=True).clip(1)).tolist()
        confusion = {
            true: dict(zip(OPENING_CLASSES, row, strict=True))
            for true, row in zip(OPENING_CLASSES, shares, strict=True)
        }
    return {**dataclasses.asdict(summarise_azimuths(measures, OPENING_CLASSES)), "confusion": confusion}


def _measure(
    encoders: PhotographEncoder, plan: FloorPlan, camera: Camera, image: UInt8[np.ndarray, "h w 3"]
) -> AzimuthMeasures:
    """Compare the predictions from a sphere with the plan around the camera."""
    log_m, log_scale, scores = read_azimuths(encoders, image, camera.camera_height_m)
    heading, room = np.array([camera.heading]), np.array([camera.room_index])
    pose = (camera.position_m[None], heading, room, plan.geometry, len(log_m), camera.camera_height_m)
    view = render_layout(*pose)
    return measure_azimuths([view.distance_m[0]], log_m, log_scale, view.kind[0], scores)
