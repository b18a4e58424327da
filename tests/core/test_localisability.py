"""Localisability: drawn predictions, and what the plan alone says of places and rooms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lalaloc_core.bundle import Manifest
from lalaloc_core.bundle.fitted_parameters import correlated
from lalaloc_core.conditions import CONDITIONS, HARDEST, condition_of, parts_of
from lalaloc_core.draw.heat import localisability_svg
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.calibrate.measured_errors import measured
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.localisability.predicted_localisability import (
    Errors,
    Searches,
    errors_of,
    localisability,
    spacing_m,
)
from lalaloc_core.localise.localisability.reports import report_of, summary_of
from lalaloc_core.render.sampling import PoseSet


def _rooms(*sizes: tuple[float, float, float]) -> FloorPlan:
    """Return rooms by their left sides, widths and depths (m)."""
    rooms = [
        {
            "id": f"room-{number}",
            "name": f"Room {number}",
            "polygon": [[x, 0.0], [x + width, 0.0], [x + width, depth], [x, depth]],
            "ceiling_height_m": 2.5,
        }
        for number, (x, width, depth) in enumerate(sizes)
    ]
    return FloorPlan.from_dict({"rooms": rooms})


def test_drawn_scores_have_the_stated_correlation() -> None:
    correlation = tuple(0.3 + 0.7 * np.exp(-np.arange(65) / 5.0))
    scores = correlated(correlation, 4000, 128, np.random.default_rng(0))
    assert scores.std() == pytest.approx(1.0, abs=0.03)
    for lag in (1, 5, 40):
        assert np.mean(scores * np.roll(scores, lag, axis=1)) == pytest.approx(correlation[lag], abs=0.04)


def test_drawn_predictions_have_the_measured_errors(manifest: Manifest) -> None:
    stated = replace(errors_of(manifest).sphere, spread=1.0)
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.0, 1.5, (800, 128))
    kind = np.repeat(rng.integers(0, 4, (800, 8)), 16, axis=1)
    log_m, log_scale = stated.profile(truth, rng)
    found = measured(log_m, log_scale, kind, truth, stated.openings(kind, rng))
    middle = slice(3, -3)
    np.testing.assert_allclose(found.error_quantiles[middle], stated.error_quantiles[middle], atol=0.25)
    np.testing.assert_allclose(found.scale_quantiles[middle], stated.scale_quantiles[middle], atol=0.1)
    np.testing.assert_allclose(found.seen, stated.seen, atol=0.03)


@pytest.mark.slow
def test_equal_rooms_are_confused_and_a_room_hint_helps(manifest: Manifest) -> None:
    plan = _rooms((0.0, 4.0, 3.0), (10.0, 4.0, 3.0), (20.0, 9.0, 7.0))
    found = localisability(plan, manifest)
    assert set(found.found) == set(CONDITIONS)
    assert {0, 1} in [set(pair.rooms) for pair in found.confused]
    sphere = found.found["sphere_known_heading"]
    # Equal rooms tie, and ties are split.
    assert [sphere[found.places.room_index == room].max() for room in (0, 1)] == [0.5, 0.5]
    assert found.rooms["sphere_known_heading"][2] > 0.5
    assert (found.gains["room_hint"] or 0.0) > 0.05
    assert found.gains["doors"] is None


@pytest.mark.slow
def test_room_alone_is_found_more_often_than_among_equal_rooms(manifest: Manifest) -> None:
    alone = localisability(_rooms((0.0, 4.0, 3.0)), manifest)
    among = localisability(_rooms((0.0, 4.0, 3.0), (10.0, 4.0, 3.0), (20.0, 4.0, 3.0)), manifest)
    for name in ("sphere_known_heading", HARDEST):
        assert alone.plan[name] > among.plan[name]


def test_larger_errors_find_fewer_photographs(manifest: Manifest) -> None:
    plan = _rooms((0.0, 4.0, 3.0), (10.0, 4.4, 3.3), (20.0, 9.0, 7.0))
    places = PoseSet(np.tile([[1.3, 1.1], [12.0, 2.0], [22.0, 5.0]], (4, 1)), np.tile([0, 1, 2], 4))
    errors = errors_of(manifest)
    shares = []
    for factor in (0.05, 3.0):
        scaled = Errors(*(replace(part, spread=factor) for part in errors))
        rows = Searches(plan, manifest, scaled, step_m=0.5).draws(
            places, "sphere_known_heading", 4, np.random.default_rng(0)
        )
        shares.append(np.mean([draw.found for row in rows for draw in row]))
    assert shares[0] > shares[1] + 0.1


@pytest.mark.slow
def test_report_has_every_room_and_is_reproducible(manifest: Manifest) -> None:
    plan = _rooms((0.0, 4.0, 3.0), (10.0, 5.0, 3.5))
    found = localisability(plan, manifest)
    report = report_of(plan, found)
    assert report == report_of(plan, localisability(plan, manifest))
    assert [room["id"] for room in report["rooms"]] == ["room-0", "room-1"]
    assert all(0.0 <= value <= 1.0 for room in report["rooms"] for value in room["probability"].values())
    assert any("draw doors" in line for line in summary_of(plan, found))
    assert report["advice"][-1] == summary_of(plan, found)[-1]
    for condition in CONDITIONS:
        photograph, heading = parts_of(condition)
        assert condition_of(photograph, heading) == condition
        drawing = localisability_svg(plan, report, condition)
        assert "<image" in drawing
        assert f"heading {heading}" in drawing
    # A coarse prediction has fewer places and no advice.
    coarse = localisability(plan, manifest, coarse=True)
    assert len(coarse.places) < 0.5 * len(found.places)
    assert coarse.spacing_m == found.spacing_m
    rough = report_of(plan, coarse, coarse=True)
    assert (rough["coarse"], rough["advice"], report["coarse"]) == (True, [], False)


def test_model_without_measured_errors_is_refused(manifest: Manifest) -> None:
    with pytest.raises(InvalidInputError, match="calibrate --errors"):
        localisability(_rooms((0.0, 4.0, 3.0)), replace(manifest, errors=None))


@pytest.mark.slow
def test_large_plan_is_predicted_on_a_coarser_grid(manifest: Manifest) -> None:
    plan = _rooms((0.0, 200.0, 200.0), (210.0, 6.0, 5.0))
    found = localisability(plan, manifest)
    assert found.spacing_m == 1.1
    assert "1.1 m apart" in summary_of(plan, found)[4]
    assert spacing_m(_rooms((0.0, 90.0, 90.0))) == 0.5


def test_fewer_photographs_are_found_by_openings_that_may_be_drawn_wrongly(manifest: Manifest) -> None:
    room = {"name": "hall", "polygon": [[0.0, 0.0], [7.0, 0.0], [7.0, 7.0], [0.0, 7.0]], "ceiling_height_m": 2.5}
    door, window = [[1.0, 0.0], [2.0, 0.0]], [[7.0, 4.0], [7.0, 6.5]]
    openings = [{"kind": "door", "line": door}, {"kind": "window", "line": window}]
    document = {"rooms": [room], "openings": openings, "opening_kinds": []}
    shares = []
    for trust in (1.0, 0.3):
        stated = FloorPlan.from_dict(document | {"opening_trust": {"door": trust, "window": trust}})
        found = localisability(stated, manifest, coarse=True).plan
        shares.append(found["sphere_unknown_heading"])
    # The walls of a square look the same at four headings.
    assert shares[0] > shares[1] + 0.1
