"""Path of a query of several pictures: compare each with the grid, link them, refine the best paths, rank."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import Manifest
from lalaloc_core.errors import InvalidMotionError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import HEADING_SEPARATION, Posterior, area_shares, distinct, signals_of, suppress
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import MatchingCost, PlaceCost, PoseGrid, cost_by_chance, grid_candidate
from lalaloc_core.localise.match.cost_terms import latent_distances
from lalaloc_core.localise.query import NO_HINTS, CameraHeight, Candidate, Query
from lalaloc_core.localise.refine.refinement import with_latents
from lalaloc_core.localise.search.pipeline import Localisation, LocaliseConfig, StageClock, run_steps
from lalaloc_core.localise.search.retrieval import contradicted
from lalaloc_core.localise.sequence.chain_inference import best_paths
from lalaloc_core.localise.sequence.joint_refinement import SequenceJob, SequenceResult
from lalaloc_core.localise.sequence.measured_motion import FLOOR, Motion, States, transition
from lalaloc_core.localise.sequence.path_posterior import Observation, Path, PictureChain
from lalaloc_core.localise.sequence.path_refinement import path_motion_costs, refined_paths, sequence_job

SequenceRefine = Literal["none", "lpo"]
# Runs joint refinement; None if it has no result (in time).
SequenceRefiner = Callable[[SequenceJob], SequenceResult | None]
# Maximum numbers of a picture's places, the best by every n-th azimuth, with n = `_STRIDE`, and of its states: places
# under each hypothesis. Pictures beyond `_FULL_PICTURES` share the states of so many.
_MAX_PLACES, _MAX_STATES, _STRIDE, _FULL_PICTURES = 2048, 131_072, 4, 10
# Number of refined paths, and of modes of each picture through which paths are searched.
_PATHS, _MODES = 8, 8
# Half squared residual, of four standard deviations, beyond which the answer contradicts a motion.
_CONTRADICTED = 0.5 * 4.0**2


@dataclass(frozen=True)
class SequenceLocalisation:
    """Localisation of a sequence.

    Attributes:
        pictures: for each picture the candidates, best path first, with the posterior given all pictures.
        path_probability: probability that the answers of all pictures are right, given that they are of the plan.
        motions_contradicted: numbers of the motions that the answer contradicts.
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

    def confidence(self, manifest: Manifest, share: float = 1.0) -> float | None:
        """Return the probability that all pictures are of the plan and all answers right; None as for one picture.

        `share` is the lowest probability that a picture is of the plans that were searched.
        """
        models = [
            manifest.confidence_for(view=picture.query.is_view, turn=picture.query.is_turn) for picture in self.pictures
        ]
        alone = [picture.confidence(model, share) for model, picture in zip(models, self.pictures, strict=True)]
        fits = [confidence.fit for confidence in alone if confidence is not None]
        return min(fits) * min(self.path_probability, 1.0) if len(fits) == len(alone) else None


# Yields None where the search can pause.
SequenceSteps = Generator[SequenceJob | None, SequenceResult | None, SequenceLocalisation]


def localise_sequence(
    plan: FloorPlan,
    grid: PoseGrid,
    encoder: LayoutEncoder,
    queries: Sequence[Query],
    motions: Sequence[Motion],
    *,
    refiner: SequenceRefiner | None = None,
    top_k: int = 5,
    config: LocaliseConfig | None = None,
) -> SequenceLocalisation:
    """Localise several encoded photographs of one visit in a plan.

    The queries are in the order in which they were taken, their stated camera heights have the same relative error, and
    `motions` are between neighbours. `refiner` refines paths; None ends at the grid. `top_k` limits the candidates of
    each picture.
    """
    refine: SequenceRefine = "none" if refiner is None else "lpo"
    steps = localise_sequence_steps(plan, grid, encoder, queries, motions, refine=refine, top_k=top_k, config=config)
    return run_steps(steps, refiner)


