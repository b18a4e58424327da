"""Tests of the pipeline: a query through all stages with real networks, and shares of places that look alike."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import HEADING_SEPARATION, photograph_heading
from lalaloc_core.localise.encode.layout_encoder import build_grid
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import CameraHeight, Candidate, Query
from lalaloc_core.localise.refine import RefinementJob, RefinementResult
from lalaloc_core.localise.refine.latent_refiner import PoseRefiner
from lalaloc_core.localise.search.pipeline import Localisation, LocaliseConfig, Refine, StageClock, localise
from lalaloc_core.render.sampling import PoseSet, random_poses
from tests.core.questions import perfect_query
from tests.strategies import crooked_flat, plan_of, present, rectangle, seeds

CAMERA_M = 1.5
EXACT = CameraHeight(CAMERA_M, 0.0)
FLAT = crooked_flat()
Search = Callable[..., Localisation]


@pytest.fixture(scope="module")
def search(grid: PoseGrid, encoders: PhotographEncoder, optimiser: PoseRefiner) -> Search:
    return partial(localise, FLAT, grid, encoders.layouts, refiner=optimiser.refine)


@pytest.fixture(scope="module")
def grid(encoders: PhotographEncoder) -> PoseGrid:
    return build_grid(FLAT, encoders.layouts, step_m=0.5, camera_height_m=CAMERA_M)


def layout_query(encoders: PhotographEncoder, plan: FloorPlan, pose: PoseSet, *, by_profile: bool = False) -> Query:
    log_scale = -5.0 if by_profile else None
    return perfect_query(encoders, plan, pose.position_m[0], log_scale=log_scale, height=EXACT)


def random_pose(plan: FloorPlan, seed: int) -> PoseSet:
    return random_poses(plan, 1, np.random.default_rng(seed))


class TestAccuracy:
    @pytest.mark.parametrize("by_profile", [False, True])
    def test_each_stage_is_more_accurate_and_costs_less(
        self, encoders: PhotographEncoder, search: Search, by_profile: bool
    ) -> None:
        errors: dict[Refine, list[float]] = {"none": [], "vdr": [], "lpo": []}
        for seed in range(10):
            pose = random_pose(FLAT, seed)
            query = layout_query(encoders, FLAT, pose, by_profile=by_profile)
            best = [search(query, refine=refine).candidates[0] for refine in errors]
            for distances, candidate in zip(errors.values(), best, strict=True):
                distances.append(float(np.linalg.norm(candidate.position_m - pose.position_m[0])))
            costs = [candidate.cost for candidate in best]
            # By walls, VDR lowers another cost than LPO.
            assert by_profile or costs == sorted(costs, reverse=True)
            # Batches of other sizes round differently.
            latent_distances = [candidate.latent_distance for candidate in best]
            assert by_profile or costs == pytest.approx(latent_distances, abs=2e-3)
        median = {refine: float(np.median(distances)) for refine, distances in errors.items()}
        assert median["lpo"] < 0.005 < median["vdr"] < median["none"] < 0.5
        assert np.mean(np.array(errors["lpo"]) < 0.01) >= 0.8


class TestCandidates:
    @given(seed=seeds(), top_k=st.integers(1, 10), heading_known=st.booleans(), refine=st.sampled_from(["none", "lpo"]))
    @settings(max_examples=20)
    def test_candidates_are_ranked_distinct_and_inside_rooms(
        self, encoders: PhotographEncoder, search: Search, seed: int, top_k: int, heading_known: bool, refine: Refine
    ) -> None:
        image = np.random.default_rng(seed).integers(0, 256, (32, 64, 3), dtype=np.uint8)
        query = encoders.spheres.query(image, 1.0 if heading_known else None, CameraHeight(CAMERA_M))
        found = search(query, refine=refine, top_k=top_k)
        positions = np.stack([candidate.position_m for candidate in found.candidates])
        assert 1 <= len(positions) <= top_k
        gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + 10.0 * np.eye(len(positions))
        turns = np.array([photograph_heading(query, candidate) for candidate in found.candidates])
        turned = np.abs(wrap_angle(turns[:, None] - turns[None])) > HEADING_SEPARATION
        assert np.all((gaps >= 1.0) | turned)
        refined = [candidate.cost for candidate in found.candidates if candidate.information is not None]
        coarse = [candidate.cost for candidate in found.candidates if candidate.information is None]
        assert bool(refined) == (refine == "lpo")
        assert [candidate.information is None for candidate in found.candidates] == sorted(
            candidate.information is None for candidate in found.candidates
        )
        for costs in (refined, coarse):
            # The candidates' costs are computed in other batches than those that ranked them, and round differently.
            assert np.all(np.diff(costs) >= -1e-5)
        assert found.best[found.stage] == found.candidates[0]
        assert FLAT.room_index_at(positions).tolist() == [candidate.room_index for candidate in found.candidates]
        for candidate in found.candidates:
            assert -math.pi <= photograph_heading(query, candidate) <= math.pi

    def test_small_plan_has_fewer_candidates(self, encoders: PhotographEncoder) -> None:
        plan = plan_of(rectangle(1.2, 1.2))
        grid = build_grid(plan, encoders.layouts, step_m=0.5, camera_height_m=CAMERA_M)
        query = layout_query(encoders, plan, PoseSet(np.array([[0.5, 0.6]]), np.array([0])))
        assert len(localise(plan, grid, encoders.layouts, query, refine="vdr", top_k=5).candidates) == 1

    def test_localisation_is_deterministic(self, encoders: PhotographEncoder, search: Search) -> None:
        query = layout_query(encoders, FLAT, random_pose(FLAT, 1))
        first, second = (search(query).candidates for _ in range(2))
        assert first == second

    @given(st.floats(-math.pi, math.pi), st.floats(-10.0, 10.0))
    def test_headings_are_wrapped(self, roll: float, frame_heading: float) -> None:
        query = Query(np.eye(2), np.array([0.0, roll]), 0.0, heading_known=False, camera_height=EXACT)
        heading = photograph_heading(query, Candidate(0.0, 0.0, 0, frame_heading, 1, 0.0, 0.0))
        assert -math.pi <= heading <= math.pi
        assert abs(wrap_angle(heading - roll - frame_heading)) < 1e-9


class TestStages:
    @pytest.fixture
    def query(self, encoders: PhotographEncoder) -> Query:
        return layout_query(encoders, FLAT, random_pose(FLAT, 3))

    def test_localisation_names_its_stage(self, search: Search, query: Query) -> None:
        def stage(**options: Any) -> tuple[str, set[str]]:
            found = search(query, **options)
            return found.stage, set(found.timings_ms)

        assert stage(refine="none") == ("retrieval", {"retrieve"})
        assert stage(refine="vdr") == ("vdr", {"retrieve", "vdr"})
        assert stage(refine="lpo") == ("lpo", {"retrieve", "vdr", "lpo"})
        assert stage(refine="lpo", refiner=None) == ("vdr", {"retrieve", "vdr"})

    def test_absent_refinement_keeps_the_vdr_pose(self, search: Search, query: Query) -> None:
        without = search(query, refine="vdr")
        late = search(query, refiner=lambda job: None)
        assert late.stage == "vdr"
        assert late.candidates == without.candidates

    def test_best_refined_candidate_is_first(self, search: Search, query: Query) -> None:
        jobs: list[RefinementJob] = []

        def refiner(job: RefinementJob) -> RefinementResult:
            jobs.append(job)
            cost = np.linspace(1.9, 0.9, len(job.position_m))
            return refinement_result(job, position_m=job.position_m + 0.01, cost=cost)

        found = search(query, refiner=refiner)
        np.testing.assert_array_equal(found.candidates[0].position_m, jobs[0].position_m[-1] + 0.01)
        assert found.candidates[0].cost == 0.9
        assert found.candidates[0].latent_distance == 0.5
        np.testing.assert_array_equal(found.candidates[0].information, np.eye(2))
        assert found.signals["lpo"].cost == 0.9

    def test_signals_are_independent_of_top_k(self, search: Search, query: Query) -> None:
        few, many = (search(query, top_k=k) for k in (1, 10))
        assert list(few.signals) == list(few.best) == ["retrieval", "vdr", "lpo"]
        assert few.signals == many.signals
        assert few.signals["lpo"].cost == few.candidates[0].cost

    def test_profile_query_runs_vdr_only_if_needed(self, encoders: PhotographEncoder, search: Search) -> None:
        query = layout_query(encoders, FLAT, random_pose(FLAT, 3), by_profile=True)
        every = LocaliseConfig(every_stage=True)
        short = search(query)
        complete = search(query, config=every)
        lost = search(query, refiner=lambda job: None)
        assert list(short.best) == ["lpo"]
        assert list(complete.best) == ["retrieval", "vdr", "lpo"]
        assert list(lost.best) == ["retrieval", "vdr"]
        assert lost.stage == "vdr"
        assert "vdr" not in short.timings_ms
        assert complete.timings_ms["vdr"] > 0.0
        assert short.candidates == complete.candidates
        assert short.signals["lpo"] == complete.signals["lpo"]

    def test_refiner_gets_each_candidates_room_and_target(self, encoders: PhotographEncoder, search: Search) -> None:
        jobs: list[RefinementJob] = []
        image = np.random.default_rng(0).integers(0, 256, (32, 64, 3), dtype=np.uint8)
        for heading in (None, 0.5):
            query = encoders.spheres.query(image, heading, CameraHeight(CAMERA_M))
            assert query.profile is not None
            search(query, refiner=lambda job: jobs.append(job))
            expected = search(query, refine="none").candidates
            job = jobs[-1]
            assert job.optimise_heading == (heading is None)
            assert job.log_profile is not None
            for candidate in expected:
                # Candidates at the same place with different headings are separate starts.
                same_place = (job.position_m == candidate.position_m).all(axis=1)
                same_target = (job.targets == query.latents[candidate.hypothesis]).all(axis=1)
                index = int(np.flatnonzero(same_place & same_target)[0])
                np.testing.assert_array_equal(job.log_profile[index], query.profile.log_m[candidate.hypothesis])
                np.testing.assert_array_equal(job.walls_m[index], FLAT.walls_m[candidate.room_index])
                assert job.heading[index] == candidate.frame_heading
                assert job.camera_height_m[index] == CAMERA_M

    def test_number_of_refined_candidates_is_configured(
        self, encoders: PhotographEncoder, search: Search, query: Query
    ) -> None:
        refiner = Mock(return_value=None)
        config = LocaliseConfig(lpo_candidates=2, profile_candidates=3)
        by_profile = layout_query(encoders, FLAT, random_pose(FLAT, 3), by_profile=True)
        for start in (query, by_profile):
            assert len(search(start, top_k=4, refiner=refiner, config=config).candidates) == 4
        assert [len(call.args[0].position_m) for call in refiner.call_args_list] == [2, 3]

    def test_candidates_that_meet_become_one(self, search: Search, query: Query) -> None:
        def refiner(job: RefinementJob) -> RefinementResult:
            count = len(job.position_m)
            together = np.repeat(job.position_m[:1], count, axis=0)
            return refinement_result(job, position_m=together, cost=np.linspace(0.0, 1e-3, count))

        found = search(query, top_k=5, refiner=refiner)
        places = np.stack([candidate.position_m for candidate in found.candidates])
        assert np.linalg.norm(places[1:] - places[0], axis=1).min(initial=9.0) >= 1.0

    def test_posterior_pairs_each_refined_candidate_with_its_mode(
        self, grid: PoseGrid, encoders: PhotographEncoder, search: Search
    ) -> None:
        def unmoved(job: RefinementJob) -> RefinementResult:
            return refinement_result(job, position_m=job.position_m, cost=np.linspace(0.1, 0.2, len(job.position_m)))

        config = LocaliseConfig(vdr_candidates=5)
        for seed in range(5):
            query = layout_query(encoders, FLAT, random_pose(FLAT, seed))
            support = search(query, refiner=unmoved, config=config).posterior.support
            # Re-sampling moves a mode by at most the radius of the disc.
            moved_m = np.linalg.norm(support.position_m - grid.poses.position_m[support.pose], axis=1)
            assert moved_m.max() <= config.vdr_radius_steps * grid.step_m

    def test_clock_counts_a_failed_stage(self) -> None:
        clock = StageClock()
        with pytest.raises(RuntimeError), clock.stage("lpo"):
            raise RuntimeError
        assert clock.timings_ms["lpo"] >= 0.0


class TestGrid:
    def test_grid_has_latents_and_profiles_at_heading_zero(self, grid: PoseGrid, encoders: PhotographEncoder) -> None:
        assert len(present(grid.latents)) == len(grid.poses)
        index = np.array([0, 5, len(grid.poses) - 1])
        poses = PoseSet(grid.poses.position_m[index], grid.poses.room_index[index])
        latents, profile_m = encoders.layouts.poses(FLAT, poses, np.zeros(3), CAMERA_M)
        np.testing.assert_allclose(latents, present(grid.latents)[index], atol=1e-5)
        np.testing.assert_array_equal(profile_m, grid.profile_m[index])

    def test_grid_depends_on_the_camera_height(self, grid: PoseGrid, encoders: PhotographEncoder) -> None:
        higher = build_grid(FLAT, encoders.layouts, step_m=0.5, camera_height_m=1.8)
        assert dataclasses.replace(higher, latents=grid.latents).camera_height_m == 1.8
        assert np.abs(present(higher.latents) - grid.latents).max() > 1e-3


def refinement_result(job: RefinementJob, *, position_m: np.ndarray, cost: np.ndarray) -> RefinementResult:
    count = len(cost)
    return RefinementResult(
        position_m=position_m,
        heading=job.heading,
        cost=cost,
        latent_distance=np.full(count, 0.5),
        information=np.tile(np.eye(2), (count, 1, 1)),
    )


LOG_SCALE = -3.5
# Not a multiple of the grid's step, so that the lattice lies differently in every copy.
APART_M = 0.17
COPIES = [2, 8]


def copied(polygons: list[Any], count: int) -> FloorPlan:
    step_m = float(np.ptp(np.concatenate(polygons)[:, 0])) + 1.0 + APART_M
    shift = [np.array([k * step_m, 0.13 * k]) for k in range(count)]
    return plan_of(*((np.array(polygon) + by).tolist() for by in shift for polygon in polygons))


def localised(
    encoders: PhotographEncoder,
    optimiser: PoseRefiner,
    plan: FloorPlan,
    place_m: tuple[float, float],
    *,
    known: bool,
    noise: float = 0.0,
    seed: int = 0,
) -> Localisation:
    """Localise a perfect picture of a place, with some noise of the encoders' outputs."""
    query = perfect_query(encoders, plan, place_m, hypotheses=1 if known else 64, log_scale=LOG_SCALE)
    profile = present(query.profile)
    grain = np.random.default_rng(seed).normal(size=profile.log_m.shape).astype(np.float32)
    query = dataclasses.replace(query, profile=dataclasses.replace(profile, log_m=profile.log_m + noise * grain))
    grid = build_grid(plan, encoders.layouts, step_m=0.5, camera_height_m=CAMERA_M)
    return localise(plan, grid, encoders.layouts, query, refiner=optimiser.refine, top_k=10)


