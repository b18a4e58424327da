"""Scenes of synthetic photographs: facts, objects, and the camera with its lenses, patches and compression."""

from __future__ import annotations

import dataclasses
import io
import math
from typing import get_args

import numpy as np
import pytest
import shapely
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.learn.data.synthetic.generated import Fact, facts_of
from lalaloc_core.learn.synth.camera import (
    Exposure,
    compress,
    cover_poles,
    lens_gain,
    sample_exposure,
    sample_staged_exposure,
    tilt,
)
from lalaloc_core.learn.synth.furniture.furnish import furnish, rectangle, wall_frame
from lalaloc_core.learn.synth.homes.plans import TRAIN, generate_home, home_of
from lalaloc_core.learn.synth.records import Column, Joined, Records
from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer
from lalaloc_core.learn.synth.scene.build import Reflection, build_scene
from lalaloc_core.learn.synth.scene.doors import boards, hang_leaves
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.render_scene import Sun
from lalaloc_core.learn.synth.scene.shells import ceiling_boxes
from lalaloc_core.learn.synth.scene.shots import POSE_MARGIN_M, Shot, sample_shots, stage_rooms
from tests.painted import picture_file
from tests.strategies import seeds


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
    for fact in get_args(Fact):
        share = sum(fact in facts for _, facts in known) / len(known)
        assert 0.02 < share < 0.9, fact
    assert set().union(*(facts for _, facts in known)) <= set(get_args(Fact))


@pytest.mark.slow
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
    renderer = SphereRenderer(materials, height=64, width=128)
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


@pytest.mark.slow
def test_empty_staged_rooms_have_no_mirrors_or_fittings(materials: MaterialLibrary) -> None:
    for seed in range(8):
        rng = np.random.default_rng(seed)
        for shot in stage_rooms(generate_home(rng), rng):
            empty = dataclasses.replace(shot, furniture="empty")
            assert not facts_of(empty) & {"mirror", "counter", "nadir_patch", "bare_bright"}
            assert not build_scene(shot, materials).facts & {"mirror", "bare_bright"}


@given(seed=seeds(), fitted=st.booleans())
@settings(max_examples=25)
def test_built_in_furniture_stays_in_its_room_clear_of_doors(seed: int, fitted: bool) -> None:
    rng = np.random.default_rng(seed)
    home = generate_home(rng)
    for index, room in enumerate(home.plan.rooms):
        openings = [opening for opening in home.openings if opening.room == index]
        for prism in furnish(room, openings, "empty", rng, built_in=True, fitted=fitted):
            footprint = rectangle(prism.centre_m, prism.axis, *prism.half_m)
            assert room.shape.buffer(0.03).contains(footprint)
            assert prism.z_m[1] < room.ceiling_height_m
            for opening in openings:
                start, along, inwards = wall_frame(room, opening.wall)
                before = start + along * 0.5 * (opening.start_m + opening.end_m) + inwards * 0.1
                assert opening.kind == "window" or not footprint.contains(shapely.Point(before))


@given(seed=seeds())
@example(seed=1310720)
@settings(max_examples=25)
def test_ceiling_boxes_stay_in_their_room_above_camera_and_openings(seed: int) -> None:
    rng = np.random.default_rng(seed)
    home = generate_home(rng)
    for index, room in enumerate(home.plan.rooms):
        openings = [opening for opening in home.openings if opening.room == index]
        camera_m = rng.uniform(0.5, room.ceiling_height_m - 0.3)
        for prism in ceiling_boxes(room, openings, camera_m, rng):
            assert camera_m < prism.z_m[0] < prism.z_m[1] == room.ceiling_height_m
            footprint = rectangle(prism.centre_m, prism.axis, *prism.half_m)
            assert footprint.difference(room.shape.buffer(0.01)).area <= 0.01 * footprint.area
            if prism.finish != "paint":
                continue
            # Beams cross windows above their head only in height; soffits and slopes keep clear of them.
            for opening in openings:
                start, along, inwards = wall_frame(room, opening.wall)
                before = start + along * 0.5 * (opening.start_m + opening.end_m) + inwards * 0.05
                parallel = abs(float(prism.axis @ along)) > 0.99
                assert not parallel or prism.z_m[0] > opening.head_m or not footprint.contains(shapely.Point(before))


