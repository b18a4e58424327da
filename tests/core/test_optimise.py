"""Tests of pose refinement (LPO): convergence, containment in the room, and batches."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
import shapely
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from lalaloc_core.bundle import LAYOUT_WEIGHTS, Bundle
from lalaloc_core.errors import BundleError
from lalaloc_core.localise.refine import LpoConfig, Problem, RefinementJob, RefinementResult, refine_walls
from lalaloc_core.localise.refine.descent_methods import descend
from lalaloc_core.localise.refine.latent_refiner import PoseRefiner
from lalaloc_core.nets.layout_network import RingConfig, RingLayoutEncoder
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.sampling import PoseSet
from tests.strategies import Scene, convex_polygons, l_shape, plan_of, present, room_polygons, scene_of, seeds

CAMERA_M, COLUMNS = 1.4, RingConfig().profile_columns
# Pruning compares the starts of a job; most tests need every start to finish.
LM = LpoConfig(prune_after=99)
ADAM = LpoConfig(method="adam")
L_ROOM = l_shape(5.0, 4.0, 2.0, 2.5)


@cache
def smooth_encoder() -> RingLayoutEncoder:
    """Untrained layout encoder: a fixed, smooth embedding of layouts, sufficient for optimisation."""
    torch.manual_seed(0)
    config = RingConfig(sectors=64, channels=8, layout_width=16, layout_dilations=(1,))
    return RingLayoutEncoder(config).eval().requires_grad_(False)


def refined(job: RefinementJob, config: LpoConfig = LM) -> RefinementResult:
    return PoseRefiner(smooth_encoder(), config).refine(job)


def latents_at(scene: Scene, position_m: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Return the latents of poses in the rooms of the scene's poses."""
    profile = wall_profile(position_m, heading, scene.walls_m, COLUMNS)
    arrays = (profile, np.full(len(profile), CAMERA_M), scene.ceiling_height_m)
    return smooth_encoder()(*(torch.tensor(array, dtype=torch.float32) for array in arrays)).numpy()


def exact_targets(scene: Scene) -> np.ndarray:
    """Return the latents of the scene's poses at heading 0."""
    return latents_at(scene, scene.poses.position_m, np.zeros(len(scene.poses)))


def job_near(scene: Scene, seed: int, *, heading_known: bool) -> RefinementJob:
    """Return a job that starts within 15 cm of the scene's poses (and 3° of heading 0), in the same room."""
    rng = np.random.default_rng(seed)
    count = len(scene.poses)
    angle, radius = rng.uniform(0.0, 2.0 * np.pi, count), 0.15 * np.sqrt(rng.uniform(0.0, 1.0, count))
    moved = scene.poses.position_m + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inside = scene.plan.room_index_at(moved) == scene.poses.room_index
    return RefinementJob(
        targets=exact_targets(scene),
        position_m=np.where(inside[:, None], moved, scene.poses.position_m),
        heading=np.zeros(count) if heading_known else rng.uniform(-0.05, 0.05, count),
        walls_m=scene.walls_m,
        camera_height_m=np.full(count, CAMERA_M),
        ceiling_height_m=scene.ceiling_height_m,
        optimise_heading=not heading_known,
    )


def profile_job(job: RefinementJob, scene: Scene, *, offset: float = 0.0) -> RefinementJob:
    """Return the job with the wall profiles of the scene's poses as targets; `offset` is added to the log profile."""
    profile = wall_profile(scene.poses.position_m, np.zeros(len(scene.poses)), scene.walls_m, COLUMNS)
    log_profile = (np.log(profile) + offset).astype(np.float32)
    return dataclasses.replace(job, log_profile=log_profile, precision=np.full_like(log_profile, 5.0))


