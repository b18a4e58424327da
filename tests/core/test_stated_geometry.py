"""Statements and metadata about the lens that do not fit the photograph: scaled, turned, or named in a warning."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags

from lalaloc_core.photograph import Intrinsics
from lalaloc_core.photograph.cameras import Fisheye, Perspective
from lalaloc_core.photograph.exif import read_exif_lens
from lalaloc_core.photograph.stated_camera import fit_intrinsics
from tests.core.taken import PHONE, exif_of, jpeg, opened, sphere, take

Tag = ExifTags.Base
CAMERA = Perspective.of_hfov(640, 480, math.radians(67.3))


def picture() -> np.ndarray:
    return take(sphere("kitchen"), CAMERA)


@pytest.mark.parametrize("size", [(320, 240), (1600, 1200), (4000, 3000)])
def test_calibration_of_another_size_is_scaled(size: tuple[int, int]) -> None:
    scale = size[0] / 640
    stated = Intrinsics(fx=480 * scale, fy=482 * scale, cx=size[0] / 2 - 0.5, cy=size[1] / 2 - 0.5, k1=-0.05)
    view = opened(jpeg(picture(), PHONE), intrinsics=stated)
    assert isinstance(view.camera, Perspective)
    assert (view.camera.fx, view.camera.fy) == pytest.approx((480.0, 482.0))
    assert (view.camera.cx, view.camera.cy) == pytest.approx((320.0, 240.0))
    assert f"the middle of a picture of {size[0]} x {size[1]}, and the photograph has 640 x 480" in view.warnings[0]


@pytest.mark.parametrize("orientation", [6, 8])
def test_calibration_of_the_stored_picture_is_turned(orientation: int) -> None:
    stored = Perspective(
        width=640, height=480, fx=500.0, fy=510.0, cx=330.0, cy=236.0, radial=(-0.1, 0.02, 0.0), tangential=(0.01, 0.02)
    )
    found, (text,) = fit_intrinsics(
        Intrinsics(fx=500.0, fy=510.0, cx=329.5, cy=235.5, k1=-0.1, k2=0.02, p1=0.01, p2=0.02), 480, 640, orientation
    )
    assert "the middle of a picture on its side, not of the upright one of 480 x 640" in text
    assert found.cx is not None
    assert found.cy is not None
    ideal = Perspective(width=480, height=640, fx=found.fx, fy=found.fy, cx=found.cx + 0.5, cy=found.cy + 0.5)
    upright = replace(ideal, radial=(found.k1, found.k2, found.k3), tangential=(found.p1, found.p2))
    pixels = np.random.default_rng(0).uniform((50, 50), (590, 430), (50, 2))
    right, forward, up = stored.rays(pixels).T
    # A quarter turn of picture and rays together.
    x, y = pixels.T
    turned, rays = (
        (np.stack([480 - y, x], -1), np.stack([up, forward, -right], -1))
        if orientation == 6
        else (np.stack([y, 640 - x], -1), np.stack([-up, forward, right], -1))
    )
    np.testing.assert_allclose(upright.pixels(rays)[0], turned, atol=1e-6)


def test_only_optical_centres_far_from_the_middle_are_named() -> None:
    for cx, cy in ((320.0, 240.0), (340.0, 225.0), (370.0, 200.0)):
        stated = Intrinsics(fx=480.0, fy=480.0, cx=cx, cy=cy)
        assert fit_intrinsics(stated, 640, 480, 1) == (stated, ())
    assert fit_intrinsics(Intrinsics(fx=480.0, fy=480.0), 640, 480, 6)[1] == ()
    stated = Intrinsics(fx=480.0, fy=480.0, cx=500.0, cy=240.0)
    found, (text,) = fit_intrinsics(stated, 640, 480, 1)
    assert found == stated
    assert "(cx, cy) is (500, 240), more than 10% of a side from (320, 240)" in text


@pytest.mark.parametrize("stated", [{"hfov_deg": 40.0}, {"intrinsics": Intrinsics(fx=880.0, fy=880.0)}])
def test_statement_that_contradicts_exif_is_named(stated: dict[str, Any]) -> None:
    (text,) = opened(jpeg(picture(), PHONE), **stated).warnings
    assert "the stated field of view is 40°, and the EXIF focal length gives 67°" in text
    assert opened(jpeg(picture(), PHONE), hfov_deg=65.0).warnings == ()


@pytest.mark.parametrize(
    ("maker", "model", "film_mm", "is_fisheye"),
    [
        ("GoPro", "HERO9 Black", 15, True),
        ("GoPro", "HERO9 Black", 0, True),
        ("GoPro", "HERO9 Black", 24, False),
        ("DJI", "DJI Osmo Action 4", None, True),
        ("DJI", "FC3582", 24, False),
        ("SJCAM", "SJ8 PRO", None, True),
        ("Apple", "iPhone 13", 14, False),
    ],
)
def test_wide_lenses_of_action_cameras_are_fisheyes(
    maker: str, model: str, film_mm: int | None, *, is_fisheye: bool
) -> None:
    tags = exif_of({} if film_mm is None else {Tag.FocalLengthIn35mmFilm: film_mm})
    tags[Tag.Make], tags[Tag.Model] = maker, model
    assert (read_exif_lens(tags, width=640, height=480).fisheye is not None) == is_fisheye


def test_photograph_of_an_action_camera_is_read_as_fisheye() -> None:
    camera = Fisheye.of_hfov(640, 480, math.radians(122.6))
    tags: dict[Any, Any] = {Tag.FocalLengthIn35mmFilm: 15}
    content = jpeg(take(sphere("kitchen"), camera), tags, maker="GoPro", model="HERO5 Black")
    view = opened(content)
    assert (view.projection, view.projection_source, view.hfov.source) == ("fisheye", "exif", "assumed")
    assert math.degrees(view.hfov.value) == pytest.approx(122.6, abs=0.1)
    assert view.warnings[0].startswith("GoPro HERO5 Black has a fisheye lens of about 123°")
    assert opened(content, projection="perspective", hfov_deg=90.0).projection == "perspective"
