"""Procedural homes and their photographs."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from PIL import Image

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.synthetic.generated import facts_of
from lalaloc_core.learn.synth.furniture.furnish import (
    CAMERA_CLEARANCE_M,
    FURNITURE_LEVELS,
    ROOM_PIECES,
    furnish,
    rectangle,
)
from lalaloc_core.learn.synth.homes.plans import TEST, TRAIN, Home, generate_home
from lalaloc_core.learn.synth.homes.plans import home_of as home_of_split
from lalaloc_core.learn.synth.rendering.sphere_renderer import SphereRenderer
from lalaloc_core.learn.synth.scene.build import build_scene
from lalaloc_core.learn.synth.scene.materials import MaterialLibrary
from lalaloc_core.learn.synth.scene.shots import sample_shots
from lalaloc_core.render.profile import layout_depth, wall_profile
from tests.strategies import seeds

ROWS, COLUMNS = 64, 128


@pytest.fixture(scope="module")
def renderer(materials: MaterialLibrary) -> SphereRenderer:
    return SphereRenderer(materials, height=ROWS, width=COLUMNS)


def home_of(seed: int) -> Home:
    return generate_home(np.random.default_rng(seed))


def shut(home: Home) -> Home:
    """Return the home with every door and wide opening shut."""
    openings = tuple(
        opening if opening.kind == "window" else dataclasses.replace(opening, kind="door_shut")
        for opening in home.openings
    )
    return Home(home.plan, openings)


@pytest.mark.slow
@given(seed=seeds())
@settings(max_examples=40)
def test_homes_are_valid_plans_within_their_size_range(seed: int) -> None:
    plan = home_of(seed).plan
    assert plan.warnings == ()
    assert 3 <= len(plan.rooms) <= 10
    assert 15.0 < plan.area_m2 <= 180.0
    assert all(2.2 <= room.ceiling_height_m <= 3.5 for room in plan.rooms)
    assert len({room.name for room in plan.rooms}) == len(plan.rooms)
    assert FloorPlan.from_dict(plan.to_dict()).to_dict() == plan.to_dict()


@given(seed=seeds())
@settings(max_examples=40)
def test_openings_lie_in_their_walls_without_overlap(seed: int) -> None:
    home = home_of(seed)
    taken: dict[tuple[int, int], list[tuple[float, float]]] = {}
    for opening in home.openings:
        room = home.plan.rooms[opening.room]
        x0, y0, x1, y1 = room.walls_m[opening.wall]
        assert 0.0 <= opening.start_m < opening.end_m <= np.hypot(x1 - x0, y1 - y0)
        assert 0.0 <= opening.sill_m < opening.head_m <= room.ceiling_height_m
        taken.setdefault((opening.room, opening.wall), []).append((opening.start_m, opening.end_m))
    for intervals in taken.values():
        intervals.sort()
        assert all(before[1] < after[0] for before, after in itertools.pairwise(intervals))


@given(seed=seeds())
@settings(max_examples=20)
def test_door_has_one_place_in_both_rooms(seed: int) -> None:
    home = home_of(seed)

    def middle(opening):
        x0, y0, x1, y1 = home.plan.rooms[opening.room].walls_m[opening.wall]
        share = 0.5 * (opening.start_m + opening.end_m) / np.hypot(x1 - x0, y1 - y0)
        return np.array([x0 + share * (x1 - x0), y0 + share * (y1 - y0)])

    for opening in home.openings:
        if opening.neighbour < 0:
            continue
        others = [
            other for other in home.openings if (other.room, other.neighbour) == (opening.neighbour, opening.room)
        ]
        nearest = min(others, key=lambda other: float(np.linalg.norm(middle(other) - middle(opening))))
        assert np.linalg.norm(middle(nearest) - middle(opening)) < 0.3
        assert nearest.kind == opening.kind


def test_seed_determines_the_home() -> None:
    first, again, other = home_of(1), home_of(1), home_of(2)
    assert first.plan.to_dict() == again.plan.to_dict()
    assert first.openings == again.openings
    assert first.plan.to_dict() != other.plan.to_dict()


def test_training_homes_are_more_varied_than_test_homes() -> None:
    varied, usual = ([home_of_split(split, 0, index)[0] for index in range(40)] for split in (TRAIN, TEST))

    def highest(homes: list[Home]) -> float:
        return max(room.ceiling_height_m for home in homes for room in home.plan.rooms)

    def to_the_floor(homes: list[Home]) -> float:
        sills = [opening.sill_m for home in homes for opening in home.openings if opening.kind == "window"]
        return float(np.mean(np.array(sills) < 0.1))

    def wing_walls(homes: list[Home]) -> int:
        """Walls that end free: an edge as short as a wall is thick, and a long way into the room."""
        count = 0
        for room in (room for home in homes for room in home.plan.rooms):
            lengths = np.hypot(*(room.walls_m[:, 2:] - room.walls_m[:, :2]).T)
            count += sum(
                lengths[k] < 0.26 and min(lengths[k - 1], lengths[(k + 1) % len(lengths)]) > 0.75
                for k in range(len(lengths))
            )
        return count

    assert highest(usual) <= 3.5 < highest(varied)
    assert to_the_floor(varied) > to_the_floor(usual)
    assert wing_walls(varied) > 2 * wing_walls(usual)


def test_night_has_dark_windows_and_lit_lamps(materials: MaterialLibrary) -> None:
    home, rng = home_of(3), np.random.default_rng(3)
    assert not any(shot.is_night for shot in sample_shots(home, 8, rng))
    for shot in sample_shots(home, 4, rng, night_share=1.0):
        scene, by_day = (build_scene(dataclasses.replace(shot, is_night=night), materials) for night in (True, False))
        outdoors = scene.surfaces.is_outdoors > 0
        assert outdoors.any()
        assert scene.surfaces.glow[outdoors].max() < 0.15 < by_day.surfaces.glow[outdoors].min()
        # No window gives light, whose rows have a normal; lamps have none.
        assert not scene.lights.normal.any()
        assert scene.lights.colour.any()


@pytest.mark.slow
def test_homes_are_varied() -> None:
    homes = [home_of(seed) for seed in range(150)]
    rooms = [room for home in homes for room in home.plan.rooms]
    kinds = {opening.kind for home in homes for opening in home.openings}
    assert kinds == {"door_shut", "door_open", "opening", "window"}
    assert min(room.area_m2 for room in rooms) < 2.5
    assert max(room.area_m2 for room in rooms) > 45.0
    assert {4, 5, 6, 8} <= {len(room.polygon_m) for room in rooms}
    turned = sum(
        np.abs(home.plan.rooms[0].walls_m[0, :2] - home.plan.rooms[0].walls_m[0, 2:]).min() > 0.05 for home in homes
    )
    assert 0.1 < turned / len(homes) < 0.7


@pytest.mark.slow
@given(seed=seeds())
@settings(max_examples=25)
def test_empty_closed_room_shows_its_layout(renderer: SphereRenderer, seed: int) -> None:
    rng = np.random.default_rng(seed)
    home = shut(generate_home(rng))
    shots = sample_shots(home, 3, rng, "empty")
    hits = renderer.hits(shots)
    elevation_cosine = np.cos((0.5 - (np.arange(ROWS) + 0.5) / ROWS) * np.pi)
    depth = hits.distance_m.numpy().transpose(0, 2, 1) / elevation_cosine[None, :, None]
    for index, shot in enumerate(shots):
        room = home.plan.rooms[shot.room_index]
        profile = wall_profile(shot.position_m[None], np.array([shot.heading]), room.walls_m[None], COLUMNS)
        expected = layout_depth(profile, np.array([shot.camera_height_m]), np.array([room.ceiling_height_m]), ROWS)[0]
        # Mirrors show more than the layout.
        bare = (~hits.furniture[index] & (hits.slot[index] == 0)).numpy().T
        assert bare.mean() > 0.5
        np.testing.assert_allclose(depth[index][bare], expected[bare], atol=1e-3)


@given(seed=seeds())
@settings(max_examples=10)
def test_rays_end_at_walls_except_through_openings(renderer: SphereRenderer, seed: int) -> None:
    rng = np.random.default_rng(seed)
    home = generate_home(rng)
    (shot,) = sample_shots(home, 1, rng, "empty")
    hits = renderer.hits([shot])
    walls = home.plan.rooms[shot.room_index].walls_m
    profile = wall_profile(shot.position_m[None], np.array([shot.heading]), walls[None], COLUMNS)[0]
    through = hits.distance_m[0].numpy().max(axis=1) > profile + 1e-3
    kinds = {opening.kind for opening in home.openings if opening.room == shot.room_index}
    assert not through.any() or kinds & {"door_open", "opening"} or "mirror" in facts_of(shot)
    assert hits.distance_m.isfinite().all()


def test_picture_does_not_depend_on_its_batch(renderer: SphereRenderer) -> None:
    rng = np.random.default_rng(3)
    shots = [shot for seed in range(4) for shot in sample_shots(home_of(seed), 2, rng)]
    together = renderer.render(shots)
    assert together.shape == (8, ROWS, COLUMNS, 3)
    assert together.dtype == torch.uint8
    assert torch.equal(together, renderer.render(shots))
    alone = torch.cat([renderer.render([shot]) for shot in shots])
    assert (together.int() - alone.int()).abs().max() <= 1
    reseeded = renderer.render([dataclasses.replace(shots[0], seed=shots[0].seed + 1)])
    assert not torch.equal(together[:1], reseeded)


def test_pictures_are_well_exposed(renderer: SphereRenderer) -> None:
    rng = np.random.default_rng(4)
    shots = [shot for seed in range(20) for shot in sample_shots(home_of(seed), 2, rng)]
    mean = renderer.render(shots).float().mean(dim=(1, 2, 3))
    assert 60.0 < float(mean.mean()) < 190.0
    assert float(mean.min()) > 12.0
    assert float(mean.std()) > 10.0


def test_turned_camera_rolls_the_picture(renderer: SphereRenderer) -> None:
    (shot,) = sample_shots(home_of(5), 1, np.random.default_rng(5), "full")
    turned = dataclasses.replace(shot, heading=shot.heading + 2.0 * np.pi * 32 / COLUMNS)
    hits = renderer.hits([shot, turned])
    rolled = hits.distance_m[0].roll(-32, dims=0)
    assert ((rolled - hits.distance_m[1]).abs() < 1e-2).float().mean() > 0.99


@pytest.mark.slow
def test_furniture_hides_the_layout(renderer: SphereRenderer) -> None:
    shares = []
    for level in FURNITURE_LEVELS:
        rng = np.random.default_rng(6)
        shots = [shot for seed in range(20) for shot in sample_shots(home_of(seed), 1, rng, level)]
        shares.append(float(renderer.hits(shots).furniture.float().mean()))
    assert shares[0] < 0.05
    assert shares[0] + 0.03 < shares[1] < shares[2] - 0.03


@given(seed=seeds())
@settings(max_examples=20)
def test_pieces_stay_within_their_footprints(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for makers in ROOM_PIECES.values():
        for maker, _ in makers:
            piece = maker(rng)
            for part in piece.parts:
                assert abs(part.x) + part.half_x <= 0.5 * piece.width_m + 0.06, maker.__name__
                assert abs(part.y) + part.half_y <= 0.5 * piece.depth_m + 0.06, maker.__name__


@given(seed=seeds())
@settings(max_examples=25)
def test_furniture_stays_in_its_room_clear_of_the_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    home = generate_home(rng)
    for shot in sample_shots(home, 2, rng, "full"):
        room = home.plan.rooms[shot.room_index]
        openings = [opening for opening in home.openings if opening.room == shot.room_index]
        roomy = room.shape.buffer(0.05)
        for prism in furnish(room, openings, "full", rng, shot.position_m):
            assert shapely.contains_xy(roomy, *prism.centre_m)
            z0, z1 = prism.z_m
            assert z0 < z1 < room.ceiling_height_m
            if z1 < 0.05:
                continue
            footprint = rectangle(prism.centre_m, prism.axis, *prism.half_m)
            assert shapely.distance(footprint, shapely.Point(shot.position_m)) > CAMERA_CLEARANCE_M - 0.1


@pytest.mark.slow
@given(seed=seeds())
@settings(max_examples=25)
def test_camera_is_outside_all_objects(materials: MaterialLibrary, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for shot in sample_shots(generate_home(rng), 2, rng, "full"):
        scene = build_scene(shot, materials)
        x, y, ax, ay, a, b, z0, z1, *_ = scene.prisms.rows.T
        inside = (np.abs(x * ax + y * ay) <= a) & (np.abs(y * ax - x * ay) <= b)
        inside &= (z0 <= shot.camera_height_m) & (shot.camera_height_m <= z1)
        assert not inside.any()


def test_shots_keep_clear_of_walls_and_ceiling() -> None:
    rng = np.random.default_rng(7)
    home = home_of(7)
    shots = sample_shots(home, 200, rng, by_room_share=0.5)
    for shot in shots:
        room = home.plan.rooms[shot.room_index]
        assert room.shape.contains(shapely.Point(shot.position_m))
        assert room.shape.exterior.distance(shapely.Point(shot.position_m)) >= 0.199
        assert 1.0 <= shot.camera_height_m <= min(1.9, room.ceiling_height_m - 0.2)
    assert {shot.furniture for shot in shots} == set(FURNITURE_LEVELS)


def test_materials_work_with_and_without_textures(tmp_path: Path, materials: MaterialLibrary) -> None:
    assert materials.pictures.shape[1:] == (128, 128, 3)
    assert float(materials.pictures.min()) >= 0.0
    assert float(materials.pictures.max()) <= 1.0
    folder = tmp_path / "floor" / "tiles"
    folder.mkdir(parents=True)
    Image.new("RGB", (100, 128), (255, 0, 0)).save(folder / "red.jpg")
    library = MaterialLibrary.create(np.random.default_rng(0), tmp_path)
    drawn = {library.sample("floor", rng) for rng in [np.random.default_rng(8)] for _ in range(50)}
    photographs = set(np.concatenate(library.photographs["floor"]).tolist())
    assert drawn & photographs
    assert drawn - photographs
    np.testing.assert_allclose(library.mean_colours[min(photographs)], [1.0, 0.0, 0.0], atol=0.02)
    with pytest.raises(InvalidInputError, match="contains no pictures"):
        MaterialLibrary.create(np.random.default_rng(0), folder)


def test_odd_height_is_refused(materials: MaterialLibrary) -> None:
    with pytest.raises(InvalidInputError, match="even"):
        SphereRenderer(materials, height=63, width=128)
