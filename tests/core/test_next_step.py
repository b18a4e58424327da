"""Next step after an answer that is not sure."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lalaloc_core.bundle import Manifest
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import Support
from lalaloc_core.localise.localisability.next_step import Known, NextStep, next_step, next_steps
from lalaloc_core.localise.localisability.reports import words_of

_FIELD = math.radians(80.0)


def _plan(*, passages: bool = False) -> FloorPlan:
    """Return two equal rooms of 4 m x 3 m beside a larger one, which one of them leads to."""
    corners = {"left": (0.0, 0.0, 4.0, 3.0), "right": (10.0, 0.0, 14.0, 3.0), "hall": (0.0, 3.0, 9.0, 9.0)}
    rooms = [
        {"id": name, "name": name.title(), "polygon": [[x, y], [x2, y], [x2, y2], [x, y2]], "ceiling_height_m": 2.5}
        for name, (x, y, x2, y2) in corners.items()
    ]
    doors = [{"kind": "door", "line": [[1.5, 3.0], [2.5, 3.0]]}] if passages else []
    return FloorPlan.from_dict({"rooms": rooms, "openings": doors})


def _known(*places: tuple[float, float, float], fit: float = 1.0, **facts: object) -> Known:
    """Return equally probable places: x, y (m) and heading (degrees)."""
    position_m = np.array([place[:2] for place in places])
    heading = np.radians([place[2] for place in places])
    support = Support(np.arange(len(places)), position_m, heading, np.full(len(places), 1.0 / len(places)))
    facts = {"arcs": [(-_FIELD / 2, _FIELD / 2)], "field": _FIELD, "height_m": 1.5, "is_view": True} | facts
    facts = {"answer": 1.0} | facts
    return Known(support=support, fit=fit, **facts)  # pyright: ignore[reportArgumentType]


def _steps(plan: FloorPlan, manifest: Manifest, known: Known) -> dict[str, NextStep]:
    best: dict[str, NextStep] = {}
    for step in next_steps(plan, manifest, known, step_m=0.5):
        best.setdefault(step.kind, step)
    return best


# Four headings in the same places: the middles of the two equal rooms.
EQUAL = [(2.0, 1.5, 0.0), (2.0, 1.5, 180.0), (12.0, 1.5, 0.0), (12.0, 1.5, 180.0)]


def test_choice_between_equal_rooms_is_expected_to_tell_one_bit(manifest: Manifest) -> None:
    # 0.5 is the share of each room, so the photograph must be a little doubtful for the answer to be unsure.
    step = next_step(_plan(), manifest, _known(*EQUAL, fit=0.9), step_m=0.5)
    assert step is not None
    assert (step.kind, sorted(step.rooms)) == ("rooms", [0, 1])
    assert step.bits == pytest.approx(1.0)
    assert step.confidence == pytest.approx(0.9)
    assert words_of(_plan(), step) == "choose the room: Left or Right; the expected confidence is then 90 %"


def test_heading_tells_places_apart_that_look_along_other_azimuths(manifest: Manifest) -> None:
    places = [(2.0, 1.5, 0.0), (12.0, 1.5, 90.0), (4.0, 6.0, 180.0)]
    steps = _steps(_plan(), manifest, _known(*places, rooms=True))
    assert steps["heading"].confidence == pytest.approx(1.0)
    assert steps["heading"].bits == pytest.approx(math.log2(3.0), abs=0.01)
    assert "heading" not in _steps(_plan(), manifest, _known(*places, heading=True))


def test_statements_presume_that_the_answer_has_less_than_the_largest_share(manifest: Manifest) -> None:
    places = [(2.0, 1.5, 0.0), (12.0, 1.5, 90.0)]
    # Half of the posterior is near the best place, but only 0.4 near the one that fits best.
    steps = _steps(_plan(), manifest, _known(*places, fit=0.9, answer=0.4))
    assert steps["heading"].confidence == pytest.approx(0.9 * 0.8)
    assert steps["rooms"].confidence == pytest.approx(0.9 * 0.8)
    assert steps["rooms"].bits == pytest.approx(1.0)


def test_turn_tells_rooms_of_other_sizes_apart_but_not_equal_ones(manifest: Manifest) -> None:
    # Seen along -y, 1.5 m from the wall; what is behind differs.
    other = [(2.0, 1.5, 180.0), (6.0, 4.5, 180.0), (12.0, 1.5, 180.0)]
    turn = _steps(_plan(), manifest, _known(*other))["turn"]
    # The equal rooms stay equal.
    assert 0.5 < turn.confidence < 0.72
    assert abs(turn.turn) >= math.radians(45.0)
    assert "turn" not in _steps(_plan(), manifest, _known(*EQUAL, fit=0.9))
    seen = _known(*other, arcs=[(-math.pi, math.pi)])
    assert "turn" not in _steps(_plan(), manifest, seen)


def test_door_that_one_of_two_equal_rooms_has_tells_them_apart(manifest: Manifest) -> None:
    plan = _plan(passages=True)
    # Most places are in the room with the door, at headings that the photograph cannot tell apart.
    places = [(2.0, 1.5, 0.0)] * 3 + [(12.0, 1.5, 0.0)] * 2
    step = _steps(plan, manifest, _known(*places, fit=0.8, heading=True, rooms=True))["door"]
    assert math.degrees(step.turn) == pytest.approx(0.0, abs=4.0)
    assert step.distance_m == pytest.approx(1.5, abs=0.1)
    assert step.confidence == pytest.approx(0.8)
    assert words_of(plan, step).startswith("step through the door")


def test_sure_answers_and_foreign_photographs_have_no_step(manifest: Manifest) -> None:
    assert next_step(_plan(), manifest, _known((2.0, 1.5, 0.0)), step_m=0.5) is None
    assert next_step(_plan(), manifest, _known(*EQUAL, fit=0.3), step_m=0.5) is None


def test_models_without_measured_errors_ask_for_statements_only(manifest: Manifest) -> None:
    assert manifest.view is not None
    old = replace(manifest, errors=None, view=replace(manifest.view, errors=None))
    places = [(2.0, 1.5, 180.0), (6.0, 4.5, 180.0), (12.0, 1.5, 90.0)]
    assert set(_steps(_plan(passages=True), old, _known(*places))) == {"heading", "rooms"}
