"""DWG drawings: a converter makes them DXF, if one is installed."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ImportLimits, detect_format, export_plan, import_plan

# Loaded before the time limits of the tests begin.
importlib.import_module("lalaloc_core.importers.formats.dwg")
DWG = b"AC1032" + bytes(100)


def _install(folder: Path, script: str, name: str = "dwg2dxf") -> None:
    """Install a program that is called as the converter is."""
    program = folder / name
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of programs in which no converter is."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("cp", "sleep", "head"):
        (folder / name).symlink_to(shutil.which(name) or name)
    monkeypatch.setenv("PATH", str(folder))
    return folder


def test_missing_converter_is_named(programs: Path):
    assert detect_format(DWG) == "dwg"
    with pytest.raises(InvalidFloorPlanError, match=r"install dwg2dxf \(LibreDWG\) or ODAFileConverter .* as DXF"):
        import_plan(DWG)


@pytest.mark.skipif(not (shutil.which("dwg2dxf") and shutil.which("dxf2dwg")), reason="LibreDWG is not installed")
def test_drawing_is_converted_by_libredwg(flat: FloorPlan, tmp_path: Path):
    drawing, converted = tmp_path / "flat.dxf", tmp_path / "flat.dwg"
    drawing.write_bytes(export_plan(flat, "dxf"))
    subprocess.run(["dxf2dwg", "-y", "-o", str(converted), str(drawing)], check=True)
    plan = import_plan(converted.read_bytes())
    assert (plan.report.format, len(plan.document["rooms"])) == ("dwg", 3)


@pytest.mark.parametrize(
    ("name", "script"),
    [("dwg2dxf", 'cp {dxf} "$3"'), ("ODAFileConverter", '[ -f "$1/plan.dwg" ] && cp {dxf} "$2/plan.dxf"')],
)
def test_converter_gets_its_arguments(programs: Path, flat: FloorPlan, tmp_path: Path, name: str, script: str):
    drawing = tmp_path / "flat.dxf"
    drawing.write_bytes(export_plan(flat, "dxf"))
    _install(programs, script.format(dxf=drawing), name)
    plan = import_plan(DWG)
    assert (plan.report.format, len(plan.document["rooms"]), len(plan.document["openings"])) == ("dwg", 3, 4)


def test_failure_of_the_converter_is_reported(programs: Path):
    _install(programs, "echo 'ERROR: bad section page' >&2; exit 1")
    with pytest.raises(InvalidFloorPlanError, match=r"dwg2dxf could not read the DWG drawing: ERROR: bad section page"):
        import_plan(DWG)


@pytest.mark.slow
def test_converter_is_stopped_with_its_children(programs: Path, tmp_path: Path):
    alive = tmp_path / "alive"
    _install(programs, f"(while true; do echo x >> {alive}; sleep 0.05; done) & sleep 600")
    with pytest.raises(InvalidFloorPlanError, match="takes more than 3 s"):
        import_plan(DWG, limits=ImportLimits(max_import_s=3.0))
    size = alive.stat().st_size
    time.sleep(0.5)
    assert alive.stat().st_size == size


def test_output_of_the_converter_is_limited(programs: Path):
    _install(programs, 'head -c 5000000 /dev/zero > "$3"')
    with pytest.raises(InvalidFloorPlanError, match=r"converts to 1000000 bytes; the limit is 1000000 \(max_unpacked"):
        import_plan(DWG, limits=ImportLimits(max_unpacked_bytes=1_000_000))


def test_converter_leaves_no_files(programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    _install(programs, "exit 1")
    with pytest.raises(InvalidFloorPlanError):
        import_plan(DWG)
    assert os.listdir(scratch) == []
