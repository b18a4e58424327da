"""Small files with the traits of real ones: each is read right, or refused with a remedy."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import import_plan
from tests.importers.conftest import shapes, zip_file

FOLDER = Path(__file__).parent / "faults"


@dataclass(frozen=True)
class _Expected:
    """Rooms by area (m²), openings by kind (None: any), types of rooms, and a text of the report."""

    areas_m2: tuple[float, ...]
    openings: dict[str, int] | None = None
    types: frozenset[str] = field(default_factory=frozenset)
    said: str = ""


_DOOR_AND_WINDOW = {"door": 1, "window": 1}
_FLAT_OF_FOUR = (30.1, 20.9, 13.4, 1.6)
EXPECTED = {
    "door_curtain.ifc": _Expected((19.2, 16.0), _DOOR_AND_WINDOW),
    "door_ok.ifc": _Expected((19.2, 16.0), _DOOR_AND_WINDOW),
    "door_space.ifc": _Expected((19.2, 16.0), _DOOR_AND_WINDOW),
    "door_wall.ifc": _Expected((19.2, 16.0), _DOOR_AND_WINDOW),
    "low_attic.ifc": _Expected((19.2, 16.0), said="room 'Eaves' (34.2 m², 100 % of the floor) is 1.20 m high"),
    "low_cell.gml": _Expected((20.0,), said="room 'Store' (3.6 m², 15 % of the floor) is 1.25 m high"),
    "low_cupboard.ifc": _Expected((19.2, 16.0), said="'Understairs' (2.4 m², 6 % of the floor) is 1.30 m high"),
    "painted_doors_leaf60.pdf": _Expected((13.6,) * 6, {"door": 4}),
    "painted_openings.pdf": _Expected((13.6,) * 6, {"door": 5, "window": 6}),
    "pillars.dxf": _Expected((34.8, 34.8), {"passage": 1}),
    "pillars_off.dxf": _Expected((35.0, 35.0), {"passage": 1}),
    "rooms_by_use.dxf": _Expected(
        (20.0, 18.2, 15.2, 15.2, 11.2, 10.6), types=frozenset({"meeting", "office", "bathroom", "storage"})
    ),
    "rooms_by_use.svg": _Expected((20.0, 16.0, 12.5, 10.0), types=frozenset({"living", "bedroom", "kitchen"})),
    "ros_glass.yaml": _Expected((126.9, 103.3), said="never seen (unknown cells, as behind glass) and are a guess"),
    "sloped_all.gml": _Expected((30.0, 29.0)),
    "sloped_cell.gml": _Expected((30.0, 19.5, 17.9)),
    "sloped_ramp.ifc": _Expected((32.0, 15.2)),
    "small_box_wins.svg": _Expected((31.5, 20.5, 16.5, 1.4), said="chosen: the areas enclosed by all lines"),
    "stepped_hall.ifc": _Expected((54.0, 12.0)),
    "thick_closed_outer.svg": _Expected(_FLAT_OF_FOUR, {"passage": 3}),
    "thick_closed_outer_control.svg": _Expected(_FLAT_OF_FOUR, {"passage": 3}),
    "wall_body_grey.svg": _Expected((23.5, 23.5)),
    "wall_body_pier.svg": _Expected((23.5, 22.5)),
    "wall_body_thin.svg": _Expected((23.5, 23.5)),
}
REFUSED = {"no_spaces.ifc": "export it with rooms"}


@pytest.mark.parametrize("name", EXPECTED)
def test_file_is_read_right(name: str):
    expected = EXPECTED[name]
    plan = import_plan(_content(name))
    assert sorted((room.area for room in shapes(plan.document)), reverse=True) == pytest.approx(
        sorted(expected.areas_m2, reverse=True), abs=0.06
    )
    if expected.openings is not None:
        assert Counter(opening["kind"] for opening in plan.document.get("openings", ())) == expected.openings
    assert expected.types <= {room.get("type") for room in plan.document["rooms"]}
    report = plan.report
    assert any(expected.said in line for line in (*report.notes, *report.warnings, *report.unsure, ""))


@pytest.mark.parametrize("name", REFUSED)
def test_file_is_refused_with_a_remedy(name: str):
    with pytest.raises(InvalidFloorPlanError, match=REFUSED[name]):
        import_plan(_content(name))


def test_every_file_is_expected():
    names = {path.name for path in FOLDER.iterdir() if path.suffix != ".png"}
    assert names == EXPECTED.keys() | REFUSED.keys()


def _content(name: str) -> bytes:
    path = FOLDER / name
    if path.suffix != ".yaml":
        return path.read_bytes()
    return zip_file({file.name: file.read_bytes() for file in (path, path.with_suffix(".png"))})
