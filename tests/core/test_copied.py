"""Copies of a home that differ in their doors: one of them is the photographed home, the others lack doors of it."""

from __future__ import annotations

import numpy as np

from lalaloc_core.data.synthetic.copied import CopiedScenes
from lalaloc_core.data.synthetic.generated import GeneratedScenes

HOMES = GeneratedScenes(homes=3, shots_per_home=2)


def test_copies_differ_in_their_doors_only_and_the_camera_stands_in_the_whole_one() -> None:
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
        assert doors[whole] == sum(one.kind == "door" for one in home.plan.openings) > 0
        assert all(doors[copy] < doors[whole] for copy in range(4) if copy != whole)
        for kind in ("window", "passage"):
            assert len(set(counts[kind].tolist())) == 1
        for moved, camera in zip(scene.cameras, home.cameras, strict=True):
            np.testing.assert_allclose(moved.position_m, camera.position_m + np.array([whole * step_m, 0.0]))
            assert plan.room_index_at(moved.position_m[None])[0] == moved.room_index
            assert moved.photographs.keys() == camera.photographs.keys()
