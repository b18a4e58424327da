"""The path of a query: retrieve, re-sample on the Vogel disc, optimise the pose, rank.

The same code answers over HTTP and in evaluation; only `refine`, who runs the optimiser, differs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from operator import attrgetter
from typing import Literal

import numpy as np

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import ConfidenceModel
from lalaloc_core.localise.cohort import cost_by_chance
from lalaloc_core.localise.confidence import Signals, signals_of
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.hints import NO_HINTS, HintName, Hints
from lalaloc_core.localise.matching_cost import MatchingConfig
from lalaloc_core.localise.poses import Candidate, PoseGrid, Query, RefinementJob, RefinementResult
from lalaloc_core.localise.posterior import Posterior, area_shares, posterior_of
from lalaloc_core.localise.refinement import refined, refinement_job, with_latents
from lalaloc_core.localise.retrieval import contradicted, grid_costs, missed_hints, retrieve, suppress
from lalaloc_core.localise.steps import run_steps
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
        alike_margin, max_candidates: as many more, up to this number in all, as cost less than this more than the best:
            places that look alike must all be refined to share what is probable.
        separation_m: candidates nearer than this to a better one are dropped; retrieval keeps those turned otherwise.
        every_stage: tell what every stage found, even where a later one is reached. Where walls are compared the
            optimiser begins with the grid's candidates; VDR is then worth its time only where LPO has no result.
        by_probability: rank the answers by how probable they are instead of by cost, as places of several plans are.
        matching: settings of the matching cost.
    """

    vdr_samples: int = 200
    vdr_radius_steps: float = 2.0
    vdr_candidates: int = 1
    lpo_candidates: int = 5
    profile_candidates: int = 10
    profile_candidates_turned: int = 20
    alike_margin: float = 0.2
    max_candidates: int = 64
    separation_m: float = 1.0
    every_stage: bool = False
    by_probability: bool = False
    matching: MatchingConfig = field(default_factory=MatchingConfig)

    def least_starts(self, query: Query) -> int:
        """How many candidates of a query are optimised at least."""
        if not self.matching.compares_profiles(query):
            return self.lpo_candidates
        return self.profile_candidates if query.heading_known else self.profile_candidates_turned

    def starts(self, query: Query, modes: list[Candidate]) -> int:
        """How many of the modes of a query's posterior, the best first, are optimised."""
        least = self.least_starts(query)
        if not self.matching.compares_profiles(query):
            return least
        alike = sum(mode.total_cost < modes[0].total_cost + self.alike_margin for mode in modes)
        return max(least, min(alike, self.max_candidates))


@dataclass(frozen=True, kw_only=True)
class Localisation:
    """Distinct candidates, best first, and how they came about.

    Attributes:
        query: what was searched for: the query, or it with an unknown heading where the picture contradicts it.
        posterior: how probable all places of the grid and the candidates are, given that the picture is of the plan.
        stage: the last stage that ran.
        best: the best candidate after each stage that ran, in order.
        signals: what the confidence of the best candidate after each stage is judged by.
        heading_contradicted: whether the heading was said, and is not what the picture shows.
        hints_missed: hints that do not hold at the answer; of strict ones, those that the picture contradicts.
        timings_ms: milliseconds per stage.
    """

    query: Query
    candidates: list[Candidate]
    posterior: Posterior
    stage: SearchStage
    signals: dict[SearchStage, Signals]
    heading_contradicted: bool = False
    hints_missed: tuple[HintName, ...] = ()
    best: dict[SearchStage, Candidate] = field(default_factory=dict)
    timings_ms: dict[str, float] = field(default_factory=dict)

    @property
    def camera_height_m(self) -> float:
        """The camera height that fits the answer best."""
        stated = self.query.camera_height.height_m
        return stated * math.exp(self.candidates[0].height_offset)

    def fit_probability(self, model: ConfidenceModel) -> float | None:
        """Probability that the picture is of the plan at all."""
        known = self.query.heading_known
        return model.fit_probability(self.stage, asdict(self.signals[self.stage]), heading_known=known)

    def confidence(self, model: ConfidenceModel) -> float | None:
        """Probability that the answer is right within 1 m; None where the model does not know its stage."""
        fits = self.fit_probability(model)
        return None if fits is None else fits * self.posterior.position

    def heading_confidence(self, model: ConfidenceModel) -> float | None:
        """Probability that the answer's heading is right within 5°."""
        fits = self.fit_probability(model)
        return None if fits is None else fits * min(self.posterior.heading, 1.0)


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
    grid: PoseGrid,
    encoders: Encoders,
    query: Query,
    *,
    refine: Refine = "lpo",
    top_k: int = 5,
    refiner: Refiner | None = None,
    config: LocaliseConfig | None = None,
    clock: StageClock | None = None,
    hints: Hints = NO_HINTS,
) -> Localisation:
    """Find an encoded panorama in a plan.

    Args:
        grid: the plan's latent grid; its camera height is the query's.
        refine: how far to go; "lpo" without a `refiner`, or with one that returns None, ends at "vdr".
        top_k: how many distinct candidates to return.
        clock: times the stages; by default one of their own.
        hints: what is known of the place beforehand; strict ones forbid doubts of a known heading, too.

    Raises:
        InvalidHintError: the hints cannot be meant for the plan, or strict ones leave nothing of it.
    """
    if refiner is None and refine == "lpo":
        refine = "vdr"
    steps = localise_steps(
        plan, grid, encoders, query, refine=refine, top_k=top_k, config=config, clock=clock, hints=hints
    )
    return run_steps(steps, refiner)


