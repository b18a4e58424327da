"""Maps of ROS `map_server`."""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
import shapely
import yaml
from PIL import Image
from shapely import affinity

from lalaloc_core.cli import main
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportOptions, detect_format, export_plan, import_plan
from lalaloc_core.importers.common.geometry import MapFrame
from lalaloc_core.importers.formats.ros import write
from tests.importers.conftest import FLAT, lines, shapes, zip_file
from tests.painted import picture_file

SETTINGS = {"image": "map.pgm", "resolution": 0.05, "origin": [0.0, 0.0, 0.0], "negate": 0}


def _files(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _cells(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(_files(content)["map.pgm"])))


def _scanned() -> np.ndarray:
    """Return a map of two rooms with walls of one cell, an open door between them, and specks, in unknown space."""
    cells = np.full((100, 160), 205, np.uint8)
    cells[10:91, 10:151] = 0
    cells[11:90, 11:150] = 254
    cells[11:90, 80] = 0
    cells[40:58, 80] = 254
    cells[30, 30] = cells[60:62, 120] = 0
    return cells


def _map(cells: np.ndarray, **settings: object) -> bytes:
    return zip_file({"map.yaml": yaml.safe_dump(SETTINGS | settings), "map.pgm": picture_file(cells, "PPM")})


def _assert_same_rooms(document: dict, expected: list[shapely.Polygon], within_m: float) -> None:
    found = shapes(document)
    assert len(found) == len(expected)
    for room in expected:
        nearest = min(found, key=lambda shape: shape.centroid.distance(room.centroid))
        assert nearest.hausdorff_distance(shapely.Polygon(room.exterior)) < within_m


def test_exported_map_is_imported_in_the_plan_frame(flat: FloorPlan):
    content = export_plan(flat, "ros")
    assert content == export_plan(flat, "ros")
    plan = import_plan(content)
    assert (plan.report.format, plan.report.is_draft, plan.report.metres_per_unit) == ("ros", True, 0.05)
    _assert_same_rooms(plan.document, shapes(dict(FLAT)), 0.08)
    # Doors and passages are open, and windows are walls.
    for door in (*lines(dict(FLAT), "door"), *lines(dict(FLAT), "passage")):
        assert any(line.centroid.distance(door.centroid) < 0.15 for line in lines(plan.document, "passage"))
    assert lines(plan.document, "window") == []
    assert plan.document["opening_kinds"] == []


def test_exported_cells_are_free_occupied_or_unknown(flat: FloorPlan):
    files = _files(export_plan(flat, "ros"))
    settings = yaml.safe_load(files["map.yaml"])
    assert settings["image"] == "map.pgm"
    assert settings["occupied_thresh"] > settings["free_thresh"]
    cells = np.asarray(Image.open(io.BytesIO(files["map.pgm"])))
    (x0, y0, _), size = settings["origin"], settings["resolution"]

    def value(x: float, y: float) -> int:
        return int(cells[len(cells) - 1 - math.floor((y - y0) / size), math.floor((x - x0) / size)])

    bedroom, door, wall, column, window, inner, outside = (
        value(1, 3), value(1.45, 1.95), value(3, 1.95), value(3.2, 4.2), value(2, 5.08), value(7, 3.2), value(-0.8, 3)
    )  # fmt: skip
    assert (bedroom, door) == (254, 254)
    assert (wall, column, window, inner) == (0, 0, 0, 0)
    assert outside == 205


