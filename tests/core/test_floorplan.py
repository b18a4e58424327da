"""Validation of floor plans and its error messages."""

from __future__ import annotations

import contextlib
import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.errors import InvalidFloorPlanError, InvalidInputError
from lalaloc_core.floorplan import FloorPlan, PlanLimits
from tests.strategies import plan_document, plan_of, plans, rectangle, room_polygons

_KITCHEN = {"name": "kitchen", "polygon": [[0, 0], [4, 0], [4, 3], [0, 3]], "ceiling_height_m": 2.4}
EXAMPLE = {"name": "Flat 3", "ceiling_height_m": 2.5, "camera_height_m": 1.5, "rooms": [_KITCHEN]}


def refused(document: Any, limits: PlanLimits | None = None) -> InvalidFloorPlanError:
    with pytest.raises(InvalidFloorPlanError) as caught:
        FloorPlan.from_dict(document, limits or PlanLimits())
    return caught.value


@given(plans())
def test_plan_round_trips_through_json(plan: FloorPlan) -> None:
    again = FloorPlan.from_json(json.dumps(plan.to_dict()))
    assert again.to_dict() == plan.to_dict()
    assert again.warnings == plan.warnings
    np.testing.assert_array_equal(again.walls_m, plan.walls_m)


@given(room_polygons(), st.integers(0, 20), st.booleans())
def test_vertex_order_does_not_change_the_room(polygon: list[list[float]], start: int, clockwise: bool) -> None:
    start %= len(polygon)
    turned = polygon[start:] + polygon[:start]
    room = plan_of(turned[::-1] if clockwise else turned).rooms[0]
    assert room.shape.exterior.is_ccw
    assert room.shape.normalize().equals_exact(plan_of(polygon).rooms[0].shape.normalize(), 1e-12)


def test_closing_and_repeated_vertices_are_dropped() -> None:
    clean = rectangle(3.0, 2.0)
    repeated = [clean[0], clean[0], clean[1], clean[2], clean[2], clean[2], clean[3], clean[0]]
    assert plan_of(repeated).rooms[0].polygon_m.tolist() == plan_of(clean).rooms[0].polygon_m.tolist()


def test_unnamed_room_gets_a_number() -> None:
    document = plan_document(rectangle(2.0, 2.0))
    del document["rooms"][0]["name"]
    assert FloorPlan.from_dict(document).rooms[0].name == "room 1"


@pytest.mark.parametrize(
    ("polygon", "reason"),
    [
        ([[0, 0], [2, 2], [2, 0], [0, 2]], "crosses itself"),
        ([[0, 0], [4, 0], [4, 4], [2, 4], [2, 0], [1, 0], [1, 4], [0, 4]], "crosses itself"),
        (rectangle(0.4, 0.4), "0.2 m²"),
        ([[0, 0], [1, 0], [2, 0]], "lie on one line"),
        ([[0, 0], [0, 0], [1, 0], [0, 0]], "distinct"),
        ([[0, 0], [1, 1]], "at least three"),
        ([[0, 0], [3, 0], [3, math.nan]], "finite"),
        ([[0, 0], [3, 0], [3, 10**400]], "finite"),
        ([[0, 0], [3, 0], [3, 1e12]], "finite"),
        ([[0, 0], [3, 0], [3, "3"]], "two numbers"),
        ([[0, 0], [3, 0], [3, True]], "two numbers"),
        ([[0, 0], [3, 0], [3, 3, 3]], "two numbers"),
        ([[0, 0], [3, 0], None], "two numbers"),
        ("polygon", "list"),
        ({"x": 1}, "list"),
    ],
)
def test_bad_polygon_error_names_the_room(polygon: Any, reason: str) -> None:
    error = refused(plan_document(rectangle(2.0, 2.0, corner=(50.0, 0.0)), polygon))
    assert error.room == "room 2"
    assert reason in error.reason
    assert "room 2" in str(error)
    assert isinstance(error, InvalidInputError)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"rooms": []}, "at least one room"),
        ({"rooms": "kitchen"}, "at least one room"),
        ({"storeys": 2}, "unknown key 'storeys'"),
        ({"name": ""}, "non-empty"),
        ({"name": 3}, "non-empty"),
        ({"name": "x" * 201}, "201 characters"),
        ({"name": "flat\x00"}, "control"),
        ({"name": "\ud800"}, "surrogate"),
        ({"ceiling_height_m": "high"}, "number"),
        ({"ceiling_height_m": 25.0}, "between 1 and 20"),
        ({"camera_height_m": 0}, "above 0"),
        ({"camera_height_m": 0.09}, "at least 0.1 m"),
        ({"camera_height_m": math.nan}, "finite"),
        ({"camera_height_m": 10**400}, "finite"),
        ({"camera_height_m": "1.5"}, "number"),
        ({"camera_height_m": True}, "number"),
        ({"camera_height_m": 2.5}, "below the lowest ceiling"),
    ],
)
def test_bad_plan_error_names_the_reason(change: dict[str, Any], reason: str) -> None:
    document = plan_document(rectangle(3.0, 3.0))
    document["rooms"][0]["ceiling_height_m"] = 2.5
    error = refused({**document, **change})
    assert error.room is None
    assert reason in str(error)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"ceiling_height_m": 0.5}, "between 1 and 20"),
        ({"ceiling_height_m": math.inf}, "finite"),
        ({"ceiling_height_m": "high"}, "number"),
        ({"floor": "parquet"}, "unknown key 'floor'"),
    ],
)
def test_bad_room_error_names_the_room(change: dict[str, Any], reason: str) -> None:
    document = plan_document(rectangle(3.0, 3.0))
    document["rooms"][0].update(change)
    error = refused(document)
    assert error.room == "room 1"
    assert reason in error.reason