def localise_sequence_steps(
    plan: FloorPlan,
    grid: PoseGrid,
    encoder: LayoutEncoder,
    queries: Sequence[Query],
    motions: Sequence[Motion],
    *,
    refine: SequenceRefine = "lpo",
    top_k: int = 5,
    config: LocaliseConfig | None = None,
    clock: StageClock | None = None,
) -> SequenceSteps:
    """Run `localise_sequence` for callers that refine paths elsewhere; models without a profile end at the grid."""
    if len(motions) != len(queries) - 1:
        raise InvalidMotionError(f"{len(motions)} motions are given; {len(queries)} pictures need {len(queries) - 1}")
    config, clock = config or LocaliseConfig(), clock or StageClock()
    search = _SequenceSearch(plan, grid, encoder, config)
    with clock.stage("retrieve"):
        max_states = _MAX_STATES * _FULL_PICTURES // max(len(queries), _FULL_PICTURES)
        pictures: list[Observation] = []
        for query in queries:
            pictures.append(search.observe(query, max_states))
            yield None
        transitions = [
            transition(motion, first.states, second.states, grid.step_m)
            for motion, (first, second) in zip(motions, itertools.pairwise(pictures), strict=True)
        ]
        log_heights = -queries[0].camera_height.penalty(search.height_offsets(pictures[0].query))
        chain = PictureChain(pictures, motions, transitions, log_heights - np.logaddexp.reduce(log_heights))
        paths = search.best_paths(chain)
    stage: Literal["retrieval", "lpo"] = "retrieval"
    if refine == "lpo" and all(config.matching.compares_profiles(picture.query) for picture in pictures):
        with clock.stage("lpo"):
            result = yield sequence_job(plan, grid, chain, paths, config)
            if result is not None:
                paths, stage = refined_paths(plan, encoder, chain, paths, result, config), "lpo"
    candidates = [
        distinct([path.ends[t] for path in paths], picture.query, config.separation_m, top_k)
        for t, picture in enumerate(pictures)
    ]
    shares, posteriors = chain.posterior(paths, candidates, poses=len(grid.poses), separation_m=config.separation_m)
    if stage == "retrieval" and config.matching.compares_profiles(pictures[0].query):
        candidates = [
            with_latents(plan, encoder, picture.query, answers, grid.camera_height_m)
            for picture, answers in zip(pictures, candidates, strict=True)
        ]
    found = zip(pictures, candidates, posteriors, strict=True)
    missed = _contradicted_motions(chain, paths[0], stage)
    localisations = linked([search.localisation(*each, stage) for each in found], motions, missed, encoder.manifest)
    # Paths that differ by less than counts as right are right as well, so Boole's inequality can say more.
    right = max(float(shares[0]), 1.0 - sum(1.0 - posterior.position for posterior in posteriors))
    return SequenceLocalisation(localisations, right, stage, missed, clock.timings_ms)


def linked(
    pictures: Sequence[Localisation], motions: Sequence[Motion], missed: Sequence[int], manifest: Manifest
) -> list[Localisation]:
    """Return the localisations, each with the highest fit of the pictures that it is linked to.

    Pictures between which the camera moved by a measured distance are of one building, unless the answer contradicts
    the motion: if any of them is of the plan, all are.
    """
    groups = [[0]]
    for index, motion in enumerate(motions):
        if motion.distance_m is not None and index not in missed:
            groups[-1].append(index + 1)
        else:
            groups.append([index + 1])
    found = list(pictures)
    for group in groups:
        own = [
            pictures[index].confidence(manifest.confidence_for(view=pictures[index].query.is_view)) for index in group
        ]
        fit = max((confidence.fit for confidence in own if confidence is not None), default=0.0)
        for index in group:
            found[index] = replace(pictures[index], linked_fit=fit)
    return found


def _contradicted_motions(chain: PictureChain, path: Path, stage: Literal["retrieval", "lpo"]) -> tuple[int, ...]:
    """Return the numbers of the motions that a path contradicts."""
    if stage == "retrieval":
        # Transitions allow for the distance of grid poses from the camera.
        pairs = zip(chain.transitions, itertools.pairwise(path.states), strict=True)
        return tuple(s for s, (link, pair) in enumerate(pairs) if link.floor and link.likelihood(*pair) <= FLOOR)
    return tuple(int(index) for index in np.flatnonzero(path_motion_costs(chain, [path])[0] > _CONTRADICTED))


def _at_height(query: Query, offset: float) -> Query:
    """Return the query with an exact camera height, that of an offset."""
    height_m = query.camera_height.height_m * math.exp(offset)
    return replace(query.scaled(offset), camera_height=CameraHeight(height_m, 0.0))


