"""Queries of `lalaloc bench`: pictures that cannot tell the place."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lalaloc_core.evaluate.bench.accuracy import blank_azimuth, landscape
from lalaloc_core.learn.data.dataset import Camera
from tests.strategies import plan_of, present, rectangle

# Room of 4 x 3 m with a window in the whole of its nearest wall, on the left of the camera.
WINDOW = {"kind": "window", "line": [[0.0, 0.01], [0.0, 2.99]]}
ROOM = rectangle(4.0, 3.0)


def camera(heading: float) -> Camera:
    position_m = np.array([0.5, 2.0])
    return Camera(name="c", position_m=position_m, room_index=0, heading=heading, camera_height_m=1.5, photographs={})


@pytest.mark.parametrize("heading", [0.0, 1.0, -2.5])
@pytest.mark.parametrize(("openings", "expected"), [([], -math.pi / 2.0), ([WINDOW], 0.0)])
def test_blank_wall_is_the_nearest_without_openings(heading: float, openings: list, expected: float) -> None:
    found = present(blank_azimuth(plan_of(ROOM, openings=openings), camera(heading)))
    # The wall to the north is one metre away; near the corner the view also shows a part of the window.
    off = (found + heading - expected + math.pi) % (2.0 * math.pi) - math.pi
    assert abs(off) < 0.5


def test_room_of_windows_has_no_blank_wall() -> None:
    walls = [[[0.01, 0], [3.99, 0]], [[4, 0.01], [4, 2.99]], [[3.99, 3], [0.01, 3]], [[0, 2.99], [0, 0.01]]]
    windows = [{"kind": "window", "line": line} for line in walls]
    assert blank_azimuth(plan_of(ROOM, openings=windows), camera(0.0)) is None


def test_landscape_continues_behind_the_camera() -> None:
    picture = landscape(np.random.default_rng(0)).astype(float)
    assert picture.shape == (512, 1024, 3)
    # Patches of the ground end anywhere; sky and hills go around.
    assert np.abs(picture[:240, 0] - picture[:240, -1]).max() < 2.0
    assert picture[:200].mean() > picture[300:].mean() + 30.0
