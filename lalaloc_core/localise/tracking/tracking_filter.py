"""Bayes filter for one photograph of a tracked camera: predict, compare, refine the modes, answer.

The belief after a photograph is

    b'(s) ∝ ((1 - c) prediction(s) + c prior(s)) · (L(s) + f),    L(s) = exp(-T (cost(s) - best)),

with the prediction of `TrackedPlans.moved`, the probability c of being carried anywhere, and the likelihood L of the
posterior of a single photograph (`localise.belief.posterior`). Photographs in doorways or close to furniture can fit
elsewhere better; f, the likelihood of an outlier, limits their effect. It is the mean of L by the prior times the odds
of an outlier, so that an outlier is as probable in a room as in a large building. LPO refines the modes of the belief;
its gain is evidence for a mode. The pose of the best mode is fused with the one that odometry predicts
(`belief_modes.py`).
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.localise.belief import Posterior, area_shares, confidence_of, signals_of
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import MatchingCost, cost_by_chance
from lalaloc_core.localise.query import NO_HINTS, Candidate, Hints, KnownHeading, Query
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from lalaloc_core.localise.refine.refinement import refined_candidates, refinement_job, with_latents
from lalaloc_core.localise.search.pipeline import LocaliseConfig, SearchStage, StageClock
from lalaloc_core.localise.search.retrieval import grid_costs
from lalaloc_core.localise.tracking.belief_modes import (
    ComparedStates,
    Gaussian,
    carried_on,
    contradicted,
    fused,
    hypothesis_of,
    measured_pose,
    sector_of,
)
from lalaloc_core.localise.tracking.track_state import MAX_STATES, Component, Mode, TrackedPose, TrackState
from lalaloc_core.localise.tracking.tracked_plans import TrackedPlans
from lalaloc_core.localise.tracking.walk_motion import Odometry, States

# Probability of being carried elsewhere between two photographs, and odds of a photograph that fits its place badly.
_CARRIED, _OUTLIER = 0.003, 0.05
# Predicted states that are compared in full, besides those that the grid offers.
_PREDICTED = 1024
# States below this share of the total are dropped.
_NEGLIGIBLE_SHARE = 1e-7
# The belief in being in the plan: probability of leaving or entering it between photographs, limits of the evidence of
# one photograph, and thresholds of the modes.
_LEAVING, _MAX_ODDS = 0.02, 10.0
# Factor of the odds that a partial photograph is of the plan: real homes are read worse than the generated ones that
# confidence is fitted on. Chosen on a furnished house by others, whose sessions were lost though places were right.
_READ_WORSE = 2.0
_LOST_BELOW, _TRACKING_FROM = 0.2, 0.5
# Probability of its pose from which a photograph is sure by itself.
_SURE = 0.9
# Probability that a known heading is wrong, and the deviation (radians) of headings beyond its tolerance.
_HEADING_DOUBT, _HEADING_STD = 0.02, math.radians(2.0)


@dataclass(frozen=True, eq=False)
class Tracked:
    """Answer for one photograph.

    Attributes:
        state: state for the next photograph.
        pose: the answer, in the frame of its plan; `pose.plan` is its number among the tracked ones.
        query, candidates: the best poses in the frame of all plans, the answer first as LPO has it, each with its
            `probability`.
        fit: probability that this photograph, by itself, is of the plan; None without a model.
        contradicted: components of the motion that this photograph contradicts.
        stage: last stage that ran.
    """

    state: TrackState
    pose: TrackedPose
    query: Query
    candidates: list[Candidate]
    probability: tuple[float, ...]
    fit: float | None
    contradicted: tuple[Component, ...]
    stage: SearchStage


TrackSteps = Generator[RefinementJob, RefinementResult | None, Tracked]


def track_steps(
    plans: TrackedPlans,
    encoder: LayoutEncoder,
    state: TrackState,
    query: Query,
    odometry: Odometry | None,
    *,
    known_heading: KnownHeading | None = None,
    hints: Hints = NO_HINTS,
    top_k: int = 5,
    clock: StageClock | None = None,
) -> TrackSteps:
    """Follow a camera to its next photograph; yield LPO jobs, as `pipeline.localise_steps` does.

    `state` is that after the photographs before, and `odometry` the motion since the last of them, if it is known. The
    query has an unknown heading. `hints` are the prior of the first photograph, in the frame of all plans.

    Raises:
        InvalidStateError: the state is of another grid or model.
    """
    photograph = _Photograph(plans, encoder, query, LocaliseConfig())
    clock = clock or StageClock()
    state = plans.entered(state).with_sectors(len(query.roll))
    with clock.stage("predict"):
        prediction = _predict(plans, state, odometry, known_heading, hints)
    with clock.stage("retrieve"):
        everything, grid_cost = photograph.compare(prediction)
        compared = everything.only(everything.weight > _NEGLIGIBLE_SHARE)
    starts = compared.modes()
    with clock.stage("lpo"):
        result = yield photograph.lpo_job(starts)
        refined, ends = photograph.refine(compared, starts, result)
    stage: SearchStage = "retrieval" if result is None else "lpo"
    with clock.stage("rank"):
        compared = compared.regained(starts, refined)
        (best, *others), posterior = compared.ranked(starts, ends, top_k)
        (best,) = with_latents(plans.plan, encoder, query, [best], plans.grid.camera_height_m)
        fit = photograph.fit(best, posterior, stage, grid_cost)
    in_plan = _in_plan(state.in_plan, fit, _READ_WORSE if query.is_view else 1.0)
    probability = in_plan * posterior.position
    mode: Mode = "lost" if in_plan < _LOST_BELOW else "tracking" if probability >= _TRACKING_FROM else "searching"
    own_plan = plans.merged.plan_of(best.room_index)
    sure = everything.share_alone(best) >= _SURE
    # Plans have frames of their own, which odometry does not join.
    before = state.pose if state.pose is not None and state.pose.plan == own_plan else None
    measured = measured_pose(plans.plan, encoder, query, best)
    is_refined = best.information is not None
    ((x_m, y_m, heading), covariance), missed = _follow(
        before, odometry, measured, mode, sure=sure, is_refined=is_refined
    )
    pose = TrackedPose(
        float(x_m),
        float(y_m),
        float(wrap_angle(heading)),
        covariance,
        best.room_index,
        probability,
        mode,
        state.number + 1,
        sure,
        own_plan,
    )
    most = np.argsort(-compared.weight, kind="stable")[:MAX_STATES]
    belief = States(compared.pose[most], compared.sector[most], compared.weight[most])
    state = state if missed is None else state.judged(missed)
    after = plans.left(replace(state, belief=belief, in_plan=in_plan, number=pose.number, pose=pose))
    assert after.pose is not None
    pose = replace(after.pose, plan=own_plan)
    shares = tuple(in_plan * share for share in posterior.candidate)
    return Tracked(after, pose, query, [best, *others], shares, fit, missed or (), stage)


@dataclass(frozen=True, eq=False)
class _Prediction:
    """Belief before the photograph is compared.

    Attributes:
        belief: (n, k) probability of each pose and sector.
        prior: (n, k) the same for a camera that can be anywhere in the plans; the sum is about one.
        anywhere: probability of a camera that was carried, or of which nothing is known.
    """

    belief: Float[np.ndarray, "n k"]
    prior: Float[np.ndarray, "n k"]
    anywhere: float


def _predict(
    plans: TrackedPlans, state: TrackState, odometry: Odometry | None, known: KnownHeading | None, hints: Hints
) -> _Prediction:
    sectors, share = state.sectors, area_shares(plans.grid.poses, plans.plan.areas_m2)
    if state.number == 0:
        hints.check(plans.plan)
        share = share - hints.penalty(plans.plan, plans.grid.poses.position_m, plans.grid.poses.room_index)
    prior = np.exp(share - share.max())
    prior = np.broadcast_to((prior / (prior.sum() * sectors))[:, None], (len(prior), sectors))
    anywhere = max(1.0 - float(state.belief.weight.sum()), _CARRIED)
    covered = 1.0 if plans.left_out is None else plans.left_out.area_share
    belief = anywhere * covered * prior
    if len(state.belief.pose):
        belief = belief + (1.0 - anywhere) * plans.moved(state.belief, sectors, odometry)
    if known is None or known.heading is None:
        return _Prediction(belief, prior, anywhere)
    off = np.abs(wrap_angle(np.arange(sectors) * (TWO_PI / sectors) - known.heading))
    beyond = np.maximum(off - known.tolerance, 0.0) / math.hypot(_HEADING_STD, TWO_PI / sectors / 3.0)
    factor = np.exp(-0.5 * np.square(beyond))
    factor = (1.0 - _HEADING_DOUBT) * factor / factor.mean() + _HEADING_DOUBT
    return _Prediction(belief * factor, prior * factor, anywhere)


@dataclass(frozen=True, eq=False)
class _Photograph:
    """A photograph, and the plans that it is compared with."""

    plans: TrackedPlans
    encoder: LayoutEncoder
    query: Query
    config: LocaliseConfig

    @property
    def _weights(self) -> MatchingWeights:
        return self.encoder.manifest.evidence_for(view=self.query.is_view)

    @property
    def _reach_m(self) -> float:
        return self.config.matching.grid_reach * self.plans.grid.step_m

    def compare(self, prediction: _Prediction) -> tuple[ComparedStates, float]:
        """Compare the photograph with the probable states; return their weights, and the cost of the best grid pose."""
        plans, query, weights, matching = self.plans, self.query, self._weights, self.config.matching
        plan, grid, sectors = plans.plan, plans.grid, len(query.roll)
        costs = grid_costs(plan, grid, query, weights, matching)
        number = costs.pose * sectors + sector_of(query, costs.hypothesis)
        cost, offset = costs.cost.astype(np.float64), costs.offset
        flat = prediction.belief.ravel()
        likely = np.argpartition(-flat, min(_PREDICTED, len(flat) - 1))[:_PREDICTED]
        missing = np.setdiff1d(likely, number[: costs.compared])
        if len(missing) and matching.compares_profiles(query):
            pose, sector = np.divmod(missing, sectors)
            matching_cost = MatchingCost(plan, query, self._reach_m, weights, matching)
            more, more_offset = matching_cost.pairs(grid.layouts(plan), pose, hypothesis_of(query)[sector])
            left = ~np.isin(number, missing)
            number = np.append(number[left], missing)
            cost, offset = np.append(cost[left], more), np.append(offset[left], more_offset)
        pose, sector = np.divmod(number, sectors)
        value = np.exp(-weights.temperature * (cost - cost.min()))
        by_pose = np.bincount(pose, prediction.prior.ravel()[number] * value, minlength=len(grid.poses))
        share, covered = plans.share(by_pose), 1.0 if plans.left_out is None else plans.left_out.area_share
        mean = covered * float(by_pose.sum()) / share
        # The likelihood of an outlier, and the weight of the plans that are left out.
        outlier = _OUTLIER * mean
        elsewhere = prediction.anywhere * ((1.0 - share) * mean + (1.0 - covered) * outlier)
        weight = flat[number] * (value + outlier)
        rest = max(float(flat.sum() - flat[number].sum()), 0.0) * outlier + elsewhere
        total = float(weight.sum()) + rest
        compared = ComparedStates(
            grid=grid,
            query=query,
            pose=pose,
            sector=sector,
            cost=cost,
            offset=offset,
            weight=weight / total,
            rest=rest / total,
            outlier=outlier,
            temperature=weights.temperature,
            separation_m=self.config.separation_m,
        )
        return compared, float(costs.cost.min())

    def lpo_job(self, starts: list[Candidate]) -> RefinementJob:
        """Return the refinement job of the modes."""
        camera_height_m, matching = self.plans.grid.camera_height_m, self.config.matching
        return refinement_job(self.plans.plan, self.query, starts, camera_height_m, self._weights, matching)

    def refine(
        self, compared: ComparedStates, starts: list[Candidate], result: RefinementResult | None
    ) -> tuple[list[Candidate], list[Candidate]]:
        """Return the modes after LPO, and the same left at their starts where the photograph is an outlier."""
        if result is None:
            return starts, starts
        refined = refined_candidates(self.plans.plan, self.encoder, self.query, starts, result, self.config.matching)
        # The photograph is rather an outlier at modes that fit worse than this.
        followed = compared.relative_likelihood(refined) >= 2.0 * compared.outlier
        return refined, [end if follow else start for start, end, follow in zip(starts, refined, followed, strict=True)]

    def fit(self, answer: Candidate, posterior: Posterior, stage: SearchStage, grid_cost: float) -> float | None:
        """Return the probability that the photograph is of the plan; None without a model."""
        encoder, query, plan, matching = self.encoder, self.query, self.plans.plan, self.config.matching
        by_chance = cost_by_chance(
            encoder.cohort, plan, query, self._reach_m, self._weights, matching, room=answer.room_index
        )
        signals = signals_of(query, answer, posterior, grid_cost, by_chance)
        model = encoder.manifest.confidence_for(view=query.is_view)
        confidence = confidence_of(model, stage, signals, posterior, heading_known=False)
        return None if confidence is None else confidence.fit


def _in_plan(before: float, fit: float | None, factor: float) -> float:
    """Return the probability of being in the plan after a photograph that fits it, by a factor of its odds."""
    before = before + _LEAVING * (1.0 - 2.0 * before)
    if fit is None:
        return before
    odds = min(max(factor * fit / max(1.0 - fit, 1e-9), 1.0 / _MAX_ODDS), _MAX_ODDS)
    return before * odds / (before * odds + 1.0 - before)


def _follow(
    before: TrackedPose | None,
    odometry: Odometry | None,
    measured: Gaussian,
    mode: Mode,
    *,
    sure: bool,
    is_refined: bool,
) -> tuple[Gaussian, tuple[Component, ...] | None]:
    """Fuse the measured pose with the one that odometry predicts, unless they contradict each other.

    Returns the pose, and the components of the motion that the photograph contradicts; None if it does not judge them.
    """
    if before is None or odometry is None:
        return measured, None
    predicted = carried_on(before, odometry)
    tracking = before.mode == mode == "tracking"
    # Wrong odometry keeps the belief from settling, so photographs that are sure by themselves judge it as well.
    comparable = tracking or (sure and before.sure)
    differing = contradicted(before, predicted, measured) if comparable else ()
    # A camera that was carried elsewhere is where the photograph says.
    pose = fused(predicted, measured) if tracking and not differing else measured
    return pose, differing if comparable and is_refined else None