def localise_steps(
    plan: FloorPlan,
    grid: PoseGrid,
    encoders: Encoders,
    query: Query,
    *,
    refine: Refine = "lpo",
    top_k: int = 5,
    config: LocaliseConfig | None = None,
    clock: StageClock | None = None,
    hints: Hints = NO_HINTS,
) -> Steps:
    """`localise` for who waits for the optimiser elsewhere: stops where poses are to be optimised; see `steps`."""
    config, clock = config or LocaliseConfig(), clock or StageClock()
    hints.check(plan)
    search = _Search(plan, grid, encoders, query, config=config, clock=clock, hints=hints, top_k=top_k)
    resampling = refine != "none" and config.vdr_candidates > 0
    if refine != "lpo":
        return search.answer(search.without_lpo(resampling=resampling))
    # Where walls are compared the optimiser begins with the grid's candidates, and what comes before is told at need.
    early = None
    if config.every_stage or not search.by_walls:
        early = search.without_lpo(resampling=resampling)
    begun = search.modes if search.by_walls or early is None else early
    with clock.stage("lpo"):
        result = yield search.job(begun)
        refined = None if result is None else search.refined(begun, result)
    if refined is not None:
        return search.answer(refined)
    return search.answer(search.without_lpo(resampling=resampling) if early is None else early)


