"""The native format with units, and what is said about plans that are likely wrong."""

from __future__ import annotations

import json

import pytest

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportOptions, KnownDistance, import_plan
from lalaloc_core.importers.model.checks import check_document, likely_unit
from tests.plans.conftest import FLAT, assert_same_plan

FOOT = 0.3048


def _scaled(value: object, factor: float) -> object:
    if isinstance(value, list):
        return [_scaled(item, factor) for item in value]
    return value * factor if isinstance(value, float | int) else value


def _in_feet() -> dict:
    plan = json.loads(json.dumps(FLAT))
    plan["units"] = "ft"
    plan["ceiling_height"] = plan.pop("ceiling_height_m") / FOOT
    for room in plan["rooms"]:
        for key in ("polygon", "holes", "walls"):
            if key in room:
                room[key] = _scaled(room[key], 1 / FOOT)
    for opening in plan["openings"]:
        opening["line"] = _scaled(opening["line"], 1 / FOOT)
    return plan


def _import(document: dict, **options: object):
    return import_plan(json.dumps(document).encode(), ImportOptions(**options))  # type: ignore[arg-type]


def test_a_plan_in_metres_stays_as_it_is():
    imported = _import(FLAT)
    assert imported.document == json.loads(json.dumps(FLAT))
    assert imported.report.format == "native"
    assert imported.report.warnings == ()


def test_a_plan_in_feet_is_converted():
    imported = _import(_in_feet())
    assert_same_plan(imported, FLAT, within_m=1e-9)
    assert imported.document["ceiling_height_m"] == pytest.approx(2.5)
    assert imported.report.metres_per_unit == FOOT
    imported.plan()


def test_the_option_wins_over_what_the_file_says():
    assert _import({**FLAT, "units": "mm"}, units="m").document["rooms"] == json.loads(json.dumps(FLAT["rooms"]))


def test_an_option_that_says_nothing_about_a_format_is_told():
    (warning,) = _import(FLAT, page=3).report.warnings
    assert warning == "'page' says nothing about a native file and was not used"


def test_y_down_turns_the_plan_over_with_its_north():
    plan = {**FLAT, "y_axis": "down", "north_deg": 30.0}
    imported = _import(plan)
    assert imported.document["north_deg"] == pytest.approx(150.0)
    assert imported.document["rooms"][2]["polygon"] == [[0, 0], [9, 0], [9, -1.9], [0, -1.9]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"units": "yd"}, "units is 'yd', known are m, cm, mm, in, ft"),
        ({"units": "ft", "ceiling_height": 8}, "'ceiling_height' and 'ceiling_height_m' say the same"),
        ({"ceiling_height_m": 2500}, "it looks like mm"),
        ({"y_axis": "left"}, "known are up, down"),
        ({"colour": "red"}, "unknown key 'colour'"),
    ],
)
def test_what_cannot_be_is_refused(change: dict, message: str):
    with pytest.raises(InvalidFloorPlanError, match=message):
        _import({**FLAT, **change})


def test_a_ceiling_of_eight_metres_is_likely_in_feet():
    (warning,) = _import({**FLAT, "ceiling_height_m": 8.0}).report.warnings
    assert "8 m" in warning
    assert "feet" in warning
    assert "2.44 m" in warning


def test_doors_of_three_metres_thirty_are_likely_in_feet():
    plan = json.loads(json.dumps(FLAT))
    plan["openings"] = [{"kind": "door", "line": [[0.2, 1.95], [3.6, 1.95]]}]
    assert any("door's width is 3.4 m" in warning for warning in _import(plan).report.warnings)


@pytest.mark.parametrize(("value", "unit"), [(2.5, None), (8.0, "ft"), (250.0, "cm"), (2500.0, "mm"), (96.0, "in")])
def test_the_likely_unit_of_a_ceiling(value: float, unit: str | None):
    assert likely_unit(value, (1.9, 6.0)) == unit


def test_rooms_that_no_door_reaches_gaps_and_doubled_names_are_told():
    plan = json.loads(json.dumps(FLAT))
    plan["rooms"].append({"name": "bedroom", "polygon": [[20, 0], [24, 0], [24, 4], [20, 4]]})
    warnings = check_document(FloorPlan.from_dict(plan).to_dict())
    assert any(warning == "no door or passage reaches 'bedroom'" for warning in warnings)
    assert any("farther than a wall's thickness" in warning and "'bedroom'" in warning for warning in warnings)
    assert any("share a name: 'bedroom'" in warning for warning in warnings)
    assert check_document(FloorPlan.from_dict(FLAT).to_dict()) == []


def test_options_come_from_text():
    options = ImportOptions.from_text(
        {"scale": "1:100", "layers": "walls, doors", "page": "2", "level": "", "ceiling_height_m": "2.7"}
    )
    assert options == ImportOptions(scale=100.0, layers=("walls", "doors"), page=2, ceiling_height_m=2.7)
    known = ImportOptions.from_text({"known_distance": "0, 0, 30, 40, 5"}).known_distance
    assert known == KnownDistance((0.0, 0.0), (30.0, 40.0), 5.0)
    assert known is not None
    assert known.metres_per_unit == pytest.approx(0.1)


@pytest.mark.parametrize(
    "values",
    [
        {"scale": "1:0"}, {"scale": "big"}, {"units": "yd"}, {"page": "0"}, {"page": "1.5"}, {"page": "-1"},
        {"known_distance": "1,1,1,1,3"}, {"known_distance": "1,2,3"}, {"metres_per_pixel": "nan"},
        {"ceiling_height_m": "200"}, {"colour": "red"}, {"scale": "1:50", "metres_per_pixel": "0.01"},
        {"y_axis": "sideways"}, {"name": "a\x00b"}, {"level": "x" * 201},
    ],
)  # fmt: skip
def test_options_that_make_no_sense_are_refused(values: dict[str, str]):
    with pytest.raises(InvalidFloorPlanError):
        ImportOptions.from_text(values)
