"""Small files with traits of real ones: read right, or refused with a remedy; `test_floorplans.py` sends them, too."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from lalaloc_core.cli import main
from lalaloc_core.importers import import_plans
from tests.importers.conftest import shapes, zip_file

FOLDER = Path(__file__).parent / "faults"


@dataclass(frozen=True)
class _Expected:
    """Rooms by area (m²), openings by kind (None: any), types of rooms, a text of the report, and options."""

    areas_m2: tuple[float, ...]
    openings: dict[str, int] | None = None
    types: frozenset[str] = field(default_factory=frozenset)
    said: str = ""
    options: Mapping[str, str] = field(default_factory=dict)

    def check(self, document: dict[str, Any], report: Mapping[str, Any]) -> None:
        """Check a plan that was read, and the report on it."""
        areas_m2 = sorted((room.area for room in shapes(document)), reverse=True)
        assert areas_m2 == pytest.approx(sorted(self.areas_m2, reverse=True), abs=0.06)
        if self.openings is not None:
            assert Counter(opening["kind"] for opening in document.get("openings", ())) == self.openings
        assert self.types <= {room.get("type") for room in document["rooms"]}
        lines = (*report["notes"], *report["warnings"], *report["unsure"], report["scale_source"], "")
        assert any(self.said in line for line in lines)


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
    "metres.png": _Expected((26.4, 18.8)),
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
    "transparent.png": _Expected((26.6, 18.9), options={"metres_per_pixel": "0.0125"}),
    "valetudo.json": _Expected((26.9, 19.3), {"passage": 1}, frozenset({"living", "bedroom"})),
    "valetudo.png": _Expected((26.9, 19.3), {"passage": 1}, frozenset({"living", "bedroom"})),
    "views.svg": _Expected((20.0, 20.0, 15.0, 11.2, 5.0)),
    "wall_body_grey.svg": _Expected((23.5, 23.5)),
    "wall_body_pier.svg": _Expected((23.5, 22.5)),
    "wall_body_thin.svg": _Expected((23.5, 23.5)),
    "white_on_transparent.png": _Expected((26.6, 18.9), options={"metres_per_pixel": "0.0125"}),
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
def test_file_is_read_right(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    expected, out = EXPECTED[name], tmp_path / "plan.json"
    options = [part for key, value in expected.options.items() for part in (f"--{key.replace('_', '-')}", value)]
    assert main(["plan", "import", str(FOLDER / name), "--out", str(out), *options]) == 0
    expected.check(json.loads(out.read_bytes()), json.loads(re.sub(r"^level .*?: ", "", capsys.readouterr().err)))


@pytest.mark.parametrize("name", REFUSED)
def test_file_is_refused_with_a_remedy(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    # The command line writes a plan of each level.
    code = 0 if name == "levels_by_layer.dxf" else 2
    assert main(["plan", "import", str(FOLDER / name), "--out", str(tmp_path / "plan.json")]) == code
    assert re.search(REFUSED[name], capsys.readouterr().err, re.DOTALL)


def test_storeys_on_layers_of_their_own_are_plans():
    plans = import_plans(content_of("levels_by_layer.dxf"))
    assert [plan.level and plan.level.name for plan in plans] == ["EG", "OG"]
    assert [any("OG" in use.layer for use in plan.report.layers) for plan in plans] == [False, True]
    assert [round(sum(room.area for room in shapes(plan.document)), 1) for plan in plans] == [79.9, 79.9]


def test_every_file_is_expected():
    names = {path.name for path in FOLDER.iterdir()} - {"ros_glass.png"}
    assert names == EXPECTED.keys() | REFUSED.keys()


def content_of(name: str) -> bytes:
    """Return a file, with the picture beside it if it has one."""
    path = FOLDER / name
    if path.suffix != ".yaml":
        return path.read_bytes()
    return zip_file({file.name: file.read_bytes() for file in (path, path.with_suffix(".png"))})
