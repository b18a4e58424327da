"""Plans with copies of a home: one equals the home, in the others doors are moved."""

from __future__ import annotations

import dataclasses

import numpy as np

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Scene
from lalaloc_core.learn.data.synthetic.copied import CopiedScenes
from lalaloc_core.learn.data.synthetic.generated import GeneratedScenes
from lalaloc_core.render.layout import layout_view

HOMES = GeneratedScenes(homes=3, shots_per_home=2)


def test_copies_differ_in_their_doors_only() -> None:
    for name in CopiedScenes(HOMES).scenes("validation"):
        home, scene = HOMES.load(name), CopiedScenes(HOMES).load(name)
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
    for name in CopiedScenes(HOMES).scenes("validation"):
        home, scene = HOMES.load(name), CopiedScenes(HOMES).load(name)
        rooms, plan = len(home.plan.rooms), scene.plan
        step_m = plan.rooms[rooms].polygon_m[0, 0] - home.plan.rooms[0].polygon_m[0, 0]
        for camera in scene.cameras:
            whole, room = divmod(camera.room_index, rooms)
            away = np.arange(4) - whole
            seen = layout_view(
                camera.position_m + away[:, None] * np.array([step_m, 0.0]),
                np.zeros(4),
                room + rooms * np.arange(4),
                plan.geometry,
                128,
                camera.camera_height_m,
            ).kind
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
    assert CopiedScenes(_Doorless(homes=1)).load("validation-00000").cameras == ()
