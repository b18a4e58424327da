"""Native format with units, checks of plans, and import options."""

from __future__ import annotations

import json
import math
import re

import pytest

from lalaloc_core.errors import InvalidFloorPlanError, SeveralLevelsError
from lalaloc_core.importers import ImportOptions, KnownDistance, import_if_native, import_plan, import_plans
from lalaloc_core.importers.common.plausibility import likely_unit
from lalaloc_core.importers.importing import begins_with_plans
from tests.importers.conftest import FLAT, assert_same_plan

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


def test_plan_in_metres_is_unchanged():
    imported = _import(FLAT)
    assert imported.document == json.loads(json.dumps(FLAT))
    assert imported.report.format == "native"
    assert imported.report.warnings == ()


def test_plan_in_feet_is_converted():
    imported = _import(_in_feet())
    assert_same_plan(imported, FLAT, within_m=1e-9)
    assert imported.document["ceiling_height_m"] == pytest.approx(2.5)
    assert imported.report.metres_per_unit == FOOT
    imported.plan()


def test_units_option_overrides_the_file():
    assert _import({**FLAT, "units": "mm"}, units="m").document["rooms"] == json.loads(json.dumps(FLAT["rooms"]))


def _street(*levels: object) -> list[dict]:
    return [{**FLAT, "name": f"home {number}", "level": level} for number, level in enumerate(levels)]


def test_several_plans_keep_their_names_and_are_ordered_by_level():
    content = json.dumps({"plans": [*_street(2, -1.5), {**FLAT, "name": "home 2"}]}).encode()
    plans = import_plans(content, ImportOptions(ceiling_height_m=2.4), building="street")
    levels = [(plan.document["name"], plan.level and plan.level.number) for plan in plans]
    assert levels == [("home 1", -1.5), ("home 2", 0.0), ("home 0", 2.0)]
    assert all(plan.document["rooms"] == json.loads(json.dumps(FLAT["rooms"])) for plan in plans)
    assert begins_with_plans(b"\xef\xbb\xbf " + content)
    # A service's own process leaves them to a worker.
    assert import_if_native(content) is None
    assert import_plan(content, ImportOptions(level="home 2", name="mine")).document["name"] == "mine"
    with pytest.raises(SeveralLevelsError):
        import_plan(content)


def test_plans_without_names_are_named_after_the_file():
    nameless = {"rooms": FLAT["rooms"], "ceiling_height_m": 2.5}
    content = json.dumps({"plans": [{**FLAT, "name": "home"}, nameless]}).encode()
    plans = import_plans(content, building="street")
    names = [(plan.document["name"], plan.plan().name) for plan in plans]
    assert names == [("home", "home"), ("street – plan 1", "street – plan 1")]


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ({"plans": []}, "'plans' must be a list of at least one plan"),
        ({"plans": {"0": FLAT}}, "'plans' must be a list of at least one plan"),
        ({"plans": [FLAT, 3]}, "each an object with 'rooms'"),
        ({"plans": [FLAT], "units": "ft"}, "'units' stands beside 'plans'; move it into the plans"),
        ({"plans": _street(0, "1")}, "plan 1 of 'plans' has level '1'; it must be a number from -1000 to 1000"),
        ({"plans": _street(math.nan)}, "plan 0 of 'plans' has level 'nan'"),
        ({"plans": [FLAT, {**FLAT, "name": "home", "rooms": []}]}, "level 'home': "),
        ({"plans": [FLAT, {"plans": [FLAT]}]}, "level 'plan 1': "),
        ({"plans": _street(*range(201))}, "has 201 levels; the limit is 200 (max_levels)"),
    ],
)
def test_faulty_plans_are_refused(document: dict, words: str):
    with pytest.raises(InvalidFloorPlanError, match=re.escape(words)):
        import_plans(json.dumps(document).encode())


def test_y_down_flips_plan_and_north():
    imported = _import({**FLAT, "y_axis": "down", "north_deg": 30.0})
    assert imported.document["north_deg"] == pytest.approx(150.0)
    assert imported.document["rooms"][2]["polygon"] == [[0, 0], [9, 0], [9, -1.9], [0, -1.9]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"units": "yd"}, "units is 'yd'; set it to one of m, cm, mm, in, ft"),
        ({"units": "ft", "ceiling_height": 8}, "'ceiling_height' and 'ceiling_height_m' are both set"),
        ({"ceiling_height_m": 2500}, "It looks like mm"),
        ({"y_axis": "left"}, "set it to up or down"),
        ({"colour": "red"}, "unknown key 'colour'"),
    ],
)
def test_invalid_values_are_rejected(change: dict, message: str):
    with pytest.raises(InvalidFloorPlanError, match=message):
        _import({**FLAT, **change})


def test_doors_wider_than_three_metres_give_a_warning():
    plan = json.loads(json.dumps(FLAT))
    plan["openings"] = [{"kind": "door", "line": [[0.2, 1.95], [3.6, 1.95]]}]
    assert any("the median width of doors is 3.4 m" in warning for warning in _import(plan).report.warnings)


@pytest.mark.parametrize(("value", "unit"), [(2.5, None), (8.0, "ft"), (250.0, "cm"), (2500.0, "mm"), (96.0, "in")])
def test_likely_unit_of_a_ceiling(value: float, unit: str | None):
    assert likely_unit(value, (1.9, 6.0)) == unit


def test_options_are_parsed_from_text():
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
def test_invalid_options_are_rejected(values: dict[str, str]):
    with pytest.raises(InvalidFloorPlanError):
        ImportOptions.from_text(values)
