"""Homes with disturbed photographs and unchanged plans and poses."""

from __future__ import annotations

import numpy as np
import pytest

from lalaloc_core.errors import DatasetError
from lalaloc_core.learn.data.synthetic import disturbed
from lalaloc_core.learn.data.synthetic.disturbed import DisturbedPhotograph, DisturbedScenes
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes

HOMES = GeneratedScenes(homes=1, shots_per_home=3, furniture=None)
LOOK = HOMES.appearances[0]


class _Shaded:
    """Photograph whose brightness encodes the azimuth: dark in front, brighter towards the back."""

    def image(self, height: int, width: int) -> np.ndarray:
        away = np.abs(np.arange(width) + 0.5 - 0.5 * width) / (0.5 * width)
        return np.broadcast_to((60.0 + 120.0 * away).astype(np.uint8)[None, :, None], (height, width, 3)).copy()

    def depth_m(self) -> np.ndarray:
        return np.ones((8, 16))


def test_only_the_picture_is_disturbed() -> None:
    scene, own = DisturbedScenes(HOMES).load("validation-00000"), HOMES.load("validation-00000")
    assert scene.plan.to_dict() == own.plan.to_dict()
    for camera, mine in zip(scene.cameras, own.cameras, strict=True):
        assert np.array_equal(camera.position_m, mine.position_m)
        assert (camera.room_index, camera.heading) == (mine.room_index, mine.heading)
        assert camera.camera_height_m == mine.camera_height_m
        picture, plain = camera.photographs[LOOK].image(16, 32), mine.photographs[LOOK].image(16, 32)
        assert picture.dtype == np.uint8
        assert picture.shape == plain.shape
        assert not np.array_equal(picture, plain)


def test_disturbance_depends_on_the_photograph_only() -> None:
    first, again, different = (DisturbedPhotograph(_Shaded(), seed).image(16, 32) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, different)


def test_length_error_is_ten_percent(monkeypatch: pytest.MonkeyPatch) -> None:
    """The direction at 45 degrees gives the ratio of the factors of width and depth."""
    monkeypatch.setattr(disturbed, "_STRENGTH", 0.0)
    width, ratios = 256, []
    plain = _Shaded().image(1, width)[0, :, 0].astype(float)
    right = slice(width // 2, width)
    for seed in range(200):
        picture = DisturbedPhotograph(_Shaded(), seed).image(16, width)[8, :, 0].astype(float)
        shift = np.interp(picture[5 * width // 8], plain[right], np.arange(width)[right]) - 5 * width // 8
        ratios.append(np.tan(np.pi / 4 + shift / width * 2.0 * np.pi))
    assert np.std(np.log(ratios)) == pytest.approx(0.1 * np.sqrt(2.0), rel=0.2)
    assert np.mean(np.log(ratios)) == pytest.approx(0.0, abs=0.04)


def test_disturbed_photograph_has_no_depth() -> None:
    with pytest.raises(DatasetError, match="no depth"):
        DisturbedPhotograph(_Shaded(), 0).depth_m()
