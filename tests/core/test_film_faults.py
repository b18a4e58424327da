"""Films with the faults that people's films have."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import pytest

from lalaloc_core.errors import InvalidFilmError
from lalaloc_core.photograph.cameras import Fisheye
from lalaloc_core.photograph.film import read_film
from tests.core.fault_photographs import FOLDER
from tests.core.filmed import H264, encode, needs_ffmpeg, turn
from tests.core.taken import sphere, take, within_bars
from tests.core.test_sphere_formats import small, unusable
from tests.strategies import present


def test_black_bars_beside_a_film_are_cut_off() -> None:
    film = read_film((FOLDER / "pillarbox_black.mp4").read_bytes())
    assert film.warnings[0] == "the film has bars, 68% of its picture: they were cut off"
    assert math.degrees(film.turned) > 320.0
    camera = film.photographs[0].camera
    assert camera is not None
    assert camera.width < camera.height


@needs_ffmpeg
@pytest.mark.parametrize("words", ["films of full spheres", "stereo sphere, one", "dual fisheye", "cube map, 3 x 2"])
def test_films_of_360_degree_cameras_are_refused_by_name(tmp_path: Path, words: str) -> None:
    room = small("living_room")
    pictures = {"films of full spheres": room} | unusable(room)
    frame = next(picture for name, picture in pictures.items() if name.startswith(words))
    with pytest.raises(InvalidFilmError, match=words):
        read_film(encode([frame - frame // 8 * (number % 2) for number in range(30)], tmp_path / "sphere.mp4"))


@needs_ffmpeg
def test_film_with_the_telemetry_of_an_action_camera_is_read_as_fisheye(tmp_path: Path) -> None:
    camera = Fisheye.of_hfov(640, 480, math.radians(122.6))
    frames = [take(sphere("living_room"), camera, heading_deg=6.0 * number) for number in range(31)]
    film = read_film(encode(frames, tmp_path / "action.mp4", *H264, "-metadata", "comment=GoPro MET"))
    assert math.degrees(film.turned) == pytest.approx(180.0, abs=15.0)
    assert any("GoPro has a fisheye lens" in text for text in film.photographs[0].warnings)


@needs_ffmpeg
@pytest.mark.parametrize("kind", ["unequal", "of two colours", "blurred", "unequal, of a low quality, at the sides"])
def test_bars_of_a_film_are_cut_off(tmp_path: Path, kind: str) -> None:
    low = ("-c:v", "libx264", "-preset", "fast", "-crf", "35") if "low" in kind else ()
    frames = [cv2.copyMakeBorder(f, 0, 0, 200, 380, 0) if low else within_bars(f, kind) for f in turn()[:31]]
    film = read_film(encode(frames, tmp_path / "barred.mp4", *low))
    assert "the film has bars" in film.warnings[0]
    assert math.degrees(film.turned) == pytest.approx(180.0, abs=25.0 if low else 15.0)
    camera = present(film.photographs[0].camera)
    assert (camera.width, camera.height) == pytest.approx((270, 480), abs=8)


@needs_ffmpeg
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("-vf", "setsar=4/3"), "4:3, not square"),
        (("-flags", "+ildct+ilme"), "10 frames of the film are the same: .* interlaced"),
        (("-f", "avi"), "the film is a video by its first bytes, not MP4"),
    ],
)
def test_film_that_is_not_read_is_refused_by_name(tmp_path: Path, options: tuple[str, str], words: str) -> None:
    with pytest.raises(InvalidFilmError, match=words):
        read_film(encode(turn()[:10], tmp_path / "film.mp4", *H264, *options))


@needs_ffmpeg
def test_film_that_is_cut_off_is_named(tmp_path: Path) -> None:
    content = encode(turn()[:46], tmp_path / "whole.mp4", *H264, "-movflags", "+faststart")
    assert "of 4.6 s, as if cut off" in read_film(content[: len(content) // 2]).warnings[0]


def test_film_on_its_side_is_named() -> None:
    with pytest.raises(InvalidFilmError, match=r"lies on its side: in it the camera nods by 35\d°"):
        read_film((FOLDER / "sideways_no_flag.mp4").read_bytes())
