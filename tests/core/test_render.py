"""The renderer against the reference ray tracer, its gradients against differences, and the pixel conventions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from trimesh.ray.ray_pyembree import RayMeshIntersector

from lalaloc_core.conventions import (
    TWO_PI,
    column_azimuths,
    heading_from_degrees,
    heading_to_degrees,
    row_elevations,
    wrap_angle,
)
from lalaloc_core.floorplan import Room
from lalaloc_core.floorplan.geometry import pad_walls
from lalaloc_core.render.profile import back_project, cast_rays, layout_depth, wall_profile
from tests.strategies import Scene, plan_of, present, rectangle, scenes

COLUMNS = 64
CAMERA_M = 1.4


def profile_of(scene: Scene, columns: int = COLUMNS) -> np.ndarray:
    return wall_profile(scene.poses.position_m, scene.heading, scene.walls_m, columns)


def nearest_wall(position_m: np.ndarray, heading: np.ndarray, walls_m: np.ndarray) -> np.ndarray:
    """Return the index of the wall that each column's ray hits, by casting against one wall at a time."""
    alone = [wall_profile(position_m, heading, walls_m[:, k : k + 1], COLUMNS) for k in range(walls_m.shape[1])]
    return np.argmin(np.stack(alone), axis=0)


def reference_depth(room: Room, position_m: np.ndarray, heading: float, rows: int) -> np.ndarray:
    """Return the layout depth (m) by casting every pixel's ray; inf for rays that escape through a seam of the mesh."""
    j, i = np.meshgrid(np.arange(COLUMNS), np.arange(rows))
    azimuth = heading + ((j + 0.5) / COLUMNS - 0.5) * 2.0 * np.pi
    elevation = (0.5 - (i + 0.5) / rows) * np.pi
    x = np.sin(azimuth) * np.cos(elevation)
    y = np.cos(azimuth) * np.cos(elevation)
    directions = np.stack([x, y, np.sin(elevation)], axis=-1).reshape(-1, 3)
    origins = np.broadcast_to([*position_m, CAMERA_M], directions.shape)
    mesh = trimesh.creation.extrude_polygon(room.shape, room.ceiling_height_m)
    hits, ray, _ = RayMeshIntersector(mesh).intersects_location(origins, directions, multiple_hits=False)
    depth = np.full(rows * COLUMNS, np.inf)
    depth[ray] = np.linalg.norm(hits - origins[ray], axis=1)
    return depth.reshape(rows, COLUMNS)


class TestOracle:
    @given(scenes(count=1))
    def test_layout_depth_matches_mesh_ray_casting(self, scene: Scene) -> None:
        rows = 24
        profile = profile_of(scene)
        depth = layout_depth(profile, np.full(1, CAMERA_M), scene.ceiling_height_m, rows)[0]
        position, heading = scene.poses.position_m[0], float(scene.heading[0])
        oracle = reference_depth(scene.plan.rooms[0], position, heading, rows)
        # Next to an occluding corner rounding decides which wall a ray hits; such columns are skipped.
        before, after = (
            wall_profile(scene.poses.position_m, scene.heading + shift, scene.walls_m, COLUMNS)[0]
            for shift in (-1e-4, 1e-4)
        )
        steady = np.abs(after - before) < 0.02 * profile[0]
        assert steady.mean() > 0.9
        hit = np.isfinite(oracle)
        assert hit.mean() > 0.99, "the oracle's mesh has holes"
        checked = hit & steady[None, :]
        np.testing.assert_allclose(depth[checked], oracle[checked], rtol=2e-3, atol=2e-3)


