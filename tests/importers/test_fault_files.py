"""Small files with the traits of real ones: each is read right, or refused with a remedy."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers import import_plan, import_plans
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
_THREE = frozenset({"kitchen", "bedroom", "bathroom"})
_FLAT_OF_FOUR = (30.1, 20.9, 13.4, 1.6)
EXPECTED = {
    "centred_origin.dxf": _Expected((18.9, 14.7, 12.6), types=_THREE),
    "core.svg": _Expected((563.5, 26.3, 26.3)),
    "door_curtain.ifc": _Expected((19.2, 16.0), _DOOR_AND_WINDOW),
    "door_ok.ifc": _Expected((19.2, 16.0), _DOOR_AND_WINDOW),
    "door_space.ifc": _Expected((19.2, 16.0), _DOOR_AND_WINDOW),
    "door_wall.ifc": _Expected((19.2, 16.0), _DOOR_AND_WINDOW),
    "framed.pdf": _Expected((33.6, 22.0), {"passage": 2}, said="27.7 m x 19.0 m is taken for the sheet's frame"),
    "framed.svg": _Expected((26.3, 26.3), said="1 white lines were left out"),
    "half_size_a3.pdf": _Expected((38.9, 32.1), {"door": 1}, said="for A1, 2 times the page"),
    "hidden_parts.dxf": _Expected((35.5, 23.7), {"passage": 1}, said="layer 'LINES' is not plotted, and was left out"),
    "illustrator.svg": _Expected((24.1, 16.9), types=frozenset({"kitchen", "bedroom"})),
    "lat_lon.geojson": _Expected((24.2, 21.0, 19.8), said="latitude and longitude"),
    "layers_off.pdf": _Expected((33.6, 22.0), said="switched off in the PDF were not read: one without a name, 'Äß'"),
    "layers_on.pdf": _Expected((22.0, 16.2, 16.2)),
    "low_attic.ifc": _Expected((19.2, 16.0), said="room 'Eaves' (34.2 m², 100 % of the floor) is 1.20 m high"),
    "low_cell.gml": _Expected((20.0,), said="room 'Store' (3.6 m², 15 % of the floor) is 1.25 m high"),
    "low_cupboard.ifc": _Expected((19.2, 16.0), said="'Understairs' (2.4 m², 6 % of the floor) is 1.30 m high"),
    "mline_walls.dxf": _Expected((25.1, 18.2), {"door": 1}),
    "open_outlines.geojson": _Expected((24.0, 19.2, 41.8), said="the open outline of 'Office' was closed"),
    "outlines.ifc": _Expected((24.0, 15.2), said="space 'Living' is 0.00 m high"),
    "painted_doors_leaf60.pdf": _Expected((13.6,) * 6, {"door": 4}),
    "painted_openings.pdf": _Expected((13.6,) * 6, {"door": 5, "window": 6}),
    "pillars.dxf": _Expected((34.8, 34.8), {"passage": 1}),
    "pillars_off.dxf": _Expected((35.0, 35.0), {"passage": 1}),
    "renovation.dxf": _Expected((33.6, 20.4), {"door": 1}, said="'A-WALL-DEMO' shows what is to be demolished"),
    "revit_areas.ifc": _Expected((30.8, 10.4, 8.5), said="'Gross Building Area' (60.0 m²) covers 3 rooms"),
    "right_a1.pdf": _Expected((38.9, 32.1), {"door": 1}),
    "right_aligned.dxf": _Expected((18.9, 14.7, 12.6), types=_THREE),
    "right_order.geojson": _Expected((24.2, 21.0, 19.8)),
    "rooms_by_use.dxf": _Expected(
        (20.0, 18.2, 15.2, 15.2, 11.2, 10.6), types=frozenset({"meeting", "office", "bathroom", "storage"})
    ),
    "rooms_by_use.svg": _Expected((20.0, 16.0, 12.5, 10.0), types=frozenset({"living", "bedroom", "kitchen"})),
    "ros_glass.yaml": _Expected((126.9, 103.3), said="never seen (unknown cells, as behind glass) and are a guess"),
    "sheet_house.svg": _Expected((81.7, 44.2)),
    "sheet_studio.svg": _Expected((127.3,)),
    "sloped_all.gml": _Expected((30.0, 29.0)),
    "sloped_cell.gml": _Expected((30.0, 19.5, 17.9)),
    "sloped_ramp.ifc": _Expected((32.0, 15.2)),
    "small_box_wins.svg": _Expected((31.5, 20.5, 16.5, 1.4), said="chosen: the areas enclosed by all lines"),
    "stepped_hall.ifc": _Expected((54.0, 12.0)),
    "thick_closed_outer.svg": _Expected(_FLAT_OF_FOUR, {"passage": 3}),
    "thick_closed_outer_control.svg": _Expected(_FLAT_OF_FOUR, {"passage": 3}),
    "valetudo.json": _Expected((26.9, 19.3), {"passage": 1}, frozenset({"living", "bedroom"})),
    "views.svg": _Expected((20.0, 20.0, 15.0, 11.2, 5.0)),
    "wall_body_grey.svg": _Expected((23.5, 23.5)),
    "wall_body_pier.svg": _Expected((23.5, 22.5)),
    "wall_body_thin.svg": _Expected((23.5, 23.5)),
    "wide_walls.dxf": _Expected((23.9, 17.2), {"door": 1}),
}
REFUSED = {
    "ha_floorplan.svg": "if the plan is a picture, send that PNG or JPEG",
    "levels_by_layer.dxf": "EG.*OG",
    "no_spaces.ifc": "export it with rooms",
    "xref_frame.dxf": "attaches '.*ground-floor.dwg', which is not in the file: bind it",
    "xref_only.dxf": "attaches '.*ground-floor.dwg', which is not in the file: bind it",
}


# The control of `half_size_a3.pdf`; a large page takes seconds.
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "right_a1.pdf" else []) for name in EXPECTED]
)
def test_file_is_read_right(name: str):
    expected = EXPECTED[name]
    plan = import_plan(content_of(name))
    assert sorted((room.area for room in shapes(plan.document)), reverse=True) == pytest.approx(
        sorted(expected.areas_m2, reverse=True), abs=0.06
    )
    if expected.openings is not None:
        assert Counter(opening["kind"] for opening in plan.document.get("openings", ())) == expected.openings
    assert expected.types <= {room.get("type") for room in plan.document["rooms"]}
    report = plan.report
    lines = (*report.notes, *report.warnings, *report.unsure, report.scale_source, "")
    assert any(expected.said in line for line in lines)


@pytest.mark.parametrize("name", REFUSED)
def test_file_is_refused_with_a_remedy(name: str):
    with pytest.raises(InvalidFloorPlanError, match=REFUSED[name]):
        import_plan(content_of(name))


def test_storeys_on_layers_of_their_own_are_plans():
    plans = import_plans(content_of("levels_by_layer.dxf"))
    assert [plan.level and plan.level.name for plan in plans] == ["EG", "OG"]
    assert [round(sum(room.area for room in shapes(plan.document)), 1) for plan in plans] == [79.9, 79.9]


def test_picture_of_a_robots_map_has_the_map():
    assert import_plan(content_of("valetudo.png")).document == import_plan(content_of("valetudo.json")).document


def test_every_file_is_expected():
    names = {path.name for path in FOLDER.iterdir() if path.suffix != ".png"}
    assert names == EXPECTED.keys() | REFUSED.keys()


def content_of(name: str) -> bytes:
    """Return a file, with the picture beside it if it has one."""
    path = FOLDER / name
    if path.suffix != ".yaml":
        return path.read_bytes()
    return zip_file({file.name: file.read_bytes() for file in (path, path.with_suffix(".png"))})
