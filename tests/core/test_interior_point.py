"""The interior point of a room: position, distance from walls, and bounded time."""

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
def test_interior_point_is_far_from_walls(plan: FloorPlan) -> None:
    for room in plan.rooms:
        (x, y), distance_m = interior_point(room.shape)
        assert room.shape.buffer(1e-9).contains(shapely.Point(x, y))
        assert distance_m == pytest.approx(room.shape.boundary.distance(shapely.Point(x, y)))
        assert distance_m > 0.9 * shapely.maximum_inscribed_circle(room.shape, 0.01).length


def test_interior_point_of_a_square_is_its_centre() -> None:
    (x, y), distance_m = interior_point(shapely.Polygon(rectangle(4.0, 4.0)))
    assert (x, y, distance_m) == pytest.approx((2.0, 2.0, 2.0), abs=0.01)


def test_thin_floor_has_an_interior_point() -> None:
    sliver = shapely.Polygon([(0.0, 0.0), (0.008, 0.0), (265.0, 290.0), (264.992, 290.0)])
    (x, y), distance_m = interior_point(sliver)
    assert sliver.contains(shapely.Point(x, y))
    assert 0.0 < distance_m < 0.004


def test_interior_point_takes_linear_time() -> None:
    def find(corners: int) -> Callable[[], object]:
        room = plan_of(spiral(corners)).rooms[0]
        return lambda: interior_point(room.shape)

    assert_no_worse_than_linear(find, 240)