def profile_residual(job: RefinementJob, position_m: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Return the weighted residuals of a profile job, computed with numpy, at one pose per start."""
    log_profile = np.log(wall_profile(position_m, heading, job.walls_m, present(job.log_profile).shape[1]))
    return (log_profile - present(job.log_profile)) * present(job.precision)


def profile_cost(job: RefinementJob, position_m: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Return the cost that a profile job minimises, at one pose per start."""
    return np.log1p(np.square(profile_residual(job, position_m, heading))).mean(axis=1)


def errors_m(result: RefinementResult, scene: Scene) -> np.ndarray:
    return np.linalg.norm(result.position_m - scene.poses.position_m, axis=1)


def latent_distance(result: RefinementResult) -> np.ndarray:
    return present(result.latent_distance)


def single_job(job: RefinementJob, index: int) -> RefinementJob:
    arrays = {name: value[index : index + 1] for name, value in vars(job).items() if isinstance(value, np.ndarray)}
    return dataclasses.replace(job, **arrays)


def changed(bundle: Bundle, **changes: Any) -> Bundle:
    return dataclasses.replace(bundle, manifest=dataclasses.replace(bundle.manifest, **changes))


class TestConvergence:
    @pytest.mark.slow
    @pytest.mark.parametrize("heading_known", [True, False])
    @given(polygon=convex_polygons(), seed=seeds())
    @settings(max_examples=20)
    def test_levenberg_marquardt_converges_in_convex_rooms(self, heading_known: bool, polygon: list, seed: int) -> None:
        scene = scene_of(plan_of(polygon), 4, seed)
        result = refined(job_near(scene, seed, heading_known=heading_known))
        assert errors_m(result, scene).max() < 1e-3
        assert np.abs(result.heading).max() < 1e-3
        assert latent_distance(result).max() < 1e-3

    @pytest.mark.parametrize(("config", "share"), [(LM, 0.95), (ADAM, 0.85)], ids=["lm", "adam"])
    @pytest.mark.parametrize("heading_known", [True, False])
    def test_most_starts_converge_to_1_cm_despite_occlusion(
        self, config: LpoConfig, share: float, heading_known: bool
    ) -> None:
        scene = scene_of(plan_of(L_ROOM), 24, 0)
        result = refined(job_near(scene, 1, heading_known=heading_known), config)
        assert np.mean(errors_m(result, scene) < 0.01) >= share

    @pytest.mark.slow
    @pytest.mark.parametrize("config", [LM, ADAM], ids=["lm", "adam"])
    @given(polygon=room_polygons(), seed=seeds())
    @settings(max_examples=6)
    def test_result_is_never_worse_than_the_start(self, config: LpoConfig, polygon: list, seed: int) -> None:
        scene = scene_of(plan_of(polygon), 4, seed)
        job = job_near(scene, seed, heading_known=False)
        at_start = exact_targets(Scene(scene.plan, PoseSet(job.position_m, scene.poses.room_index), scene.heading))
        # The targets are at heading 0.
        job = dataclasses.replace(job, heading=np.zeros(4))
        result = refined(job, config)
        assert (latent_distance(result) <= np.linalg.norm(at_start - job.targets, axis=1) + 1e-5).all()

    def test_start_at_the_truth_stays(self) -> None:
        scene = scene_of(plan_of(L_ROOM), 3, 5)
        job = dataclasses.replace(job_near(scene, 0, heading_known=True), position_m=scene.poses.position_m)
        assert errors_m(refined(job), scene).max() < 1e-4

    @pytest.mark.slow
    @given(seeds())
    @settings(max_examples=10)
    def test_precision_is_independent_of_the_origin(self, seed: int) -> None:
        polygon = np.add(L_ROOM, [500.0, -500.0])
        scene = scene_of(plan_of(polygon.tolist()), 3, seed)
        job = job_near(scene, seed, heading_known=True)
        near = dataclasses.replace(
            job, position_m=job.position_m - [500.0, -500.0], walls_m=job.walls_m - [500.0, -500.0, 500.0, -500.0]
        )
        shifted, original = (refined(job) for job in (job, near))
        np.testing.assert_allclose(shifted.position_m - [500.0, -500.0], original.position_m, atol=1e-4)


class TestProfiles:
    @pytest.mark.parametrize("heading_known", [True, False])
    @given(polygon=convex_polygons(), seed=seeds())
    @settings(max_examples=10)
    def test_profile_refinement_converges(self, heading_known: bool, polygon: list, seed: int) -> None:
        scene = scene_of(plan_of(polygon), 4, seed)
        job = profile_job(job_near(scene, seed, heading_known=heading_known), scene)
        result = refined(job)
        assert errors_m(result, scene).max() < 5e-3
        assert np.abs(result.heading).max() < 5e-3

    @pytest.mark.parametrize("latent_weight", [0.0, 0.5])
    def test_cost_and_latent_distance_belong_to_the_final_pose(self, latent_weight: float) -> None:
        scene = scene_of(plan_of(L_ROOM), 5, 2)
        job = profile_job(job_near(scene, 2, heading_known=False), scene, offset=0.05)
        job = dataclasses.replace(job, latent_weight=latent_weight)
        result = refined(job, LpoConfig())
        fit = profile_cost(job, result.position_m, result.heading)
        assert (fit <= profile_cost(job, job.position_m, job.heading) + 1e-5).all()
        if not latent_weight:
            assert result.latent_distance is None
            np.testing.assert_allclose(result.cost, fit, rtol=1e-3, atol=1e-4)
            return
        np.testing.assert_allclose(result.cost, fit + latent_weight * latent_distance(result), rtol=1e-3, atol=1e-4)
        latents = latents_at(scene, result.position_m, result.heading)
        np.testing.assert_allclose(latent_distance(result), np.linalg.norm(latents - job.targets, axis=1), atol=1e-4)

    @pytest.mark.parametrize("heading_known", [True, False])
    @given(polygon=room_polygons(), seed=seeds())
    @settings(max_examples=10)
    def test_numpy_refines_as_torch_does(self, heading_known: bool, polygon: list, seed: int) -> None:
        scene = scene_of(plan_of(polygon), 4, seed)
        job = profile_job(job_near(scene, seed, heading_known=heading_known), scene, offset=0.03)
        heights = np.zeros(4, np.float32)
        job = dataclasses.replace(job, height_offset=heights, height_stiffness=3.0, height_bounds=(-0.1, 0.1))
        by_torch = dataclasses.replace(job, targets=present(job.log_profile))
        # Rounding decides which step is the last near a corner; before that, both take the same steps.
        config = LpoConfig(max_iterations=3, prune_after=99)
        expected = present(descend(Problem(COLUMNS, "cauchy", by_torch, torch.empty(0)), config))
        result = present(refine_walls(job, config))
        np.testing.assert_allclose(result.position_m, expected.position_m, atol=1e-4)
        np.testing.assert_allclose(result.heading, expected.heading, atol=1e-4)
        np.testing.assert_allclose(present(result.height_offset), present(expected.height_offset), atol=1e-4)
        np.testing.assert_allclose(result.cost, expected.cost, atol=1e-4)
        assert result.information.shape == expected.information.shape == (4, *2 * (2 if heading_known else 3,))

    def test_unwanted_refinement_ends_before_the_next_iteration(self) -> None:
        scene = scene_of(plan_of(L_ROOM), 3, 1)
        job = profile_job(job_near(scene, 1, heading_known=False), scene)
        asked = iter([True, True, False])
        assert refine_walls(job, LM, wanted=lambda: next(asked)) is None
        assert list(asked) == []

    @given(seeds())
    @settings(max_examples=10)
    def test_information_is_the_curvature_of_an_exact_fit(self, seed: int) -> None:
        scene = scene_of(plan_of([[0.0, 0.0], [5.0, 0.3], [4.4, 3.8], [0.4, 3.2]]), 1, seed)
        job = profile_job(job_near(scene, seed, heading_known=False), scene)
        job = dataclasses.replace(job, position_m=scene.poses.position_m, heading=np.zeros(1))
        (information,) = refined(job).information
        np.testing.assert_allclose(information, information.T, rtol=1e-5)
        for step in 2e-4 * np.eye(3):
            ends = [(job.position_m + sign * step[:2], sign * step[2:]) for sign in (1.0, -1.0)]
            forward, backward = (profile_residual(job, *end) for end in ends)
            # A ray that crosses a corner within the step has no derivative.
            assume(np.abs(forward + backward).max() < 0.02 * np.abs(forward - backward).max())
            # The optimiser's cost is half the sum over the columns; averaging both sides cancels the odd orders.
            cost = 0.5 * COLUMNS * np.mean([profile_cost(job, *end) for end in ends])
            assert cost == pytest.approx(0.5 * step @ information @ step, rel=0.05)


class TestContainment:
    @pytest.mark.slow
    @pytest.mark.parametrize("config", [LM, ADAM], ids=["lm", "adam"])
    @given(room=room_polygons(), target_room=room_polygons(), seed=seeds(), heading_known=st.booleans())
    @settings(max_examples=15)
    def test_pose_never_leaves_its_room(
        self, config: LpoConfig, room: list, target_room: list, seed: int, heading_known: bool
    ) -> None:
        config = dataclasses.replace(config, adam_steps=40)
        # Starts lie anywhere in the room, even beside a wall; targets belong to another room or to no layout.
        scene = scene_of(plan_of(room), 5, seed, margin_m=0.01)
        targets = exact_targets(scene_of(plan_of(target_room), 5, seed))
        targets[0] = -targets[0]
        job = dataclasses.replace(
            job_near(scene, seed, heading_known=heading_known), targets=targets, position_m=scene.poses.position_m
        )
        result = refined(job, config)
        assert np.isfinite(result.position_m).all()
        assert np.isfinite(result.heading).all()
        assert shapely.contains(scene.plan.rooms[0].shape, shapely.points(result.position_m)).all()

    @pytest.mark.slow
    @pytest.mark.parametrize("config", [LM, ADAM], ids=["lm", "adam"])
    def test_pose_does_not_cross_a_thin_wall(self, config: LpoConfig) -> None:
        left = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0]]
        both = plan_of(left, [[3.05, 0.0], [6.0, 0.0], [6.0, 3.0], [3.05, 3.0]])
        start = Scene(both, PoseSet(np.array([[2.9, 1.5]]), np.array([0])), np.zeros(1))
        wide = plan_of([[0.0, 0.0], [6.0, 0.0], [6.0, 3.0], [0.0, 3.0]])
        target = Scene(wide, PoseSet(np.array([[3.6, 1.5]]), np.array([0])), np.zeros(1))
        job = dataclasses.replace(
            job_near(start, 0, heading_known=True), targets=exact_targets(target), position_m=start.poses.position_m
        )
        assert both.room_index_at(refined(job, config).position_m).tolist() == [0]


