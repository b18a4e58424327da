"""Queries of `lalaloc bench`: pictures that cannot tell the place, and predictions replaced by the true layout."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.evaluate.bench.accuracy import blank_azimuth, landscape
from lalaloc_core.evaluate.bench.bounds import Asked, with_truth
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.learn.data.dataset import Camera
from lalaloc_core.localise.match import layouts_at
from lalaloc_core.localise.query import CameraHeight, PredictedOpenings, PredictedProfile, Query
from lalaloc_core.render.sampling import PoseSet
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


# Bounds: predictions are those of the layout at the true pose.

COLUMNS = 64
PLAN = plan_of(rectangle(5.0, 3.0), openings=[{"kind": "door", "line": [[1.0, 0.0], [2.0, 0.0]]}])


def asked(heading: float) -> Asked:
    seen = np.full((COLUMNS, COLUMNS), np.inf)
    seen[:, :60] = 0.0
    prior = np.array([0.7, 0.1, 0.1, 0.1])
    query = Query(
        np.zeros((COLUMNS, 1), np.float32),
        np.arange(COLUMNS) * (TWO_PI / COLUMNS),
        0.0,
        False,
        CameraHeight(1.5, 0.0),
        profile=PredictedProfile(np.zeros((COLUMNS, COLUMNS)), seen),
        openings=PredictedOpenings(np.tile(np.log(prior), (COLUMNS, COLUMNS, 1)), prior),
    )
    return Asked(PLAN, Pose.at(np.array([2.0, 1.2]), 0, heading), query)


def test_the_hypothesis_of_the_true_heading_has_the_layout_of_the_plan() -> None:
    number = 11
    one = asked(number * TWO_PI / COLUMNS)
    query = with_truth(one, noise=1e-9, openings=True, rng=np.random.default_rng(0))
    layouts = layouts_at(PLAN, PoseSet(one.pose.position_m[None], np.array([0])), np.zeros(1), COLUMNS)
    profile, openings, kind = present(query.profile), present(query.openings), present(layouts.kind)[0]
    np.testing.assert_allclose(profile.log_m[number], layouts.log_profile[0], atol=1e-6)
    seen = profile.seen[number]
    np.testing.assert_array_equal(openings.log_probability[number].argmax(axis=1)[seen], kind[seen])
    assert (kind[seen] != 0).any()


def test_azimuths_that_are_not_seen_stay_unknown_and_walls_stay_predicted_without_noise() -> None:
    one = asked(0.4)
    query = with_truth(one, noise=None, openings=True, rng=np.random.default_rng(0))
    assert query.profile is one.query.profile
    unseen = ~present(one.query.profile).seen[0]
    shares = np.exp(present(query.openings).log_probability[0][unseen])
    np.testing.assert_allclose(shares, [[0.7, 0.1, 0.1, 0.1]] * unseen.sum())
    np.testing.assert_allclose(np.exp(present(query.ceiling).log_m), 1.0)
