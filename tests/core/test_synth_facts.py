"""Facts of shots match their scenes; new objects in a room keep its layout."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from lalaloc_core.learn.synth.furniture.furnish import furnish, rectangle, wall_frame
from lalaloc_core.learn.synth.homes.plans import generate_home
from lalaloc_core.learn.synth.homes.splits import TRAIN, home_of
from lalaloc_core.learn.synth.rendering.panorama import PanoramaRenderer
from lalaloc_core.learn.synth.scene.build import build_scene
from lalaloc_core.learn.synth.scene.facts import FACTS, facts_of
from lalaloc_core.learn.synth.scene.leaves import boards, hang_leaves
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.mirrors import Reflection
from lalaloc_core.learn.synth.scene.render_scene import Sun
from lalaloc_core.learn.synth.scene.shots import POSE_MARGIN_M, Shot, sample_shots, stage_rooms

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def materials() -> MaterialLibrary:
    return MaterialLibrary.create(np.random.default_rng(0))


def shots_of(homes: int) -> list[Shot]:
    """Shots as training draws them."""
    shots = []
    for index in range(homes):
        home, rng = home_of(TRAIN, 0, index)
        shots += sample_shots(home, 2, rng, by_room_share=0.25, hard_share=0.25)
    return shots


@pytest.fixture(scope="module")
def known() -> list[tuple[Shot, frozenset[str]]]:
    return [(shot, facts_of(shot)) for shot in shots_of(60)]


def test_hard_places_include_openings_and_clear_walls() -> None:
    """Within `POSE_MARGIN_M` of a room's outline only where it is open, and never on it."""
    inside = 0
    for index in range(40):
        home, rng = home_of(TRAIN, 0, index)
        for shot in sample_shots(home, 8, rng, hard_share=1.0):
            room, here = home.plan.rooms[shot.room_index], shapely.Point(shot.position_m)
            assert room.shape.contains(here)
            walls = room.shape.boundary
            for opening in home.openings:
                if opening.room == shot.room_index and opening.is_see_through:
                    start, along, _ = wall_frame(room, opening.wall)
                    ends = [start + along * opening.start_m, start + along * opening.end_m]
                    walls = walls.difference(shapely.LineString(ends).buffer(2e-3))
            assert walls.distance(here) > POSE_MARGIN_M - 1e-6
            nearest_m = room.shape.boundary.distance(here)
            assert nearest_m > 0.029
            inside += nearest_m < POSE_MARGIN_M - 1e-6
    # 30 % of the hard places are thresholds if there is an opening, and half of these are in the opening.
    assert 0.05 < inside / (8 * 40) < 0.2


def test_each_fact_occurs_sometimes(known: list[tuple[Shot, frozenset[str]]]) -> None:
    for fact in FACTS:
        share = sum(fact in facts for _, facts in known) / len(known)
        assert 0.02 < share < 0.9, fact
    assert set().union(*(facts for _, facts in known)) <= set(FACTS)


def test_facts_match_the_scene(known: list[tuple[Shot, frozenset[str]]], materials: MaterialLibrary) -> None:
    for shot, facts in known:
        scene, room = build_scene(shot, materials), shot.home.plan.rooms[shot.room_index]
        assert ("nadir_patch" in facts) == (scene.exposure.nadir > 0.0)
        assert ("closet" in facts) == (room.area_m2 < 3.0)
        behind = scene.decals.slot
        through = {int(slot) for slot in behind if slot >= 0}
        # A mirror is a hole to one more room than there are doors to.
        doors = {
            opening.neighbour
            for opening in shot.home.openings
            if opening.room == shot.room_index and opening.kind in ("door_open", "opening") and opening.neighbour >= 0
        }
        assert len(through) - len(doors) == ("mirror" in facts)
        if facts & {"open_door", "wide_opening", "threshold"}:
            assert doors
        if "sun_patch" in facts:
            assert scene.sun.colour.min() > 0.0
        if "bare_bright" in facts:
            assert shot.furniture == "empty"
        if "corridor" in facts:
            assert shapely.maximum_inscribed_circle(room.shape).length < 0.8


