"""Predictions that are replaced by the layout at the true pose, of `lalaloc bench --only bounds`."""

from __future__ import annotations

import numpy as np

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.evaluate.bench.bounds import Asked, with_truth
from lalaloc_core.evaluate.methods.method import Pose
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match import layouts_at
from lalaloc_core.localise.query import CameraHeight, PredictedOpenings, PredictedProfile, Query
from lalaloc_core.render.sampling import PoseSet

COLUMNS = 64
DOOR = {"kind": "door", "line": [[1.0, 0.0], [2.0, 0.0]]}
PLAN = FloorPlan.from_dict(
    {"ceiling_height_m": 2.5, "rooms": [{"polygon": [[0, 0], [5, 0], [5, 3], [0, 3]]}], "openings": [DOOR]}
)


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
    assert query.profile is not None
    assert query.openings is not None
    assert layouts.kind is not None
    np.testing.assert_allclose(query.profile.log_m[number], layouts.log_profile[0], atol=1e-6)
    seen = query.profile.seen[number]
    likeliest = query.openings.log_probability[number].argmax(axis=1)
    np.testing.assert_array_equal(likeliest[seen], layouts.kind[0][seen])
    assert (layouts.kind[0][seen] != 0).any()


def test_azimuths_that_are_not_seen_stay_unknown_and_walls_stay_predicted_without_noise() -> None:
    one = asked(0.4)
    query = with_truth(one, noise=None, openings=True, rng=np.random.default_rng(0))
    assert query.profile is one.query.profile
    assert query.openings is not None
    assert one.query.profile is not None
    unseen = ~one.query.profile.seen[0]
    np.testing.assert_allclose(np.exp(query.openings.log_probability[0][unseen]), [[0.7, 0.1, 0.1, 0.1]] * unseen.sum())
    assert query.ceiling is not None
    np.testing.assert_allclose(np.exp(query.ceiling.log_m), 1.0)