class TestBatches:
    @pytest.mark.slow
    @pytest.mark.parametrize("heading_known", [True, False])
    @given(polygon=room_polygons(), seed=seeds())
    @settings(max_examples=8)
    def test_batch_equals_single_jobs(self, heading_known: bool, polygon: list, seed: int) -> None:
        job = job_near(scene_of(plan_of(polygon), 4, seed), seed, heading_known=heading_known)
        together = refined(job)
        for index in range(4):
            alone = refined(single_job(job, index))
            np.testing.assert_allclose(alone.position_m[0], together.position_m[index], atol=1e-3)
            np.testing.assert_allclose(alone.heading[0], together.heading[index], atol=1e-3)
            np.testing.assert_allclose(latent_distance(alone)[0], latent_distance(together)[index], atol=1e-4)

    def test_batch_may_mix_rooms_and_heights(self) -> None:
        plan = plan_of(L_ROOM, [[6.0, 0.0], [9.0, 0.0], [8.0, 3.0]])
        poses = PoseSet(np.array([[1.0, 1.0], [7.5, 1.0]]), np.array([0, 1]))
        scene = Scene(plan, poses, np.zeros(2))
        result = refined(job_near(scene, 0, heading_known=True))
        assert errors_m(result, scene).max() < 1e-3

    @pytest.mark.slow
    @given(seeds())
    @settings(max_examples=10)
    def test_pruning_keeps_the_best_result(self, seed: int) -> None:
        # One start lies near the target, four anywhere in the room.
        job = job_near(scene_of(plan_of(L_ROOM), 5, seed), seed, heading_known=True)
        job = dataclasses.replace(job, targets=job.targets[:1].repeat(5, axis=0))
        pruned, full = (refined(job, config) for config in (LpoConfig(), LM))
        best = int(latent_distance(full).argmin())
        assert latent_distance(pruned).min() <= 1e-3 + latent_distance(full)[best]
        found = pruned.position_m[int(latent_distance(pruned).argmin())]
        np.testing.assert_allclose(found, full.position_m[best], atol=5e-3)

    @given(seeds())
    @settings(max_examples=10)
    def test_best_start_is_never_pruned(self, seed: int) -> None:
        job = job_near(scene_of(plan_of(L_ROOM), 1, seed), seed, heading_known=False)
        strict = LpoConfig(prune_after=1, prune_ratio=1.0)
        pruned, full = (refined(job, config) for config in (strict, LM))
        np.testing.assert_allclose(pruned.position_m, full.position_m, atol=1e-6)

    def test_known_heading_is_unchanged(self) -> None:
        job = job_near(scene_of(plan_of(L_ROOM), 3, 1), 0, heading_known=True)
        job = dataclasses.replace(job, heading=np.array([0.01, -0.02, 0.0]))
        np.testing.assert_allclose(refined(job, LpoConfig()).heading, job.heading, atol=1e-7)


class TestLoading:
    def test_unknown_network_and_unsuitable_or_missing_weights_are_bundle_errors(self, opened_bundle: Bundle) -> None:
        sizes = [opened_bundle.manifest.layout_config | {name: 24} for name in ("depth", "layout_width")]
        for changes in ({"architecture": "transformer"}, *({"layout_config": config} for config in sizes)):
            with pytest.raises(BundleError, match="does not load"):
                PoseRefiner.from_bundle(changed(opened_bundle, **changes))
        files = {name: entry for name, entry in opened_bundle.manifest.files.items() if name != LAYOUT_WEIGHTS}
        with pytest.raises(BundleError, match="has no file"):
            PoseRefiner.from_bundle(changed(opened_bundle, files=files))
