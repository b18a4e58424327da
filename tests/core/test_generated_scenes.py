"""Generated homes with moved doors, mismatched photographs and disturbed photographs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Scene
from lalaloc_core.learn.data.synthetic import altered_homes
from lalaloc_core.learn.data.synthetic.altered_homes import (
    AlteredScenes,
    Cropped,
    DisturbedPhotograph,
    OutdoorPhotograph,
    UpsideDown,
)
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.render.sweep import sweep_layouts

HOMES = GeneratedScenes(homes=3, shots_per_home=2)
FURNISHED = GeneratedScenes(homes=2, shots_per_home=4, furniture=None)
LOOK = FURNISHED.appearances[0]


def test_copies_differ_in_their_doors_only() -> None:
    for name in AlteredScenes(HOMES, "copies").scenes("validation"):
        home, scene = HOMES.load(name), AlteredScenes(HOMES, "copies").load(name)
        rooms, plan = len(home.plan.rooms), scene.plan
        assert len(plan.rooms) == 4 * rooms
        assert plan.opening_kinds == home.plan.opening_kinds
        own = {camera.room_index // rooms for camera in scene.cameras}
        assert len(own) == 1
        shift_m = plan.rooms[rooms].polygon_m - home.plan.rooms[0].polygon_m
        step_m = shift_m[0, 0]
        counts = {kind: np.zeros(4, int) for kind in ("door", "window", "passage")}
        for opening in plan.openings:
            x_m = float(np.mean(np.asarray(opening.line_m)[:, 0])) - home.plan.bounds_m[0] + 1.0
            counts[opening.kind][int(x_m // step_m)] += 1
        doors = counts["door"]
        (whole,) = own
        assert doors[whole] == sum(opening.kind == "door" for opening in home.plan.openings) > 0
        assert all(doors[whole] - 1 <= count <= doors[whole] for count in doors)
        for kind in ("window", "passage"):
            assert len(set(counts[kind].tolist())) == 1
        cameras = {camera.name: camera for camera in home.cameras}
        for moved in scene.cameras:
            camera = cameras[moved.name]
            np.testing.assert_allclose(moved.position_m, camera.position_m + np.array([whole * step_m, 0.0]))
            assert plan.room_index_at(moved.position_m[None])[0] == moved.room_index
            assert moved.photographs.keys() == camera.photographs.keys()


def test_every_photograph_identifies_its_copy() -> None:
    photographs = 0
    for name in AlteredScenes(HOMES, "copies").scenes("validation"):
        home, scene = HOMES.load(name), AlteredScenes(HOMES, "copies").load(name)
        rooms, plan = len(home.plan.rooms), scene.plan
        step_m = plan.rooms[rooms].polygon_m[0, 0] - home.plan.rooms[0].polygon_m[0, 0]
        for camera in scene.cameras:
            whole, room = divmod(camera.room_index, rooms)
            away = np.arange(4) - whole
            places, copies = camera.position_m + away[:, None] * np.array([step_m, 0.0]), room + rooms * np.arange(4)
            seen = sweep_layouts(places, np.zeros(4), copies, plan.wall_table, 128, camera.camera_height_m).kind
            lacking = (seen[whole] == OPENING_CLASSES.index("door")) & (seen != seen[whole])
            assert all(lacking[copy].sum() >= 2 for copy in range(4) if copy != whole)
            photographs += 1
    assert photographs >= 4


class _Doorless(GeneratedScenes):
    """Generated homes with windows instead of doors."""

    def load(self, name: str, problems: list[DatasetError] | None = None) -> Scene:
        home = super().load(name, problems)
        document = home.plan.to_dict()
        openings = [{**opening, "kind": "window"} for opening in document["openings"]]
        return dataclasses.replace(home, plan=FloorPlan.from_dict({**document, "openings": openings}))


def test_camera_without_door_in_view_is_left_out() -> None:
    assert AlteredScenes(_Doorless(homes=1), "copies").load("validation-00000").cameras == ()


def test_cameras_show_the_next_home() -> None:
    mismatched, own = (
        scenes.load("validation-00001") for scenes in (AlteredScenes(FURNISHED, "mismatched"), FURNISHED)
    )
    # The last home uses the first one beyond the split.
    following = FURNISHED.load("validation-00002")
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
    scene = AlteredScenes(FURNISHED, "mismatched").load("validation-00000")
    assert not any(isinstance(camera.photographs[LOOK], Cropped) for camera in scene.cameras)


def test_cropped_photograph_is_a_stretched_part() -> None:
    whole = FURNISHED.load("validation-00000").cameras[0].photographs[LOOK]
    picture, part = whole.image(40, 80), Cropped(whole).image(40, 80)
    assert part.shape == picture.shape
    assert np.array_equal(part[0, 0], picture[12, 20])
    assert np.array_equal(part[-1, -1], picture[27, 39])


def test_outdoor_photograph_has_no_walls() -> None:
    for seed in range(20):
        picture = OutdoorPhotograph(seed).image(64, 128).astype(float)
        # Azimuths differ by grain only.
        assert np.ptp(picture.mean(axis=0), axis=0).max() < 12.0
        assert np.array_equal(picture, OutdoorPhotograph(seed).image(64, 128))


class _Shaded:
    """Photograph whose brightness encodes the azimuth: dark in front, brighter towards the back."""

    def image(self, height: int, width: int) -> np.ndarray:
        away = np.abs(np.arange(width) + 0.5 - 0.5 * width) / (0.5 * width)
        return np.broadcast_to((60.0 + 120.0 * away).astype(np.uint8)[None, :, None], (height, width, 3)).copy()

    def depth_m(self) -> np.ndarray:
        return np.ones((8, 16))


def test_only_the_picture_is_disturbed() -> None:
    scene, own = AlteredScenes(FURNISHED, "disturbed").load("validation-00000"), FURNISHED.load("validation-00000")
    assert scene.plan.to_dict() == own.plan.to_dict()
    for camera, mine in zip(scene.cameras, own.cameras, strict=True):
        assert np.array_equal(camera.position_m, mine.position_m)
        assert (camera.room_index, camera.heading) == (mine.room_index, mine.heading)
        assert camera.camera_height_m == mine.camera_height_m
        picture, plain = camera.photographs[LOOK].image(16, 32), mine.photographs[LOOK].image(16, 32)
        assert picture.dtype == np.uint8
        assert picture.shape == plain.shape
        assert not np.array_equal(picture, plain)


def test_disturbance_depends_on_the_photograph_only_and_leaves_no_depth() -> None:
    first, again, different = (DisturbedPhotograph(_Shaded(), seed).image(16, 32) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, different)
    with pytest.raises(DatasetError, match="no depth"):
        DisturbedPhotograph(_Shaded(), 0).depth_m()


def test_length_error_is_ten_percent(monkeypatch: pytest.MonkeyPatch) -> None:
    """The direction at 45 degrees gives the ratio of the factors of width and depth."""
    monkeypatch.setattr(altered_homes, "_STRENGTH", 0.0)
    width, ratios = 256, []
    plain = _Shaded().image(1, width)[0, :, 0].astype(float)
    right = slice(width // 2, width)
    for seed in range(200):
        picture = DisturbedPhotograph(_Shaded(), seed).image(16, width)[8, :, 0].astype(float)
        shift = np.interp(picture[5 * width // 8], plain[right], np.arange(width)[right]) - 5 * width // 8
        ratios.append(np.tan(np.pi / 4 + shift / width * 2.0 * np.pi))
    assert np.std(np.log(ratios)) == pytest.approx(0.1 * np.sqrt(2.0), rel=0.2)
    assert np.mean(np.log(ratios)) == pytest.approx(0.0, abs=0.04)


def test_photographs_are_asked_for_in_other_buildings() -> None:
    homes = GeneratedScenes(homes=6, shots_per_home=2)
    own = homes.load("validation-00000")
    scenes = [AlteredScenes(homes, "foreign").load(f"validation-{number:05d}") for number in range(6)]
    # The next home, its walls alone, and offices, of which one shows its openings.
    assert [bool(scene.plan.openings) for scene in scenes] == [True, False, False, True, False, True]
    assert [scene.plan.name == "office" for scene in scenes] == [False, False, True] * 2
    assert all(len(scene.plan.rooms) > 10 for scene in scenes[2::3])
    for scene in scenes:
        places = np.stack([camera.position_m for camera in scene.cameras])
        assert (scene.plan.room_index_at(places) == [camera.room_index for camera in scene.cameras]).all()
    assert not np.array_equal(scenes[0].cameras[0].position_m, own.cameras[0].position_m)
    look = homes.appearances[0]
    shown, true = (scene.cameras[0].photographs[look].image(8, 16) for scene in (scenes[0], own))
    np.testing.assert_array_equal(shown, true)


def test_unopened_plans_show_walls_alone() -> None:
    homes = GeneratedScenes(homes=1)
    own, bare = (dataset.load("validation-00000") for dataset in (homes, AlteredScenes(homes, "unopened")))
    assert own.plan.openings
    assert not bare.plan.openings
    assert not bare.plan.opening_kinds
    assert [room.id for room in bare.plan.rooms] == [room.id for room in own.plan.rooms]
