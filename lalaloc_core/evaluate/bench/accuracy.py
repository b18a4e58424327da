"""Accuracy and confidence of the shipped model on homes that training never draws."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lalaloc_core.conditions import CONDITIONS
from lalaloc_core.conventions import OPENING_CLASSES, WALL_CODE, wrap_angle
from lalaloc_core.evaluate.bench.measured import Setting, evaluate
from lalaloc_core.evaluate.calibrate.measured_errors import outcomes_of, predicted_shares
from lalaloc_core.evaluate.methods.method import QueryKind
from lalaloc_core.evaluate.runs.photograph_reading import read_azimuths
from lalaloc_core.evaluate.runs.predictions import Prediction, RunInfo
from lalaloc_core.evaluate.runs.score import StageScores, score
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data import Camera, Dataset, HeldoutScenes, Scene, Stated, cut_view, encode_jpeg
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.dataset_names import HELDOUT_HOMES
from lalaloc_core.learn.metrics import AzimuthMeasures, confusion_shares, measure_azimuths, summarise_azimuths
from lalaloc_core.localise.belief import CONFIDENT
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.localisability.predicted_localisability import errors_of
from lalaloc_core.localise.match import layouts_at
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.photograph import StatedCamera
from lalaloc_core.photograph.cameras import Perspective
from lalaloc_core.render.sampling import PoseSet
from lalaloc_core.render.sweep import sweep_layouts

# Limits for minor figures, for those that repeat their queries six times, and for spots that are localised six times.
_MINOR_HOMES, _REPEATED_HOMES, _SPOT_HOMES = 100, 50, 65
_RESAMPLES = 2000
_SHOWN = ("median_cm", "within_1cm", "within_5cm", "within_10cm", "within_1m")
_HEADINGS = {"known_heading": True, "unknown_heading": False}


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """Queries for the model, 4 in each of at most `max_homes` homes.

    `generator` is that of the homes: "copies" are plans of four copies of a home that differ in their doors, "heldout"
    the out-of-distribution homes. `view_deg` is the field of view of the photographs, None for spheres, and `stated`
    what is known of it. `settings` are those of method "lalaloc".
    """

    kind: QueryKind = "photograph"
    furniture: str = "full"
    heading_known: bool = True
    generator: str = "synth"
    view_deg: float | None = None
    stated: Stated = "field"
    settings: Mapping[str, Any] = field(default_factory=dict)
    max_homes: int = 10_000

    def run(self, setting: Setting) -> list[Prediction]:
        """Return the predictions."""
        homes, textures = min(setting.homes, self.max_homes), setting.textures
        generated: dict[str, Any] = {"generator": self.generator, "homes": homes}
        if self.generator == "heldout":
            generated["homes"] = min(homes, HELDOUT_HOMES)
        else:
            generated |= {"furniture": self.furniture, "textures": None if textures is None else str(textures)}
        info = RunInfo(
            label=f"{self.kind}, {self.generator}, {self.furniture}",
            kind=self.kind,
            dataset="generated homes",
            split="test",
            settings=dict(self.settings),
            generated=generated,
            views=None if self.view_deg is None else {"field_deg": self.view_deg, "stated": self.stated},
            bundle=str(setting.bundle.folder),
            furniture=self.furniture,
            heading_known=self.heading_known,
        )
        return evaluate(info)


def _view(view_deg: float, *, heading_known: bool = False, **changes: Any) -> Benchmark:
    return Benchmark(view_deg=view_deg, heading_known=heading_known, max_homes=_MINOR_HOMES, **changes)


def _by_heading(settings: Mapping[str, Mapping[str, Any]], **changes: Any) -> dict[str, dict[str, Benchmark]]:
    """Return benchmarks by row of settings and heading. Terms that a plan or a model lacks have no effect."""
    return {
        name: {heading: Benchmark(settings=row, heading_known=known, **changes) for heading, known in _HEADINGS.items()}
        for name, row in settings.items()
    }


_TERMS: Mapping[str, Mapping[str, Any]] = {
    "all": {},
    "without_openings": {"openings": False},
    "without_see_through": {"see_through": False},
    "without_ceiling": {"ceiling": False},
    "without_room_type": {"room_type": False},
    "walls_alone": {"openings": False, "see_through": False, "ceiling": False, "room_type": False},
}
_OF_COPIES = ("all", "without_openings")
# Benchmarks, or groups of them, by group and row.
GROUPS: Mapping[str, Mapping[str, Any]] = {
    "accuracy": {
        "layout": Benchmark(kind="layout"),
        "sphere_full": Benchmark(),
        "sphere_empty": Benchmark(furniture="empty", max_homes=_MINOR_HOMES),
        "sphere_full_unknown_heading": Benchmark(heading_known=False),
        "heldout_full": Benchmark(generator="heldout"),
        "heldout_full_unknown_heading": Benchmark(generator="heldout", heading_known=False),
    },
    "views": {
        "view_60_unknown_heading": _view(60.0),
        "view_80_unknown_heading": _view(80.0),
        "view_80_known_tilt": _view(80.0, stated="tilt"),
        "view_80_unknown_field": _view(80.0, stated="nothing"),
        "view_80_heading_within_10_deg": _view(80.0, heading_known=True, settings={"heading_error_deg": 10.0}),
        "view_106_unknown_heading": _view(106.0),
        "heldout_view_80_unknown_heading": _view(80.0, generator="heldout"),
        "heldout_view_106_unknown_heading": _view(106.0, generator="heldout"),
    },
    "evidence": _by_heading(
        {term: {"evidence": term} for term in ("latent", "profile", "both")}, max_homes=_REPEATED_HOMES
    ),
    "terms": {"test": _by_heading(_TERMS), "heldout": _by_heading(_TERMS, generator="heldout")},
    "heights": {
        "test": _by_heading(
            {
                "right": {},
                "20_cm_too_high": {"camera_height_error_m": 0.2},
                "20_cm_too_low": {"camera_height_error_m": -0.2},
                "unknown": {"camera_height": "unknown"},
            }
        )
    },
    "copies": {
        "test": _by_heading({name: _TERMS[name] for name in _OF_COPIES}, generator="copies", max_homes=_MINOR_HOMES)
    },
}


def measure(rows: Mapping[str, Any], setting: Setting) -> dict[str, Any]:
    """Return the figures of benchmarks, nested as they are."""
    return {
        name: summarise(row.run(setting)) if isinstance(row, Benchmark) else measure(row, setting)
        for name, row in rows.items()
    }


def summarise(predictions: list[Prediction]) -> dict[str, Any]:
    """Return the figures of some predictions that tables show."""
    scores = score(predictions)

    def figures(stage: StageScores) -> dict[str, float]:
        return {name: getattr(stage, name).value for name in _SHOWN}

    interval = scores.final.within_1m
    return {
        "n": scores.n,
        **figures(scores.final),
        "within_1m_interval": [interval.low, interval.high],
        "within_1m_30deg": scores.final.within_1m_30deg.value,
        "among_5": float(np.mean([_is_among(prediction, 5) for prediction in predictions])),
        "retrieval": figures(scores.stages["retrieval"]),
        "correct_room": scores.final.correct_room.value,
        "heading_within_2deg": scores.final.heading_within_2deg.value,
        "median_ms": scores.median_ms,
        "expected_calibration_error": scores.calibration_error,
    }


def _is_among(prediction: Prediction, count: int) -> bool:
    """Return whether one of the first candidates is within 1 m of the truth."""
    poses = [candidate.pose for candidate in prediction.candidates[:count]]
    return any(math.dist(pose.position_m, prediction.truth.position_m) < 1.0 for pose in poses)


def bench_azimuths(setting: Setting) -> dict[str, Any]:
    """Measure walls and openings in furnished test and out-of-distribution homes, 4 spheres per home."""
    encoders = PhotographEncoder(setting.bundle, threads=1)
    homes = min(setting.homes, _MINOR_HOMES)
    heldout = HeldoutScenes(homes=min(homes, HELDOUT_HOMES))
    datasets = {"test": GeneratedScenes(homes=homes, textures=setting.textures), "heldout": heldout}
    return {family: azimuth_figures(encoders, dataset) for family, dataset in datasets.items()}


def azimuth_figures(encoders: PhotographEncoder, dataset: Dataset) -> dict[str, Any]:
    """Return the `AzimuthSummary` of a test split, and its `confusion`: shares by true and predicted class."""
    scenes = map(dataset.load, dataset.scenes("test"))
    measures = [_measured(encoders, scene, camera) for scene in scenes for camera in scene.cameras]
    confusion = None
    if (shares := confusion_shares(measures)) is not None:
        rows = zip(OPENING_CLASSES, shares, strict=True)
        confusion = {true: dict(zip(OPENING_CLASSES, row, strict=True)) for true, row in rows}
    return {**dataclasses.asdict(summarise_azimuths(measures, OPENING_CLASSES)), "confusion": confusion}


def _measured(encoders: PhotographEncoder, scene: Scene, camera: Camera) -> AzimuthMeasures:
    """Compare the predictions from the only sphere of a camera with the plan around it."""
    (photograph,) = camera.photographs.values()
    image = photograph.image(encoders.manifest.image_height, encoders.manifest.image_width)
    log_m, log_scale, scores = read_azimuths(encoders, image, camera.camera_height_m)
    heading, room = np.array([camera.heading]), np.array([camera.room_index])
    place = camera.position_m[None], heading, room
    view = sweep_layouts(*place, scene.plan.wall_table, len(log_m), camera.camera_height_m)
    return measure_azimuths([view.distance_m[0]], log_m, log_scale, view.kind[0].astype(int), scores)


def bench_localisability(setting: Setting) -> dict[str, Any]:
    """Compare the share of photographs that the model finds with the share that the plan alone predicts.

    In furnished test homes, with 4 spots each. `interval` is the 95 % interval of the predicted minus the found share,
    by resampling homes.
    """
    manifest, homes = setting.bundle.manifest, min(setting.homes, _SPOT_HOMES)
    outcomes = outcomes_of(setting.bundle, homes, "test", setting.textures)
    predicted = predicted_shares(manifest, errors_of(manifest), [outcome.spot for outcome in outcomes])
    rng, rows = np.random.default_rng(0), dict[str, Any]()
    for name in CONDITIONS:
        found = np.array([float(outcome.found[name]) for outcome in outcomes])
        # Spots are sorted by home.
        by_home = (predicted[name] - found).reshape(homes, -1).mean(axis=1)
        means = by_home[rng.integers(homes, size=(_RESAMPLES, homes))].mean(axis=1)
        interval = np.quantile(means, (0.025, 0.975)).tolist()
        rows[name] = {"found": float(found.mean()), "predicted": float(predicted[name].mean()), "interval": interval}
    difference = [abs(row["found"] - row["predicted"]) for row in rows.values()]
    return {"n": len(outcomes), "mean_difference": float(np.mean(difference)), **rows}


_SPHERE_SIZE, _VIEW_SIZE = (512, 1024), (640, 480)
# Fields of view (degrees): of a blank wall, as it seldom fills more, and of the others; elevation of a ceiling.
_WALL_DEG, _FIELD_DEG, _CEILING_DEG = 50.0, 80.0, 60.0
_COLUMNS = 128


def bench_uninformative(setting: Setting) -> dict[str, Any]:
    """Measure how often photographs that cannot tell the place are believed, in test homes of 4 cameras each.

    A blank wall is the wall without openings that fills the view and is nearest, in unfurnished homes. A landscape is
    a textured ground below a sky, drawn for this.
    """
    model, manifest = setting.model, setting.bundle.manifest
    scenes = GeneratedScenes(homes=setting.homes, furniture="empty", textures=setting.textures)
    confidence: dict[str, list[float]] = {"blank_wall": [], "ceiling": [], "landscape": []}
    for name in scenes.scenes("test"):
        scene = scenes.load(name)
        for number, camera in enumerate(scene.cameras):
            height = CameraHeight(camera.camera_height_m)
            grid = model.grid(scene.plan, height.height_m)
            rng = np.random.default_rng([len(confidence["ceiling"]), number])
            for kind, (picture, field_deg) in _pictures(scene.plan, camera, rng).items():
                stated = StatedCamera(projection="perspective", hfov_deg=field_deg)
                query = model.encoder.query(model.open(encode_jpeg(picture), stated), None, height)
                answer = model.localise(scene.plan, grid, query)
                believed = answer.confidence(manifest.confidence_for(view=True))
                confidence[kind].append(math.nan if believed is None else believed.position)
    return {kind: _summary(found) for kind, found in confidence.items()}


def _pictures(
    plan: FloorPlan, camera: Camera, rng: np.random.Generator
) -> dict[str, tuple[UInt8[np.ndarray, "h w 3"], float]]:
    """Return the pictures at a place with their fields of view (degrees)."""
    (photograph,) = camera.photographs.values()
    sphere, azimuth = photograph.image(*_SPHERE_SIZE), float(rng.uniform(-math.pi, math.pi))
    shown = {
        "ceiling": (sphere, azimuth, _CEILING_DEG, _FIELD_DEG),
        "landscape": (landscape(rng), azimuth, 0.0, _FIELD_DEG),
    }
    if (blank := blank_azimuth(plan, camera)) is not None:
        shown["blank_wall"] = (sphere, blank, 0.0, _WALL_DEG)
    pictures = {}
    for kind, (pixels, towards, pitch_deg, field_deg) in shown.items():
        lens = Perspective.of_hfov(*_VIEW_SIZE, math.radians(field_deg))
        pictures[kind] = cut_view(pixels, lens, azimuth=towards, pitch=math.radians(pitch_deg), roll=0.0), field_deg
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
    azimuth = float(wrap_angle((best + 0.5) / _COLUMNS * 2.0 * math.pi - math.pi))
    return azimuth if np.isfinite(farthest[best]) else None


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
