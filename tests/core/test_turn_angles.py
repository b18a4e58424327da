"""Angles of photographs of one spot by what they show twice: turns cut from a sphere, and turns with parallax."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.localise.answers.turns import Turn
from lalaloc_core.localise.query import CameraHeight
from lalaloc_core.localise.query.query import UNKNOWN_HEADING
from lalaloc_core.photograph import Photograph, StatedCamera, open_photograph
from lalaloc_core.photograph.cameras import Fisheye, Perspective, level_axes
from lalaloc_core.photograph.overlap import Features, Link, Step, agreeing_links, headings_in_order, usual_steps
from lalaloc_core.photograph.patches import PatchSize
from lalaloc_core.photograph.turn_angles import Overview, TurnAngles, TurnView, angles_of_turn
from lalaloc_core.photograph.turned import open_turn, turn_views, turned_photographs
from tests.core.taken import jpeg, sphere, take
from tests.strategies import present

PORTRAIT = Perspective.of_hfov(360, 480, math.radians(53.0))
ONCE_AROUND = [24.0 * index for index in range(15)]
# Box of a room (m), and the axis of the turn in it.
ROOM_M, AXIS_M = np.array([5.5, 4.5, 2.5]), np.array([2.9, 2.1, 1.5])


def photographs(headings_deg: Sequence[float], room: str = "living_room", **stated: Any) -> list[Photograph]:
    pitches_deg = itertools.cycle([4.0, -6.0, 1.0])
    pictures = [
        jpeg(take(sphere(room), PORTRAIT, heading_deg=heading, pitch_deg=pitch))
        for heading, pitch in zip(headings_deg, pitches_deg, strict=False)
    ]
    statement = StatedCamera(projection="perspective", **stated)
    return [open_photograph(picture, sphere_size=(128, 256), stated=statement, purpose="turn") for picture in pictures]


def misses_deg(angles: Sequence[TurnAngles], headings: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the errors of headings; the common one is the first photograph's."""
    missed = wrap_angle(np.array([angle.heading for angle in angles]) - headings)
    return np.degrees(np.abs(wrap_angle(missed - np.median(missed))))


@pytest.mark.slow
def test_closed_turn_fixes_the_field_of_view() -> None:
    taken = photographs(ONCE_AROUND)
    views = turn_views(taken)
    turned = turned_photographs(taken, views, angles_of_turn(views), PatchSize())
    alone = np.array([math.degrees(photograph.hfov.value) for photograph in taken])
    assert np.abs(alone - 53.0).max() > 2.0
    for found in turned:
        assert found.hfov.source == "estimated"
        assert math.degrees(found.hfov.value) == pytest.approx(53.0, abs=0.6)
        assert present(found.camera).hfov == found.hfov.value
    assert "estimated from all photographs of the turn" in turned[0].warnings[-1]


def turn_of(angles: list[TurnAngles]) -> Turn:
    """Return a turn of photographs with a field of view of 53°."""
    taken = photographs([0.0], hfov_deg=53.0) * len(angles)
    return Turn.of_overlap(taken, [UNKNOWN_HEADING] * len(angles), CameraHeight(1.5), angles)


def test_photographs_without_overlap_form_groups() -> None:
    angles = angles_of_turn(turn_views(photographs([0.0, 24.0, 120.0, 144.0, 250.0], hfov_deg=53.0)))
    assert [angle.group for angle in angles] == [0, 0, 1, 1, 2]
    assert math.degrees(angles[3].heading) == pytest.approx(24.0, abs=0.5)
    turn = turn_of(angles)
    assert turn.turns is None
    (warning,) = turn.warnings
    assert "3 groups (photo[0], photo[1]; photo[2], photo[3]; photo[4])" in warning
    assert "half the field of view, 26°" in warning


def test_photographs_of_plain_walls_get_their_angles_by_order() -> None:
    views = turn_views(photographs(ONCE_AROUND, hfov_deg=53.0))
    blank = Overview(Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8)), np.zeros((0, 4)))
    plain = [replace(view, overview=blank) if index in (4, 5, 6) else view for index, view in enumerate(views)]
    angles = angles_of_turn(plain)
    assert [index for index, angle in enumerate(angles) if angle.is_assumed] == [4, 5, 6]
    assert misses_deg(angles, np.radians(ONCE_AROUND)).max() < 2.0
    # The turn closes, so the middle of the gap is the least certain.
    sd_deg = np.degrees([angle.heading_sd for angle in angles])
    assert 3.0 < sd_deg[4] < sd_deg[5] < 8.0
    turn = turn_of(angles)
    assert turn.turns is not None
    (warning,) = turn.warnings
    assert "nothing links photo[4], photo[5], photo[6] to most others" in warning
    assert f"within ± {2.0 * sd_deg.max():.0f}°" in warning