class _Search:
    """One query in one plan: its candidates, and what its stages tell of them.

    Attributes:
        query: it, or it with an unknown heading where the picture contradicts what is said of the heading.
        by_walls: whether poses are compared by their wall profiles.
        modes: of the grid's posterior, the best first.
    """

    def __init__(
        self,
        plan: FloorPlan,
        grid: PoseGrid,
        encoders: Encoders,
        query: Query,
        *,
        config: LocaliseConfig,
        clock: StageClock,
        hints: Hints,
        top_k: int,
    ) -> None:
        """Retrieve candidates."""
        self._plan, self._grid, self._encoders, self._config = plan, grid, encoders, config
        self._clock, self._hints, self._top_k = clock, hints, top_k
        weights, evidence = encoders.manifest.evidence, config.matching
        with clock.stage("retrieve"):
            self._doubted = not hints.strict and contradicted(plan, grid, query, weights, evidence)
            self.query = query = query.searched if self._doubted and query.searched is not None else query
            self._costs = costs = grid_costs(plan, grid, query, weights, evidence, hints)
            # Refined candidates may meet and become one; spare ones then take the free places.
            least = config.least_starts(query)
            self.modes = retrieve(
                costs,
                grid,
                query,
                top_k=max(top_k, least) + least,
                separation_m=config.separation_m,
                margin=config.alike_margin,
                limit=config.max_candidates + top_k,
            )
            self._starts = config.starts(query, self.modes)
            reach_m = evidence.grid_reach * grid.step_m
            self._grid_cost = float(costs.cost.min())
            self._by_chance = cost_by_chance(encoders.cohort, plan, query, reach_m, weights, evidence)
        self.by_walls = evidence.compares_profiles(query)
        self._prior = area_shares(grid.poses, plan.areas_m2)
        self._ends = list[Candidate]()
        self._best = dict[SearchStage, Candidate]()
        self._signals = dict[SearchStage, Signals]()
        self._stage: SearchStage = "retrieval"

    def without_lpo(self, *, resampling: bool) -> list[Candidate]:
        """The candidates after retrieval and, with `resampling`, after VDR; tells what these stages found."""
        config, camera_height_m = self._config, self._grid.camera_height_m
        first = with_latents(self._plan, self._encoders, self.query, self.modes[:1], camera_height_m)
        candidates = first + self.modes[1:]
        self._tell("retrieval", first[0], self._posterior(first))
        if not resampling:
            return candidates
        with self._clock.stage("vdr"):
            resampled = [
                resample(
                    self._plan,
                    self._encoders,
                    self.query,
                    candidate,
                    camera_height_m=camera_height_m,
                    samples=config.vdr_samples,
                    radius_m=config.vdr_radius_steps * self._grid.step_m,
                    evidence=config.matching,
                    hints=self._hints,
                )
                for candidate in candidates[: config.vdr_candidates]
            ]
        resampled.sort(key=attrgetter("total_cost"))
        self._tell("vdr", resampled[0], self._posterior(resampled[:1]))
        return resampled + candidates[config.vdr_candidates :]

    def job(self, begun: list[Candidate]) -> RefinementJob:
        """What is to be optimised of candidates."""
        weights, evidence = self._encoders.manifest.evidence, self._config.matching
        first = begun[: self._starts]
        return refinement_job(self._plan, self.query, first, self._grid.camera_height_m, weights, evidence)

    def refined(self, begun: list[Candidate], result: RefinementResult) -> list[Candidate]:
        """The candidates after LPO, the best first."""
        evidence, first, rest = self._config.matching, begun[: self._starts], begun[self._starts :]
        self._ends = refined(self._plan, self._encoders, self.query, first, result, evidence, self._hints)
        self._stage = "lpo"
        return sorted(self._ends, key=attrgetter("total_cost")) + rest

    def answer(self, candidates: list[Candidate]) -> Localisation:
        """The distinct ones of the candidates of the last stage, and how they came about."""
        config, hints, camera_height_m = self._config, self._hints, self._grid.camera_height_m
        wanted = max(self._top_k, self._starts) if config.by_probability else self._top_k
        answers = distinct(candidates, self.query, config.separation_m, wanted)
        found = self._posterior(answers)
        if config.by_probability:
            answers, found = _by_probability(answers, found, self._top_k, self._posterior)
        if self.by_walls:
            answers = with_latents(self._plan, self._encoders, self.query, answers, camera_height_m)
        if self._stage == "lpo" or config.by_probability:
            self._tell(self._stage, answers[0], found)
        missed = hints.missed(answers[0].position_m, answers[0].room_index)
        if hints.strict:
            missed = missed_hints(self._plan, self._costs, self._encoders.manifest.evidence, hints)
        return Localisation(
            query=self.query,
            candidates=answers,
            posterior=found,
            stage=self._stage,
            signals=self._signals,
            heading_contradicted=self._doubted,
            hints_missed=missed,
            best=self._best,
            timings_ms=self._clock.timings_ms,
        )

    def _posterior(self, first: list[Candidate]) -> Posterior:
        """The posterior by what is known by now, with the probabilities of some candidates."""
        return posterior_of(
            self._costs,
            self._prior,
            self.query,
            starts=self.modes[: len(self._ends)],
            ends=self._ends,
            candidates=first,
            temperature=self._encoders.manifest.evidence.temperature,
            separation_m=self._config.separation_m,
        )

    def _tell(self, stage: SearchStage, candidate: Candidate, found: Posterior) -> None:
        self._stage, self._best[stage] = stage, candidate
        self._signals[stage] = signals_of(self.query, candidate, found, self._grid_cost, self._by_chance)


def panorama_heading(query: Query, candidate: Candidate) -> float:
    """Azimuth (radians) of the panorama's centre column that a candidate implies."""
    return float(wrap_angle(query.roll[candidate.hypothesis] + candidate.frame_heading))


def _by_probability(
    answers: list[Candidate], found: Posterior, top_k: int, posterior: Callable[[list[Candidate]], Posterior]
) -> tuple[list[Candidate], Posterior]:
    """The most probable answers, the most probable first, with the posterior that they were ranked by."""
    shares = found.candidate
    order = sorted(range(len(answers)), key=lambda index: -shares[index])[:top_k]
    ranked = [answers[index] for index in order]
    # Place and heading are those of the first one.
    first = posterior(ranked[:1])
    ordered = tuple(shares[index] for index in order)
    return ranked, replace(found, position=first.position, candidate=ordered, heading=first.heading)


def distinct(candidates: list[Candidate], query: Query, separation_m: float, top_k: int) -> list[Candidate]:
    """The first candidates of which no two are at one place and turned alike."""
    kept = suppress(
        np.stack([candidate.position_m for candidate in candidates]),
        np.arange(len(candidates), dtype=float),
        separation_m=separation_m,
        limit=top_k,
        heading=np.array([panorama_heading(query, candidate) for candidate in candidates]),
    )
    return [candidates[index] for index in kept]