def test_rooms_that_touch_have_a_wall():
    rooms = [{"polygon": [[x, 0], [x + 4, 0], [x + 4, 3], [x, 3]]} for x in (0, 4)]
    cells = _cells(export_plan(FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": rooms}), "ros"))
    row = cells[len(cells) // 2]
    free = np.flatnonzero(row == 254)
    assert (row[free[0] : free[-1]] == 0).any()


def test_large_plan_has_larger_cells():
    rooms = [{"polygon": [[x, 0], [x + 4, 0], [x + 4, 3], [x, 3]]} for x in (0, 600)]
    rooms.append({"polygon": [[0, 600], [4, 600], [4, 604]]})
    plan = FloorPlan.from_dict({"ceiling_height_m": 2.5, "rooms": rooms})
    files = _files(export_plan(plan, "ros"))
    assert yaml.safe_load(files["map.yaml"])["resolution"] == 0.4
    assert len(files["map.pgm"]) < 4.1e6


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.0])
def test_origin_and_rotation_of_a_map_are_kept(flat: FloorPlan, yaw: float):
    frame = MapFrame(0.04, (-7.3, -9.1, yaw), (800, 800))
    content = write(flat.to_dict(), None, frame)
    assert _cells(content).shape == (800, 800)
    # Rotated counter-clockwise by `yaw` about the lower left corner.
    corner = affinity.rotate(shapely.Point(1.0, 2.0), yaw, origin=(0, 0), use_radians=True)
    assert tuple(frame.to_map(np.array([[1.0, 2.0]]))[0]) == pytest.approx((corner.x - 7.3, corner.y - 9.1))
    if yaw != -2.0:
        _assert_same_rooms(import_plan(content).document, shapes(dict(FLAT)), 0.15)


def test_scanned_map_becomes_rooms():
    plan = import_plan(_map(_scanned(), origin=[-3.0, 2.0, 0.0]))
    rooms = sorted(shapes(plan.document), key=lambda room: room.centroid.x)
    assert [room.area for room in rooms] == pytest.approx([3.45 * 3.95, 3.45 * 3.95], rel=0.03)
    assert rooms[0].bounds == pytest.approx((-2.45, 2.5, 1.0, 6.45), abs=0.06)
    (passage,) = lines(plan.document, "passage")
    assert passage.length == pytest.approx(0.9, abs=0.1)
    assert passage.centroid.coords[0] == pytest.approx((1.02, 4.55), abs=0.1)


def test_furniture_in_a_map_is_no_wall_and_is_named():
    bare, cells = _scanned(), _scanned()
    # Outlines of tables of 1.2 m x 0.7 m and 2.2 m x 0.9 m, one of them beside the door.
    for top, left, height, width in ((40, 60, 14, 17), (20, 100, 18, 44), (70, 30, 14, 24)):
        cells[top : top + height, left : left + width] = 0
        cells[top + 1 : top + height - 1, left + 1 : left + width - 1] = 205
    plan, expected = import_plan(_map(cells)), import_plan(_map(bare))
    _assert_same_rooms(plan.document, shapes(expected.document), 0.1)
    assert len(lines(plan.document, "passage")) == 1
    (told,) = (text for text in plan.report.unsure if "furniture" in text)
    assert told.startswith("3 occupied areas")
    assert "(6.1, 3.6)" in told
    assert not any("furniture" in text for text in expected.report.unsure)


def test_free_standing_wall_is_no_furniture():
    cells = _scanned()
    cells[50, 25:60] = 0
    assert not any("furniture" in text for text in import_plan(_map(cells)).report.unsure)


def test_unknown_areas_are_no_rooms():
    cells = _scanned()
    cells[11:90, 81:150] = 205
    (room,) = shapes(import_plan(_map(cells)).document)
    assert room.centroid.x < 4.0


def test_negated_and_transparent_pictures():
    cells = _scanned()
    assert len(import_plan(_map(255 - cells, negate=1)).document["rooms"]) == 2
    opaque = np.where(cells == 205, 0, 255).astype(np.uint8)
    picture = picture_file(np.dstack([cells, opaque]))
    settings = yaml.safe_dump(SETTINGS | {"image": "maps/map.png"})
    assert len(import_plan(zip_file({"a/b.yml": settings, "a/map.png": picture})).document["rooms"]) == 2


def test_picture_alone_needs_a_scale():
    picture = picture_file(_scanned(), "PPM")
    assert detect_format(picture) == "ros"
    with pytest.raises(InvalidFloorPlanError, match="one zip archive, or the PGM picture with metres_per_pixel"):
        import_plan(picture)
    plan = import_plan(picture, ImportOptions(metres_per_pixel=0.05))
    assert (len(plan.document["rooms"]), plan.report.scale_source) == (2, "metres_per_pixel")
    with pytest.raises(InvalidFloorPlanError, match="a part of a ROS map"):
        import_plan(b"# map\nresolution: 0.05\nimage: map.pgm\n")


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"a.yaml": "image: x.pgm\n"}, "no picture 'x.pgm', which the ROS map names"),
        ({"a.yaml": "", "b.yaml": ""}, "2 YAML files"),
        ({"a.yaml": "[1, 2"}, "the YAML of the ROS map is invalid"),
        ({"a.yaml": "- 1"}, "must have 'image'"),
        ({"a.yaml": "resolution: 1"}, "has no 'image'"),
        ({"a.yaml": "x: " + "y" * 70_000}, "70003 bytes; the limit is 65536"),
        ({"a.yaml": "image: m.pgm\norigin: [0, 0, 0]", "m.pgm": b"P5 2 2 255 abcd"}, "resolution .* is None"),
        ({"a.yaml": "image: m.pgm\nresolution: 0.05", "m.pgm": b"P5 2 2 255 abcd"}, "origin of the ROS map is None"),
        (
            {"a.yaml": "image: m.pgm\nresolution: .nan\norigin: [0, 0]", "m.pgm": b"P5 2 2 255 abcd"},
            "resolution of the ROS map is .nan",
        ),
        ({"a.yaml": "image: m.pgm", "m.pgm": b"P5 90000 90000 255 "}, "90000 x 90000 cells|cannot be read"),
        ({"a.yaml": "image: m.pgm", "m.pgm": b"nothing"}, "cannot be read"),
    ],
)
def test_invalid_map_is_rejected(files: dict[str, bytes | str], words: str):
    with pytest.raises(InvalidFloorPlanError, match=words):
        import_plan(zip_file(files))


