"""Homes asked with photographs of others: everything of the question is the home's own but what is seen."""

from __future__ import annotations

import numpy as np

from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.learn.data.synthetic.mismatched import Cropped, MismatchedScenes, OutdoorPhotograph, UpsideDown

HOMES = GeneratedScenes(homes=2, shots_per_home=4, furniture=None)
LOOK = HOMES.appearances[0]


def test_cameras_are_the_homes_own_and_see_the_next_home() -> None:
    mismatched, own = MismatchedScenes(HOMES).load("validation-00001"), HOMES.load("validation-00001")
    # The next one is there beyond the last that is asked about, too.
    other = HOMES.load("validation-00002")
    assert mismatched.plan.to_dict() == own.plan.to_dict()
    for k, (camera, mine, theirs) in enumerate(zip(mismatched.cameras, own.cameras, other.cameras, strict=True)):
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
            pictures = [one.photographs[LOOK].image(16, 32) for one in (camera, mine, theirs)]
            assert np.array_equal(pictures[0], pictures[2])
            assert not np.array_equal(pictures[0], pictures[1])


def test_every_other_home_is_shown_nothing_that_is_cut_out() -> None:
    shown = [camera.photographs[LOOK] for camera in MismatchedScenes(HOMES).load("validation-00000").cameras]
    assert not any(isinstance(one, Cropped) for one in shown)


def test_what_is_cut_out_is_a_part_drawn_out_to_the_whole() -> None:
    whole = HOMES.load("validation-00000").cameras[0].photographs[LOOK]
    picture, part = whole.image(40, 80), Cropped(whole).image(40, 80)
    assert part.shape == picture.shape
    assert np.array_equal(part[0, 0], picture[12, 20])
    assert np.array_equal(part[-1, -1], picture[27, 39])


def test_the_open_air_has_no_walls() -> None:
    for seed in range(20):
        picture = OutdoorPhotograph(seed).image(64, 128).astype(float)
        # Nothing but grain tells one azimuth from another.
        columns = picture.mean(axis=0)
        assert np.ptp(columns, axis=0).max() < 12.0
        assert np.array_equal(picture, OutdoorPhotograph(seed).image(64, 128))
