"""Films with the faults that people's films have."""

from __future__ import annotations

import math

import pytest

from lalaloc_core.errors import InvalidFilmError
from lalaloc_core.photograph.film import read_film
from tests.core.fault_photographs import FOLDER


def test_black_bars_are_cut_off() -> None:
    film = read_film((FOLDER / "pillarbox_black.mp4").read_bytes())
    assert film.warnings[0] == "the film has black bars, 69% of its picture: they were cut off"
    assert math.degrees(film.turned) > 320.0
    camera = film.photographs[0].camera
    assert camera is not None
    assert camera.width < camera.height


def test_film_on_its_side_is_named() -> None:
    with pytest.raises(InvalidFilmError, match=r"lies on its side: in it the camera nods by 35\d°"):
        read_film((FOLDER / "sideways_no_flag.mp4").read_bytes())
