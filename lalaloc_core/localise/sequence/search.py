"""The path of a query of several pictures: compare each with the grid, link them, optimise the best paths, rank."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from lalaloc_core.errors import InvalidMotionError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import ConfidenceModel, MatchingWeights
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.cohort import cost_by_chance
from lalaloc_core.localise.confidence import Signals, signals_of
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.matching_cost import MatchingCost, latent_distances
from lalaloc_core.localise.pipeline import Localisation, LocaliseConfig, StageClock
from lalaloc_core.localise.poses import Candidate, PoseGrid, Query, grid_candidate
from lalaloc_core.localise.posterior import Posterior, area_shares
from lalaloc_core.localise.ranking import HEADING_SEPARATION, distinct, suppress
from lalaloc_core.localise.refinement import with_latents
from lalaloc_core.localise.retrieval import contradicted
from lalaloc_core.localise.sequence.chain import best_paths, forward_backward
from lalaloc_core.localise.sequence.joint import SequenceJob, SequenceResult
from lalaloc_core.localise.sequence.motion import FLOOR, Motion, States, Transition, transition
from lalaloc_core.localise.sequence.paths import Observation, Path, path_posterior
from lalaloc_core.localise.sequence.refinement import are_alike, ended_paths, job_parts, path_motion_costs, sequence_job
from lalaloc_core.localise.steps import run_steps

SequenceRefine = Literal["none", "lpo"]
# Runs joint optimisation; None when it could not answer (in time).
SequenceRefiner = Callable[[SequenceJob], SequenceResult | None]
# Places that a picture may have; of more, those that are best by every `_STRIDE`th azimuth.
_MAX_PLACES, _STRIDE = 2048, 4
# Paths that are optimised, and how many modes of each picture they are looked for through.
_PATHS, _MODES = 8, 8
# A motion is contradicted by what is less likely than four standard deviations off.
_CONTRADICTED = 0.5 * 4.0**2


@dataclass(frozen=True)
class SequenceLocalisation:
    """Where the pictures of a sequence were taken.

    Attributes:
        pictures: of each picture the candidates, best path first, with the posterior that all pictures together give.
        path_probability: that of the answers of all pictures being right at once, given that they are of the plan.
        motions_contradicted: numbers of the motions that the answer differs from by more than they allow for.
    """

    pictures: list[Localisation]
    path_probability: float
    stage: Literal["retrieval", "lpo"]
    motions_contradicted: tuple[int, ...] = ()
    timings_ms: dict[str, float] = field(default_factory=dict)

    @property
    def camera_height_m(self) -> float:
        """Camera height that fits all pictures best."""
        return self.pictures[0].camera_height_m

    def confidence(self, model: ConfidenceModel | None) -> float | None:
        """Return the probability that all pictures are of the plan and all answers right; None as for one picture."""
        alone = [picture.confidence(model) for picture in self.pictures]
        fits = [confidence.fit for confidence in alone if confidence is not None]
        return min(fits) * min(self.path_probability, 1.0) if len(fits) == len(alone) else None


SequenceSteps = Generator[SequenceJob, SequenceResult | None, SequenceLocalisation]


def localise_sequence(
    plan: FloorPlan,
    grid: PoseGrid,
    encoders: Encoders,
    queries: Sequence[Query],
    motions: Sequence[Motion],
    *,
    refiner: SequenceRefiner | None = None,
    top_k: int = 5,
    config: LocaliseConfig | None = None,
) -> SequenceLocalisation:
    """Find the places of several encoded panoramas of one visit in a plan.

    Args:
        queries: in the order in which they were taken, all with the same statement about the camera's height.
        motions: between neighbours.
        refiner: optimises paths; None ends at the grid.

    Raises:
        InvalidMotionError: there is not one motion less than there are pictures.
    """
    refine: SequenceRefine = "none" if refiner is None else "lpo"
    steps = localise_sequence_steps(plan, grid, encoders, queries, motions, refine=refine, top_k=top_k, config=config)
    return run_steps(steps, refiner)


def localise_sequence_steps(
    plan: FloorPlan,
    grid: PoseGrid,
    encoders: Encoders,
    queries: Sequence[Query],
    motions: Sequence[Motion],
    *,
    refine: SequenceRefine = "lpo",
    top_k: int = 5,
    config: LocaliseConfig | None = None,
    clock: StageClock | None = None,
) -> SequenceSteps:
    """`localise_sequence` for who waits for the optimiser elsewhere; models without a profile end at the grid."""
    if len(motions) != len(queries) - 1:
        raise InvalidMotionError(f"{len(motions)} motions are given, {len(queries)} pictures have {len(queries) - 1}")
    config, clock = config or LocaliseConfig(), clock or StageClock()
    weights, height = encoders.manifest.evidence, queries[0].camera_height
    with clock.stage("retrieve"):
        pictures = [_picture(plan, grid, query, weights, config) for query in queries]
        transitions = [
            transition(motion, first.states, second.states, grid.step_m)
            for motion, (first, second) in zip(motions, itertools.pairwise(pictures), strict=True)
        ]
        log_heights = -height.penalty(_offsets(pictures[0].query, config))
        log_heights = log_heights - np.logaddexp.reduce(log_heights)
        whole = forward_backward([one.log_likelihood for one in pictures], transitions, log_heights)
        at = int(whole.height.argmax())
        paths = _paths(grid, pictures, transitions, at, float(log_heights[at]), config)
    stage: Literal["retrieval", "lpo"] = "retrieval"
    if refine == "lpo" and all(config.matching.compares_profiles(one.query) for one in pictures):
        with clock.stage("lpo"):
            parts = job_parts(plan, grid, pictures, paths, weights, config)
            job = sequence_job(parts, pictures, paths, transitions, motions, weights.temperature)
            result = yield job
            if result is not None:
                paths = ended_paths(plan, encoders, pictures, motions, paths, result, config)
                stage = "lpo"
    candidates = [
        distinct([path.ends[t] for path in paths], picture.query, config.separation_m, top_k)
        for t, picture in enumerate(pictures)
    ]
    found = path_posterior(
        pictures,
        transitions,
        paths,
        poses=grid.poses,
        log_heights=log_heights,
        whole=whole,
        candidates=candidates,
        separation_m=config.separation_m,
    )
    if stage == "retrieval" and config.matching.compares_profiles(pictures[0].query):
        candidates = [
            with_latents(plan, encoders, picture.query, answers, grid.camera_height_m)
            for picture, answers in zip(pictures, candidates, strict=True)
        ]
    told = [
        _localisation(
            picture, answers, posterior, stage, _signals(plan, grid, encoders, picture, answers[0], posterior, config)
        )
        for picture, answers, posterior in zip(pictures, candidates, found.pictures, strict=True)
    ]
    missed = _contradicted_motions(pictures, motions, transitions, paths[0], stage)
    return SequenceLocalisation(told, float(found.path[0]), stage, missed, clock.timings_ms)


def _localisation(
    picture: Observation,
    answers: list[Candidate],
    posterior: Posterior,
    stage: Literal["retrieval", "lpo"],
    signals: Signals,
) -> Localisation:
    """What is told of one picture."""
    return Localisation(
        query=picture.query,
        candidates=answers,
        posterior=posterior,
        stage=stage,
        signals={stage: signals},
        heading_contradicted=picture.doubted,
        best={stage: answers[0]},
    )


def _contradicted_motions(
    pictures: Sequence[Observation],
    motions: Sequence[Motion],
    transitions: Sequence[Transition],
    path: Path,
    stage: Literal["retrieval", "lpo"],
) -> tuple[int, ...]:
    """Numbers of the motions that a path differs from by more than they allow for."""
    if stage == "retrieval":
        # The places of a grid are off themselves.
        pairs = zip(transitions, itertools.pairwise(path.states), strict=True)
        return tuple(s for s, (one, pair) in enumerate(pairs) if one.floor and one.likelihood(*pair) <= FLOOR)
    costs = path_motion_costs(pictures, motions, [path])[0]
    return tuple(int(index) for index in np.flatnonzero(costs > _CONTRADICTED))


def _signals(
    plan: FloorPlan,
    grid: PoseGrid,
    encoders: Encoders,
    picture: Observation,
    answer: Candidate,
    posterior: Posterior,
    config: LocaliseConfig,
) -> Signals:
    """Of one picture; heights that nobody expects cost what they do of a single picture."""
    query, weights = picture.query, encoders.manifest.evidence
    penalty = query.camera_height.penalty(_offsets(query, config)) / weights.temperature
    grid_cost = float((picture.cost.min(axis=(1, 2)) + penalty).min())
    reach_m = config.matching.grid_reach * grid.step_m
    by_chance = cost_by_chance(encoders.cohort, plan, query, reach_m, weights, config.matching)
    return signals_of(query, answer, posterior, grid_cost, by_chance)


def _offsets(query: Query, config: LocaliseConfig) -> Float[np.ndarray, "j"]:
    """The height offsets that are tried; latents are of the stated height alone."""
    return query.camera_height.offsets if config.matching.compares_profiles(query) else np.zeros(1)


def _picture(
    plan: FloorPlan, grid: PoseGrid, query: Query, weights: MatchingWeights, config: LocaliseConfig
) -> Observation:
    """Compare a picture with the grid at every height."""
    evidence = config.matching
    doubted = contradicted(plan, grid, query, weights, evidence)
    query = query.searched if doubted and query.searched is not None else query
    index = np.arange(len(grid.poses))
    if evidence.compares_profiles(query):
        layouts, reach_m = grid.layouts(plan), evidence.grid_reach * grid.step_m
        if len(index) > _MAX_PLACES:
            coarse, _ = MatchingCost(plan, query, reach_m, weights, evidence, stride=_STRIDE).costs(layouts)
            index = np.sort(np.argpartition(coarse.min(axis=0), _MAX_PLACES)[:_MAX_PLACES])
            layouts = layouts.rows(index)
        costs = []
        for offset in query.camera_height.offsets:
            height_m = query.camera_height.height_m * math.exp(offset)
            exact = replace(query.scaled(float(offset)), camera_height=CameraHeight(height_m, 0.0))
            costs.append(MatchingCost(plan, exact, reach_m, weights, evidence).costs(layouts)[0].T)
        cost = np.stack(costs).astype(np.float64)
    else:
        distance = latent_distances(grid.known_latents, query.latents)
        index = np.sort(np.argsort(distance.min(axis=0), kind="stable")[:_MAX_PLACES])
        cost = distance[:, index].T[None].astype(np.float64)
    prior = area_shares(grid.poses, plan.areas_m2)
    prior = prior - np.logaddexp.reduce(prior) - math.log(len(query.roll))
    states = States(grid.poses.position_m[index], query.roll + query.frame_heading, query.sector)
    return Observation(query, index, states, cost, -weights.temperature * cost + prior[index][None, :, None], doubted)


def _paths(
    grid: PoseGrid,
    pictures: list[Observation],
    transitions: list[Transition],
    at: int,
    log_height: float,
    config: LocaliseConfig,
) -> list[Path]:
    """The best paths of which no two are alike, at one of the heights."""
    found = best_paths([one.log_likelihood[at] for one in pictures], transitions)
    through: dict[tuple[int, ...], float] = {}
    for t, picture in enumerate(pictures):
        score, headings = found.score[t], len(picture.states.heading)
        ranked = np.argsort(-score, axis=None)[: 64 * _MODES]
        row, hypothesis = np.unravel_index(ranked, score.shape)
        modes = suppress(
            picture.states.position_m[row],
            -score[row, hypothesis],
            separation_m=config.separation_m,
            limit=_MODES,
            heading=picture.states.heading[hypothesis],
        )
        for mode in modes:
            state = int(row[mode]) * headings + int(hypothesis[mode])
            through.setdefault(tuple(found.through(t, state)), float(score.ravel()[state]))
    kept: list[Path] = []
    for states in sorted(through, key=lambda one: -through[one]):
        starts = tuple(_start(grid, picture, state, at) for picture, state in zip(pictures, states, strict=True))
        alike = (are_alike(pictures, starts, path.ends, config.separation_m, HEADING_SEPARATION) for path in kept)
        if not any(alike):
            kept.append(Path(states, starts, -through[states] - log_height, starts))
        if len(kept) == _PATHS:
            break
    return kept


def _start(grid: PoseGrid, picture: Observation, state: int, at: int) -> Candidate:
    """A state of a picture as a candidate."""
    row, hypothesis = divmod(state, len(picture.states.heading))
    pose, query = int(picture.index[row]), picture.query
    offsets = query.camera_height.offsets
    return grid_candidate(
        grid,
        pose,
        query,
        hypothesis,
        cost=float(picture.cost[at, row, hypothesis]),
        height_offset=float(offsets[at]) if picture.cost.shape[0] == len(offsets) else 0.0,
    )
