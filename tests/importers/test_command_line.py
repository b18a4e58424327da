"""Command `lalaloc plan`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lalaloc_core.cli import main
from lalaloc_core.floorplan import FloorPlan
from tests.importers.conftest import FLAT


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "flat.json"
    path.write_text(json.dumps(FLAT), encoding="utf-8")
    return path


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
