"""Layout views against the reference ray tracer, known plans and the sweep renderer, and gradients of profiles."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.buildings import Building
from lalaloc_core.conventions import DOOR_CODE, OPENING_CLASSES, PASSAGE_CODE, WALL_CODE, WINDOW_CODE, column_azimuths
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.synth.homes.plans import VALIDATION, generate_home
from lalaloc_core.localise.match import Layouts, layouts_at
from lalaloc_core.localise.match.pose_grid import layouts_of_plans
from lalaloc_core.render.profile import (
    free_travel_m,
    log_distance_gradient,
    log_profile_gradient,
    nearest_walls,
    wall_profile,
)
from lalaloc_core.render.sampling import PoseSet, pose_grid, random_poses
from lalaloc_core.render.sweep import profiles_at, sweep_layouts
from tests.core.reference_views import reference_view
from tests.strategies import plan_document, plan_of, rectangle, rows_of_rooms, scene_of, seeds, spiral

COLUMNS, EYE_M = 64, 1.5
# Two rooms of 4 x 3 m, separated by a wall of 20 cm, with a door drawn on the wall's axis.
TWO_ROOMS = plan_document(rectangle(4.0, 3.0), rectangle(4.0, 3.0, corner=(4.2, 0.0)))
DOOR = {"kind": "door", "line": [[4.1, 1.0], [4.1, 2.0]]}


class View(NamedTuple):
    """Layouts, with the distances behind openings of all rays: the wall's distance where no room is behind."""

    distance_m: np.ndarray
    kind: np.ndarray
    behind_m: np.ndarray


def view_along(
    plan: FloorPlan, position_m: tuple[float, float], azimuths_deg: list[float], eye_m: float = EYE_M
) -> View:
    positions = np.tile(position_m, (len(azimuths_deg), 1)).astype(float)
    poses = PoseSet(positions, plan.room_index_at(positions))
    # Of an odd number of columns that in the middle is along the heading.
    view = render(plan, poses, np.radians(azimuths_deg), 2 * COLUMNS + 1, eye_m)
    return View(*(values[:, [COLUMNS]] for values in view))


def render(plan: FloorPlan, poses: PoseSet, heading: np.ndarray, columns: int = COLUMNS, eye_m: float = EYE_M) -> View:
    swept = sweep_layouts(poses.position_m, heading, poses.room_index, plan.wall_table, columns, eye_m)
    behind_m = swept.distance_m.copy()
    behind_m[swept.row, swept.column] = swept.behind_m
    return View(swept.distance_m, swept.kind, behind_m)


