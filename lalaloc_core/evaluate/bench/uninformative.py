"""Confidence of photographs that cannot tell the place: blank walls, ceilings and landscapes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import WALL_CODE, wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Camera
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.data.views import cut_view, encode_jpeg
from lalaloc_core.localise.belief import CONFIDENT
from lalaloc_core.localise.local_model import LocalModel
from lalaloc_core.localise.match import layouts_at
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.photograph import StatedCamera
from lalaloc_core.photograph.cameras import Perspective
from lalaloc_core.render.sampling import PoseSet

_SPHERE_SIZE, _VIEW_SIZE = (512, 1024), (640, 480)
# Fields of view (degrees): of a blank wall, as it seldom fills more, and of the others; elevation of a ceiling.
_WALL_DEG, _FIELD_DEG, _CEILING_DEG = 50.0, 80.0, 60.0
_COLUMNS = 128


def bench_uninformative(bundle: Bundle, homes: int, textures: Path | None) -> dict[str, Any]:
    """Measure how often photographs that cannot tell the place are believed, in test homes of 4 cameras each.

    A blank wall is the wall without openings that fills the view and is nearest, in unfurnished homes. A landscape is
    a textured ground below a sky, drawn for this.
    """
    model = LocalModel(bundle)
    scenes = GeneratedScenes(homes=homes, furniture="empty", textures=textures)
    confidence: dict[str, list[float]] = {"blank_wall": [], "ceiling": [], "landscape": []}
    for name in scenes.scenes("test"):
        scene = scenes.load(name)
        for number, camera in enumerate(scene.cameras):
            height = CameraHeight(camera.camera_height_m)
            grid = model.grid(scene.plan, height.height_m)
            rng = np.random.default_rng([len(confidence["ceiling"]), number])
            for kind, picture in _pictures(scene.plan, camera, rng).items():
                field_deg = _WALL_DEG if kind == "blank_wall" else _FIELD_DEG
                stated = StatedCamera(projection="perspective", hfov_deg=field_deg)
                query = model.encoder.query(model.open(encode_jpeg(picture), stated), None, height)
                answer = model.localise(scene.plan, grid, query)
                believed = answer.confidence(bundle.manifest.confidence_for(view=True))
                confidence[kind].append(math.nan if believed is None else believed.position)
    return {kind: _summary(found) for kind, found in confidence.items()}


def _pictures(plan: FloorPlan, camera: Camera, rng: np.random.Generator) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
    (photograph,) = camera.photographs.values()
    sphere = photograph.image(*_SPHERE_SIZE)
    wide = Perspective.of_hfov(*_VIEW_SIZE, math.radians(_FIELD_DEG))
    azimuth = float(rng.uniform(-math.pi, math.pi))
    pictures = {
        "ceiling": cut_view(sphere, wide, azimuth=azimuth, pitch=math.radians(_CEILING_DEG), roll=0.0),
        "landscape": cut_view(landscape(rng), wide, azimuth=azimuth, pitch=0.0, roll=0.0),
    }
    blank = blank_azimuth(plan, camera)
    if blank is not None:
        narrow = Perspective.of_hfov(*_VIEW_SIZE, math.radians(_WALL_DEG))
        pictures["blank_wall"] = cut_view(sphere, narrow, azimuth=blank, pitch=0.0, roll=0.0)
    return pictures


def blank_azimuth(plan: FloorPlan, camera: Camera) -> float | None:
    """Return the azimuth (radians, relative to the sphere's centre) of the nearest view without openings."""
    poses = PoseSet(camera.position_m[None], np.array([camera.room_index]))
    layouts = layouts_at(plan, poses, np.array([camera.heading]), _COLUMNS)
    half = math.ceil(_COLUMNS * _WALL_DEG / 720.0)
    around = (np.arange(_COLUMNS)[:, None] + np.arange(-half, half + 1)) % _COLUMNS
    farthest = layouts.log_profile[0][around].max(axis=1)
    if layouts.kind is not None:
        farthest[(layouts.kind[0][around] != WALL_CODE).any(axis=1)] = np.inf
    best = int(farthest.argmin())
    if not np.isfinite(farthest[best]):
        return None
    return float(wrap_angle((best + 0.5) / _COLUMNS * 2.0 * math.pi - math.pi))


def landscape(rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a sphere: sky above hills above a ground of patches, seen from 1.5 m."""
    height, width = _SPHERE_SIZE
    azimuth = (np.arange(width) + 0.5) / width * 2.0 * np.pi
    elevation = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    waves = rng.integers(2, 12, 6)[:, None] * azimuth + rng.uniform(0.0, 2.0 * np.pi, (6, 1))
    hills = 0.05 + 0.02 * np.sin(waves).sum(axis=0)
    sky = np.array([90, 140, 220]) + (1.0 - elevation.clip(0.0)[:, None] / (np.pi / 2.0)) * np.array([110, 80, 30])
    distance_m = 1.5 / np.tan(np.maximum(-elevation, 0.01))
    x, y = distance_m[:, None] * np.sin(azimuth), distance_m[:, None] * np.cos(azimuth)
    patches = rng.uniform(0.6, 1.2, (64, 64))[np.floor(x).astype(int) % 64, np.floor(y).astype(int) % 64]
    picture = np.broadcast_to(sky[:, None], (height, width, 3)).copy()
    picture[elevation[:, None] < hills] = np.array([60, 90, 50])
    below = elevation < 0.0
    picture[below] = patches[below][..., None] * rng.uniform(60.0, 150.0, 3)
    return picture.clip(0.0, 255.0).astype(np.uint8)


def _summary(confidence: list[float]) -> dict[str, float]:
    values = np.array(confidence)
    return {
        "n": len(values),
        "above_half": float((values > CONFIDENT).mean()),
        "median": float(np.median(values)),
        "highest": float(values.max()),
    }
