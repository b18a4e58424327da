"""The path of a query: retrieve, re-sample on the Vogel disc, optimise in the latent space, rank.

The same code answers over HTTP and in evaluation; only `refine`, who runs the optimiser, differs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.poses import Candidate, LatentGrid, Query, RefinementJob, RefinementResult
from lalaloc_core.localise.retrieval import retrieve, suppress
from lalaloc_core.localise.vogel import resample

Stage = Literal["retrieval", "vdr", "lpo"]
Refine = Literal["none", "vdr", "lpo"]
# Runs latent pose optimisation; None when it could not answer (in time).
Refiner = Callable[[RefinementJob], RefinementResult | None]


@dataclass(frozen=True, kw_only=True)
class LocaliseConfig:
    """Settings of the search; the defaults are the paper's where it names them (section 5)."""

    vdr_samples: int = 200
    vdr_radius_steps: float = 2.0
    # How many of the candidates are re-sampled (0: no VDR) and optimised; the paper refines the first alone.
    vdr_candidates: int = 1
    lpo_candidates: int = 5
    separation_m: float = 1.0


@dataclass(frozen=True)
class Localisation:
    """Distinct candidates, best first, and how they came about.

    Attributes:
        stage: the last stage that ran.
        best: the best candidate after each stage that ran, in order.
        timings_ms: milliseconds per stage.
    """

    candidates: list[Candidate]
    stage: Stage
    best: dict[Stage, Candidate] = field(default_factory=dict)
    timings_ms: dict[str, float] = field(default_factory=dict)


class StageClock:
    """Wall-clock milliseconds per named stage."""

    def __init__(self) -> None:
        self.timings_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block under `name`."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.timings_ms[name] = (time.perf_counter() - begin) * 1e3


def localise(
    plan: FloorPlan,
    grid: LatentGrid,
    encoders: Encoders,
    query: Query,
    *,
    refine: Refine = "lpo",
    top_k: int = 5,
    refiner: Refiner | None = None,
    config: LocaliseConfig | None = None,
) -> Localisation:
    """Find an encoded panorama in a plan.

    Args:
        grid: the plan's latent grid; its camera height is the query's.
        refine: how far to go; "lpo" without a `refiner`, or with one that returns None, ends at "vdr".
        top_k: how many distinct candidates to return.
    """
    config = config or LocaliseConfig()
    clock = StageClock()
    stage: Stage = "retrieval"
    with clock.stage("retrieve"):
        # Refined candidates may meet and become one; spare ones then take the free places.
        wanted = max(top_k, config.lpo_candidates) + config.lpo_candidates
        candidates = retrieve(grid, query, top_k=wanted, separation_m=config.separation_m)
    best: dict[Stage, Candidate] = {"retrieval": candidates[0]}
    if refine in ("vdr", "lpo") and config.vdr_candidates:
        with clock.stage("vdr"):
            for index in range(min(config.vdr_candidates, len(candidates))):
                candidates[index] = resample(
                    plan,
                    encoders,
                    query,
                    candidates[index],
                    camera_height_m=grid.camera_height_m,
                    samples=config.vdr_samples,
                    radius_m=config.vdr_radius_steps * grid.step_m,
                )
        stage = "vdr"
        best[stage] = _nearest(candidates)
    if refine == "lpo" and refiner is not None:
        with clock.stage("lpo"):
            starts = candidates[: config.lpo_candidates]
            result = refiner(refinement_job(plan, query, starts, grid.camera_height_m))
            if result is not None:
                candidates = _merge(starts, result) + candidates[config.lpo_candidates :]
                stage = "lpo"
                best[stage] = _nearest(candidates)
    return Localisation(_rank(candidates, config.separation_m, top_k), stage, best, clock.timings_ms)


def panorama_heading(query: Query, candidate: Candidate) -> float:
    """Azimuth (radians) of the panorama's centre column that a candidate implies."""
    return float(wrap_angle(query.roll[candidate.hypothesis] + candidate.frame_heading))


def refinement_job(plan: FloorPlan, query: Query, candidates: list[Candidate], camera_height_m: float) -> RefinementJob:
    """What the optimiser needs to refine these candidates, each within its own room."""
    rooms = np.array([candidate.room_index for candidate in candidates])
    return RefinementJob(
        targets=query.latents[[candidate.hypothesis for candidate in candidates]],
        position_m=np.stack([candidate.position_m for candidate in candidates]),
        heading=np.array([candidate.frame_heading for candidate in candidates]),
        walls_m=plan.walls_m[rooms],
        camera_height_m=np.full(len(rooms), camera_height_m),
        ceiling_height_m=plan.ceiling_heights_m[rooms],
        optimise_heading=not query.heading_known,
    )


def _merge(starts: list[Candidate], result: RefinementResult) -> list[Candidate]:
    """Candidates moved to where the optimiser took them, unless that made them worse."""
    moved = []
    for index, start in enumerate(starts):
        if not result.latent_distance[index] < start.latent_distance:
            moved.append(start)
            continue
        moved.append(
            replace(
                start,
                x_m=float(result.position_m[index, 0]),
                y_m=float(result.position_m[index, 1]),
                frame_heading=float(result.heading[index]),
                latent_distance=float(result.latent_distance[index]),
            )
        )
    return moved


def _nearest(candidates: list[Candidate]) -> Candidate:
    return min(candidates, key=lambda candidate: candidate.latent_distance)


def _rank(candidates: list[Candidate], separation_m: float, top_k: int) -> list[Candidate]:
    positions = np.stack([candidate.position_m for candidate in candidates])
    distances = np.array([candidate.latent_distance for candidate in candidates])
    kept = suppress(positions, distances, separation_m=separation_m, limit=top_k)
    return [candidates[index] for index in kept]
