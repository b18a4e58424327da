"""Path of a query: retrieve, re-sample on the Vogel disc (VDR), refine the pose (LPO), rank.

`_Search` retrieves when it is made; `before_lpo` runs VDR, `lpo_job` and `after_lpo` LPO.

The same code answers over HTTP and in evaluation, which records every stage; the refiner, which runs pose refinement,
differs. A search is therefore a generator: it yields refinement jobs, which the caller runs at once
(`run_steps`) or wherever it wants (`next_step`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Literal, TypeVar

from lalaloc_core.bundle import ConfidenceModel
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import Confidence, Posterior, area_shares, confidence_of, distinct, signals_of
from lalaloc_core.localise.belief.confidence import Signals
from lalaloc_core.localise.belief.posterior import WeightedPlaces, weighted_places
from lalaloc_core.localise.belief.ranking import ranked
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import MatchingConfig, PoseGrid, cost_by_chance
from lalaloc_core.localise.query import NO_HINTS, Candidate, HintName, Hints, Query
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from lalaloc_core.localise.refine.refinement import refined_candidates, refinement_job, with_latents
from lalaloc_core.localise.search.retrieval import contradicted, grid_costs, missed_hints, resample, retrieve

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")
FoundT = TypeVar("FoundT")
SearchStage = Literal["retrieval", "vdr", "lpo"]
Refine = Literal["none", "vdr", "lpo"]
# Runs pose refinement; None if it has no result (in time).
Refiner = Callable[[RefinementJob], RefinementResult | None]


@dataclass(frozen=True, kw_only=True)
class LocaliseConfig:
    """Settings of the search; the defaults of `vdr_*` are the paper's (section 5).

    Attributes:
        vdr_samples: poses of a Vogel disc.
        vdr_radius_steps: radius of the disc, in units of the grid's step.
        vdr_candidates: number of candidates that are re-sampled; 0 omits VDR.
        lpo_candidates: number of candidates refined by their latents; the paper refines the first alone.
        profile_candidates: number of candidates refined by their wall profiles, which is faster.
        profile_candidates_turned: the same if the heading is searched, as rooms look alike from several sides.
        alike_margin: candidates that cost less than this more than the best are refined as well, up to
            `max_candidates`, as places that look alike must all be refined to share the probability.
        separation_m: smallest distance (m) between candidates at about one heading.
        every_stage: run and record every stage. Otherwise, if wall profiles are compared, refinement begins with the
            grid's candidates, and VDR runs only if LPO has no result.
        by_probability: rank candidates by probability instead of cost, as for places of several plans.
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

    def min_starts(self, query: Query) -> int:
        """Return the minimum number of candidates of a query that are refined."""
        if not self.matching.compares_profiles(query):
            return self.lpo_candidates
        return self.profile_candidates if query.heading_known else self.profile_candidates_turned

    def starts(self, query: Query, modes: list[Candidate]) -> int:
        """Return the number of modes of a query's posterior, sorted by cost, that are refined."""
        minimum = self.min_starts(query)
        if not self.matching.compares_profiles(query):
            return minimum
        alike = sum(mode.total_cost < modes[0].total_cost + self.alike_margin for mode in modes)
        return max(minimum, min(alike, self.max_candidates))