@pytest.mark.parametrize("room", [None, 3, "kitchen", [[0, 0], [1, 0], [1, 1]]])
def test_non_object_room_error_names_its_number(room: Any) -> None:
    document = plan_document(rectangle(3.0, 3.0))
    document["rooms"].append(room)
    assert refused(document).room == "room 2"


def test_camera_must_be_below_the_lowest_ceiling() -> None:
    document = plan_document(rectangle(3.0, 3.0), rectangle(3.0, 3.0, corner=(4.0, 0.0)), camera_height_m=2.2)
    FloorPlan.from_dict(document)
    document["rooms"][1]["ceiling_height_m"] = 2.1
    assert "2.1 m" in str(refused(document))


def test_limits_are_inclusive() -> None:
    limits = PlanLimits(max_rooms=2, max_vertices_per_room=5)
    square = rectangle(1.0, 1.0)
    apart = [rectangle(1.0, 1.0, corner=(2.0 * index, 0.0)) for index in range(3)]
    assert len(FloorPlan.from_dict(plan_document(*apart[:2]), limits).rooms) == 2
    assert "3 rooms; the limit is 2 (max_rooms)" in str(refused(plan_document(*apart), limits))
    assert len(FloorPlan.from_dict(plan_document([*square, [-0.5, 0.5]]), limits).rooms) == 1
    error = refused(plan_document([*square, [-0.5, 0.5], [-0.4, 0.2]]), limits)
    assert (error.room, "6 vertices; the limit is 5" in error.reason) == ("room 1", True)


def test_overlapping_rooms_give_a_warning() -> None:
    touching = plan_of(rectangle(2.0, 2.0), rectangle(2.0, 2.0, corner=(2.0, 0.0)))
    overlapping = plan_of(rectangle(2.0, 2.0), rectangle(2.0, 2.0, corner=(1.5, 0.0)))
    assert touching.warnings == ()
    assert overlapping.warnings == ("rooms 'room 1' and 'room 2' overlap by 1.00 m²",)


@pytest.mark.parametrize("text", ["", "{", "[1, 2", b"\xff\xfe\x00", "nothing"])
def test_invalid_json_is_refused(text: str | bytes) -> None:
    with pytest.raises(InvalidFloorPlanError, match="not valid JSON"):
        FloorPlan.from_json(text)


_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda children: st.lists(children, max_size=4) | st.dictionaries(st.text(max_size=5), children, max_size=3),
    max_leaves=8,
)