@pytest.mark.parametrize("known", [True, False], ids=["heading known", "heading searched"])
@pytest.mark.parametrize("count", COPIES)
class TestShares:
    @pytest.mark.parametrize("place_m", [(1.37, 1.12), (5.1, 1.3)])
    def test_copies_of_a_flat_share_the_probability(
        self, encoders: PhotographEncoder, optimiser: PoseRefiner, count: int, known: bool, place_m: tuple[float, float]
    ) -> None:
        plan = copied([room.polygon_m for room in FLAT.rooms], count)
        found = localised(encoders, optimiser, plan, place_m, known=known)
        assert 0.6 / count <= found.posterior.position <= 1.0 / count + 0.05

    @pytest.mark.parametrize("width_m", [0.9, 1.15, 1.6, 2.9])
    def test_equal_offices_share_the_probability(
        self, encoders: PhotographEncoder, optimiser: PoseRefiner, count: int, known: bool, width_m: float
    ) -> None:
        plan = copied([np.array(rectangle(width_m, 4.1))], count)
        found = localised(encoders, optimiser, plan, (0.4 * width_m, 1.3), known=known)
        assert found.posterior.position <= 1.0 / count + 0.05


class TestHeadings:
    @pytest.mark.parametrize(("depth_m", "ways"), [(4.6, 2), (3.2, 4)], ids=["rectangle", "square"])
    @pytest.mark.parametrize("place_m", [(0.9, 1.1), (1.6, 0.0)], ids=["corner", "middle"])
    @pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-5])
    def test_symmetric_room_is_split_between_its_headings(
        self,
        encoders: PhotographEncoder,
        optimiser: PoseRefiner,
        depth_m: float,
        ways: int,
        place_m: tuple[float, float],
        noise: float,
    ) -> None:
        middle = place_m[1] == 0.0
        plan, place_m = plan_of(rectangle(3.2, depth_m)), (1.6, 0.5 * depth_m) if middle else place_m
        found = localised(encoders, optimiser, plan, place_m, known=False, noise=noise)
        headings = [photograph_heading(found.query, candidate) for candidate in found.candidates[:ways]]
        step = TWO_PI / ways
        turns = sorted(round(heading / step) % ways for heading in headings)
        assert turns == list(range(ways)), [math.degrees(heading) for heading in headings]
        assert found.posterior.candidate[:ways] == pytest.approx([1.0 / ways] * ways, abs=1e-3)
        assert found.posterior.heading <= 1.0 / ways + 0.05
        # In the middle of the room, all headings are at one place.
        assert found.posterior.position == pytest.approx(1.0 if middle else 1.0 / ways, abs=1e-3)

    def test_first_of_equal_places_does_not_depend_on_rounding(
        self, encoders: PhotographEncoder, optimiser: PoseRefiner
    ) -> None:
        plan = plan_of(rectangle(3.2, 3.2))
        first = localised(encoders, optimiser, plan, (0.9, 1.1), known=False).candidates[0]
        for seed in range(3):
            noisy = localised(encoders, optimiser, plan, (0.9, 1.1), known=False, noise=1e-6, seed=seed).candidates[0]
            assert noisy.position_m == pytest.approx(first.position_m, abs=1e-3)
            assert noisy.hypothesis == first.hypothesis
