"""Layout views against the reference ray tracer and known plans, and their gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings

from lalaloc_core.conventions import DOOR_CODE, OPENING_CLASSES, PASSAGE_CODE, WALL_CODE, WINDOW_CODE, column_azimuths
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.synth.homes.plans import generate_home
from lalaloc_core.render.layout import LayoutView, layout_view
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.reference import reference_view
from lalaloc_core.render.sampling import random_poses
from tests.strategies import plan_document, plan_of, rectangle, rows_of_rooms, seeds

COLUMNS = 48
EYE_M = 1.5
# Two rooms of 4 x 3 m, separated by a wall of 20 cm, with a door drawn on the wall's axis.
TWO_ROOMS = plan_document(rectangle(4.0, 3.0), rectangle(4.0, 3.0, at=(4.2, 0.0)))
DOOR = {"kind": "door", "line": [[4.1, 1.0], [4.1, 2.0]]}


def view_along(
    plan: FloorPlan, position_m: tuple[float, float], azimuths_deg: list[float], eye_m: float = EYE_M
) -> LayoutView:
    """Render one ray for each azimuth."""
    count = len(azimuths_deg)
    positions = np.tile(position_m, (count, 1)).astype(float)
    room = plan.room_index_at(positions)
    # With a single column a pose's ray is along its heading.
    return layout_view(positions, np.radians(azimuths_deg), room, plan.geometry, 1, np.full(count, eye_m))


def render(plan: FloorPlan, poses, heading, columns=COLUMNS) -> LayoutView:
    return layout_view(poses.position_m, heading, poses.room_index, plan.geometry, columns, EYE_M)


@settings(max_examples=25, deadline=None)
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
@settings(max_examples=10, deadline=None)
def test_distances_equal_the_wall_profile(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plan = generate_home(rng).plan
    poses, heading = random_poses(plan, 4, rng), rng.uniform(-math.pi, math.pi, 4)
    view = render(plan, poses, heading)
    profile = wall_profile(poses.position_m, heading, plan.walls_m[poses.room_index], COLUMNS)
    np.testing.assert_array_equal(view.distance_m, profile)
    assert (view.behind_m >= view.distance_m).all()
    open_kinds = np.isin(view.kind, [DOOR_CODE, PASSAGE_CODE])
    np.testing.assert_array_equal(view.behind_m[~open_kinds], view.distance_m[~open_kinds])


@given(seeds())
@settings(max_examples=10, deadline=None)
def test_torch_matches_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plan = generate_home(rng).plan
    poses, heading = random_poses(plan, 4, rng), rng.uniform(-math.pi, math.pi, 4)
    view = render(plan, poses, heading)
    other = layout_view(
        torch.tensor(poses.position_m),
        torch.tensor(heading),
        torch.tensor(poses.room_index),
        plan.geometry,
        COLUMNS,
        torch.full((4,), EYE_M, dtype=torch.float64),
    )
    np.testing.assert_array_equal(other.kind.numpy(), view.kind)
    np.testing.assert_allclose(other.distance_m.numpy(), view.distance_m, rtol=1e-12)
    np.testing.assert_allclose(other.behind_m.numpy(), view.behind_m, rtol=1e-9)


def test_gradients_match_differences() -> None:
    plan = FloorPlan.from_dict(TWO_ROOMS | {"openings": [DOOR]})
    position = torch.tensor([[1.1, 1.3], [6.3, 1.6]], dtype=torch.float64, requires_grad=True)
    heading = torch.tensor([0.3, 2.0], dtype=torch.float64, requires_grad=True)

    def distances(position_m: torch.Tensor, heading: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        view = layout_view(position_m, heading, torch.tensor([0, 1]), plan.geometry, 16, EYE_M)
        assert (view.behind_m > view.distance_m).any()
        return view.distance_m, view.behind_m

    assert torch.autograd.gradcheck(distances, (position, heading))


def test_door_shows_the_far_wall_of_the_next_room() -> None:
    plan = FloorPlan.from_dict(TWO_ROOMS | {"openings": [DOOR]})
    view = view_along(plan, (1.0, 1.5), [90.0, 0.0])
    assert view.kind[:, 0].tolist() == [DOOR_CODE, WALL_CODE]
    np.testing.assert_allclose(view.distance_m[:, 0], [3.0, 1.5])
    np.testing.assert_allclose(view.behind_m[:, 0], [7.2, 1.5])
    back = view_along(plan, (5.2, 1.5), [-90.0])
    np.testing.assert_allclose([back.distance_m[0, 0], back.behind_m[0, 0]], [1.0, 5.2])


def test_slanting_ray_ends_in_the_reveal() -> None:
    plan = FloorPlan.from_dict(TWO_ROOMS | {"openings": [DOOR]})
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


def test_padding_changes_nothing() -> None:
    """Padding repeats the first wall; its door is met on every copy."""
    many = [[0.1 * k, 3.0 + 0.01 * (k % 2)] for k in range(40, -1, -1)]
    document = plan_document(rectangle(4.0, 3.0, at=(0.0, -4.0)), [[0.0, 0.0], [4.0, 0.0], *many])
    document["openings"] = [{"kind": "door", "line": [[1.0, -4.0], [3.0, -4.0]]}]
    plan = FloorPlan.from_dict(document)
    assert plan.geometry.wall_count.tolist() == [4, 43]
    position = torch.tensor([[2.0, -2.0]], dtype=torch.float64)
    view = layout_view(position, torch.full((1,), math.pi), torch.tensor([0]), plan.geometry, 1, EYE_M)
    assert int(view.kind[0, 0]) == DOOR_CODE
