"""Photographs with the faults of people's files on the command line, with the shipped model."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from lalaloc_core.cli import main
from lalaloc_core.cli.printing import with_options
from tests.core.fault_photographs import FAULTS, FOLDER, LIBRARY_WORDS, Fault, fault_id
from tests.core.taken import EXAMPLES

PLAN = str(EXAMPLES / "flat.json")
OPTIONS = {"heading_deg": "--heading", "intrinsics": "--intrinsics"}


def options_of(fault: Fault) -> list[str]:
    return [text for name, value in fault.fields.items() for text in (OPTIONS[name], value)]


def test_files_are_localised_right_or_refused_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    plain = [fault for fault in FAULTS if not fault.fields]
    assert main(["localise", PLAN, *(str(FOLDER / fault.name) for fault in plain), "--json"]) == 2
    out, errors = capsys.readouterr()
    refused = sum(not fault.is_usable for fault in plain)
    assert f"{refused} of {len(plain)} photographs were not localised" in errors
    for fault, answer in zip(plain, json.loads(out), strict=True):
        if fault.is_usable:
            fault.check(answer)
            assert fault.said is None or f"warning: {FOLDER / fault.name}: " in errors
        else:
            fault.check_refusal(answer["error"])
            assert f"error: {with_options(answer['error'])}" in errors


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault.fields], ids=fault_id)
def test_statements_that_do_not_fit_are_corrected(fault: Fault, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["localise", PLAN, str(FOLDER / fault.name), *options_of(fault), "--json"]) == 0
    fault.check(json.loads(capsys.readouterr().out)[0])


@pytest.mark.slow
def test_track_goes_on_after_a_file_that_cannot_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, name in enumerate(("two_xmp.jpg", "dual_fisheye.jpg", "jpeg_no_eoi.jpg")):
        shutil.copy(FOLDER / name, tmp_path / f"{number}.jpg")
    (tmp_path / "path.csv").write_text("time_s,x_m,y_m,yaw_deg\n0,2,1,30\n2,2,1,30\n")
    command = ["track", PLAN, str(tmp_path), "--odometry", str(tmp_path / "path.csv"), "--json"]
    assert main(command) == 2
    out, errors = capsys.readouterr()
    first, refused, last = json.loads(out)
    assert (first["room"], last["room"]) == ("kitchen", "kitchen")
    assert last["motion_contradicted"] == []
    assert refused["error"] in errors
    assert "dual fisheye" in refused["error"]
    assert "1 of 3 photographs were left out" in errors
    shutil.copy(FOLDER / "dual_fisheye.jpg", tmp_path / "0.jpg")
    (tmp_path / "2.jpg").unlink()
    assert main(command) == 2
    assert "none of 2 photographs can be used" in capsys.readouterr().err


@pytest.mark.slow
def test_track_names_odometry_of_optical_frames(capsys: pytest.CaptureFixture[str]) -> None:
    odometry = str(FOLDER / "tum_optical.tum")
    command = ["track", PLAN, str(FOLDER / "tum_optical"), "--hfov", "80", "--odometry", odometry, "--json"]
    assert main(command) == 0
    out, errors = capsys.readouterr()
    assert "optical" in errors
    assert not any(word in errors for word in LIBRARY_WORDS)
    assert [pose["room"] for pose in json.loads(out)][-3:] == ["kitchen", "study", "bedroom"]