def test_map_without_a_room_is_rejected():
    cells = _scanned()
    for empty in (np.full_like(cells, 254), np.where(cells == 0, 254, cells)):
        with pytest.raises(InvalidFloorPlanError, match=r"no walls that enclose a room .* 8.0 m by 5.0 m"):
            import_plan(_map(empty))


def test_command_reads_the_map_beside_its_yaml_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(SETTINGS | {"origin": [-3.0, 2.0, 0.0]}), encoding="utf-8")
    (tmp_path / "map.pgm").write_bytes(picture_file(_scanned(), "PPM"))
    plan, out = tmp_path / "plan.json", tmp_path / "out.zip"
    assert main(["plan", "import", str(tmp_path / "map.yaml"), "-o", str(plan)]) == 0
    assert len(json.loads(plan.read_text(encoding="utf-8"))["rooms"]) == 2
    export = ["plan", "export", str(plan), "--format", "ros", "--out", str(out)]
    assert main([*export, "--like", str(tmp_path / "map.yaml")]) == 0
    settings = yaml.safe_load(_files(out.read_bytes())["map.yaml"])
    assert (settings["origin"], settings["resolution"]) == ([-3.0, 2.0, 0.0], 0.05)
    cells = _cells(out.read_bytes())
    assert cells.shape == (100, 160)
    # The written map equals the scanned one, besides the specks and a cell along the walls.
    assert (cells[_scanned() == 254] == 254).mean() > 0.95
    assert (cells[_scanned() == 0] == 0).mean() > 0.9
    assert main([*export[:4], "dxf", *export[5:], "--like", str(tmp_path / "map.yaml")]) == 2
    (tmp_path / "map.pgm").unlink()
    assert main(["plan", "import", str(tmp_path / "map.yaml")]) == 2
    assert "map.pgm' cannot be read" in capsys.readouterr().err
