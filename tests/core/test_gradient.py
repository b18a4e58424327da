"""Closed-form derivatives of log wall profiles against autograd and differences, for numpy and torch."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings

from lalaloc_core.conventions import column_azimuths
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.gradient import log_distance_gradient, log_profile_gradient
from lalaloc_core.render.layout import layout_view
from lalaloc_core.render.profile import wall_profile
from tests.strategies import plan_of, rectangle, rows_of_rooms, scene_of, seeds

COLUMNS = 64


class TestProfiles:
    @given(rows_of_rooms(), seeds())
    @settings(max_examples=40)
    def test_gradients_match_autograd(self, plan: FloorPlan, seed: int) -> None:
        # Rooms with columns and free-standing walls, rotated by any angle.
        scene = scene_of(plan, 4, seed)
        walls = torch.tensor(scene.walls_m)
        pose = torch.tensor(np.column_stack([scene.poses.position_m, scene.heading]))

        def log_profile(unknowns: torch.Tensor) -> torch.Tensor:
            return wall_profile(unknowns[:, :2], unknowns[:, 2], walls, COLUMNS).log()

        value, by_pose, _ = log_profile_gradient(pose[:, :2], pose[:, 2], walls, COLUMNS)
        for unknown in range(3):
            tangent = torch.zeros_like(pose)
            tangent[:, unknown] = 1.0
            expected, slope = torch.func.jvp(log_profile, (pose,), (tangent,))[:2]
            torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(by_pose[:, unknown], slope, rtol=1e-6, atol=1e-6)

    @given(rows_of_rooms(), seeds())
    @settings(max_examples=20)
    def test_gradients_match_differences(self, plan: FloorPlan, seed: int) -> None:
        scene, step = scene_of(plan, 2, seed), 1e-6
        pose = np.column_stack([scene.poses.position_m, scene.heading])
        here = log_profile_gradient(pose[:, :2], pose[:, 2], scene.walls_m, COLUMNS)
        for unknown in range(3):
            low, high = (
                log_profile_gradient(moved[:, :2], moved[:, 2], scene.walls_m, COLUMNS)
                for moved in (pose + sign * step * np.eye(3)[unknown] for sign in (-1.0, 1.0))
            )
            smooth = (low.wall == here.wall) & (here.wall == high.wall)
            assert smooth.mean() > 0.9
            difference = (high.log_m - low.log_m) / (2.0 * step)
            np.testing.assert_allclose(here.by_pose[:, unknown][smooth], difference[smooth], rtol=1e-3, atol=1e-4)

    @given(rows_of_rooms(), seeds())
    @settings(max_examples=20)
    def test_single_precision_and_torch_agree(self, plan: FloorPlan, seed: int) -> None:
        scene = scene_of(plan, 3, seed)
        exact = log_profile_gradient(scene.poses.position_m, scene.heading, scene.walls_m, COLUMNS)
        arrays = (scene.poses.position_m, scene.heading, scene.walls_m)
        position, heading, walls = (torch.tensor(array, dtype=torch.float32) for array in arrays)
        single = log_profile_gradient(position, heading, walls, COLUMNS)
        assert single.by_pose.dtype == torch.float32
        # Next to an occluding edge rounding decides which wall is met.
        same = single.wall.numpy() == exact.wall
        assert same.mean() > 0.95
        np.testing.assert_allclose(single.log_m.numpy()[same], exact.log_m[same], atol=1e-4)
        for unknown in range(3):
            np.testing.assert_allclose(
                single.by_pose[:, unknown].numpy()[same], exact.by_pose[:, unknown][same], rtol=1e-2, atol=1e-3
            )

    def test_gradients_outside_rooms_are_finite(self) -> None:
        walls = plan_of(rectangle(4.0, 3.0)).walls_m[:1]
        found = log_profile_gradient(np.array([[90.0, 1.5]]), np.zeros(1), walls, COLUMNS)
        assert np.isfinite(found.log_m).all()
        assert np.isfinite(found.by_pose).all()

    def test_edge_on_wall_is_invisible(self) -> None:
        plan = plan_of(rectangle(4.0, 3.0))
        stub = np.array([[[2.0, 1.0, 2.0, 2.0]]])
        walls = np.concatenate([plan.walls_m[:1], stub], axis=1)
        found = log_distance_gradient(np.array([[2.0, 0.5]]), np.zeros((1, 1)), walls)
        assert np.exp(found.log_m) == 2.5
        assert found.by_pose[0, :, 0].tolist() == [0.0, -1.0 / 2.5, 0.0]


@given(rows_of_rooms(), seeds())
@settings(max_examples=20)
def test_gradient_through_an_opening(plan: FloorPlan, seed: int) -> None:
    scene = scene_of(plan, 4, seed)
    position, heading = torch.tensor(scene.poses.position_m), torch.tensor(scene.heading)
    room = torch.tensor(scene.poses.room_index)

    def log_behind(unknowns: torch.Tensor) -> torch.Tensor:
        return layout_view(unknowns[:, :2], unknowns[:, 2], room, plan.geometry, COLUMNS, 1.5).behind_m.log()

    pose = torch.cat([position, heading[:, None]], dim=1)
    view = layout_view(position, heading, room, plan.geometry, COLUMNS, 1.5)
    row, column = torch.nonzero(view.behind_m > view.distance_m, as_tuple=True)
    if not len(row):
        return
    azimuth = heading[row] + torch.tensor(column_azimuths(COLUMNS))[column]
    direction = torch.stack([azimuth.sin(), azimuth.cos()], dim=1)
    behind_m = view.behind_m[row, column]
    for unknown in range(3):
        tangent = torch.zeros_like(pose)
        tangent[:, unknown] = 1.0
        slope = torch.func.jvp(log_behind, (pose,), (tangent,))[1][row, column]
        end = position[row] + behind_m[:, None] * direction
        walls = torch.tensor(plan.walls_m).flatten(0, 1)
        # Only the wall that the ray ends on.
        met = _wall_at(end, walls)
        found = log_distance_gradient(position[row], azimuth[:, None], met[:, None])
        torch.testing.assert_close(found.log_m[:, 0], behind_m.log(), rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(found.by_pose[:, unknown, 0], slope, rtol=1e-5, atol=1e-5)


def _wall_at(point_m: torch.Tensor, walls_m: torch.Tensor) -> torch.Tensor:
    """Return the wall segment that each point lies on."""
    start, edge = walls_m[:, :2], walls_m[:, 2:] - walls_m[:, :2]
    offset = point_m[:, None] - start[None]
    share = ((offset * edge).sum(dim=2) / edge.square().sum(dim=1)).clamp(0.0, 1.0)
    return walls_m[torch.linalg.vector_norm(offset - share[:, :, None] * edge, dim=2).argmin(dim=1)]
