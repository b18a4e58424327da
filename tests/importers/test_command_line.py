"""Command `lalaloc plan`."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ezdxf.filemanagement import new as new_dxf
from PIL import Image

from lalaloc_core.cli import main
from lalaloc_core.draw.plan import plan_svg
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import export_plan
from tests.importers.conftest import FLAT, dxf_file
from tests.importers.test_pictures import hall_beside_a_photograph, open_hall

FAULTS = Path(__file__).parent / "faults"
ROOM = {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [[[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]]]}}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "flat.json"
    path.write_text(json.dumps(FLAT), encoding="utf-8")
    return path


def _two_levels() -> str:
    rooms = [ROOM | {"properties": {"indoor": "room", "level": level}} for level in ("Attic", "2")]
    return json.dumps({"type": "FeatureCollection", "units": "m", "features": rooms})


def _run(*arguments: str, **streams: Any) -> subprocess.CompletedProcess[bytes]:
    command = "import sys; from lalaloc_core.cli import main; sys.exit(main())"
    return subprocess.run([sys.executable, "-c", command, *arguments], check=False, **streams)


def test_plan_is_exported_and_imported(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    drawing, back = tmp_path / "flat.dxf", tmp_path / "back.json"
    assert main(["plan", "export", str(file), "--format", "dxf", "--out", str(drawing)]) == 0
    assert main(["plan", "import", str(drawing), "--out", str(back), "--ceiling-height-m", "2.5"]) == 0
    plan = FloorPlan.from_json(back.read_bytes())
    assert {room.name for room in plan.rooms} == {"bedroom", "living room", "corridor"}
    assert len(plan.openings) == 4
    assert '"$INSUNITS is 6 (m)"' in capsys.readouterr().err


def test_check_prints_warnings(file: Path, capsys: pytest.CaptureFixture[str]):
    file.write_text(json.dumps({**FLAT, "ceiling_height_m": 8}), encoding="utf-8")
    assert main(["plan", "check", str(file)]) == 0
    shown = capsys.readouterr().out
    assert "3 rooms" in shown
    assert "looks like feet" in shown


def test_plan_is_written_although_the_reader_of_the_report_left(file: Path, tmp_path: Path):
    out = tmp_path / "out.json"
    read, write = os.pipe()
    os.close(read)
    run = _run("plan", "import", str(file), "--out", str(out), stdout=write, stderr=write)
    os.close(write)
    assert run.returncode == 0
    assert len(FloorPlan.from_json(out.read_bytes()).rooms) == 3


@pytest.mark.slow
def test_export_to_dxf_logs_nothing(file: Path, tmp_path: Path):
    out = str(tmp_path / "flat.dxf")
    run = _run("plan", "export", str(file), "--format", "dxf", "--out", out, stderr=subprocess.PIPE)
    assert (run.returncode, run.stderr) == (0, b"")


def test_plan_without_a_name_is_named_after_its_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "Ground floor.svg"
    file.write_bytes(export_plan(FloorPlan.from_dict(json.loads(json.dumps(FLAT))), "svg"))
    assert main(["plan", "check", str(file)]) == 0
    assert "'Ground floor': 3 rooms" in capsys.readouterr().out


def test_anchor_option_is_used_for_imdf(file: Path, tmp_path: Path):
    out = tmp_path / "flat.zip"
    arguments = ["plan", "export", str(file), "--format", "imdf", "--out", str(out)]
    assert main(arguments) == 2
    assert main([*arguments, "--anchor", "48.1,11.5,20"]) == 0
    assert out.read_bytes().startswith(b"PK")


@pytest.mark.parametrize(
    "arguments",
    [["--anchor", "91,0"], ["--anchor", "here"], ["--anchor", "1,2,3,4"], ["--units", "yd"], ["--scale", "much"]],
)
def test_invalid_options_are_rejected(file: Path, tmp_path: Path, arguments: list[str]):
    out = str(tmp_path / "x")
    assert main(["plan", "export", str(file), "--format", "imdf", "--out", out, *arguments]) == 2


def test_missing_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["plan", "import", str(tmp_path / "none.svg")]) == 2
    assert "none.svg' cannot be read: No such file" in capsys.readouterr().err


def test_every_level_is_written_to_a_folder(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["plan", "import", str(file), "--all-levels", "-o", str(tmp_path / "out")]) == 0
    assert FloorPlan.from_json((tmp_path / "out" / "flat.json").read_bytes()).name == "Flat"
    assert capsys.readouterr().out == f"{tmp_path / 'out' / 'flat.json'}\n"
    file, folder = tmp_path / "Duplex.geojson", tmp_path / "plans" / "duplex"
    file.write_text(_two_levels(), encoding="utf-8")
    assert main(["plan", "import", str(file), "--all-levels"]) == 2
    assert "add --out FOLDER" in capsys.readouterr().err
    assert main(["plan", "import", str(file), "--all-levels", "-o", str(folder)]) == 0
    written = sorted(folder.iterdir())
    assert capsys.readouterr().out.split() == [str(folder / "attic.json"), str(folder / "level-2.json")]
    assert [FloorPlan.from_json(path.read_bytes()).name for path in written] == ["Duplex – Attic", "Duplex – Level 2"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("plan import attic.json --all-levels --replace --out .", "'attic.json' is read and never changed"),
        ("plan import home-1.json --out home.json", "'home-1.json' is read"),
        ("plan import home-1.json --all-levels --out .", "'attic.json' exists; choose another name, or add --replace"),
        ("plan import home-1.json --debug keep.svg", "'keep.svg' exists"),
        ("plan draw ros_glass.yaml --out ros_glass.png", "'ros_glass.png' is read"),
        ("encode kitchen.features", "'kitchen.features' is read"),
    ],
)
def test_no_file_is_overwritten(arguments: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for name in ("attic.json", "home-1.json", "keep.svg", "kitchen.features"):
        (tmp_path / name).write_text(_two_levels(), encoding="utf-8")
    for path in FAULTS.glob("ros_glass.*"):
        shutil.copy(path, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with contextlib.chdir(tmp_path):
        assert main(arguments.split()) == 2
    assert message in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_area_without_a_room_is_drawn(tmp_path: Path):
    picture, out = tmp_path / "hall.png", tmp_path / "hall.svg"
    picture.write_bytes(open_hall())
    assert main(["plan", "draw", str(picture), "--metres-per-pixel", "0.01", "--out", str(out)]) == 0
    drawn = out.read_text(encoding="utf-8")
    assert drawn.count('class="no-room"') == 1
    # The view shows the whole area, to x = 9.8 m.
    left, _, width, _ = (float(value) for value in re.findall(r'viewBox="([^"]*)"', drawn)[0].split())
    assert left + width > 9.8


def test_picture_that_looks_like_a_photograph_is_read_with_is_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    picture = tmp_path / "hall.png"
    picture.write_bytes(hall_beside_a_photograph())
    arguments = ["plan", "check", str(picture), "--metres-per-pixel", "0.01", "--crop", "0,0,1100,500"]
    assert main(arguments) == 2
    assert "if it is a plan, set plan=true (--is-plan on the command line)" in capsys.readouterr().err
    assert main([*arguments, "--is-plan"]) == 0
    assert "2 rooms" in capsys.readouterr().out


def test_legend_lies_below_areas_without_a_room(flat: FloorPlan):
    drawn = plan_svg(flat, no_room=[[(2.0, -6.0), (7.0, -6.0), (7.0, -1.0), (2.0, -1.0)]])
    assert float(re.findall(r'class="key".*?<path d="M[-\d.]+ ([-\d.]+)h', drawn)[0]) > 6.0


def test_debug_draws_a_drawing_that_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    document = new_dxf()
    space = document.modelspace()
    for start, end in (((0, 0), (4, 0)), ((4, 0), (4, 3)), ((9, 0), (9, 3))):
        space.add_line(start, end, dxfattribs={"layer": "WALL"})
    space.add_line((1, 0), (2, 0), dxfattribs={"layer": "A-DOOR"})
    drawing, out = tmp_path / "open.dxf", tmp_path / "read.svg"
    drawing.write_bytes(dxf_file(document))
    assert main(["plan", "import", str(drawing), "--debug", str(out)]) == 2
    error = capsys.readouterr().err
    assert "no room was found" in error
    assert "3 lines: wall on 'WALL'" in error
    drawn = out.read_text(encoding="utf-8")
    assert ">line of a wall<" in drawn
    assert ">door<" in drawn
    assert ">room<" not in drawn
    assert main(["plan", "import", str(drawing), "--debug", str(tmp_path / "read.gif")]) == 2
    assert "must end in .png or .svg (--debug)" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["svg", "png"])
def test_debug_draws_rooms_gaps_and_lost_areas(tmp_path: Path, kind: str):
    picture, out = tmp_path / "hall.png", tmp_path / f"read.{kind}"
    picture.write_bytes(open_hall())
    arguments = ["plan", "import", str(picture), "--metres-per-pixel", "0.01", "-o", str(tmp_path / "plan.json")]
    assert main([*arguments, "--debug", str(out)]) == 0
    if kind == "svg":
        assert all(f">{part}<" in out.read_text(encoding="utf-8") for part in ("wall", "room", "inside, but no room"))
    else:
        with Image.open(out) as drawn:
            assert drawn.width == 1600


def test_debug_of_a_file_without_a_drawing_says_so(file: Path, tmp_path: Path):
    out = tmp_path / "read.svg"
    assert main(["plan", "import", str(file), "-o", str(tmp_path / "plan.json"), "--debug", str(out)]) == 0
    assert "Nothing was read from a drawing." in out.read_text(encoding="utf-8")


def test_terminal_shows_the_steps_of_an_import_on_one_line(file: Path):
    terminal, own_end = os.openpty()
    try:
        done = _run("plan", "check", str(file), stderr=own_end, stdout=subprocess.DEVNULL)
        assert done.returncode == 0
        shown = os.read(terminal, 65_536).decode()
    finally:
        os.close(own_end)
        os.close(terminal)
    assert "\r\x1b[Kflat.json: opening the file …" in shown
    assert shown.endswith("\r\x1b[K")
    assert "\n" not in shown


def test_steps_are_not_shown_without_a_terminal(file: Path):
    assert _run("plan", "check", str(file), stderr=subprocess.PIPE, stdout=subprocess.DEVNULL).stderr == b""
