"""Homes with photographs of other places and unchanged plans and poses."""

from __future__ import annotations

import numpy as np

from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.data.synthetic.mismatched import Cropped, MismatchedScenes, OutdoorPhotograph, UpsideDown

HOMES = GeneratedScenes(homes=2, shots_per_home=4, furniture=None)
LOOK = HOMES.appearances[0]


def test_cameras_show_the_next_home() -> None:
    mismatched, own = MismatchedScenes(HOMES).load("validation-00001"), HOMES.load("validation-00001")
    # The last home uses the first one beyond the split.
    following = HOMES.load("validation-00002")
    assert mismatched.plan.to_dict() == own.plan.to_dict()
    for k, (camera, mine, theirs) in enumerate(zip(mismatched.cameras, own.cameras, following.cameras, strict=True)):
        assert np.array_equal(camera.position_m, mine.position_m)
        assert (camera.room_index, camera.heading) == (mine.room_index, mine.heading)
        if k == 3:
            assert isinstance(camera.photographs[LOOK], OutdoorPhotograph)
        elif k == 2:
            shown = camera.photographs[LOOK]
            assert isinstance(shown, UpsideDown)
            assert np.array_equal(shown.image(16, 32)[::-1, ::-1], mine.photographs[LOOK].image(16, 32))
        elif k == 1:
            assert isinstance(camera.photographs[LOOK], Cropped)
        else:
            pictures = [view.photographs[LOOK].image(16, 32) for view in (camera, mine, theirs)]
            assert np.array_equal(pictures[0], pictures[2])
            assert not np.array_equal(pictures[0], pictures[1])


def test_even_homes_have_no_cropped_photograph() -> None:
    shown = [camera.photographs[LOOK] for camera in MismatchedScenes(HOMES).load("validation-00000").cameras]
    assert not any(isinstance(photograph, Cropped) for photograph in shown)


def test_cropped_photograph_is_a_stretched_part() -> None:
    whole = HOMES.load("validation-00000").cameras[0].photographs[LOOK]
    picture, part = whole.image(40, 80), Cropped(whole).image(40, 80)
    assert part.shape == picture.shape
    assert np.array_equal(part[0, 0], picture[12, 20])
    assert np.array_equal(part[-1, -1], picture[27, 39])


def test_outdoor_photograph_has_no_walls() -> None:
    for seed in range(20):
        picture = OutdoorPhotograph(seed).image(64, 128).astype(float)
        # Azimuths differ by grain only.
        columns = picture.mean(axis=0)
        assert np.ptp(columns, axis=0).max() < 12.0
        assert np.array_equal(picture, OutdoorPhotograph(seed).image(64, 128))
