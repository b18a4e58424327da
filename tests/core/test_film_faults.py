"""Films with the faults that people's films have."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from lalaloc_core.errors import InvalidFilmError
from lalaloc_core.photograph.film import read_film
from tests.core.fault_photographs import FOLDER
from tests.core.filmed import H264, encode, needs_ffmpeg, turn
from tests.core.taken import within_bars
from tests.strategies import present


def test_black_bars_beside_a_film_are_cut_off() -> None:
    film = read_film((FOLDER / "pillarbox_black.mp4").read_bytes())
    assert film.warnings[0] == "the film has bars, 68% of its picture: they were cut off"
    assert math.degrees(film.turned) > 320.0
    camera = film.photographs[0].camera
    assert camera is not None
    assert camera.width < camera.height


@needs_ffmpeg
@pytest.mark.parametrize("kind", ["unequal", "of two colours", "blurred"])
def test_bars_above_and_below_a_film_are_cut_off(tmp_path: Path, kind: str) -> None:
    film = read_film(encode([within_bars(frame, kind) for frame in turn()[:31]], tmp_path / "barred.mp4"))
    assert "the film has bars" in film.warnings[0]
    assert math.degrees(film.turned) == pytest.approx(180.0, abs=15.0)
    assert present(film.photographs[0].camera).height == pytest.approx(480, abs=8)


@needs_ffmpeg
def test_film_that_is_cut_off_is_named(tmp_path: Path) -> None:
    content = encode(turn()[:46], tmp_path / "whole.mp4", *H264, "-movflags", "+faststart")
    assert "of 4.6 s, as if cut off" in read_film(content[: len(content) // 2]).warnings[0]


def test_film_on_its_side_is_named() -> None:
    with pytest.raises(InvalidFilmError, match=r"lies on its side: in it the camera nods by 35\d°"):
        read_film((FOLDER / "sideways_no_flag.mp4").read_bytes())
