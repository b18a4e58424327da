"""The path of a query: retrieve, re-sample on the Vogel disc, optimise the pose, rank.

The same code answers over HTTP and in evaluation; only `refine`, who runs the optimiser, differs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.confidence import Signals, signals_of
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.evidence import EvidenceConfig, targets
from lalaloc_core.localise.poses import Candidate, LatentGrid, Query, RefinementJob, RefinementResult
from lalaloc_core.localise.retrieval import retrieve, suppress
from lalaloc_core.localise.vogel import resample

SearchStage = Literal["retrieval", "vdr", "lpo"]
Refine = Literal["none", "vdr", "lpo"]
# Runs pose optimisation; None when it could not answer (in time).
Refiner = Callable[[RefinementJob], RefinementResult | None]


@dataclass(frozen=True, kw_only=True)
class LocaliseConfig:
    """Settings of the search; the defaults are the paper's where it names them (section 5).

    Attributes:
        vdr_candidates: how many of the candidates are re-sampled; 0: no VDR.
        lpo_candidates: how many are optimised in the latent space; the paper refines the first alone.
        profile_candidates: how many are optimised by their wall profiles, which is cheaper.
        profile_candidates_turned: the same where the heading is searched: rooms look alike from several sides.
        separation_m: candidates nearer than this to a better one are dropped; retrieval keeps those turned otherwise.
        evidence: what poses are compared by.
    """

    vdr_samples: int = 200
    vdr_radius_steps: float = 2.0
    vdr_candidates: int = 1
    lpo_candidates: int = 5
    profile_candidates: int = 10
    profile_candidates_turned: int = 20
    separation_m: float = 1.0
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)

    def starts(self, query: Query) -> int:
        """How many candidates of a query are optimised."""
        if not self.evidence.compares_profiles(query):
            return self.lpo_candidates
        return self.profile_candidates if query.heading_known else self.profile_candidates_turned


@dataclass(frozen=True)
class Localisation:
    """Distinct candidates, best first, and how they came about.

    Attributes:
        stage: the last stage that ran.
        best: the best candidate after each stage that ran, in order.
        signals: what the confidence of the best candidate after each stage is judged by.
        timings_ms: milliseconds per stage.
    """

    candidates: list[Candidate]
    stage: SearchStage
    signals: dict[SearchStage, Signals]
    best: dict[SearchStage, Candidate] = field(default_factory=dict)
    timings_ms: dict[str, float] = field(default_factory=dict)


Steps = Generator[RefinementJob, RefinementResult | None, Localisation]


class StageClock:
    """Wall-clock milliseconds per named stage."""

    def __init__(self) -> None:
        self.timings_ms: dict[str, float] = {}
        self._begun_s: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block under `name`."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._begun_s[name] = begin
            self.timings_ms[name] = (time.perf_counter() - begin) * 1e3

    def spans(self) -> dict[str, tuple[float, float]]:
        """When each finished stage began, on the clock of `time.perf_counter`, and how long it took; both seconds."""
        return {name: (self._begun_s[name], spent_ms / 1e3) for name, spent_ms in dict(self.timings_ms).items()}


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
    clock: StageClock | None = None,
) -> Localisation:
    """Find an encoded panorama in a plan.

    Args:
        grid: the plan's latent grid; its camera height is the query's.
        refine: how far to go; "lpo" without a `refiner`, or with one that returns None, ends at "vdr".
        top_k: how many distinct candidates to return.
        clock: times the stages; by default one of their own.
    """
    if refiner is None and refine == "lpo":
        refine = "vdr"
    steps = localise_steps(plan, grid, encoders, query, refine=refine, top_k=top_k, config=config, clock=clock)
    result: RefinementResult | None = None
    while True:
        step = next_step(steps, result)
        if isinstance(step, Localisation):
            return step
        assert refiner is not None
        result = refiner(step)


def next_step(steps: Steps, result: RefinementResult | None) -> RefinementJob | Localisation:
    """Go on with a search: what is to be refined next, or what was found.

    Args:
        result: of the job that the last step gave; None at first, and where nobody could refine it (in time).
    """
    try:
        return steps.send(result)
    except StopIteration as done:
        return done.value


def localise_steps(
    plan: FloorPlan,
    grid: LatentGrid,
    encoders: Encoders,
    query: Query,
    *,
    refine: Refine = "lpo",
    top_k: int = 5,
    config: LocaliseConfig | None = None,
    clock: StageClock | None = None,
) -> Steps:
    """`localise` for who waits for the optimiser elsewhere: stops where poses are to be optimised; see `next_step`."""
    config = config or LocaliseConfig()
    clock = clock or StageClock()
    stage: SearchStage = "retrieval"
    starts = config.starts(query)
    with clock.stage("retrieve"):
        # Refined candidates may meet and become one; spare ones then take the free places.
        wanted = max(top_k, starts) + starts
        candidates = retrieve(grid, query, top_k=wanted, separation_m=config.separation_m, evidence=config.evidence)
    best: dict[SearchStage, Candidate] = {"retrieval": candidates[0]}
    # Of a number of candidates that does not depend on how many are asked for.
    signals: dict[SearchStage, Signals] = {
        "retrieval": signals_of(query, candidates[: 2 * starts], complete=len(candidates) < 2 * starts)
    }
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
                    evidence=config.evidence,
                )
            candidates[: config.vdr_candidates] = sorted(candidates[: config.vdr_candidates], key=lambda c: c.cost)
        stage = "vdr"
        best[stage] = candidates[0]
        # Costs of re-sampled poses do not compare with those of the grid's.
        signals[stage] = signals["retrieval"]
    if refine == "lpo":
        with clock.stage("lpo"):
            job = refinement_job(plan, query, candidates[:starts], grid.camera_height_m, config.evidence)
            result = yield job
            if result is not None:
                moved = [_moved(start, result, index) for index, start in enumerate(candidates[:starts])]
                moved.sort(key=lambda candidate: candidate.cost)
                candidates = moved + candidates[starts:]
                stage = "lpo"
                best[stage] = candidates[0]
                signals[stage] = signals_of(query, moved, complete=len(candidates) == len(moved))
    return Localisation(_distinct(candidates, config.separation_m, top_k), stage, signals, best, clock.timings_ms)


def panorama_heading(query: Query, candidate: Candidate) -> float:
    """Azimuth (radians) of the panorama's centre column that a candidate implies."""
    return float(wrap_angle(query.roll[candidate.hypothesis] + candidate.frame_heading))


