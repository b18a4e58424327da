"""Tests of retrieval, the coarse pass, non-maximum suppression and Vogel-disc re-sampling."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float

from benchmarks.buildings import Building
from lalaloc_core.bundle import Manifest, MatchingWeights
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.synth.homes.plans import VALIDATION
from lalaloc_core.localise.belief import suppress
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import Layouts, MatchingConfig, MatchingCost, PlaceCost, PoseGrid, layouts_at
from lalaloc_core.localise.match.coarse_pass import CoarseTable, LowestCosts, coarse_costs, likeliest
from lalaloc_core.localise.match.cost_terms import latent_distances, precisions
from lalaloc_core.localise.match.pose_grid import SPHERE_AZIMUTHS, VIEW_AZIMUTHS, BinnedLayouts
from lalaloc_core.localise.query import CameraHeight, Candidate, PredictedOpenings, PredictedProfile, Query, rolled
from lalaloc_core.localise.query.query import Later
from lalaloc_core.localise.search.retrieval import contradicted, grid_costs, resample, retrieve, vogel_disc
from lalaloc_core.render.sampling import PoseSet, pose_grid, random_poses
from tests.strategies import plan_of, present, rectangle, seeds

PLAN = plan_of(rectangle(6.0, 6.0))
EXACT = CameraHeight(1.5, 0.0)


def unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    vectors = rng.normal(size=shape)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_grid(seed: int, poses: int = 60, columns: int = 16) -> PoseGrid:
    rng = np.random.default_rng(seed)
    places = PoseSet(rng.uniform(0, 6, (poses, 2)), np.zeros(poses, dtype=int))
    return PoseGrid(places, unit(rng, poses, 8), rng.uniform(0.5, 5.0, (poses, columns)), 0.5, 1.5)


def best_candidates(
    grid: PoseGrid, query: Query, *, top_k: int, config: MatchingConfig | None = None
) -> list[Candidate]:
    costs = grid_costs(PLAN, grid, query, MatchingWeights(), config or MatchingConfig())
    return retrieve(costs, grid, query, top_k=top_k, separation_m=1.0)


def unknown_heading_query(latents: np.ndarray) -> Query:
    return Query(latents, np.arange(len(latents)) * (2.0 * math.pi / len(latents)), 0.0, False, EXACT)


class PlaceEncoders(LayoutEncoder):
    """Fake encoder: the latent of a pose is a direction that depends smoothly on its position."""

    def __init__(self) -> None:
        sizes: dict[str, Any] = {"image_height": 1, "image_width": 2, "profile_columns": 1, "latent_size": 4}
        sizes |= {"ring_sectors": 0, "layout_config": {}, "image_mean": [], "image_std": []}
        self.manifest = Manifest(name="places", version="1", architecture="paper", **sizes)

    def poses(
        self, plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "b"], camera_height_m: float
    ) -> tuple[np.ndarray, np.ndarray]:
        features = np.stack(
            [poses.position_m[:, 0], poses.position_m[:, 1], 3.0 * np.sin(heading), np.full(len(poses), 5.0)], 1
        )
        return features / np.linalg.norm(features, axis=1, keepdims=True), np.ones((len(poses), 1))


PLACES = PlaceEncoders()


class TestRetrieval:
    @given(seeds())
    def test_latent_distance_is_euclidean(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        latents, targets = unit(rng, 20, 16), unit(rng, 3, 16)
        direct = np.linalg.norm(targets[:, None] - latents[None], axis=-1)
        np.testing.assert_allclose(latent_distances(latents, targets), direct, atol=1e-7)

    def test_latent_distance_to_itself_is_zero(self) -> None:
        latents = unit(np.random.default_rng(0), 50, 128).astype(np.float32)
        assert np.diag(latent_distances(latents, latents)).max() < 1e-3

    @given(seeds(), st.integers(1, 12), st.floats(0.0, 3.0))
    def test_suppression_keeps_the_best_separated_places(self, seed: int, limit: int, separation_m: float) -> None:
        rng = np.random.default_rng(seed)
        position, distance = rng.uniform(0, 5, (40, 2)), rng.uniform(0, 2, 40)
        kept = suppress(position, distance, separation_m=separation_m, limit=limit)
        assert 1 <= len(kept) <= limit
        assert kept[0] == int(distance.argmin())
        assert list(distance[kept]) == sorted(distance[kept])
        gaps = np.linalg.norm(position[:, None] - position[kept][None], axis=-1)
        assert all(gaps[a, k] >= separation_m for k in range(len(kept)) for a in kept[:k])
        worst_kept = distance[kept[-1]]
        for dropped in set(range(40)) - set(kept):
            near = [i for k, i in enumerate(kept) if gaps[dropped, k] < separation_m]
            shadowed = any(distance[i] <= distance[dropped] for i in near)
            assert shadowed or (len(kept) == limit and distance[dropped] >= worst_kept)

    @given(seeds())
    def test_suppression_keeps_a_place_once_per_heading(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        position, heading = np.zeros((60, 2)), rng.uniform(-math.pi, math.pi, 60)
        kept = suppress(position, rng.uniform(0, 2, 60), separation_m=1.0, limit=60, heading=heading)
        gaps = np.abs(wrap_angle(heading[kept][:, None] - heading[kept][None])) + 9.0 * np.eye(len(kept))
        assert gaps.min() > math.radians(25.0)
        assert np.abs(wrap_angle(heading[:, None] - heading[kept][None])).min(axis=1).max() <= math.radians(25.0)

    @given(seeds(), st.integers(1, 8))
    def test_first_candidate_is_the_global_minimum(self, seed: int, hypotheses: int) -> None:
        grid = random_grid(seed)
        query = unknown_heading_query(unit(np.random.default_rng(seed + 1), hypotheses, 8))
        distances = latent_distances(present(grid.latents), query.latents)
        found = best_candidates(grid, query, top_k=5)
        assert found[0].latent_distance == pytest.approx(distances.min())
        for candidate in found:
            place = int(np.linalg.norm(grid.poses.position_m - candidate.position_m, axis=1).argmin())
            assert candidate.cost == distances[candidate.hypothesis, place]
            assert candidate.latent_distance == pytest.approx(candidate.cost)
            assert candidate.room_index == grid.poses.room_index[place]
            assert candidate.frame_heading == query.frame_heading

    def test_fine_grid_gives_top_k_candidates(self) -> None:
        rng = np.random.default_rng(0)
        position = np.stack(np.meshgrid(np.arange(0, 6, 0.1), np.arange(0, 4, 0.1)), axis=-1).reshape(-1, 2)
        poses = PoseSet(position, np.zeros(len(position), dtype=int))
        latents = unit(rng, len(position), 8)
        # One place fits far better than all others at every heading.
        latents[np.linalg.norm(position - 2.0, axis=1) < 1.0] = np.eye(8)[0]
        grid = PoseGrid(poses, latents, np.ones((len(position), 4)), 0.1, 1.5)
        query = unknown_heading_query(np.repeat(np.eye(8)[:1], 64, axis=0))
        assert len(best_candidates(grid, query, top_k=40)) == 40

    def test_profile_retrieves_its_own_grid_pose_and_heading(self) -> None:
        grid = random_grid(0)
        for index in (0, 17, 59):
            # Hypothesis k undoes a turn by k of 8 sectors, two columns each; the truth is hypothesis 3.
            seen = np.roll(np.log(grid.profile_m[index]), -6)
            turned = np.stack([np.roll(seen, 2 * k) for k in range(8)])
            profile = PredictedProfile(turned, np.full((8, 16), -3.0))
            query = dataclasses.replace(unknown_heading_query(unit(np.random.default_rng(1), 8, 8)), profile=profile)
            best = best_candidates(grid, query, top_k=1)[0]
            np.testing.assert_array_equal(best.position_m, grid.poses.position_m[index])
            assert best.hypothesis == 3
            assert best.cost < 1e-6

    @given(seeds())
    def test_cost_adds_profile_and_weighted_latent(self, seed: int) -> None:
        grid, rng = random_grid(seed), np.random.default_rng(seed)
        query = dataclasses.replace(
            unknown_heading_query(unit(rng, 3, 8)),
            profile=PredictedProfile(rng.normal(size=(3, 16)), rng.normal(size=(3, 16))),
        )
        config = MatchingConfig(latent_weight=0.7)
        profile = present(query.profile)
        residual = np.log(grid.profile_m)[None] - profile.log_m[:, None]
        precision = precisions(profile.log_m, profile.log_scale, 0.3, MatchingWeights.tail)
        costs = np.log1p(np.square(residual * precision[:, None])).mean(axis=2)
        costs += 0.7 * latent_distances(present(grid.latents), query.latents)
        best = best_candidates(grid, query, top_k=1, config=config)[0]
        assert best.cost == pytest.approx(costs.min(), rel=1e-4)
        by_latent = best_candidates(grid, query, top_k=1, config=MatchingConfig(use_profile=False))[0]
        assert by_latent.cost == pytest.approx(latent_distances(present(grid.latents), query.latents).min())

    def test_large_grid_is_preselected_coarsely(self, monkeypatch: pytest.MonkeyPatch) -> None:
        grid, rng = random_grid(0, poses=400), np.random.default_rng(0)
        seen = np.log(grid.profile_m[[7, 300]]) + rng.normal(scale=0.02, size=(2, 16))
        query = dataclasses.replace(
            unknown_heading_query(unit(rng, 2, 8)), profile=PredictedProfile(seen, np.full((2, 16), -3.0))
        )
        exhaustive = best_candidates(grid, query, top_k=3)
        for limit, poses in (("ALL", 0), ("MIN", 50), ("MAX", 50)):
            monkeypatch.setattr(f"lalaloc_core.localise.search.retrieval._{limit}_COMPARED", poses)
        costs = grid_costs(PLAN, grid, query, MatchingWeights(), MatchingConfig())
        assert costs.compared == 50
        assert best_candidates(grid, query, top_k=3)[:2] == exhaustive[:2]
        best = grid_costs(PLAN, grid, query, MatchingWeights(), MatchingConfig(), best_only=True)
        assert len(best.cost) == best.compared == 50
        assert best.cost.min() == costs.cost.min()


class TestContradictedHeading:
    @pytest.fixture
    def grid(self) -> PoseGrid:
        return random_grid(0, columns=64)

    def query(self, grid: PoseGrid, turned_by: int) -> Query:
        """Return a query at a grid pose with the stated heading 0, turned by `turned_by` sectors of 8."""
        seen = np.roll(np.log(grid.profile_m[17]), 8 * turned_by)
        turned = np.stack([np.roll(seen, 8 * k) for k in range(8)])
        latents = unit(np.random.default_rng(1), 8, 8)
        searched = dataclasses.replace(
            unknown_heading_query(latents), profile=PredictedProfile(turned, np.full((8, 64), -4.0))
        )
        stated = PredictedProfile(turned[:1], np.full((1, 64), -4.0))
        return Query(latents[:1], np.zeros(1), 0.0, True, CameraHeight(1.5), stated, searched=Later(lambda: searched))

    def test_heading_is_kept_if_right_or_check_is_off_or_gain_small(self, grid: PoseGrid) -> None:
        right, wrong = self.query(grid, 0), self.query(grid, 3)
        assert not contradicted(PLAN, grid, right, MatchingWeights(), MatchingConfig())
        assert contradicted(PLAN, grid, wrong, MatchingWeights(), MatchingConfig())
        assert not contradicted(PLAN, grid, wrong, MatchingWeights(), MatchingConfig(heading_doubt=0.0))
        assert not contradicted(PLAN, grid, wrong, MatchingWeights(temperature=0.5), MatchingConfig())

    def test_heading_is_kept_if_it_fits_as_usual(self, grid: PoseGrid) -> None:
        wrong, config = self.query(grid, 3), MatchingConfig()
        given, searched = (
            float(grid_costs(PLAN, grid, query, MatchingWeights(), config).cost.min())
            for query in (wrong, present(wrong.searched).value)
        )
        gain = 1.0 - searched / given
        for weights, is_contradicted in (
            (MatchingWeights(usual_cost=0.9 * given), True),
            (MatchingWeights(usual_cost=1.1 * given), False),
            (MatchingWeights(usual_gain=0.9 * gain), True),
            (MatchingWeights(usual_gain=1.1 * gain), False),
        ):
            assert contradicted(PLAN, grid, wrong, weights, config) == is_contradicted


class TestVogelDisc:
    @pytest.mark.parametrize("samples", [1, 2, 200])
    def test_points_follow_the_formula(self, samples: int) -> None:
        golden, index = (1.0 + math.sqrt(5.0)) / 2.0, np.arange(samples)
        angle, radius = index * 2.0 * math.pi * (1.0 - 1.0 / golden), np.sqrt(index / samples)
        expected = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        np.testing.assert_allclose(vogel_disc(samples), expected, atol=1e-9)


class TestResampling:
    plan = plan_of(rectangle(4.0, 4.0), rectangle(4.0, 4.0, corner=(4.5, 0.0)))

    def query(self, x: float, y: float, heading_known: bool = True, heading: float = 0.0) -> Query:
        pose = PoseSet(np.array([[x, y]]), np.array([0]))
        latent, _ = PLACES.poses(self.plan, pose, np.array([heading]), 1.5)
        if not heading_known:
            return unknown_heading_query(latent.repeat(8, 0))
        return Query(latent, np.zeros(1), 0.0, heading_known, EXACT)

    def candidate(self, query: Query, x: float, y: float) -> Candidate:
        pose = PoseSet(np.array([[x, y]]), np.array([0]))
        latent, _ = PLACES.poses(self.plan, pose, np.zeros(1), 1.5)
        distance = float(latent_distances(latent, query.latents[:1])[0, 0])
        return Candidate(x, y, 0, 0.0, 0, distance, distance)

    def resample(self, query: Query, start: Candidate, radius_m: float) -> Candidate:
        return resample(self.plan, PLACES, query, start, camera_height_m=1.5, samples=200, radius_m=radius_m)

    def test_resampling_approaches_the_truth_within_the_disc(self) -> None:
        query = self.query(2.3, 2.6)
        start = self.candidate(query, 2.0, 2.0)
        found = self.resample(query, start, 1.0)
        assert np.hypot(found.x_m - 2.3, found.y_m - 2.6) < 0.1
        assert found.cost < start.cost
        assert found.latent_distance == pytest.approx(found.cost, abs=1e-6)
        assert np.hypot(found.x_m - 2.0, found.y_m - 2.0) <= 1.0

    def test_samples_outside_rooms_are_dropped(self) -> None:
        # The truth lies in the wall between the rooms; the result must lie in the room it names.
        query = self.query(4.3, 2.0)
        found = self.resample(query, self.candidate(query, 3.8, 2.0), 1.0)
        assert self.plan.room_index_at(found.position_m[None])[0] == found.room_index >= 0
        across = self.query(4.7, 2.0)
        moved = self.resample(across, self.candidate(across, 3.8, 2.0), 1.2)
        assert moved.room_index == 1
        assert moved.x_m > 4.5

    def test_optimal_candidate_is_kept(self) -> None:
        query = self.query(2.0, 2.0)
        found = self.resample(query, self.candidate(query, 2.0, 2.0), 1.0)
        assert (found.x_m, found.y_m, found.room_index, found.frame_heading) == (2.0, 2.0, 0, 0.0)

    def test_only_an_unknown_heading_is_resampled(self) -> None:
        known = self.query(2.3, 2.6)
        assert self.resample(known, self.candidate(known, 2.0, 2.0), 1.0).frame_heading == 0.0
        unknown = self.query(2.3, 2.6, heading_known=False, heading=0.3)
        found = self.resample(unknown, self.candidate(unknown, 2.0, 2.0), 1.0)
        assert 0.0 < found.frame_heading <= math.pi / 8


STEP_M, COLUMNS, HYPOTHESES, QUERIES = 0.7, 64, 32, 24
WEIGHTS, CONFIG = MatchingWeights(temperature=40.0, openings=0.4), MatchingConfig()


@pytest.fixture(scope="module")
def building() -> Building:
    return Building(VALIDATION, 3, 350.0, hall_share=0.0)


@pytest.fixture(scope="module")
def grid(building: Building) -> PoseGrid:
    poses = pose_grid(building.plan, STEP_M)
    layouts = layouts_at(building.plan, poses, np.zeros(len(poses)), COLUMNS)
    return PoseGrid.without_latents(poses, layouts, STEP_M, 1.5)


@pytest.fixture(scope="module")
def queries(building: Building) -> list[Query]:
    """Return predictions at random poses with typical errors: furniture hides a third of the columns."""
    rng = np.random.default_rng(0)
    poses = random_poses(building.plan, QUERIES, rng, 0.2)
    found = []
    shifts = np.arange(HYPOTHESES) * COLUMNS // HYPOTHESES
    for index in range(QUERIES):
        pose = PoseSet(poses.position_m[[index]], poses.room_index[[index]])
        layouts = layouts_at(building.plan, pose, rng.uniform(-3.0, 3.0, 1), COLUMNS)
        log_m = layouts.log_profile[0] + rng.normal(0.0, 0.05, COLUMNS) + rng.uniform(-0.06, 0.06)
        hidden = rng.random(COLUMNS) < 0.3
        log_m[hidden] -= rng.exponential(0.3, int(hidden.sum()))
        probability = np.full((COLUMNS, 4), 0.05)
        probability[np.arange(COLUMNS), present(layouts.kind)[0]] += 0.8
        profile = PredictedProfile(log_m[None], np.full((1, COLUMNS), np.log(0.06))).moved(shifts)
        openings = PredictedOpenings(rolled(np.log(probability), shifts), np.array([0.7, 0.1, 0.15, 0.05]))
        roll = np.arange(HYPOTHESES) * (2.0 * np.pi / HYPOTHESES)
        height = CameraHeight(1.5) if index % 2 else CameraHeight(1.5, float("inf"))
        latents = np.tile(np.eye(1, 8), (HYPOTHESES, 1))
        found.append(Query(latents, roll, 0.0, False, height, profile, openings))
    return found


def view_of(query: Query, hypotheses: int = HYPOTHESES, unseen: float = np.inf) -> Query:
    """Return a query that shows a quarter of the horizon; `unseen` is the log scale of the rest."""
    assert query.profile is not None
    assert query.openings is not None
    log_scale = np.full((HYPOTHESES, COLUMNS), unseen)
    shown = (np.arange(COLUMNS // 4) + np.arange(0, COLUMNS, COLUMNS // HYPOTHESES)[:, None]) % COLUMNS
    np.put_along_axis(log_scale, shown, np.log(0.06), axis=1)
    blank = np.broadcast_to(np.log(query.openings.prior), query.openings.log_probability.shape)
    openings = np.where(
        np.isfinite(log_scale)[..., None] & (log_scale < 0)[..., None], query.openings.log_probability, blank
    )
    return dataclasses.replace(
        query,
        latents=query.latents[:hypotheses],
        roll=query.roll[:hypotheses],
        profile=PredictedProfile(query.profile.log_m[:hypotheses], log_scale[:hypotheses]),
        openings=PredictedOpenings(openings[:hypotheses], query.openings.prior),
        is_view=True,
    )


def direct_coarse_costs(binned: BinnedLayouts, cost: MatchingCost, layouts: Layouts) -> np.ndarray:
    """Return the coarse costs by their definition, without tables."""
    number = np.floor(np.clip(layouts.log_profile[:, binned.columns].astype(np.float32), math.log(0.1), None) / 0.05)
    modes, which = cost.predicted_modes(binned.columns)
    centre, precision, odds = np.moveaxis(modes[which][:, :, 0], 2, 0)
    assert (odds == 1.0).all()
    (loss,), kind = present(cost.opening_costs(binned.columns)), present(layouts.kind)[:, binned.columns]
    found = []
    for k in range(cost.hypotheses):
        residual = (0.05 * (number + 0.5) - centre[k] - cost.offsets[:, None, None]) * precision[k]
        walls = np.log1p(np.square(residual)).mean(axis=2) + cost.room_costs[:, layouts.room_index]
        found.append(walls.min(axis=0) + loss[k, np.arange(len(binned.columns)), kind].mean(axis=1))
    return np.stack(found, axis=1)


def matching_cost_of(building: Building, query: Query, weights: MatchingWeights = WEIGHTS) -> MatchingCost:
    return MatchingCost(building.plan, query, CONFIG.grid_reach * STEP_M, weights, CONFIG)


def probabilities(pose: np.ndarray, cost: np.ndarray, poses: int) -> np.ndarray:
    weight = np.exp(-WEIGHTS.temperature * (cost - cost.min()).astype(float))
    return np.bincount(pose, weight, poses) / weight.sum()


@pytest.mark.slow
def test_best_pose_and_posterior_equal_the_exhaustive_search(
    building: Building, grid: PoseGrid, queries: list[Query]
) -> None:
    compared = 0
    for query in queries:
        found = grid_costs(building.plan, grid, query, WEIGHTS, CONFIG)
        every, offset = matching_cost_of(building, query).costs(grid.layouts(building.plan))
        hypothesis, pose = np.unravel_index(every.argmin(), every.shape)
        best = retrieve(found, grid, query, top_k=5, separation_m=1.0)[0]
        np.testing.assert_array_equal(best.position_m, grid.poses.position_m[pose])
        assert best.hypothesis == hypothesis
        assert best.cost == pytest.approx(float(every.min()), abs=1e-5)
        assert best.height_offset == pytest.approx(float(offset[hypothesis, pose]))
        exact = slice(0, found.compared)
        np.testing.assert_allclose(found.cost[exact], every[found.hypothesis[exact], found.pose[exact]], atol=1e-5)
        places = np.tile(np.arange(len(grid.poses)), HYPOTHESES)
        expected = probabilities(places, every.ravel(), len(grid.poses))
        got = probabilities(found.pose, found.cost, len(grid.poses))
        assert 0.5 * np.abs(expected - got).sum() < 0.01
        compared += found.compared
    assert compared < 0.15 * QUERIES * len(grid.poses) * HYPOTHESES


def test_estimated_pairs_keep_their_share_of_the_probability(
    building: Building, grid: PoseGrid, queries: list[Query], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lalaloc_core.localise.search.retrieval._MIN_COMPARED", 64)
    monkeypatch.setattr("lalaloc_core.localise.search.retrieval._MAX_COMPARED", 64)
    # At this temperature thousands of pairs share the probability.
    unsure = MatchingWeights(temperature=8.0, openings=0.4)
    ratios = []
    for query in queries:
        found = grid_costs(building.plan, grid, query, unsure, CONFIG)
        every, _ = matching_cost_of(building, query, unsure).costs(grid.layouts(building.plan))
        assert found.compared == 64 < len(found.cost)
        whole = np.exp(-8.0 * (every - every.min()).astype(float)).sum()
        ratios.append(np.exp(-8.0 * (found.cost - every.min()).astype(float)).sum() / whole)
        seen = np.exp(-8.0 * (found.cost[:64] - every.min()).astype(float)).sum() / whole
        assert seen < 0.8
    assert 0.75 < np.median(ratios) < 1.3


def test_pair_costs_equal_the_full_matrix(building: Building, grid: PoseGrid, queries: list[Query]) -> None:
    layouts, rng = grid.layouts(building.plan), np.random.default_rng(1)
    assert layouts.seen is not None
    matching_cost = MatchingCost(building.plan, queries[1], 0.3, WEIGHTS, CONFIG)
    every, offset = matching_cost.costs(layouts)
    pose, hypothesis = rng.integers(0, len(layouts), 700), rng.integers(0, HYPOTHESES, 700)
    cost, found = matching_cost.pairs(layouts, pose, hypothesis)
    np.testing.assert_allclose(cost, every[hypothesis, pose], atol=1e-5)
    assert (found == offset[hypothesis, pose]).mean() > 0.99


@pytest.mark.parametrize(
    "limits", [{"at_most": 6000, "at_least": 200, "window": 0.5}, {"at_most": 300, "at_least": 300, "window": 0.0}]
)
@pytest.mark.parametrize("told", [None, "hints", "fixtures", "directions"])
@pytest.mark.parametrize("chunk", [64, 1024])
@pytest.mark.parametrize("azimuths", [SPHERE_AZIMUTHS, VIEW_AZIMUTHS])
def test_likeliest_pairs_equal_a_complete_coarse_pass(
    building: Building,
    grid: PoseGrid,
    queries: list[Query],
    limits: dict[str, Any],
    told: str | None,
    chunk: int,
    azimuths: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Plans of at most so many poses are compared without bounds.
    monkeypatch.setattr("lalaloc_core.localise.match.coarse_pass._LAST_CHUNK", chunk)
    compared, rng, poses = 0, np.random.default_rng(2), len(grid.poses)
    for query in queries[:2]:
        # Half of the poses are excluded, or have a cost for each heading.
        hint = np.where(rng.random(poses) < 0.5, np.inf, 0.1) if told == "hints" else np.zeros(poses)
        fixtures = rng.random((8 if told == "fixtures" else 1, HYPOTHESES)).astype(np.float32) * 0.2
        row = rng.integers(0, len(fixtures), poses)
        # Directions of walls have a cost for each room and heading.
        rooms = len(building.plan.rooms)
        directions = rng.random((rooms if told == "directions" else 1, HYPOTHESES)).astype(np.float32) * 0.2
        room = grid.poses.room_index if told == "directions" else np.zeros(poses, np.intp)
        penalty = None if told is None else PlaceCost(hint, ((fixtures, row), (directions, room)))
        matching_cost = matching_cost_of(building, query if azimuths == SPHERE_AZIMUTHS else view_of(query))
        binned, room_index = grid.binned(building.plan, azimuths), grid.poses.room_index
        every = coarse_costs(binned, matching_cost, room_index)
        every = every if penalty is None else every + penalty.of_poses(np.arange(poses))
        found, pair = likeliest(binned, matching_cost, room_index, penalty, **limits)
        count = int((every <= every.min() + limits["window"]).sum())
        count = min(max(count, limits["at_least"]), limits["at_most"])
        np.testing.assert_allclose(found[:count], np.sort(every.ravel())[:count], atol=1e-6)
        np.testing.assert_allclose(every.ravel()[pair], found, atol=1e-6)
        assert len(np.unique(pair)) == len(pair) <= limits["at_most"]
        compared += len(np.unique(pair // HYPOTHESES))
    assert compared < 2 * len(grid.poses)


# Spheres, and views, of which a known heading with a tolerance has an odd number of hypotheses.
@pytest.mark.parametrize(
    ("azimuths", "hypotheses"), [(SPHERE_AZIMUTHS, HYPOTHESES), *((VIEW_AZIMUTHS, n) for n in (HYPOTHESES, 9, 1))]
)
def test_coarse_costs_equal_their_definition(
    building: Building, grid: PoseGrid, queries: list[Query], azimuths: int, hypotheses: int
) -> None:
    layouts, binned = grid.layouts(building.plan), grid.binned(building.plan, azimuths)
    assert azimuths == SPHERE_AZIMUTHS or len(binned.walls) > 1
    for query in queries[:3]:
        asked = query if azimuths == SPHERE_AZIMUTHS else view_of(query, hypotheses)
        cost = matching_cost_of(building, asked)
        found = coarse_costs(binned, cost, grid.poses.room_index)
        np.testing.assert_allclose(found, direct_coarse_costs(binned, cost, layouts), atol=1e-5)


def test_columns_that_a_view_does_not_show_cost_nothing(
    building: Building, grid: PoseGrid, queries: list[Query]
) -> None:
    layouts, rng = grid.layouts(building.plan), np.random.default_rng(3)
    pose, hypothesis = rng.integers(0, len(layouts), 700), rng.integers(0, HYPOTHESES, 700)
    walls = dataclasses.replace(CONFIG, use_openings=False)
    for query in queries[:3]:
        # Precisions close to 0 cost nothing as well, but all columns are compared.
        cost, every = (
            MatchingCost(building.plan, view_of(query, unseen=unseen), 0.4, WEIGHTS, walls) for unseen in (np.inf, 30.0)
        )
        for found, expected in (
            (cost.pairs(layouts, pose, hypothesis), every.pairs(layouts, pose, hypothesis)),
            (cost.costs(layouts), every.costs(layouts)),
        ):
            np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(("azimuths", "most"), [(SPHERE_AZIMUTHS, 0.1), (VIEW_AZIMUTHS, 0.6)])
def test_bound_is_at_most_the_coarse_cost(
    building: Building, grid: PoseGrid, queries: list[Query], azimuths: int, most: float
) -> None:
    ranks = []
    for query in queries[:8]:
        matching_cost = matching_cost_of(building, query if azimuths == SPHERE_AZIMUTHS else view_of(query))
        binned, room_index = grid.binned(building.plan, azimuths), grid.poses.room_index
        every = coarse_costs(binned, matching_cost, room_index)
        bound = CoarseTable(binned, matching_cost).bounds(binned, room_index)
        least = every.min(axis=1)
        assert (bound <= least).all()
        ranks.append((bound < bound[least.argmin()]).mean())
    assert np.median(ranks) < most


@given(seeds(), st.integers(1, 60))
def test_lowest_costs_of_slices_equal_those_of_the_whole(seed: int, limit: int) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.normal(size=(90, 3))
    cost[rng.random(cost.shape) < 0.2] = np.inf
    lowest = LowestCosts(limit)
    for first in range(0, 90, 16):
        lowest.offer(np.arange(first, min(first + 16, 90)), cost[first : first + 16])
    found, pair = lowest.ranked()
    finite = np.sort(cost[np.isfinite(cost)])
    np.testing.assert_array_equal(found, finite[:limit])
    np.testing.assert_array_equal(cost.ravel()[pair], found)


@given(seeds(), st.integers(0, 40))
def test_equal_costs_are_ordered_by_pair(seed: int, poses: int) -> None:
    cost = np.random.default_rng(seed).integers(0, 20, (poses, 3)) / 8.0
    lowest = LowestCosts(1000)
    lowest.offer(np.arange(poses), cost)
    _, pair = lowest.ranked()
    np.testing.assert_array_equal(pair, np.argsort(cost.ravel(), kind="stable"))