@dataclass(frozen=True, eq=False)
class _SequenceSearch:
    """Search for the pictures of a sequence in one plan."""

    plan: FloorPlan
    grid: PoseGrid
    encoder: LayoutEncoder
    config: LocaliseConfig

    @property
    def _reach_m(self) -> float:
        return self.config.matching.grid_reach * self.grid.step_m

    def height_offsets(self, query: Query) -> Float[np.ndarray, "j"]:
        """Return the height offsets that are tried; latents are of the stated height alone."""
        return query.camera_height.offsets if self.config.matching.compares_profiles(query) else np.zeros(1)

    def observe(self, query: Query, max_states: int) -> Observation:
        """Compare a picture with the grid at every height; keep the best states."""
        plan, grid, matching, reach_m = self.plan, self.grid, self.config.matching, self._reach_m
        weights = self.encoder.manifest.evidence_for(view=query.is_view)
        doubted = contradicted(plan, grid, query, weights, matching)
        query = query.searched if doubted and query.searched is not None else query
        index = np.arange(len(grid.poses))
        if matching.compares_profiles(query):
            layouts = grid.layouts(plan)
            most = max(min(_MAX_PLACES, max_states // len(query.roll)), 1)
            if len(index) > most:
                coarse, _ = MatchingCost(plan, query, reach_m, weights, matching, stride=_STRIDE).costs(layouts)
                index = np.sort(np.argpartition(coarse.min(axis=0), most)[:most])
                layouts = layouts.rows(index)
            at_heights = (_at_height(query, float(offset)) for offset in query.camera_height.offsets)
            costs = [MatchingCost(plan, exact, reach_m, weights, matching).costs(layouts)[0].T for exact in at_heights]
            cost = np.stack(costs).astype(np.float64)
        else:
            distance = latent_distances(grid.known_latents, query.latents)
            index = np.sort(np.argsort(distance.min(axis=0), kind="stable")[:_MAX_PLACES])
            cost = distance[:, index].T[None].astype(np.float64)
        prior = area_shares(grid.poses, plan.areas_m2)
        prior = prior - np.logaddexp.reduce(prior) - math.log(len(query.roll))
        states = States(grid.poses.position_m[index], query.roll + query.frame_heading, query.sector)
        log_likelihood = -weights.temperature * cost + prior[index][None, :, None]
        places = PlaceCost.of(plan, query, NO_HINTS, 1.0, states.position_m, grid.poses.room_index[index])
        if places is not None:
            log_likelihood -= places.of_poses(np.arange(len(index)))
        return Observation(query, weights, index, states, cost, log_likelihood, doubted)

    def best_paths(self, chain: PictureChain) -> list[Path]:
        """Return the best distinct paths at the most probable height."""
        height, separation_m = int(chain.marginals.height.argmax()), self.config.separation_m
        found = best_paths([picture.log_likelihood[height] for picture in chain.pictures], chain.transitions)
        through: dict[tuple[int, ...], float] = {}
        for t, picture in enumerate(chain.pictures):
            score, headings = found.score[t], len(picture.states.heading)
            ranked = np.argsort(-score, axis=None)[: 64 * _MODES]
            row, hypothesis = np.unravel_index(ranked, score.shape)
            modes = suppress(
                picture.states.position_m[row],
                -score[row, hypothesis],
                separation_m=separation_m,
                limit=_MODES,
                heading=picture.states.heading[hypothesis],
            )
            for mode in modes:
                state = int(row[mode]) * headings + int(hypothesis[mode])
                through.setdefault(tuple(found.through(t, state)), float(score.ravel()[state]))
        kept: list[Path] = []
        for states in sorted(through, key=lambda path: -through[path]):
            starts = tuple(self._start(*pair, height) for pair in zip(chain.pictures, states, strict=True))
            if not any(chain.are_alike(starts, path.ends, separation_m, HEADING_SEPARATION) for path in kept):
                nll = -through[states] - float(chain.log_heights[height])
                kept.append(Path(states, starts, nll, starts))
            if len(kept) == _PATHS:
                break
        return kept

    def _start(self, picture: Observation, state: int, height: int) -> Candidate:
        """Return a state of a picture as a candidate."""
        row, hypothesis = divmod(state, len(picture.states.heading))
        offsets, cost = picture.query.camera_height.offsets, picture.cost
        return grid_candidate(
            self.grid,
            int(picture.index[row]),
            picture.query,
            hypothesis,
            cost=float(cost[height, row, hypothesis]),
            height_offset=float(offsets[height]) if len(cost) == len(offsets) else 0.0,
        )

    def localisation(
        self, picture: Observation, answers: list[Candidate], posterior: Posterior, stage: Literal["retrieval", "lpo"]
    ) -> Localisation:
        """Return the localisation of one picture, with the penalty of the camera height as for a single picture."""
        query, weights, matching = picture.query, picture.weights, self.config.matching
        penalty = query.camera_height.penalty(self.height_offsets(query)) / weights.temperature
        grid_cost = float((picture.cost.min(axis=(1, 2)) + penalty).min())
        by_chance = cost_by_chance(
            self.encoder.cohort, self.plan, query, self._reach_m, weights, matching, room=answers[0].room_index
        )
        return Localisation(
            query=query,
            candidates=answers,
            posterior=posterior,
            stage=stage,
            signals={stage: signals_of(query, answers[0], posterior, grid_cost, by_chance)},
            heading_contradicted=picture.doubted,
            best={stage: answers[0]},
        )
