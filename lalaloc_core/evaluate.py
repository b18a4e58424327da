"""Evaluation of a bundle on synthetic homes: the full path of a query, exactly as the service runs it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from tqdm import tqdm

from lalaloc_core.bundle import Bundle
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.optimise import LatentPoseOptimiser
from lalaloc_core.localise.pipeline import LocaliseConfig, Refiner, localise, panorama_heading
from lalaloc_core.localise.poses import Query
from lalaloc_core.localise.retrieval import build_grid
from lalaloc_core.metrics import Accuracy
from lalaloc_core.sampling import PoseSet
from lalaloc_core.synth.furniture import FurnitureLevel
from lalaloc_core.synth.materials import MaterialLibrary
from lalaloc_core.synth.panorama import PanoramaRenderer, Shot, sample_shots
from lalaloc_core.training.stream import home_of

GRID_STEP_M = 0.5
QueryKind = Literal["layout", "panorama"]


@dataclass(frozen=True, kw_only=True)
class QuerySet:
    """Which synthetic queries to ask.

    Attributes:
        split: a split of `training.stream`; training never draws homes of the others.
        homes, shots_per_home: how many queries; with 1.0 to 1.9 m camera height and every heading.
        furniture: one level, or None for all in equal shares.
    """

    split: int
    homes: int
    shots_per_home: int = 4
    seed: int = 0
    furniture: FurnitureLevel | None = "full"
    textures: Path | None = None

    def shots(self) -> Iterator[list[Shot]]:
        """The shots of one home after another."""
        for index in range(self.homes):
            home, rng = home_of(self.split, self.seed, index)
            yield sample_shots(home, self.shots_per_home, rng, self.furniture)


@dataclass(frozen=True, kw_only=True)
class QueryResult:
    """One query, answered. Distances in m, angles in radians."""

    furniture: str
    error_m: float
    retrieval_error_m: float
    heading_error: float
    correct_room: bool
    candidate_distances: tuple[float, ...]
    confidence: float | None
    timings_ms: dict[str, float]


def evaluate(
    encoders: Encoders,
    queries: QuerySet,
    *,
    kind: QueryKind,
    heading_known: bool,
    refiner: Refiner | None,
    config: LocaliseConfig | None = None,
) -> list[QueryResult]:
    """Answer every query and compare with the truth.

    Args:
        kind: "panorama" renders and encodes a photograph; "layout" asks with the true layout's own latent.
        heading_known: whether the query's heading is given.
    """
    manifest = encoders.manifest
    materials = MaterialLibrary.create(np.random.default_rng([queries.split, queries.seed]), queries.textures)
    renderer = PanoramaRenderer(materials, height=manifest.image_height, width=manifest.image_width)
    results = []
    for shots in tqdm(queries.shots(), total=queries.homes, desc=f"{kind} queries", mininterval=5.0):
        images = renderer.render(shots).cpu().numpy() if kind == "panorama" else [None] * len(shots)
        for shot, image in zip(shots, images, strict=True):
            if image is None:
                query = _layout_query(encoders, shot)
            else:
                query = encoders.query(image, shot.heading if heading_known else None, shot.camera_height_m)
            results.append(_answer(encoders, shot, query, refiner, config))
    return results


def local_refiner(bundle: Bundle) -> Refiner:
    """LPO in this process. Sets torch to one thread: its tensors are too small to share, and waiting costs more."""
    torch.set_num_threads(1)
    return LatentPoseOptimiser.from_bundle(bundle).refine


def _layout_query(encoders: Encoders, shot: Shot) -> Query:
    """The query whose latent is that of the true layout, seen at heading 0."""
    pose = PoseSet(shot.position_m[None], np.array([shot.room_index]))
    latents = encoders.poses(shot.home.plan, pose, np.zeros(1), shot.camera_height_m)
    return Query(latents, np.array([shot.heading]), 0.0, heading_known=True)


def _answer(
    encoders: Encoders, shot: Shot, query: Query, refiner: Refiner | None, config: LocaliseConfig | None
) -> QueryResult:
    plan = shot.home.plan
    grid = build_grid(plan, encoders, step_m=GRID_STEP_M, camera_height_m=shot.camera_height_m)
    coarse = localise(plan, grid, encoders, query, refine="none", config=config).candidates[0]
    found = localise(plan, grid, encoders, query, refine="lpo", refiner=refiner, config=config)
    best = found.candidates[0]
    distances = tuple(candidate.latent_distance for candidate in found.candidates)
    confidence = encoders.manifest.confidence
    return QueryResult(
        furniture=shot.furniture,
        error_m=float(np.linalg.norm(best.position_m - shot.position_m)),
        retrieval_error_m=float(np.linalg.norm(coarse.position_m - shot.position_m)),
        heading_error=abs(float(wrap_angle(panorama_heading(query, best) - shot.heading))),
        correct_room=best.room_index == shot.room_index,
        candidate_distances=distances,
        confidence=None if confidence is None else confidence.probability(list(distances)),
        timings_ms=found.timings_ms,
    )


def summarise(results: list[QueryResult]) -> dict[str, object]:
    """Figures of a set of answers: final and retrieval accuracy, rooms, headings, confidence, times."""
    errors = np.array([result.error_m for result in results])
    headings = np.degrees([result.heading_error for result in results])
    summary: dict[str, object] = {
        **Accuracy.of(errors).to_dict(),
        "retrieval": Accuracy.of(np.array([result.retrieval_error_m for result in results])).to_dict(),
        "correct_room": float(np.mean([result.correct_room for result in results])),
        "heading_within_2deg": float(np.mean(headings < 2.0)),
        "median_ms": {
            stage: float(np.median([result.timings_ms.get(stage, 0.0) for result in results]))
            for stage in ("retrieve", "vdr", "lpo")
        },
    }
    if results and results[0].confidence is not None:
        confidence = np.array([result.confidence for result in results])
        summary["expected_calibration_error"] = calibration_error(confidence, errors < 1.0)
    return summary


def calibration_error(confidence: np.ndarray, correct: np.ndarray, bins: int = 10) -> float:
    """Expected calibration error: mean gap between confidence and frequency over equal-width bins."""
    index = np.minimum((confidence * bins).astype(int), bins - 1)
    gaps = [
        np.mean(index == b) * abs(confidence[index == b].mean() - correct[index == b].mean())
        for b in range(bins)
        if np.any(index == b)
    ]
    return float(np.sum(gaps))