def refinement_job(
    plan: FloorPlan, query: Query, candidates: list[Candidate], camera_height_m: float, evidence: EvidenceConfig
) -> RefinementJob:
    """What the optimiser needs to refine these candidates, each within its own room."""
    rooms = np.array([candidate.room_index for candidate in candidates])
    hypotheses = np.array([candidate.hypothesis for candidate in candidates])
    centre = precision = None
    if evidence.compares_profiles(query):
        centre, precision = targets(query, hypotheses, evidence.fine_reach_m, evidence)
    return RefinementJob(
        targets=query.latents[hypotheses],
        position_m=np.stack([candidate.position_m for candidate in candidates]),
        heading=np.array([candidate.frame_heading for candidate in candidates]),
        walls_m=plan.walls_m[rooms],
        camera_height_m=np.full(len(rooms), camera_height_m),
        ceiling_height_m=plan.ceiling_heights_m[rooms],
        optimise_heading=not query.heading_known,
        log_profile=centre,
        precision=precision,
        latent_weight=evidence.latent_weight,
    )


def _moved(start: Candidate, result: RefinementResult, index: int) -> Candidate:
    """A candidate where the optimiser took it."""
    return replace(
        start,
        x_m=float(result.position_m[index, 0]),
        y_m=float(result.position_m[index, 1]),
        frame_heading=float(result.heading[index]),
        cost=float(result.cost[index]),
        latent_distance=float(result.latent_distance[index]),
        information=result.information[index],
    )


def _distinct(candidates: list[Candidate], separation_m: float, top_k: int) -> list[Candidate]:
    """The first candidates of which no two are at one place."""
    positions = np.stack([candidate.position_m for candidate in candidates])
    kept = suppress(positions, np.arange(len(candidates), dtype=float), separation_m=separation_m, limit=top_k)
    return [candidates[index] for index in kept]