def test_links_against_the_order_are_dropped() -> None:
    rays = np.zeros((2, 12, 3))
    right = [Link(index, index + 1, rays, math.radians(30.0)) for index in range(6)]
    closing = Link(0, 11, rays, math.radians(-30.0))
    repeated = Link(3, 8, rays, math.radians(20.0))
    steps = present(usual_steps(12, [*right, closing, repeated]))
    assert [math.degrees(step.turn) for step in steps] == pytest.approx([30.0] * 12)
    assert agreeing_links([*right, closing, repeated], 12, steps) == [*right, closing]
    # Steps that do not lead once around, or are not alike, tell nothing.
    assert usual_steps(5, right[:3]) is None
    assert usual_steps(12, [right[0], Link(1, 2, rays, math.radians(80.0))]) is None


@pytest.mark.parametrize("first", [0, 2])
def test_groups_are_placed_by_steps_that_close(first: int) -> None:
    true = np.radians(30.0 * np.arange(12))
    group = np.array([0, 0, 1, 2, 2, 3, 3, 4, 0, 0, 0, 0])
    group = np.unique(np.roll(group, first), return_inverse=True)[1]
    within = true - true[[int(np.flatnonzero(group == number)[0]) for number in group]]
    # Optical flow tells a tenth too much.
    steps = [Step(1.1 * math.radians(30.0), math.radians(5.0))] * 11
    heading, sd = headings_in_order(group, wrap_angle(within), steps)
    assert np.degrees(np.abs(wrap_angle(heading - true))).max() < 3.0
    main = int(np.bincount(group).argmax())
    assert (sd[group == main] == 0.0).all()
    assert (sd[group != main] > 0.0).all()


def test_stated_tilt_and_field_are_kept() -> None:
    taken = photographs([0.0, 24.0], hfov_deg=53.0, pitch_deg=2.0, roll_deg=0.0)
    views = turn_views(taken)
    for found in turned_photographs(taken, views, angles_of_turn(views), PatchSize()):
        assert (found.hfov.source, found.pitch.source, found.roll.source) == ("given", "given", "given")
        assert (math.degrees(found.hfov.value), math.degrees(found.pitch.value)) == pytest.approx((53.0, 2.0))


def test_photographs_of_a_fisheye_lens_are_a_turn() -> None:
    lens = Fisheye.of_hfov(640, 480, math.radians(120.0))
    contents = [jpeg(take(sphere("living_room"), lens, heading_deg=heading)) for heading in (0.0, 40.0)]
    stated = StatedCamera(projection="fisheye", hfov_deg=120.0)
    for view in open_turn(contents, stated, sphere_size=(128, 256), patch_size=None)[0]:
        assert (view.hfov.source, len(view.patches)) == ("given", 2)


def room_view(rng: np.random.Generator, arm_m: float, pose: Float[np.ndarray, "3"]) -> Overview:
    """Return what a camera on an arm sees in the box: points of its walls, and its edges."""
    landmarks = np.random.default_rng(5)
    where = landmarks.uniform(0.0, 1.0, (1500, 3)) * ROOM_M
    side = landmarks.integers(4, size=1500)
    where[np.arange(1500), side // 2] = np.where(side % 2, ROOM_M[side // 2], 0.0)
    descriptor = landmarks.integers(0, 256, (1500, 128)).astype(np.uint8)
    corners = np.array(list(itertools.product(*((0.0, size) for size in ROOM_M))))
    edges = [(a, b) for a, b in itertools.combinations(corners, 2) if (a != b).sum() == 1]
    pieces = np.array([a + (b - a) * np.array([[k], [k + 1]]) / 12.0 for a, b in edges for k in range(12)])
    centre = AXIS_M + arm_m * np.array([math.sin(pose[0]), math.cos(pose[0]), 0.0]) + rng.normal(0.0, 0.01, 3)
    (axes,) = level_axes(pose[None])

    def seen(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixels, shown = PORTRAIT.pixels((points - centre) @ axes.T)
        return (pixels + rng.normal(0.0, 0.5, pixels.shape)) / (PORTRAIT.width, PORTRAIT.height), shown

    (place, shown), (ends, whole) = seen(where), seen(pieces)
    kept = np.flatnonzero(shown)
    return Overview(Features(place[kept], descriptor[kept]), ends[whole.all(axis=1)].reshape(-1, 4))


@pytest.mark.parametrize("arm_m", [0.0, 0.3, 0.4, 0.6])
def test_parallax_of_an_arm_is_tolerated(arm_m: float) -> None:
    rng = np.random.default_rng(int(10 * arm_m))
    count = 15
    heading = TWO_PI * np.arange(count) / count + np.radians(rng.normal(0.0, 2.0, count)) * (np.arange(count) > 0)
    poses = np.column_stack([heading, np.radians(rng.normal(0.0, 6.0, count)), np.radians(rng.normal(0.0, 2.0, count))])
    views = [TurnView(overview=room_view(rng, arm_m, pose), camera=PORTRAIT, focal_sd=0.0) for pose in poses]
    angles = angles_of_turn(views)
    assert {angle.group for angle in angles} == {0}
    missed = misses_deg(angles, heading)
    assert np.median(missed) < 1.5
    assert missed.max() < 5.0
    tilt = np.degrees([angle.attitude.pitch for angle in angles] - poses[:, 1])
    assert np.median(np.abs(tilt)) < 0.7