@pytest.mark.slow
def test_only_fitted_rooms_have_uneven_ceilings() -> None:
    shots = [dataclasses.replace(shot, is_fitted=fitted) for shot in shots_of(12) for fitted in (False, True)]
    materials = MaterialLibrary.create(np.random.default_rng(0))
    hanging = []
    for shot in shots:
        top = shot.home.plan.rooms[shot.room_index].ceiling_height_m
        prisms = build_scene(shot, materials).prisms
        hanging.append(int(((prisms.z1_m == top) & (prisms.z0_m > shot.camera_height_m)).sum()))
    assert not any(hanging[::2])
    assert sum(count > 0 for count in hanging[1::2]) > len(shots) / 4


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


@given(seed=seeds())
@settings(max_examples=25)
def test_reflection_is_an_involution_that_fixes_the_mirror(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mirror, wall = rng.uniform(-5.0, 5.0, 4), rng.uniform(-5.0, 5.0, 4)
    reflection = Reflection(mirror)
    np.testing.assert_allclose(reflection.wall(reflection.wall(wall)), wall, atol=1e-9)
    np.testing.assert_allclose(reflection.point(mirror[:2]), mirror[:2], atol=1e-9)
    np.testing.assert_allclose(
        np.hypot(*(wall[2:] - mirror[:2])), np.hypot(*(reflection.point(wall[2:]) - mirror[:2])), atol=1e-9
    )


class Points(Records):
    weight = Column()
    x_m = Column()
    y_m = Column()
    place_m = Joined(x_m, y_m)
    colour = Column(3)


def test_columns_have_the_order_of_their_names_and_no_others() -> None:
    points = Points.stacked([Points.row(weight=1.0, x_m=2.0, y_m=3.0, colour=(4.0, 5.0, 6.0))])
    np.testing.assert_array_equal(points.rows, [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]])
    assert Points.WIDTH == 6
    with pytest.raises(ValueError, match="have 6 columns, not 5"):
        Points(np.zeros(5))
    with pytest.raises(KeyError, match="height"):
        Points.row(height=1.0)


def test_joined_columns_are_a_view_of_their_adjacent_parts() -> None:
    points = Points(np.zeros((2, 6)))
    points.place_m += np.array([1.0, 2.0])
    np.testing.assert_array_equal(points.x_m, [1.0, 1.0])
    np.testing.assert_array_equal(points.y_m, [2.0, 2.0])
    assert not points.colour.any()
    assert not points.weight.any()
    with pytest.raises(ValueError, match="not neighbours"):

        class Scattered(Records):
            first = Column(2)
            second = Column()
            third = Column()
            ends = Joined(first, third)


ROWS, COLUMNS = 64, 128


def camera(**settings: float) -> Exposure:
    """Return one row of a neutral exposure."""
    return Exposure(torch.from_numpy(Exposure.row(**settings))[None])