class TestTorch:
    @given(scenes())
    def test_numpy_and_torch_agree(self, scene: Scene) -> None:
        profile = profile_of(scene)
        heights = (np.full(len(profile), CAMERA_M), scene.ceiling_height_m)
        position, heading, walls = map(torch.tensor, (scene.poses.position_m, scene.heading, scene.walls_m))
        in_torch = wall_profile(position, heading, walls, COLUMNS)
        np.testing.assert_allclose(in_torch.numpy(), profile, rtol=1e-12)
        depth = layout_depth(profile, *heights, 16)
        camera, ceiling = map(torch.tensor, heights)
        depth_in_torch = layout_depth(in_torch, camera, ceiling, 16)
        np.testing.assert_allclose(depth_in_torch.numpy(), depth, rtol=1e-12)
        np.testing.assert_allclose(back_project(depth_in_torch).numpy(), back_project(depth), atol=1e-9)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_result_has_the_type_of_the_positions(self, dtype: torch.dtype) -> None:
        walls = torch.tensor(plan_of(rectangle(4.0, 3.0)).walls_m[:1], dtype=dtype)
        profile = wall_profile(torch.ones(1, 2, dtype=dtype), torch.zeros(1, dtype=dtype), walls, 8)
        heights = torch.ones(1, dtype=dtype)
        assert profile.dtype == dtype
        assert layout_depth(profile, heights, 2.0 * heights, 4).dtype == dtype

    @pytest.mark.slow
    @given(scenes(count=1))
    def test_gradients_match_differences(self, scene: Scene) -> None:
        step = 1e-6
        pose = np.array([[*scene.poses.position_m[0], scene.heading[0]]])
        walls = torch.tensor(scene.walls_m)

        def render(unknowns: torch.Tensor) -> torch.Tensor:
            return wall_profile(unknowns[:, :2], unknowns[:, 2], walls, COLUMNS)[0]

        point = torch.tensor(pose)
        backward = torch.autograd.functional.jacobian(render, point)[:, 0].numpy()  # type: ignore[call-overload]
        for unknown in range(3):
            tangent = torch.zeros_like(point)
            tangent[0, unknown] = 1.0
            forward = torch.func.jvp(render, (point,), (tangent,))[1]
            shifted = [pose + sign * step * tangent.numpy() for sign in (-1.0, 1.0)]
            walls_hit = [nearest_wall(p[:, :2], p[:, 2], scene.walls_m)[0] for p in (pose, *shifted)]
            # The derivative exists only where the same wall is hit on both sides.
            smooth = (walls_hit[0] == walls_hit[1]) & (walls_hit[0] == walls_hit[2])
            assert smooth.mean() > 0.9
            low, high = (render(torch.tensor(p)).numpy() for p in shifted)
            difference = (high - low) / (2.0 * step)
            np.testing.assert_allclose(forward.numpy(), backward[:, unknown], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(backward[smooth, unknown], difference[smooth], rtol=1e-4, atol=1e-4)

    @given(scenes())
    def test_gradients_along_walls_are_finite(self, scene: Scene) -> None:
        # Rays parallel to a wall divide by zero in the unused branch.
        room = scene.plan.rooms[0]
        edge = room.polygon_m[1] - room.polygon_m[0]
        heading = torch.full((len(scene.heading),), math.atan2(edge[0], edge[1]) - float(column_azimuths(COLUMNS)[5]))
        position = torch.tensor(scene.poses.position_m, requires_grad=True)
        profile = wall_profile(position, heading.double().requires_grad_(), torch.tensor(scene.walls_m), COLUMNS)
        profile.sum().backward()
        assert bool(torch.isfinite(present(position.grad)).all())

    def test_layout_depth_gradient_is_through_walls_only(self) -> None:
        profile = torch.full((1, 4), 2.0, dtype=torch.float64, requires_grad=True)
        depth = layout_depth(profile, torch.tensor([1.5]).double(), torch.tensor([2.5]).double(), 8)
        (gradient,) = torch.autograd.grad(depth.sum(), profile)
        stretch = 1.0 / np.cos(row_elevations(8))
        is_wall = np.isclose(depth.detach()[0, :, 0].numpy(), 2.0 * stretch)
        assert 0 < is_wall.sum() < 8
        np.testing.assert_allclose(gradient.numpy(), stretch[is_wall].sum())


class TestPixelContract:
    plan = plan_of(rectangle(5.0, 3.0))
    position = np.array([[1.0, 2.25]])
    # Distances to the walls along +y, +x, -y and -x.
    ahead, right, behind, left = 0.75, 4.0, 2.25, 1.0

    def profile(self, heading: float, columns: int) -> np.ndarray:
        return wall_profile(self.position, np.array([heading]), self.plan.walls_m[:1], columns)[0]

    def test_heading_zero_looks_along_plus_y(self) -> None:
        profile = self.profile(0.0, 1024)
        half_pixel = math.cos(math.pi / 1024)
        for column, distance in ((512, self.ahead), (768, self.right), (0, self.behind), (256, self.left)):
            assert profile[column] == pytest.approx(distance / half_pixel, rel=1e-9)
            # The axis lies between two pixels.
            assert profile[column - 1] == pytest.approx(distance / half_pixel, rel=1e-9)

    @given(scenes(), st.integers(-COLUMNS, COLUMNS))
    def test_turning_rolls_the_profile_left(self, scene: Scene, columns: int) -> None:
        turned = wall_profile(
            scene.poses.position_m, scene.heading + columns * TWO_PI / COLUMNS, scene.walls_m, COLUMNS
        )
        rolled = np.roll(profile_of(scene), -columns, axis=1)
        # Rounding decides at the edge of an occluding corner.
        assert np.isclose(turned, rolled, rtol=1e-6).mean() > 0.98

    def test_columns_and_rows_are_pixel_centres(self) -> None:
        np.testing.assert_allclose(np.degrees(column_azimuths(4)), [-135.0, -45.0, 45.0, 135.0])
        np.testing.assert_allclose(np.degrees(row_elevations(2)), [45.0, -45.0])

    def test_top_is_ceiling_and_bottom_is_floor(self) -> None:
        rows = 64
        depth = layout_depth(self.profile(0.0, 16)[None], np.array([1.5]), np.array([2.6]), rows)[0]
        elevation = row_elevations(rows)
        assert elevation[0] > 0.0 > elevation[-1]
        np.testing.assert_allclose(depth[0], 1.1 / np.sin(elevation[0]))
        np.testing.assert_allclose(depth[-1], 1.5 / -np.sin(elevation[-1]))
        # The two rows at the horizon see the walls.
        np.testing.assert_allclose(depth[31], self.profile(0.0, 16) / np.cos(elevation[31]))


class TestProperties:
    @given(scenes(), st.integers(1, 7))
    def test_padding_walls_changes_nothing(self, scene: Scene, extra: int) -> None:
        padded = np.stack([pad_walls(walls, len(walls) + extra) for walls in scene.walls_m])
        again = wall_profile(scene.poses.position_m, scene.heading, padded, COLUMNS)
        np.testing.assert_array_equal(again, profile_of(scene))

    @given(scenes())
    def test_batch_equals_single_poses(self, scene: Scene) -> None:
        alone = [
            wall_profile(scene.poses.position_m[k : k + 1], scene.heading[k : k + 1], scene.walls_m[k : k + 1], COLUMNS)
            for k in range(len(scene.heading))
        ]
        np.testing.assert_array_equal(np.concatenate(alone), profile_of(scene))

    @given(scenes(), st.sampled_from([np.float32, np.float64]))
    def test_rays_at_corners_hit_a_wall(self, scene: Scene, dtype: type) -> None:
        room = scene.plan.rooms[0]
        # Relative to the camera, as this project uses single precision.
        offset = room.polygon_m[None] - scene.poses.position_m[:, None]
        walls = np.concatenate([offset, np.roll(offset, -1, axis=1)], axis=2)
        azimuth = np.concatenate(
            [np.arctan2(offset[..., 0], offset[..., 1]), np.tile(np.linspace(-4.0, 4.0, 400), (len(offset), 1))], axis=1
        )
        distance = cast_rays(np.zeros((len(offset), 2), dtype), azimuth.astype(dtype), walls.astype(dtype))
        assert np.isfinite(distance).all()
        assert (distance > 0.0).all()

    @given(scenes())
    def test_profile_is_the_distance_to_the_polygon(self, scene: Scene) -> None:
        profile = profile_of(scene)
        azimuth = scene.heading[:, None] + column_azimuths(COLUMNS)[None]
        ends = scene.poses.position_m[:, None] + profile[..., None] * np.stack(
            [np.sin(azimuth), np.cos(azimuth)], axis=-1
        )
        assert shapely.distance(scene.plan.rooms[0].shape.exterior, shapely.points(ends)).max() < 1e-6
        # Points before the wall are inside the room, so no nearer wall is missed.
        before = scene.poses.position_m[:, None] + 0.999 * (ends - scene.poses.position_m[:, None])
        room = shapely.buffer(scene.plan.rooms[0].shape, 1e-3)
        rays = shapely.linestrings(np.stack([np.broadcast_to(scene.poses.position_m[:, None], ends.shape), before], 2))
        assert shapely.contains(room, rays).all()

    @given(scenes())
    @settings(max_examples=25)
    def test_missing_rays_are_infinite_not_nan(self, scene: Scene) -> None:
        outside = scene.poses.position_m + 1000.0
        profile = wall_profile(outside, scene.heading, scene.walls_m, COLUMNS)
        assert np.isinf(profile).any()
        assert not np.isnan(profile).any()

    @given(scenes())
    def test_back_projection_inverts_layout_depth(self, scene: Scene) -> None:
        rows = 16
        depth = layout_depth(profile_of(scene), np.full(len(scene.heading), CAMERA_M), scene.ceiling_height_m, rows)
        cloud = back_project(depth)
        assert cloud.shape == (len(depth), rows * COLUMNS, 3)
        np.testing.assert_allclose(np.linalg.norm(cloud, axis=-1), depth.reshape(len(depth), -1), rtol=1e-9)
        for k, points in enumerate(cloud):
            # From the camera frame to the plan frame: y is along the heading, x a quarter turn clockwise.
            heading = scene.heading[k]
            x = points[:, 0] * math.cos(heading) + points[:, 1] * math.sin(heading)
            y = -points[:, 0] * math.sin(heading) + points[:, 1] * math.cos(heading)
            place = scene.poses.position_m[k] + np.stack([x, y], axis=1)
            to_wall = shapely.distance(scene.plan.rooms[0].shape.exterior, shapely.points(place))
            to_floor = np.abs(points[:, 2] + CAMERA_M)
            to_ceiling = np.abs(points[:, 2] - (scene.ceiling_height_m[k] - CAMERA_M))
            assert np.minimum(np.minimum(to_wall, to_floor), to_ceiling).max() < 1e-6

    @given(st.floats(-50.0, 50.0))
    def test_wrapped_angles_are_equivalent(self, angle: float) -> None:
        wrapped = wrap_angle(angle)
        assert -math.pi <= wrapped <= math.pi
        assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
        assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)

    @given(st.floats(-1000.0, 1000.0))
    def test_degrees_round_trip_through_radians(self, degrees: float) -> None:
        back = heading_to_degrees(heading_from_degrees(degrees))
        assert 0.0 <= back < 360.0
        assert abs((back - degrees + 180.0) % 360.0 - 180.0) < 1e-9

    @pytest.mark.parametrize("radians", [-1e-18, TWO_PI, -TWO_PI, math.nextafter(TWO_PI, 0.0)])
    def test_degrees_never_reach_360(self, radians: float) -> None:
        assert 0.0 <= heading_to_degrees(radians) < 360.0