def test_sun_patches_are_lit(known: list[tuple[Shot, frozenset[str]]], materials: MaterialLibrary) -> None:
    """The picture without the sun differs if the facts name a sun patch."""
    renderer = PanoramaRenderer(materials, height=64, width=128)
    seen = differs = 0
    for shot, facts in known:
        if "sun_patch" not in facts or shot.furniture == "full":
            continue
        scene = build_scene(shot, materials)
        dark = dataclasses.replace(scene, sun=Sun(np.zeros(Sun.WIDTH)))
        with_sun, without = (renderer.render_scenes([lit])[0].int() for lit in (scene, dark))
        seen += 1
        differs += bool(((with_sun - without).abs().amax(dim=-1) > 12).float().mean() > 2e-4)
    assert seen >= 5
    assert differs >= 0.8 * seen


def test_shapes_do_not_depend_on_materials(materials: MaterialLibrary) -> None:
    other = MaterialLibrary.create(np.random.default_rng(9))
    for shot in shots_of(6):
        first, second = build_scene(shot, materials), build_scene(shot, other)
        for name in ("walls_m", "wall_owner"):
            np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
        for name in ("decals", "prisms", "lights", "sun", "exposure"):
            np.testing.assert_array_equal(getattr(first, name).rows, getattr(second, name).rows)
        assert first.facts == second.facts


def test_empty_staged_rooms_have_no_mirrors_or_fittings(materials: MaterialLibrary) -> None:
    for seed in range(8):
        rng = np.random.default_rng(seed)
        for shot in stage_rooms(generate_home(rng), rng):
            empty = dataclasses.replace(shot, furniture="empty")
            assert not facts_of(empty) & {"mirror", "counter", "nadir_patch", "bare_bright"}
            assert not build_scene(shot, materials).facts & {"mirror", "bare_bright"}


@given(seed=seeds)
@settings(max_examples=25, deadline=None)
def test_built_in_furniture_stays_in_its_room_clear_of_doors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    home = generate_home(rng)
    for index, room in enumerate(home.plan.rooms):
        openings = [opening for opening in home.openings if opening.room == index]
        for prism in furnish(room, openings, "empty", rng, built_in=True):
            footprint = rectangle(
                np.array([prism.x, prism.y]), np.array([prism.axis_x, prism.axis_y]), prism.half_a, prism.half_b
            )
            assert room.shape.buffer(0.03).contains(footprint)
            assert prism.z1 < room.ceiling_height_m
            for opening in openings:
                start, along, inwards = wall_frame(room, opening.wall)
                before = start + along * 0.5 * (opening.start_m + opening.end_m) + inwards * 0.1
                assert opening.kind == "window" or not footprint.contains(shapely.Point(before))


def test_leaves_stay_in_their_rooms_at_every_angle() -> None:
    angles, own, none, doors = [], 0, 0, 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        home = generate_home(rng)
        for opening in home.openings:
            if opening.kind != "door_open":
                continue
            doors += 1
            room, neighbour = home.plan.rooms[opening.room], home.plan.rooms[opening.neighbour]
            leaves = hang_leaves(opening, room, neighbour, 0.12, np.array([1e3, 0.0]), rng)
            none += not leaves
            _, along, _ = wall_frame(room, opening.wall)
            for leaf in leaves:
                target = room if leaf.in_own_room else neighbour
                assert target.shape.contains(rectangle(leaf.centre_m, leaf.axis, leaf.half_width_m, 0.01))
                angles.append(math.degrees(math.acos(abs(float(leaf.axis @ along)))))
                own += leaf.in_own_room
    assert min(angles) < 10.0
    assert max(angles) > 80.0
    assert 0.2 < own / len(angles) < 0.9
    assert 0.05 < none / doors < 0.5


def test_glazed_leaf_is_transparent() -> None:
    middle = [board for board in boards(0.4, 2.0, glazed=True) if abs(board.along_m) <= board.half_a]
    assert not any(board.z0 < 1.0 < board.z1 for board in middle)
    assert any(board.z0 < 1.0 < board.z1 for board in boards(0.4, 2.0, glazed=False))


@given(seed=seeds)
@settings(max_examples=25, deadline=None)
def test_reflection_is_an_involution_that_fixes_the_mirror(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mirror, wall = rng.uniform(-5.0, 5.0, 4), rng.uniform(-5.0, 5.0, 4)
    reflection = Reflection(mirror)
    np.testing.assert_allclose(reflection.wall(reflection.wall(wall)), wall, atol=1e-9)
    np.testing.assert_allclose(reflection.point(mirror[:2]), mirror[:2], atol=1e-9)
    np.testing.assert_allclose(
        np.hypot(*(wall[2:] - mirror[:2])), np.hypot(*(reflection.point(wall[2:]) - mirror[:2])), atol=1e-9
    )
