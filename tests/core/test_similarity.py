"""Layout similarity and ICP against slow definitions, exact searches and true poses."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import DatasetError, InvalidInputError
from lalaloc_core.evaluate.methods import similarity
from lalaloc_core.evaluate.methods.icp import Icp, IcpConfig, align, best_motion, merge_cells, scan_of, wall_cloud
from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.evaluate.methods.similarity import (
    ChamferGrid,
    DepthGrid,
    EdgeGrid,
    Layout,
    LayoutMetric,
    PoseOracle,
    SimilarityRetrieval,
    edge_image,
    layout_grid,
)
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.sampling import PoseSet, pose_grid, random_poses
from tests.core.questions import CAMERA_M, BareRoom, question_at
from tests.strategies import crooked_flat, l_shape, plan_of, plans, present, rectangle, scene_of, seeds

ROWS, COLUMNS = 8, 16


def layout_at(plan: FloorPlan, position_m: np.ndarray, columns: int, camera_height_m: float = CAMERA_M) -> Layout:
    room = plan.room_index_at(position_m[None])
    profile = wall_profile(position_m[None], np.zeros(1), plan.walls_m[room], columns)[0]
    ceiling = float(plan.ceiling_heights_m[room][0])
    return Layout(profile_m=profile, camera_height_m=camera_height_m, ceiling_height_m=ceiling)


def slow_cloud(layout: Layout, rows: int) -> np.ndarray:
    """Return the points of a layout, pixel by pixel."""
    points = []
    columns = len(layout.profile_m)
    for i in range(rows):
        elevation = (0.5 - (i + 0.5) / rows) * math.pi
        for j, wall in enumerate(layout.profile_m):
            azimuth = ((j + 0.5) / columns - 0.5) * 2.0 * math.pi
            height = layout.ceiling_height_m - layout.camera_height_m if elevation > 0.0 else layout.camera_height_m
            horizontal = min(wall, height / abs(math.tan(elevation)))
            points.append(
                [horizontal * math.sin(azimuth), horizontal * math.cos(azimuth), horizontal * math.tan(elevation)]
            )
    return np.array(points)


def slow_chamfer(first: np.ndarray, second: np.ndarray) -> float:
    distance = np.linalg.norm(first[:, None] - second[None], axis=2)
    return float(distance.min(axis=0).mean() + distance.min(axis=1).mean())


def some_poses(plan: FloorPlan, seed: int, count: int = 12) -> PoseSet:
    return random_poses(plan, count, np.random.default_rng(seed))


class TestChamfer:
    @given(plan=plans(), elsewhere=plans(), seed=seeds())
    @settings(max_examples=15)
    def test_distance_is_chamfer_of_clouds(self, plan: FloorPlan, elsewhere: FloorPlan, seed: int) -> None:
        poses = some_poses(plan, seed)
        clouds = [slow_cloud(layout_at(plan, position, COLUMNS), ROWS) for position in poses.position_m]
        grid = ChamferGrid(plan, poses, CAMERA_M, rows=ROWS, columns=COLUMNS)
        # The same plan and height, where floors coincide, and another plan and height.
        queries = [
            layout_at(plan, some_poses(plan, seed + 1, 1).position_m[0], COLUMNS),
            layout_at(elsewhere, some_poses(elsewhere, seed, 1).position_m[0], COLUMNS, 1.1),
        ]
        for query in queries:
            expected = np.array([slow_chamfer(cloud, slow_cloud(query, ROWS)) for cloud in clouds])
            np.testing.assert_allclose(grid.distances(query), expected, atol=1e-9)
            assert expected[grid.nearest(query)] == pytest.approx(expected.min(), abs=1e-9)

    def test_search_skips_most_poses(self, monkeypatch: pytest.MonkeyPatch) -> None:
        plan = plan_of(rectangle(4.0, 3.0), rectangle(6.0, 5.0, (5.0, 0.0)), rectangle(3.0, 8.0, (12.0, 0.0)))
        poses = some_poses(plan, 3, 200)
        grid, searched = ChamferGrid(plan, poses, CAMERA_M), []
        counted = similarity._Comparison.from_query
        monkeypatch.setattr(
            similarity._Comparison, "from_query", lambda self, index: searched.append(index) or counted(self, index)
        )
        query = layout_at(plan, np.array([2.0, 1.2]), grid.columns)
        assert grid.nearest(query) == int(np.linalg.norm(poses.position_m - [2.0, 1.2], axis=1).argmin())
        assert len(searched) < 0.1 * len(poses)


class TestDepth:
    @pytest.mark.parametrize("relative", [False, True])
    @given(plan=plans(), seed=seeds())
    @settings(max_examples=10)
    def test_distance_is_mean_pixel_difference(self, relative: bool, plan: FloorPlan, seed: int) -> None:
        poses = some_poses(plan, seed, 4)
        query = layout_at(plan, some_poses(plan, seed + 1, 1).position_m[0], COLUMNS)

        def image(layout: Layout) -> np.ndarray:
            depth = np.linalg.norm(slow_cloud(layout, ROWS), axis=1)
            return depth / depth.max() if relative else depth

        layouts = [layout_at(plan, position, COLUMNS) for position in poses.position_m]
        expected = [sum(abs(image(layout) - image(query))) / (ROWS * COLUMNS) for layout in layouts]
        grid = DepthGrid(plan, poses, CAMERA_M, relative=relative, rows=ROWS, columns=COLUMNS)
        np.testing.assert_allclose(grid.distances(query), expected, atol=1e-5)


class TestEdges:
    @given(plan=plans(), seed=seeds())
    @settings(max_examples=8)
    def test_distance_is_chamfer_of_edges_wrapping_around(self, plan: FloorPlan, seed: int) -> None:
        poses = some_poses(plan, seed, 4)
        query = layout_at(plan, some_poses(plan, seed + 1, 1).position_m[0], 32)

        def pixels(layout: Layout) -> np.ndarray:
            heights = np.array([layout.camera_height_m]), np.array([layout.ceiling_height_m])
            return np.argwhere(edge_image(layout.profile_m[None], *heights, 16)[0])

        def slow(first: np.ndarray, second: np.ndarray) -> float:
            offset = np.abs(first[:, None] - second[None]).astype(float)
            offset[..., 1] = np.minimum(offset[..., 1], 32 - offset[..., 1])
            distance = np.linalg.norm(offset, axis=2)
            return float(distance.min(axis=0).mean() + distance.min(axis=1).mean())

        expected = [slow(pixels(layout_at(plan, position, 32)), pixels(query)) for position in poses.position_m]
        grid = EdgeGrid(plan, poses, CAMERA_M, rows=16, columns=32)
        np.testing.assert_allclose(grid.distances(query), expected, atol=1e-5)


class TestAnyMetric:
    @pytest.mark.parametrize("metric", get_args(LayoutMetric))
    @given(seed=seeds())
    @settings(max_examples=5)
    def test_grid_pose_is_nearest_to_itself(self, metric: LayoutMetric, seed: int) -> None:
        plan = crooked_flat()
        poses = some_poses(plan, seed)
        grid = layout_grid(metric, plan, poses, CAMERA_M)
        for index, position in enumerate(poses.position_m):
            query = layout_at(plan, position, grid.columns)
            assert grid.distances(query)[index] < 1e-6
            assert grid.nearest(query) == index


class TestRetrieval:
    @pytest.mark.parametrize("metric", get_args(LayoutMetric))
    def test_similarity_retrieval_takes_the_nearest_layout(self, metric: LayoutMetric) -> None:
        method = SimilarityRetrieval(metric)
        for heading in (0.0, 2.0):
            question = question_at(crooked_flat(), (1.02, 1.03), heading=heading)
            answer = method.locate(question)
            found = answer.stages["retrieval"]
            assert (found.x_m, found.y_m, found.room_index) == (1.0, 1.0, 0)
            assert found.heading == pytest.approx(heading)
            np.testing.assert_array_equal(question.grid.position_m[present(answer.retrieved)], [1.0, 1.0])
            assert answer.timings_ms.keys() == {"retrieve"}

    def test_pose_oracle_takes_the_nearest_pose(self) -> None:
        # The nearest grid pose is in the room on the right.
        plan = plan_of(rectangle(2.0, 2.0), rectangle(1.0, 1.0, (2.01, 0.5)))
        grid = PoseSet(np.array([[1.5, 1.0], [2.2, 1.0]]), np.array([0, 1]))
        question = question_at(plan, (1.95, 1.0), grid=grid)
        answer = PoseOracle().locate(question)
        assert (answer.retrieved, answer.stages["retrieval"].room_index) == (1, 1)
        assert SimilarityRetrieval().locate(question).retrieved == 0


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
        photograph, grid = BareRoom(large, (7.5, 7.5), 0.0), PoseSet(np.full((1, 2), 0.5), np.zeros(1, int))
        question = question_at(small, (0.9, 0.9), photograph=photograph, grid=grid)
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
