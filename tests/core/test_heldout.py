"""Out-of-family homes: sound plans, cameras in their rooms, photographs that show the truth, and apart from `synth`."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import shapely

from lalaloc_core.cli import main
from lalaloc_core.conventions import column_azimuths
from lalaloc_core.errors import DatasetError, InvalidInputError
from lalaloc_core.evaluate.runs.factories import build_dataset
from lalaloc_core.evaluate.runs.predictions import RunInfo
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Appearance, Dataset
from lalaloc_core.learn.data.synthetic.heldout import HeldoutPhotograph, HeldoutScenes
from lalaloc_core.learn.heldout.furnishing import LEVELS, Furnishing
from lalaloc_core.learn.heldout.grown_plans import MAX_AREA_M2, MAX_ROOMS, MIN_AREA_M2, MIN_ROOMS, sample_plan
from lalaloc_core.learn.heldout.homes import WALL_MARGIN_M, HomeKey, home_of, traced_home
from lalaloc_core.learn.heldout.outlines import AREAS_M2, sample_outline
from lalaloc_core.learn.heldout.shell import shell_parts
from lalaloc_core.learn.heldout.tracing import Tracer
from lalaloc_core.render.profile import layout_depth, wall_profile
from tests.core.questions import run_info

HOMES = 4


def keys() -> list[HomeKey]:
    return [HomeKey(1, 7, index) for index in range(HOMES)]


def photograph(scenes: HeldoutScenes, name: str, camera: int) -> HeldoutPhotograph:
    (shot,) = scenes.load(name).cameras[camera].photographs.values()
    assert isinstance(shot, HeldoutPhotograph)
    return shot


class TestPlans:
    def test_rooms_do_not_overlap_and_homes_respect_limits(self) -> None:
        for key in keys():
            plan = home_of(key).plan.plan
            assert MIN_ROOMS <= len(plan.rooms) <= MAX_ROOMS
            assert MIN_AREA_M2 <= plan.area_m2 <= MAX_AREA_M2
            for first, second in itertools.combinations(plan.rooms, 2):
                assert first.shape.distance(second.shape) >= home_of(key).plan.wall_m - 1e-5

    @pytest.mark.parametrize("kind", AREAS_M2)
    def test_outlines_are_simple_rings_of_the_requested_size(self, kind: str) -> None:
        rng = np.random.default_rng(0)
        for _ in range(20):
            shape = sample_outline(kind, rng)  # pyright: ignore[reportArgumentType]
            assert shape.is_valid
            assert shape.exterior.is_ccw
            assert AREAS_M2[kind][0] - 1e-6 <= shape.area <= AREAS_M2[kind][1] + 1e-6  # pyright: ignore[reportArgumentType]

    def test_many_walls_meet_at_oblique_angles(self) -> None:
        oblique = []
        for key in keys():
            for room in home_of(key).plan.plan.rooms:
                edges = room.walls_m[:, 2:] - room.walls_m[:, :2]
                bearing = np.arctan2(edges[:, 1], edges[:, 0])
                off = np.abs((np.diff(bearing, append=bearing[0]) + np.pi / 4) % (np.pi / 2) - np.pi / 4)
                oblique.append(bool((off > np.radians(5)).any()))
        assert np.mean(oblique) > 0.3

    def test_every_room_is_reachable_through_doors(self) -> None:
        for key in keys():
            home = home_of(key)
            reached, before = {0}, 0
            while len(reached) > before:
                before = len(reached)
                for opening in home.openings:
                    if opening.behind is not None and {opening.wall.room, opening.behind.room} & reached:
                        reached |= {opening.wall.room, opening.behind.room}
            assert reached == set(range(len(home.plan.kinds)))

    def test_openings_lie_within_walls_without_overlap(self) -> None:
        for key in keys():
            by_wall: dict[tuple[int, int], list[tuple[float, float]]] = {}
            for opening in home_of(key).openings:
                assert 0.0 < opening.left_m < opening.right_m < opening.wall.length_m
                assert opening.top_m < home_of(key).plan.plan.rooms[opening.wall.room].ceiling_height_m
                by_wall.setdefault((opening.wall.room, opening.wall.edge), []).append((opening.left_m, opening.right_m))
            for spans in by_wall.values():
                for (_, end), (start, _) in itertools.pairwise(sorted(spans)):
                    assert end < start


class TestTruth:
    @staticmethod
    def closed(seed: int) -> tuple[FloorPlan, Tracer]:
        """Return a home without openings or furniture."""
        rng = np.random.default_rng(seed)
        plan = sample_plan(rng, "closed").plan
        return plan, Tracer(shell_parts(plan, [], rng))

    @pytest.mark.parametrize("seed", range(3))
    def test_traced_horizon_matches_the_wall_profile(self, seed: int) -> None:
        plan, tracer = self.closed(seed)
        columns = 512
        for room in plan.rooms:
            position = np.array(shapely.maximum_inscribed_circle(room.shape, 0.05).coords[0])
            azimuth = 0.7 + column_azimuths(columns)
            rays = np.stack([np.sin(azimuth), np.cos(azimuth), np.zeros(columns)], axis=1)
            traced = tracer.first(np.broadcast_to([*position, 1.5], rays.shape), rays).distance_m
            profile = wall_profile(position[None], np.array([0.7]), room.walls_m[None], columns)[0]
            np.testing.assert_allclose(traced, profile, atol=0.01)

    @pytest.mark.slow
    def test_empty_photograph_shows_the_layout_except_openings(self) -> None:
        scenes = HeldoutScenes(homes=3, shots_per_home=2, furniture="empty")
        for name in scenes.scenes("validation"):
            scene = scenes.load(name)
            for camera in scene.cameras:
                room = scene.plan.rooms[camera.room_index]
                (taken,) = camera.photographs.values()
                seen = taken.depth_m()
                profile = wall_profile(camera.position_m[None], np.array([camera.heading]), room.walls_m[None], 512)
                height, ceiling = np.array([camera.camera_height_m]), np.array([room.ceiling_height_m])
                truth = layout_depth(profile, height, ceiling, 256)[0]
                # Leaves, frames and the lamp stand before walls, and openings let through.
                assert np.mean(np.abs(seen - truth) < 0.02) > 0.7

    @pytest.mark.slow
    def test_camera_stands_in_its_room_clear_of_obstacles(self) -> None:
        scenes = HeldoutScenes(homes=3, shots_per_home=4)
        for name in scenes.scenes("validation"):
            scene = scenes.load(name)
            for k, camera in enumerate(scene.cameras):
                room, point = scene.plan.rooms[camera.room_index], shapely.Point(camera.position_m)
                assert room.shape.contains(point)
                assert room.shape.exterior.distance(point) >= WALL_MARGIN_M - 1e-9
                assert 1.1 <= camera.camera_height_m <= 1.8
                assert camera.camera_height_m < room.ceiling_height_m
                assert np.nanmin(photograph(scenes, name, k).depth_m()) > 0.05


class TestFurniture:
    @pytest.mark.parametrize("key", keys())
    def test_furniture_grows_with_the_level_within_its_room(self, key: HomeKey) -> None:
        home = home_of(key)
        empty, simple, full = (Furnishing(home.plan, home.openings, level, key.rng(1)).taken for level in LEVELS)
        areas_m2 = [sum(float(shapely.area(shape)) for shape in taken) for taken in (empty, simple, full)]
        assert areas_m2[0] == 0.0 < areas_m2[1] < areas_m2[2]
        for room, less, more in zip(home.plan.plan.rooms, simple, full, strict=True):
            assert less.difference(more.buffer(1e-6)).area == pytest.approx(0.0, abs=1e-9)
            assert more.difference(room.shape).area == 0.0


class TestScenes:
    def test_scenes_are_deterministic_and_splits_differ(self) -> None:
        scenes = HeldoutScenes(homes=2, shots_per_home=1)
        assert isinstance(scenes, Dataset)
        first = scenes.load("test-00001")
        picture = photograph(scenes, "test-00001", 0).image(32, 64)
        home_of.cache_clear()
        traced_home.cache_clear()
        again = scenes.load("test-00001")
        np.testing.assert_array_equal(first.cameras[0].position_m, again.cameras[0].position_m)
        np.testing.assert_array_equal(picture, photograph(scenes, "test-00001", 0).image(32, 64))
        other = scenes.load("validation-00001")
        assert other.plan.to_dict() != first.plan.to_dict()

    def test_levels_share_camera_positions(self) -> None:
        places = [HeldoutScenes(homes=1, furniture=level).load("test-00000").cameras for level in LEVELS]
        for cameras in zip(*places, strict=True):
            assert len({tuple(camera.position_m) for camera in cameras}) == 1

    def test_picture_has_the_requested_size_and_contrast(self) -> None:
        picture = photograph(HeldoutScenes(homes=1), "validation-00000", 0).image(64, 128)
        assert picture.shape == (64, 128, 3)
        assert picture.std() > 10

    def test_missing_level_is_drawn_per_camera(self) -> None:
        scenes = HeldoutScenes(homes=2, shots_per_home=6, furniture=None)
        assert scenes.appearances == (Appearance(None),)
        levels = {photograph(scenes, name, k).shot.furniture for name in scenes.scenes("test") for k in range(6)}
        assert len(levels) > 1

    def test_training_split_is_refused(self) -> None:
        assert list(HeldoutScenes(homes=3).scenes("train")) == []
        with pytest.raises(DatasetError, match="unknown generated scene"):
            HeldoutScenes(homes=3).load("train-00000")

    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            ({"homes": -1}, "homes is -1; the minimum is 0"),
            ({"homes": 1, "shots_per_home": 0}, "shots_per_home is 0; the minimum is 1"),
            ({"homes": 1, "seed": -2}, "seed is -2; the minimum is 0"),
        ],
    )
    def test_invalid_arguments_are_refused(self, wrong: dict, message: str) -> None:
        with pytest.raises(InvalidInputError, match=message):
            build_dataset(heldout_run(**wrong))


def heldout_run(**generated: Any) -> RunInfo:
    return run_info(method="oracle", generated={"generator": "heldout"} | generated)


class TestRuns:
    def test_run_uses_heldout_homes(self) -> None:
        dataset = build_dataset(heldout_run(homes=2, furniture="empty"))
        assert dataset == HeldoutScenes(homes=2, furniture="empty")
        assert dataset.description == "out-of-family homes (seed 0)"

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (["--split", "train"], "no split 'train'"),
            (["--textures", "somewhere"], "--textures is for --generator synth"),
            (["--data", "somewhere"], "not for --data"),
        ],
    )
    def test_contradictory_options_are_refused(
        self, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main(["lab", "evaluate", "--generator", "heldout", "--method", "oracle", *options]) == 2
        assert message in capsys.readouterr().err
