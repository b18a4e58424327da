"""Records with named columns."""

from __future__ import annotations

import numpy as np
import pytest

from lalaloc_core.learn.synth.records import Column, Joined, Records


class Points(Records):
    weight = Column()
    x_m = Column()
    y_m = Column()
    place_m = Joined(x_m, y_m)
    colour = Column(3)


def test_columns_follow_the_order_of_their_names() -> None:
    points = Points.stacked([Points.row(weight=1.0, x_m=2.0, y_m=3.0, colour=(4.0, 5.0, 6.0))])
    np.testing.assert_array_equal(points.rows, [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])
    assert Points.WIDTH == 6


def test_joined_columns_are_a_view_of_their_parts() -> None:
    points = Points(np.zeros((2, 6)))
    points.place_m += np.array([1.0, 2.0])
    np.testing.assert_array_equal(points.x_m, [1.0, 1.0])
    np.testing.assert_array_equal(points.y_m, [2.0, 2.0])
    assert not points.colour.any()
    assert not points.weight.any()


def test_columns_that_are_not_adjacent_cannot_be_joined() -> None:
    with pytest.raises(ValueError, match="not neighbours"):

        class Scattered(Records):
            first = Column(2)
            second = Column()
            third = Column()
            ends = Joined(first, third)


def test_wrong_width_and_unknown_columns_are_refused() -> None:
    with pytest.raises(ValueError, match="have 6 columns, not 5"):
        Points(np.zeros(5))
    with pytest.raises(KeyError, match="height"):
        Points.row(height=1.0)