@dataclass(frozen=True, kw_only=True)
class Localisation:
    """Distinct candidates, best first, and the evidence for them.

    Attributes:
        query: the query, with an unknown heading if the picture contradicts the given one.
        posterior: probability of all places of the grid and of the candidates, given that the picture is of the plan.
        signals: signals of the best candidate's confidence after each stage that ran, in order.
        heading_contradicted: whether a heading was given that the picture contradicts.
        hints_missed: hints that do not hold at the answer; of strict hints, those that the picture contradicts.
        best: the best candidate after each stage that ran, in order.
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
        """Camera height that fits the answer best."""
        return self.query.camera_height.height_m * math.exp(self.candidates[0].height_offset)

    def confidence(self, model: ConfidenceModel | None, share: float = 1.0) -> Confidence | None:
        """Return the answer's confidence; None without a model, or if the model was not fitted on the last stage.

        `share` is the probability that the place is among those that were searched.
        """
        signals, known = self.signals[self.stage], self.query.heading_known
        return confidence_of(model, self.stage, signals, self.posterior, heading_known=known, share=share)


Steps = Generator[RefinementJob, RefinementResult | None, Localisation]


def next_step(steps: Generator[JobT, ResultT | None, FoundT], result: ResultT | None) -> JobT | FoundT:
    """Continue a search; return its next job or its result.

    `result` is the last job's; None at first, and if there is no result (in time).
    """
    try:
        return steps.send(result)
    except StopIteration as done:
        return done.value


def run_steps(
    steps: Generator[JobT | None, ResultT | None, FoundT], refiner: Callable[[JobT], ResultT | None] | None
) -> FoundT:
    """Run a whole search in this process, without its pauses (None).

    `refiner` runs a job; it returns None if it has no result (in time). Searches without jobs need none.
    """
    result: ResultT | None = None
    while True:
        try:
            job = steps.send(result)
        except StopIteration as done:
            return done.value
        if job is None:
            result = None
            continue
        assert refiner is not None
        result = refiner(job)


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
        """Return the begin (by `time.perf_counter`) and the duration of each finished stage, in seconds."""
        return {name: (self._begun_s[name], spent_ms / 1e3) for name, spent_ms in dict(self.timings_ms).items()}


def localise(
    plan: FloorPlan,
    grid: PoseGrid,
    encoder: LayoutEncoder,
    query: Query,
    *,
    refine: Refine = "lpo",
    top_k: int = 5,
    refiner: Refiner | None = None,
    config: LocaliseConfig | None = None,
    hints: Hints = NO_HINTS,
) -> Localisation:
    """Localise an encoded photograph in a plan.

    The grid is the plan's, made for the query's camera height. `refine` is the last stage: "lpo" without a `refiner`,
    or with one that returns None, ends at "vdr". With strict hints, a known heading is not doubted.
    """
    if refiner is None and refine == "lpo":
        refine = "vdr"
    steps = localise_steps(plan, grid, encoder, query, refine=refine, top_k=top_k, config=config, hints=hints)
    return run_steps(steps, refiner)


def localise_steps(
    plan: FloorPlan,
    grid: PoseGrid,
    encoder: LayoutEncoder,
    query: Query,
    *,
    refine: Refine = "lpo",
    top_k: int = 5,
    config: LocaliseConfig | None = None,
    clock: StageClock | None = None,
    hints: Hints = NO_HINTS,
) -> Steps:
    """Run `localise` for callers that refine poses elsewhere: yield refinement jobs, see `next_step`.

    `clock` times the stages.
    """
    config, clock = config or LocaliseConfig(), clock or StageClock()
    hints.check(plan)
    search = _Search(plan, grid, encoder, query, config=config, clock=clock, hints=hints, top_k=top_k)
    resampling = refine != "none" and config.vdr_candidates > 0
    stages: list[_Stage] = []
    # If walls are compared, refinement begins with the grid's candidates, and VDR runs on demand.
    if refine != "lpo" or config.every_stage or not search.by_walls:
        stages = search.before_lpo(resampling=resampling)
    if refine == "lpo":
        start = search.retrieved if search.by_walls else stages[-1]
        with clock.stage("lpo"):
            result = yield search.lpo_job(start)
            if result is not None:
                stages.append(search.after_lpo(start, result))
    return search.localisation(stages or search.before_lpo(resampling=resampling))


@dataclass(frozen=True, eq=False)
class _Stage:
    """Result of a stage.

    Attributes:
        candidates: the candidates, best first.
        modes: the mode of the grid that each of them comes from.
        places: the probable places, if the stage moved any.
    """

    name: SearchStage
    candidates: list[Candidate]
    modes: list[Candidate]
    places: WeightedPlaces | None = None


class _Search:
    """One query in one plan: the poses of its grid that fit best, and the stages that follow.

    Attributes:
        query: the query, with an unknown heading if the picture contradicts the given one.
        by_walls: whether poses are compared by their wall profiles.
        retrieved: the modes of the grid's posterior, without latent distances.
    """

    def __init__(
        self,
        plan: FloorPlan,
        grid: PoseGrid,
        encoder: LayoutEncoder,
        query: Query,
        *,
        config: LocaliseConfig,
        clock: StageClock,
        hints: Hints,
        top_k: int,
    ) -> None:
        """Retrieve the modes."""
        self._plan, self._grid, self._encoders, self._config = plan, grid, encoder, config
        weights, matching = encoder.manifest.evidence_for(view=query.is_view), config.matching
        self._weights, self._clock, self._hints, self._top_k = weights, clock, hints, top_k
        with clock.stage("retrieve"):
            costs = grid_costs(plan, grid, query, weights, matching) if hints.are_none else None
            doubted = not hints.strict and contradicted(plan, grid, query, weights, matching, given=costs)
            query = query.searched.value if doubted and query.searched is not None else query
            if costs is None or doubted:
                costs = grid_costs(plan, grid, query, weights, matching, hints)
            # Refined candidates can meet and become one; spare ones then take their places.
            minimum = config.min_starts(query)
            modes = retrieve(
                costs,
                grid,
                query,
                top_k=max(top_k, minimum) + minimum,
                separation_m=config.separation_m,
                margin=config.alike_margin,
                limit=config.max_candidates + top_k,
            )
            # On another thread it would take longer, as both would wait for the interpreter's lock.
            reach_m, room = matching.grid_reach * grid.step_m, modes[0].room_index
            chance = cost_by_chance(encoder.cohort, plan, query, reach_m, weights, matching, room=room)
        self.query, self._costs, self._by_chance, self._doubted = query, costs, chance, doubted
        self.by_walls = matching.compares_profiles(query)
        self.retrieved = _Stage("retrieval", modes, modes)
        self._refined = config.starts(query, modes)

    def before_lpo(self, *, resampling: bool) -> list[_Stage]:
        """Return the results of retrieval and, with `resampling`, of VDR."""
        config, modes = self._config, self.retrieved.modes
        retrieved = replace(self.retrieved, candidates=self._with_latents(modes[:1]) + modes[1:])
        if not resampling:
            return [retrieved]
        count = config.vdr_candidates
        with self._clock.stage("vdr"):
            resampled = [
                resample(
                    self._plan,
                    self._encoders,
                    self.query,
                    candidate,
                    camera_height_m=self._grid.camera_height_m,
                    samples=config.vdr_samples,
                    radius_m=config.vdr_radius_steps * self._grid.step_m,
                    matching=config.matching,
                    hints=self._hints,
                )
                for candidate in retrieved.candidates[:count]
            ]
        order = ranked(resampled, self.query)
        candidates = [resampled[index] for index in order] + retrieved.candidates[count:]
        return [retrieved, _Stage("vdr", candidates, [modes[index] for index in order] + modes[count:])]

    def lpo_job(self, start: _Stage) -> RefinementJob:
        """Return the refinement job of the first candidates of a stage."""
        candidates, matching = start.candidates[: self._refined], self._config.matching
        return refinement_job(self._plan, self.query, candidates, self._grid.camera_height_m, self._weights, matching)

    def after_lpo(self, start: _Stage, result: RefinementResult) -> _Stage:
        """Return the result of LPO: the refined candidates of `lpo_job`, best first, then the others."""
        begins, others = start.candidates[: self._refined], start.candidates[self._refined :]
        matching, hints = self._config.matching, self._hints
        ends = refined_candidates(self._plan, self._encoders, self.query, begins, result, matching, hints)
        candidates = [ends[index] for index in ranked(ends, self.query)] + others
        return _Stage("lpo", candidates, start.modes, self._places(start.modes[: self._refined], ends))

    def localisation(self, stages: Sequence[_Stage]) -> Localisation:
        """Return the distinct candidates of the last stage, best first, and the evidence after every stage."""
        config, hints, last = self._config, self._hints, stages[-1]
        by_stage: dict[SearchStage, tuple[Candidate, Posterior]] = {
            stage.name: self._first(stage) for stage in stages[:-1]
        }
        wanted = max(self._top_k, self._refined) if config.by_probability else self._top_k
        answers = distinct(last.candidates, self.query, config.separation_m, wanted)
        found = self._posterior(last, answers)
        if config.by_probability:
            answers, found = _by_probability(answers, found, self._top_k, partial(self._posterior, last))
        if self.by_walls:
            answers = self._with_latents(answers)
        is_recorded = last.name == "lpo" or config.by_probability
        by_stage[last.name] = (answers[0], found) if is_recorded else self._first(last)
        missed = hints.missed(answers[0].position_m, answers[0].room_index)
        if hints.strict:
            missed = missed_hints(self._plan, self._costs, self._weights, hints)
        grid_cost = float(self._costs.cost.min())
        return Localisation(
            query=self.query,
            candidates=answers,
            posterior=found,
            stage=last.name,
            signals={
                name: signals_of(self.query, best, posterior, grid_cost, self._by_chance)
                for name, (best, posterior) in by_stage.items()
            },
            heading_contradicted=self._doubted,
            hints_missed=missed,
            best={name: best for name, (best, _) in by_stage.items()},
            timings_ms=self._clock.timings_ms,
        )

    def _first(self, stage: _Stage) -> tuple[Candidate, Posterior]:
        """Return the best candidate after a stage, with its posterior."""
        return stage.candidates[0], self._posterior(stage, stage.candidates[:1])

    def _posterior(self, stage: _Stage, candidates: list[Candidate]) -> Posterior:
        """Return the posterior after a stage, with the probabilities of some candidates."""
        return (stage.places or self._unmoved).posterior(candidates)

    @cached_property
    def _unmoved(self) -> WeightedPlaces:
        """Probable places before LPO."""
        return self._places([], [])

    def _places(self, starts: Sequence[Candidate], ends: Sequence[Candidate]) -> WeightedPlaces:
        """Return the probable places after some modes were refined."""
        return weighted_places(
            self._costs,
            area_shares(self._grid.poses, self._plan.areas_m2),
            self.query,
            starts=starts,
            ends=ends,
            temperature=self._weights.temperature,
            separation_m=self._config.separation_m,
        )

    def _with_latents(self, candidates: list[Candidate]) -> list[Candidate]:
        return with_latents(self._plan, self._encoders, self.query, candidates, self._grid.camera_height_m)


def _by_probability(
    answers: list[Candidate], found: Posterior, top_k: int, posterior: Callable[[list[Candidate]], Posterior]
) -> tuple[list[Candidate], Posterior]:
    """Return the `top_k` most probable candidates, most probable first, and their posterior."""
    shares = found.candidate
    # Probabilities that differ by rounding alone are equal, and keep the order by cost.
    order = sorted(range(len(answers)), key=lambda index: -float(f"{shares[index]:.9g}"))[:top_k]
    ordered = [answers[index] for index in order]
    # The probabilities of place and heading are the first candidate's.
    first = posterior(ordered[:1])
    shares = tuple(shares[index] for index in order)
    return ordered, replace(found, position=first.position, candidate=shares, heading=first.heading)
