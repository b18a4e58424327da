"""A place well inside a room: inside, nearly as far from the walls as can be, and found in bounded time."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import shapely
from hypothesis import given, settings

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.rooms import interior_point
from tests.growth import assert_no_worse_than_linear
from tests.strategies import plan_of, plans, rectangle, spiral


@settings(max_examples=40, deadline=None)
@given(plans())
def test_it_is_inside_and_about_as_far_from_the_walls_as_can_be(plan: FloorPlan) -> None:
    for room in plan.rooms:
        (x, y), distance_m = interior_point(room.shape)
        assert room.shape.buffer(1e-9).contains(shapely.Point(x, y))
        assert distance_m == pytest.approx(room.shape.boundary.distance(shapely.Point(x, y)))
        assert distance_m > 0.9 * shapely.maximum_inscribed_circle(room.shape, 0.01).length


def test_of_a_square_it_is_the_middle() -> None:
    (x, y), distance_m = interior_point(shapely.Polygon(rectangle(4.0, 4.0)))
    assert (x, y, distance_m) == pytest.approx((2.0, 2.0, 2.0), abs=0.01)


def test_a_floor_thinner_than_any_lattice_has_one_too() -> None:
    sliver = shapely.Polygon([(0.0, 0.0), (0.008, 0.0), (265.0, 290.0), (264.992, 290.0)])
    (x, y), distance_m = interior_point(sliver)
    assert sliver.contains(shapely.Point(x, y))
    assert 0.0 < distance_m < 0.004


def test_the_time_for_it_grows_with_the_corners_of_a_room_and_no_faster() -> None:
    def find(corners: int) -> Callable[[], object]:
        room = plan_of(spiral(corners)).rooms[0]
        return lambda: interior_point(room.shape)

    assert_no_worse_than_linear(find, 240)