def noise_picture(seed: int = 0) -> torch.Tensor:
    """Smooth random colours in 0..1."""
    picture = torch.rand(1, 3, 8, 16, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    larger = torch.nn.functional.interpolate(picture, (ROWS, COLUMNS), mode="bilinear", align_corners=False)
    return larger.permute(0, 2, 3, 1)


# Lenses


@given(seed=seeds())
@settings(max_examples=10)
def test_level_camera_with_one_lens_keeps_the_picture(seed: int) -> None:
    picture = noise_picture(seed)
    assert torch.allclose(tilt(picture, camera(seam=seed % 6)), picture, atol=1e-9)
    assert torch.equal(lens_gain(camera(seam=seed % 6), ROWS, COLUMNS), torch.ones(1, ROWS, COLUMNS).double())


@pytest.mark.parametrize(("axis", "column"), [("pitch", 64), ("roll", 96)])
def test_tilt_raises_one_side_and_lowers_the_other(axis: str, column: int) -> None:
    elevation = ((0.5 - (torch.arange(ROWS) + 0.5) / ROWS) * math.pi).double()
    picture = elevation[None, :, None, None].expand(1, ROWS, COLUMNS, 3).clone()
    angle = math.radians(2.0)
    # Each pixel holds the elevation that it shows.
    shown = tilt(picture, camera(**{axis: angle}))[0, ROWS // 2 - 4 : ROWS // 2 + 4, :, 0]
    change = (shown - picture[0, ROWS // 2 - 4 : ROWS // 2 + 4, :, 0]).mean(dim=0)
    opposite = (column + COLUMNS // 2) % COLUMNS
    assert abs(abs(float(change[column])) - angle) < 0.05 * angle
    assert abs(float(change[column] + change[opposite])) < 0.05 * angle
    assert abs(float(change[(column + COLUMNS // 4) % COLUMNS])) < 0.05 * angle


def test_seam_turns_with_the_picture() -> None:
    straight = lens_gain(camera(seam_step=0.2, vignette=0.3), ROWS, COLUMNS)
    turned = lens_gain(camera(seam_step=0.2, vignette=0.3, seam=math.pi / 2.0), ROWS, COLUMNS)
    assert torch.allclose(straight.roll(COLUMNS // 4, dims=2), turned, atol=1e-6)
    assert float(straight.max() / straight.min()) > 1.2


# Patches


@pytest.mark.parametrize("kind", range(6))
@pytest.mark.parametrize("radius_deg", [12.0, 30.0])
def test_patch_stays_within_its_radius(kind: int, radius_deg: float) -> None:
    picture = noise_picture()
    stand = camera(nadir=math.radians(radius_deg), nadir_kind=kind, nadir_tone=0.05, nadir_turn=1.0)
    covered = cover_poles(picture.clone(), stand)
    below = round(radius_deg / 180.0 * ROWS)
    assert torch.equal(covered[:, : ROWS - below - 1], picture[:, : ROWS - below - 1])
    assert not torch.equal(covered[:, -2:], picture[:, -2:])
    assert torch.equal(cover_poles(picture.clone(), camera()), picture)


# Compression


@pytest.mark.parametrize("quality", [50, 80, 95])
@pytest.mark.parametrize("rows", [ROWS, ROWS - 6])
def test_compression_error_matches_jpeg_files(quality: int, rows: int) -> None:
    picture = noise_picture(3)[:, :rows]
    noise = torch.rand(picture.shape, generator=torch.Generator().manual_seed(1)).double()
    picture = (picture + 0.05 * noise).clamp(0, 1)
    pixels = (picture[0] * 255.0).round().to(torch.uint8).numpy()
    file = picture_file(pixels, "JPEG", quality=quality, subsampling=0)
    expected = np.asarray(Image.open(io.BytesIO(file)), dtype=float) / 255.0
    ours = compress(torch.from_numpy(pixels)[None] / 255.0, torch.tensor([float(quality)]))[0].numpy()
    loss, difference = np.abs(expected - pixels / 255.0).mean(), np.abs(expected - ours).mean()
    assert difference < 0.35 * loss + 0.002


# Exposure


@given(seed=seeds())
@settings(max_examples=30)
def test_staged_cameras_have_no_flaws(seed: int) -> None:
    drawn = sample_exposure(np.random.default_rng(seed), bright=seed % 2 == 0)
    assert max(abs(drawn.roll), abs(drawn.pitch)) <= math.radians(2.0) + 1e-9
    assert drawn.jpeg == 0.0 or 50.0 <= drawn.jpeg <= 95.0
    assert 0.0 <= drawn.nadir <= math.radians(65.0)
    staged = sample_staged_exposure(np.random.default_rng(seed))
    flaws = (staged.roll, staged.pitch, staged.nadir, staged.zenith, staged.seam_step, staged.seam_shift, staged.jpeg)
    assert not any(flaws)


# Supersampling


@pytest.mark.parametrize("rays", [(2, 1), (1, 2), (2, 2)])
def test_supersampling_keeps_the_picture(materials: MaterialLibrary, rays: tuple[int, int]) -> None:
    rng = np.random.default_rng(11)
    shots = [shot for _ in range(3) for shot in sample_shots(generate_home(rng), 2, rng, "empty")]
    few = SphereRenderer(materials, height=ROWS, width=COLUMNS).render(shots).float()
    many = SphereRenderer(materials, height=ROWS, width=COLUMNS, supersample=rays).render(shots).float()
    assert few.shape == many.shape
    assert float((few - many).abs().median()) <= 2.0
    # Averaging takes contrast away, never adds any.
    steps = [float((picture[:, 1:] - picture[:, :-1]).abs().mean()) for picture in (few, many)]
    assert rays[0] == 1 or steps[1] < steps[0]


def test_single_supersample_applies_to_both_axes_and_is_at_least_one(materials: MaterialLibrary) -> None:
    shots = sample_shots(generate_home(np.random.default_rng(1)), 1, np.random.default_rng(1))
    first, second = (
        SphereRenderer(materials, height=32, width=64, supersample=rays).render(shots) for rays in (2, (2, 2))
    )
    assert torch.equal(first, second)
    with pytest.raises(InvalidInputError, match="at least 1"):
        SphereRenderer(materials, supersample=(0, 1))