@given(st.sampled_from(["name", "rooms", "ceiling_height_m", "camera_height_m", "polygon", "vertex"]), _json)
def test_arbitrary_values_raise_only_plan_errors(key: str, value: Any) -> None:
    document = plan_document(rectangle(3.0, 3.0))
    if key == "polygon":
        document["rooms"][0]["polygon"] = value
    elif key == "vertex":
        document["rooms"][0]["polygon"][2] = value
    else:
        document[key] = value
    with contextlib.suppress(InvalidFloorPlanError):
        assert FloorPlan.from_dict(document).area_m2 > 0.0


def test_arrays_of_a_plan_are_read_only() -> None:
    plan = plan_of(rectangle(3.0, 2.0), [[4, 0], [6, 0], [5, 2]])
    for array in (plan.rooms[0].polygon_m, plan.rooms[0].walls_m, plan.walls_m, plan.ceiling_heights_m):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


@given(room_polygons())
def test_walls_close_the_polygon(polygon: list[list[float]]) -> None:
    room = plan_of(polygon).rooms[0]
    np.testing.assert_array_equal(room.walls_m[:, :2], room.polygon_m)
    np.testing.assert_array_equal(room.walls_m[:, 2:], np.roll(room.polygon_m, -1, axis=0))


def test_positions_belong_to_the_first_room() -> None:
    plan = plan_of(rectangle(2.0, 2.0), rectangle(2.0, 2.0, corner=(1.0, 0.0)), rectangle(2.0, 2.0, corner=(5.0, 0.0)))
    positions = np.array([[0.5, 1.0], [1.5, 1.0], [2.5, 1.0], [4.0, 1.0], [6.0, 1.0], [np.nan, 0.0]])
    assert plan.room_index_at(positions).tolist() == [0, 0, 1, -1, 2, -1]


@pytest.mark.parametrize(("degrees", "azimuth"), [(0, 0.0), (90, math.pi / 2), (-90, 1.5 * math.pi), (360, 0.0)])
def test_north_is_an_azimuth_of_the_plan(degrees: float, azimuth: float) -> None:
    assert FloorPlan.from_dict(EXAMPLE | {"north_deg": degrees}).north == pytest.approx(azimuth)
    assert FloorPlan.from_dict(EXAMPLE).north is None
    assert "north_deg" not in FloorPlan.from_dict(EXAMPLE).to_dict()


@given(degrees=st.floats(-360, 360))
def test_north_round_trips(degrees: float) -> None:
    once = FloorPlan.from_dict(EXAMPLE | {"north_deg": degrees}).to_dict()
    assert math.cos(math.radians(once["north_deg"] - degrees)) == pytest.approx(1.0, abs=1e-12)
    assert FloorPlan.from_dict(once).to_dict() == once


@pytest.mark.parametrize("degrees", [361, -360.5, math.nan, math.inf, "north", True, [0]])
def test_invalid_north_is_refused(degrees: Any) -> None:
    assert "north_deg" in str(refused(EXAMPLE | {"north_deg": degrees}))


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"rooms":' * 1000, '{"name": "\\"[[[[[[", "rooms": [[[[[[[[[0]]]]]]]]]}']
)
def test_deep_nesting_is_refused_before_it_is_parsed(text: str) -> None:
    for form in (text, text.encode("utf-8"), text.encode("utf-16")):
        with pytest.raises(InvalidFloorPlanError, match=r"nested \d+ levels deep; the limit is 8"):
            FloorPlan.from_json(form)
    # Brackets in strings are not nesting.
    name = '[[[[[[[[[[ {{{{{{{{{{ \\" \\\\'
    assert FloorPlan.from_json(json.dumps(EXAMPLE | {"name": name})).name == name


def test_million_vertices_are_refused() -> None:
    one_room = '{"ceiling_height_m": 2.5, "rooms": [{"polygon": [' + ",".join(["[0,0]"] * 10**6) + "]}]}"
    with pytest.raises(InvalidFloorPlanError, match=r"1000000 vertices; .* is 100000 \(max_plan_vertices\)"):
        FloorPlan.from_json(one_room)


def test_overlap_search_ends_early() -> None:
    """250 copies of a jagged room: checking all pairs would take minutes."""
    angles = 2.0 * math.pi * np.arange(200) / 200.0
    radii = 2.0 + np.arange(200) % 2
    star = np.round(np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1), 3).tolist()
    plan = plan_of(*[star] * 250)
    assert len(plan.warnings) == 21
    assert plan.warnings[-1] == "more rooms may overlap; the remaining pairs were not checked"
