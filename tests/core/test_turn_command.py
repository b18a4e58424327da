"""`lalaloc localise --turn`: films and folders of photographs of one turn, with the shipped model."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from lalaloc_core.cli import main
from tests.core.filmed import encode, needs_ffmpeg, turn
from tests.core.taken import EXAMPLES, jpeg

PLAN = str(EXAMPLES / "flat.json")
# Of the sphere that the pictures are cut from.
TRUTH = next(pose for pose in json.loads((EXAMPLES / "poses.json").read_text()) if pose["file"] == "living_room.jpg")


def answer_of(capsys: pytest.CaptureFixture[str], path: Path, *options: str) -> dict[str, Any]:
    assert main(["localise", PLAN, "--turn", str(path), "--hfov", "53", "--json", *options]) == 0
    (answer,) = json.loads(capsys.readouterr().out)
    position = answer["position"]
    assert math.hypot(position["x_m"] - TRUTH["x_m"], position["y_m"] - TRUTH["y_m"]) < 0.5
    # The pictures look along the sphere's centre first, and turn by 60° in a second.
    turned_deg = 60.0 * answer["poses"][0].get("time_s", 0.0)
    assert answer["heading_deg"] == pytest.approx(TRUTH["heading_deg"] + turned_deg, abs=4.0)
    return answer


def test_folder_of_photographs_is_one_turn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for index, frame in enumerate(turn()[:48:4]):
        (tmp_path / f"{index:02}.jpg").write_bytes(jpeg(frame))
    answer = answer_of(capsys, tmp_path, "--out", str(tmp_path / "answer.svg"))
    angles = [pose["view"]["relative_heading"]["value_deg"] % 360.0 for pose in answer["poses"]]
    assert angles == pytest.approx([24.0 * index for index in range(12)], abs=1.0)
    assert answer["poses"][0]["photograph"] == "00.jpg"
    assert (tmp_path / "answer.svg").read_text().startswith("<svg")


def test_warning_names_the_photographs_of_a_turn_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for index, frame in enumerate([*turn()[:8:4], turn()[24]]):
        (tmp_path / f"{index}.jpg").write_bytes(jpeg(frame))
    assert main(["localise", PLAN, "--turn", str(tmp_path)]) == 0
    told = capsys.readouterr().err
    assert f"warning: {tmp_path / '0.jpg'} and 2 more: the field of view of" in told
    assert "groups (0.jpg, 1.jpg; 2.jpg)" in told
    (tmp_path / "8.png").touch()
    assert main(["localise", PLAN, "--turn", str(tmp_path), "--out", f"{tmp_path}/8.png"]) == 2
    assert "8.png' is read and never changed" in capsys.readouterr().err


@pytest.mark.slow
@needs_ffmpeg
def test_film_is_localised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    encode(turn()[:46], tmp_path / "turn.mp4")
    answer = answer_of(capsys, tmp_path / "turn.mp4")
    assert answer["film"]["frames_read"] == 46
    assert answer["film"]["frames_kept"] == len(answer["poses"])


@pytest.mark.slow
def test_features_of_a_turn_are_sent_with_its_angles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "turn").mkdir()
    for index, frame in enumerate(turn()[:12:4]):
        (tmp_path / "turn" / f"{index}.jpg").write_bytes(jpeg(frame))
    assert main(["encode", "--turn", str(tmp_path / "turn"), "--hfov", "53", "-o", str(tmp_path / "out")]) == 0
    assert "turn.json" in capsys.readouterr().out
    fields = json.loads((tmp_path / "out" / "turn.json").read_text())
    assert fields["relative_heading_deg"] == pytest.approx([0.0, 24.0, 48.0], abs=1.0)
    assert 0.5 <= fields["relative_heading_std_deg"] < 5.0
    written = sorted(file.name for file in (tmp_path / "out").glob("*.features"))
    assert written == ["00.features", "01.features", "02.features"]
    assert main(["localise", PLAN, str(tmp_path / "out" / "00.features"), "--json"]) == 0
    assert main(["encode"]) == 2
    assert "give one or more photographs, or --turn" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "give one or more photographs, or --turn"),
        (("photo.jpg", "--turn", "film.mp4"), "exclude each other"),
        (("--turn", "{}", "--heading", "10"), "--heading does not go with --turn"),
        (("--turn", "{}"), "has 0 photographs; a turn has 2 to 100; 'empty.jpg' is empty and was left out"),
        (("--turn", "{}/film.mp4"), "is another file by its first bytes, not MP4, MOV, WebM or Matroska"),
    ],
)
def test_unusable_turns_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
) -> None:
    (tmp_path / "film.mp4").write_bytes(b"ffconcat version 1.0\n")
    (tmp_path / "empty.jpg").touch()
    assert main(["localise", PLAN, *(argument.format(tmp_path) for argument in arguments)]) == 2
    assert message in capsys.readouterr().err
