"""Layout similarity: each metric equals its slow definition, and the fast search is exact."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.methods import similarity
from lalaloc_core.evaluate.methods.similarity import (
    LAYOUT_METRICS,
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
from lalaloc_core.learn.metrics import chamfer_distance
from lalaloc_core.render.depth import back_project, layout_depth
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.sampling import PoseSet, random_poses
from tests.core.questions import CAMERA_M, question_at
from tests.strategies import crooked_flat, plan_of, plans, rectangle, seeds

ROWS, COLUMNS = 8, 16


def layout_at(plan: FloorPlan, position_m: np.ndarray, columns: int, camera_height_m: float = CAMERA_M) -> Layout:
    """Return the layout seen from one place."""
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
                [
                    horizontal * math.sin(azimuth),
                    horizontal * math.cos(azimuth),
                    horizontal * math.tan(elevation),
                ]
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

    def test_distance_agrees_with_training(self) -> None:
        plan = crooked_flat()
        poses = some_poses(plan, 0)
        walls, ceilings = plan.walls_m[poses.room_index], plan.ceiling_heights_m[poses.room_index]
        profile = wall_profile(poses.position_m, np.zeros(len(poses)), walls, 32)
        clouds = back_project(layout_depth(profile, np.full(len(poses), CAMERA_M), ceilings, 16))
        expected = chamfer_distance(clouds, np.repeat(clouds[:1], len(poses), axis=0))
        actual = ChamferGrid(plan, poses, CAMERA_M).distances(layout_at(plan, poses.position_m[0], 32))
        np.testing.assert_allclose(actual, expected, atol=1e-6)

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

    def test_relative_depth_ignores_scale(self) -> None:
        half, whole = plan_of(rectangle(3.0, 2.5), ceiling_m=2.5), plan_of(rectangle(6.0, 5.0), ceiling_m=5.0)
        poses = some_poses(half, 0, 5)
        grid = DepthGrid(half, poses, CAMERA_M, relative=True)
        for index, position in enumerate(poses.position_m):
            query = layout_at(whole, 2.0 * position, grid.columns, 2.0 * CAMERA_M)
            assert grid.distances(query)[index] < 1e-6
            assert DepthGrid(half, poses, CAMERA_M).distances(query)[index] > 0.5


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

    def test_square_room_has_two_lines_and_four_corners(self) -> None:
        plan = plan_of(rectangle(4.0, 4.0), ceiling_m=2.8)
        # At the centre: corners at odd multiples of 45 degrees, foot and top of walls at 35 degrees.
        layout = layout_at(plan, np.array([2.0, 2.0]), 128, 1.4)
        edges = edge_image(layout.profile_m[None], np.array([1.4]), np.array([2.8]), 64)[0]
        corners = np.flatnonzero(edges[32])
        np.testing.assert_array_equal(corners, [15, 16, 47, 48, 79, 80, 111, 112])
        np.testing.assert_array_equal(edges, edges[::-1])
        between = edges[:, 32]
        assert np.flatnonzero(between).tolist() == [
            math.floor((0.5 - math.atan(1.4 / 2.0) / math.pi) * 64),
            math.floor((0.5 + math.atan(1.4 / 2.0) / math.pi) * 64),
        ]

    def test_occlusion_is_an_edge(self) -> None:
        plan = plan_of([[0, 0], [6, 0], [6, 2], [2, 2], [2, 6], [0, 6]])
        layout = layout_at(plan, np.array([4.0, 1.0]), 256)
        edges = edge_image(layout.profile_m[None], np.array([CAMERA_M]), np.array([2.5]), 128)[0]
        # The inner corner hides the upper arm: seen from the camera it lies 2 m to the left and 1 m ahead.
        column = (math.atan2(-2.0, 1.0) / (2.0 * math.pi) + 0.5) * 256 - 0.5
        assert edges[64, [math.floor(column), math.ceil(column)]].all()


class TestAnyMetric:
    @pytest.mark.parametrize("metric", LAYOUT_METRICS)
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

    @pytest.mark.parametrize("metric", LAYOUT_METRICS)
    def test_other_profile_width_is_refused(self, metric: LayoutMetric) -> None:
        plan = crooked_flat()
        grid = layout_grid(metric, plan, some_poses(plan, 0), CAMERA_M)
        with pytest.raises(InvalidInputError, match="7 columns"):
            grid.distances(layout_at(plan, np.array([1.0, 1.0]), 7))
        with pytest.raises(InvalidInputError, match="7 columns"):
            grid.nearest(layout_at(plan, np.array([1.0, 1.0]), 7))


class TestRetrieval:
    @pytest.mark.parametrize("metric", LAYOUT_METRICS)
    def test_similarity_retrieval_takes_the_nearest_layout(self, metric: LayoutMetric) -> None:
        method = SimilarityRetrieval(metric)
        for heading in (0.0, 2.0):
            question = question_at(crooked_flat(), (1.02, 1.03), heading=heading)
            answer = method.locate(question)
            found = answer.stages["retrieval"]
            assert (found.x_m, found.y_m, found.room_index, found.heading) == (1.0, 1.0, 0, heading)
            assert answer.retrieved is not None
            np.testing.assert_array_equal(question.grid.position_m[answer.retrieved], [1.0, 1.0])
            assert answer.timings_ms.keys() == {"retrieve"}

    def test_pose_oracle_takes_the_nearest_pose(self) -> None:
        # The nearest grid pose is in the room on the right.
        plan = plan_of(rectangle(2.0, 2.0), rectangle(1.0, 1.0, (2.01, 0.5)))
        grid = PoseSet(np.array([[1.5, 1.0], [2.2, 1.0]]), np.array([0, 1]))
        question = question_at(plan, (1.95, 1.0), grid=grid)
        answer = PoseOracle().locate(question)
        assert (answer.retrieved, answer.stages["retrieval"].room_index) == (1, 1)
        assert SimilarityRetrieval().locate(question).retrieved == 0


def test_grids_are_cached_by_plan_and_camera_height() -> None:
    plan, method = crooked_flat(), SimilarityRetrieval()
    first = question_at(plan, (1.0, 1.0))
    grid = method._grid(first)
    assert method._grid(first) is grid
    assert method._grid(dataclasses.replace(first, plan=crooked_flat())) is not grid
    raised = dataclasses.replace(first.camera, camera_height_m=first.camera.camera_height_m + 0.1)
    assert method._grid(dataclasses.replace(first, camera=raised)) is not grid
    assert method._grid(first) is grid
