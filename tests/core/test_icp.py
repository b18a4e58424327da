"""ICP: parts against slow oracles, alignments against the truth."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import DatasetError, InvalidInputError
from lalaloc_core.evaluate.methods.icp import Icp, IcpConfig, align, best_motion, merge_cells, scan_of, wall_cloud
from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.render.sampling import PoseSet, pose_grid
from tests.core.questions import BareRoom, question_at
from tests.strategies import crooked_flat, l_shape, plan_of, rectangle, scene_of, seeds


class TestParts:
    @given(seeds(), st.floats(0.01, 1.0))
    def test_merged_points_are_cell_means(self, seed: int, cell_m: float) -> None:
        points = np.random.default_rng(seed).uniform(-2.0, 2.0, (60, 2))
        cells: dict[tuple[int, int], list[np.ndarray]] = defaultdict(list)
        for point in points:
            cells[math.floor(point[0] / cell_m), math.floor(point[1] / cell_m)].append(point)
        expected = np.array([np.mean(cells[cell], axis=0) for cell in sorted(cells)])
        np.testing.assert_allclose(merge_cells(points, cell_m), expected, atol=1e-12)

    @given(seeds())
    def test_best_motion_equals_kabsch(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        scan, targets = rng.normal(size=(9, 2)), rng.normal(size=(3, 9, 2))
        turn, shift = best_motion(scan, targets)
        for index, target in enumerate(targets):
            u, _, vt = np.linalg.svd((scan - scan.mean(axis=0)).T @ (target - target.mean(axis=0)))
            mirrored = np.diag([1.0, np.linalg.det(vt.T @ u.T)])
            rotation = vt.T @ mirrored @ u.T
            cosine, sine = math.cos(turn[index]), math.sin(turn[index])
            np.testing.assert_allclose([[cosine, -sine], [sine, cosine]], rotation, atol=1e-6)
            np.testing.assert_allclose(shift[index], target.mean(axis=0) - rotation @ scan.mean(axis=0), atol=1e-6)

    def test_scan_points_follow_azimuth(self) -> None:
        # Columns of a scan with four: -135, -45, 45, 135 degrees from the heading, which is 45 degrees.
        points = scan_of(np.array([[1.0, np.nan, 3.0, 4.0]]), math.pi / 4)
        np.testing.assert_allclose(points, [[-1.0, 0.0], [3.0, 0.0], [0.0, -4.0]], atol=1e-12)

    def test_plan_cloud_covers_exactly_the_walls(self) -> None:
        plan, config = crooked_flat(), IcpConfig()
        cloud = wall_cloud(plan, config)
        # Merging moves points at corners by a cell at most; other points stay on their wall.
        to_wall = np.min([_to_boundary(plan.rooms[k].polygon_m, cloud) for k in range(len(plan.rooms))], axis=0)
        assert to_wall.max() < config.plan_cell_m
        assert np.median(to_wall) < 1e-9
        along = np.concatenate(
            [
                room.polygon_m + s * (np.roll(room.polygon_m, -1, axis=0) - room.polygon_m)
                for room in plan.rooms
                for s in np.linspace(0.0, 1.0, 97)
            ]
        )
        assert KDTree(cloud).query(along)[0].max() < config.plan_cell_m * math.sqrt(2.0)


def _to_boundary(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    start, edge = polygon[None], (np.roll(polygon, -1, axis=0) - polygon)[None]
    share = np.clip(((points[:, None] - start) * edge).sum(axis=2) / (edge**2).sum(axis=2), 0.0, 1.0)
    return np.linalg.norm(points[:, None] - start - share[..., None] * edge, axis=2).min(axis=1)


class TestAlign:
    @given(seeds())
    @settings(max_examples=10)
    def test_near_starts_find_the_truth(self, seed: int) -> None:
        scene = scene_of(plan_of(l_shape(5.0, 4.0, 2.0, 2.5)), 1, seed, margin_m=0.3)
        rng = np.random.default_rng(seed)
        truth, off = scene.poses.position_m[0], float(rng.uniform(-0.05, 0.05))
        config = IcpConfig(max_iterations=200)
        profile = question_at(scene.plan, truth).true_profile(1024)
        scan = merge_cells(scan_of(profile[None], -off), config.cell_m)
        starts = truth + rng.uniform(-0.2, 0.2, (3, 2))
        result = align(scan, KDTree(wall_cloud(scene.plan, config)), starts, config)
        best = int(result.rms_m.argmin())
        assert np.linalg.norm(result.shift_m[best] - truth) < 0.01
        # A scan turned by -off (counter-clockwise for positive off) is turned back clockwise.
        assert abs(result.turn[best] + off) < 0.005
        assert result.rms_m[best] < 0.02

    def test_starts_are_independent(self) -> None:
        plan, config = crooked_flat(), IcpConfig()
        tree = KDTree(wall_cloud(plan, config))
        scan = merge_cells(scan_of(question_at(plan, (1.1, 1.2)).true_profile(256)[None], 0.0), config.cell_m)
        starts = pose_grid(plan, 1.0).position_m
        together = align(scan, tree, starts, config)
        for index in range(len(starts)):
            alone = align(scan, tree, starts[index : index + 1], config)
            np.testing.assert_allclose(alone.shift_m[0], together.shift_m[index], atol=1e-9)
            np.testing.assert_allclose(alone.rms_m[0], together.rms_m[index], atol=1e-9)
            assert alone.iterations[0] == together.iterations[index]
        assert together.iterations.max() <= config.max_iterations
        assert together.iterations.min() < config.max_iterations

    def test_reported_distance_is_to_nearest_points(self) -> None:
        config, cloud = IcpConfig(max_iterations=3), np.random.default_rng(0).normal(size=(40, 2))
        scan = np.random.default_rng(1).normal(size=(12, 2))
        result = align(scan, KDTree(cloud), np.array([[0.3, -0.2]]), config)
        cosine, sine = math.cos(result.turn[0]), math.sin(result.turn[0])
        moved = scan @ np.array([[cosine, sine], [-sine, cosine]]) + result.shift_m[0]
        nearest = np.linalg.norm(moved[:, None] - cloud[None], axis=2).min(axis=1)
        assert result.rms_m[0] == pytest.approx(math.sqrt(np.mean(nearest**2)))


class TestMethod:
    @pytest.mark.parametrize("position", [(1.13, 1.02), (5.21, 1.42), (2.34, 4.81)])
    def test_layout_query_is_located_to_a_centimetre(self, position: tuple[float, float]) -> None:
        answer = Icp().locate(question_at(crooked_flat(), position, heading=1.0, step_m=0.7))
        found = answer.stages["icp"]
        assert math.hypot(found.x_m - position[0], found.y_m - position[1]) < 0.01
        assert found.room_index == crooked_flat().room_index_at(np.array([position]))[0]
        assert abs(wrap_angle(found.heading - 1.0)) < 0.005
        assert answer.retrieved is None
        assert answer.timings_ms.keys() == {"icp"}

    @pytest.mark.parametrize("heading", [0.0, 2.3, -1.1])
    def test_measured_room_is_located_at_any_heading(self, heading: float) -> None:
        plan, position = crooked_flat(), (1.13, 1.02)
        question = question_at(
            plan, position, heading=heading, step_m=0.7, photograph=BareRoom(plan, position, heading, rows=128)
        )
        found = Icp().locate(question).stages["icp"]
        assert math.hypot(found.x_m - position[0], found.y_m - position[1]) < 0.02
        assert abs(wrap_angle(found.heading - heading)) < 0.01

    def test_small_heading_error_is_corrected(self) -> None:
        plan, position = crooked_flat(), (1.13, 1.02)
        photograph = BareRoom(plan, position, 1.0, rows=128)
        found = Icp().locate(question_at(plan, position, heading=1.03, photograph=photograph, step_m=0.7)).stages["icp"]
        assert abs(wrap_angle(found.heading - 1.0)) < 0.005

    @pytest.mark.parametrize("rows", [32, 64])
    def test_scan_uses_the_horizon(self, rows: int) -> None:
        plan, position = plan_of(rectangle(9.0, 7.0)), (4.2, 3.1)
        question = question_at(plan, position, step_m=2.0, photograph=BareRoom(plan, position, 0.3, rows), heading=0.3)
        found = Icp().locate(question).stages["icp"]
        assert math.hypot(found.x_m - position[0], found.y_m - position[1]) < 0.03

    def test_alignment_outside_keeps_its_start_room(self) -> None:
        # The scan of a large room does not fit a small one, so the camera ends outside.
        small, large = plan_of(rectangle(1.0, 1.0)), plan_of(rectangle(8.0, 8.0))
        question = question_at(
            small,
            (0.9, 0.9),
            photograph=BareRoom(large, (7.5, 7.5), 0.0),
            grid=PoseSet(np.full((1, 2), 0.5), np.zeros(1, int)),
        )
        found = Icp().locate(question).stages["icp"]
        assert small.room_index_at(np.array([[found.x_m, found.y_m]])).tolist() == [-1]
        assert found.room_index == 0

    def test_empty_scan_has_no_answer(self) -> None:
        @dataclass(frozen=True)
        class Dark(BareRoom):
            def depth_m(self) -> np.ndarray:
                return np.full((64, 128), np.nan)

        plan = crooked_flat()
        assert Icp().locate(question_at(plan, (1.0, 1.0), photograph=Dark(plan, (1.0, 1.0), 0.0))).stages == {}

    def test_missing_heading_or_depth_is_refused(self) -> None:
        plan = crooked_flat()
        with pytest.raises(InvalidInputError, match="heading"):
            Icp().locate(question_at(plan, (1.0, 1.0), heading_known=False))

        @dataclass(frozen=True)
        class NotMeasured(BareRoom):
            def depth_m(self) -> np.ndarray:
                raise DatasetError("the data set has no depth")

        with pytest.raises(DatasetError, match="no depth"):
            Icp().locate(question_at(plan, (1.0, 1.0), photograph=NotMeasured(plan, (1.0, 1.0), 0.0)))


@pytest.mark.slow
def test_generated_layout_queries_are_located_to_a_centimetre() -> None:
    dataset, method, errors = GeneratedScenes(homes=10, furniture="empty"), Icp(), []
    for name in dataset.scenes("test"):
        scene = dataset.load(name)
        grid = pose_grid(scene.plan, 0.5)
        for camera in scene.cameras:
            question = Question(
                plan=scene.plan, grid=grid, grid_step_m=0.5, camera=camera, kind="layout", photograph=None
            )
            found = method.locate(question).stages["icp"]
            errors.append(math.hypot(found.x_m - camera.position_m[0], found.y_m - camera.position_m[1]))
    assert len(errors) == 40
    assert np.median(errors) < 0.005
    assert np.mean(np.array(errors) < 0.01) > 0.9