@pytest.mark.slow
@settings(max_examples=25)
@given(rows_of_rooms(), seeds())
def test_view_matches_shapely_ray_by_ray(plan: FloorPlan, seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = random_poses(plan, 2, rng, 0.1)
    heading = rng.uniform(-math.pi, math.pi, 2)
    view = render(plan, poses, heading)
    # Next to a corner or the end of an opening rounding decides; such rays are skipped.
    around = [render(plan, poses, heading + shift) for shift in (-1e-5, 1e-5)]
    steady = np.ones(view.kind.shape, bool)
    for other in around:
        steady &= other.kind == view.kind
        steady &= np.abs(other.distance_m - view.distance_m) < 5e-3
        steady &= np.abs(other.behind_m - view.behind_m) < 5e-3
    assert steady.mean() > 0.8
    for pose, column in np.argwhere(steady):
        azimuth = float(heading[pose] + column_azimuths(COLUMNS)[column])
        expected = reference_view(plan, int(poses.room_index[pose]), poses.position_m[pose], azimuth, EYE_M)
        found = (view.distance_m[pose, column], view.kind[pose, column], view.behind_m[pose, column])
        assert found == pytest.approx(expected, abs=2e-3)


@given(seeds())
@settings(max_examples=10)
def test_only_doors_and_passages_show_what_is_behind(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plan = generate_home(rng).plan
    poses, heading = random_poses(plan, 4, rng), rng.uniform(-math.pi, math.pi, 4)
    view = render(plan, poses, heading)
    assert (view.behind_m >= view.distance_m).all()
    open_kinds = np.isin(view.kind, [DOOR_CODE, PASSAGE_CODE])
    np.testing.assert_array_equal(view.behind_m[~open_kinds], view.distance_m[~open_kinds])


def test_door_shows_the_far_wall_of_the_next_room_or_its_reveal() -> None:
    plan = FloorPlan.from_dict(TWO_ROOMS | {"openings": [DOOR]})
    view = view_along(plan, (1.0, 1.5), [90.0, 0.0])
    assert view.kind[:, 0].tolist() == [DOOR_CODE, WALL_CODE]
    np.testing.assert_allclose(view.distance_m[:, 0], [3.0, 1.5])
    np.testing.assert_allclose(view.behind_m[:, 0], [7.2, 1.5])
    back = view_along(plan, (5.2, 1.5), [-90.0])
    np.testing.assert_allclose([back.distance_m[0, 0], back.behind_m[0, 0]], [1.0, 5.2])
    # The ray enters 5 cm before the end of the door and would leave 15 cm beyond it.
    view = view_along(plan, (3.0, 0.95), [45.0])
    assert view.kind[0, 0] == DOOR_CODE
    assert view.behind_m[0, 0] == view.distance_m[0, 0]


@pytest.mark.parametrize("kind", OPENING_CLASSES[1:])
def test_outdoor_openings_show_nothing_behind(kind: str) -> None:
    opening = {"kind": kind, "line": [[0.0, 1.0], [0.0, 2.0]]}
    view = view_along(FloorPlan.from_dict(TWO_ROOMS | {"openings": [opening]}), (1.0, 1.5), [-90.0])
    assert view.kind[0, 0] == OPENING_CLASSES.index(kind)
    assert view.behind_m[0, 0] == view.distance_m[0, 0] == pytest.approx(1.0)


@pytest.mark.parametrize(("eye_m", "code"), [(0.8, WALL_CODE), (1.0, WINDOW_CODE), (2.1, WALL_CODE)])
def test_opening_is_visible_at_eye_height_only(eye_m: float, code: int) -> None:
    window = {"kind": "window", "line": [[0.0, 1.0], [0.0, 2.0]], "sill_m": 0.9, "head_m": 2.0}
    plan = FloorPlan.from_dict(TWO_ROOMS | {"openings": [window]})
    assert view_along(plan, (1.0, 1.5), [-90.0], eye_m).kind[0, 0] == code


def test_stacked_openings_are_chosen_by_eye_height() -> None:
    door = DOOR | {"head_m": 2.0}
    light = {"kind": "window", "line": DOOR["line"], "sill_m": 2.0, "head_m": 2.4}
    plan = FloorPlan.from_dict(TWO_ROOMS | {"openings": [light, door]})
    assert [int(view_along(plan, (1.0, 1.5), [90.0], eye).kind[0, 0]) for eye in (1.5, 2.2)] == [DOOR_CODE, WINDOW_CODE]


def test_room_without_openings_has_walls_only() -> None:
    plan = plan_of(rectangle(4.0, 3.0))
    view = render(plan, random_poses(plan, 3, np.random.default_rng(0)), np.zeros(3))
    assert (view.kind == WALL_CODE).all()
    assert (view.behind_m == view.distance_m).all()


def assert_the_same(plan: FloorPlan, poses: PoseSet, heading: np.ndarray, misses: float = 0.0) -> None:
    """Check that both renderers agree on all rays but a share `misses` that graze a corner, where rounding decides."""
    swept = sweep_layouts(poses.position_m, heading, poses.room_index, plan.wall_table, COLUMNS, EYE_M)
    cast_m = wall_profile(poses.position_m, heading, plan.walls_m[poses.room_index], COLUMNS)
    assert (~np.isclose(swept.distance_m, cast_m, rtol=1e-4)).mean() <= misses
    assert (np.diff(swept.row) >= 0).all()


@settings(max_examples=25)
@given(rows_of_rooms(), seeds())
def test_sweep_matches_cast_in_rows_of_rooms(plan: FloorPlan, seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = random_poses(plan, 6, rng, 0.1)
    assert_the_same(plan, poses, rng.uniform(-math.pi, math.pi, 6), misses=2 / (6 * COLUMNS))


@pytest.mark.parametrize("turned", [False, True])
def test_sweep_matches_cast_in_a_building(turned: bool) -> None:
    plan = Building(VALIDATION, 0, 2300.0, hall_share=0.8).plan
    assert max(len(room.walls_m) for room in plan.rooms) > 100
    every = pose_grid(plan, 1.0)
    rng = np.random.default_rng(0)
    some = np.sort(rng.permutation(len(every))[:300])
    heading = rng.uniform(-4.0, 4.0, len(some)) if turned else np.full(len(some), 0.3)
    poses = PoseSet(every.position_m[some], every.room_index[some])
    assert_the_same(plan, poses, heading, misses=1e-3)


@settings(max_examples=15)
@given(st.lists(rows_of_rooms(), min_size=2, max_size=5), st.lists(st.floats(1.0, 2.0), min_size=5, max_size=5))
def test_plans_rendered_together_are_those_rendered_alone(plans: list[FloorPlan], eyes_m: list[float]) -> None:
    plans = [replace(plan, camera_height_m=eye_m) for plan, eye_m in zip(plans, eyes_m, strict=False)]
    # A plan without openings between others.
    plans.insert(1, plan_of(rectangle(3.0, 2.0)))
    poses = [pose_grid(plan, 0.5) for plan in plans]
    together = layouts_of_plans(plans, poses, COLUMNS)
    assert [layout.kind is None for layout in together] == [not plan.opening_faces for plan in plans]

    def arrays(layout: Layouts) -> list[np.ndarray]:
        own = [layout.log_profile, layout.room_index] + ([] if layout.kind is None else [layout.kind])
        return own + ([] if layout.seen is None else list(vars(layout.seen).values()))

    for plan, part, layout in zip(plans, poses, together, strict=True):
        alone = arrays(layouts_at(plan, part, np.zeros(len(part)), COLUMNS))
        assert len(alone) == len(arrays(layout))
        assert all(np.array_equal(*pair) for pair in zip(alone, arrays(layout), strict=True))


def test_free_standing_walls_have_two_sides() -> None:
    document = plan_document(rectangle(8.0, 6.0))
    document["rooms"][0]["walls"] = [[[3.0, 1.0], [3.0, 5.0]], [[5.0, 2.0], [6.0, 4.0]]]
    document["openings"] = [{"kind": "passage", "line": [[3.0, 2.0], [3.0, 3.0]]}]
    plan = FloorPlan.from_dict(document)
    poses = pose_grid(plan, 0.7)
    assert_the_same(plan, poses, np.zeros(len(poses)), misses=1e-3)
    assert len(
        sweep_layouts(poses.position_m, np.zeros(len(poses)), poses.room_index, plan.wall_table, COLUMNS, EYE_M).row
    )


@pytest.mark.parametrize("origin_m", [(0.0, 0.0), (4e5, -5e6)])
def test_profiles_in_a_spiral_far_from_the_origin(origin_m: tuple[float, float]) -> None:
    plan = plan_of((np.array(spiral(80)) + origin_m).tolist())
    poses = pose_grid(plan, 0.5)
    heading = np.linspace(-1.0, 1.0, len(poses))
    swept = profiles_at(plan, poses.position_m, poses.room_index, heading, COLUMNS)
    cast = wall_profile(poses.position_m, heading, plan.walls_m[poses.room_index], COLUMNS)
    assert (~np.isclose(swept, cast, rtol=1e-6)).mean() < 1e-3


def test_profile_outside_rooms_is_infinite() -> None:
    plan = plan_of(rectangle(2.0, 2.0))
    outside = profiles_at(plan, np.array([[9.0, 1.0]]), np.zeros(1, int), np.zeros(1), 8)
    assert np.isinf(outside).all()


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

        value, by_pose = log_profile_gradient(pose[:, :2], pose[:, 2], walls, COLUMNS)
        for unknown in range(3):
            tangent = torch.zeros_like(pose)
            tangent[:, unknown] = 1.0
            expected, slope = torch.func.jvp(log_profile, (pose,), (tangent,))[:2]
            torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(by_pose[:, unknown], slope, rtol=1e-6, atol=1e-6)

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
        azimuth = scene.heading[:, None] + column_azimuths(COLUMNS)
        _, wall = nearest_walls(scene.poses.position_m, azimuth, scene.walls_m)
        _, single_wall = nearest_walls(position, torch.tensor(azimuth, dtype=torch.float32), walls)
        same = single_wall.numpy() == wall
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

    @given(seeds())
    @settings(max_examples=20)
    def test_slanted_steps_keep_the_margin_to_walls(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        # A corridor so long that its ends are never ahead.
        plan, position = plan_of(rectangle(1000.0, 3.0)), np.array([[500.0, 1.5]])
        for azimuth in rng.choice([0.0, np.pi], 50) + rng.uniform(-1.4, 1.4, 50):
            direction = np.array([[np.sin(azimuth), np.cos(azimuth)]])
            position = position + direction * free_travel_m(position, direction, plan.walls_m[:1], 0.03)[:, None]
        assert plan.rooms[0].shape.exterior.distance(shapely.Point(position[0])) > 0.03 - 1e-9
