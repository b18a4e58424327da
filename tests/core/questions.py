"""Questions about poses of small plans, for tests of methods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lalaloc_core.errors import DatasetError
from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Appearance, Camera, Photograph
from lalaloc_core.render.depth import layout_depth
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.sampling import PoseSet, pose_grid

CAMERA_M = 1.4


def question_at(
    plan: FloorPlan,
    position_m: tuple[float, float] | np.ndarray,
    *,
    step_m: float = 0.5,
    heading: float = 0.0,
    heading_known: bool = True,
    photograph: Photograph | None = None,
    camera_height_m: float = CAMERA_M,
    grid: PoseSet | None = None,
) -> Question:
    """Return a question about a pose of a plan, with its photograph or, without one, its layout."""
    position = np.array(position_m, dtype=float)
    camera = Camera(
        name="0",
        position_m=position,
        room_index=int(plan.room_index_at(position[None])[0]),
        heading=heading,
        camera_height_m=camera_height_m,
        photographs={} if photograph is None else {Appearance(): photograph},
    )
    return Question(
        plan=plan,
        grid=pose_grid(plan, step_m) if grid is None else grid,
        grid_step_m=step_m,
        camera=camera,
        kind="layout" if photograph is None else "panorama",
        photograph=photograph,
        heading_known=heading_known,
    )


@dataclass(frozen=True, eq=False)
class BareRoom:
    """Photograph of an empty room with the depth of its layout and no pixels."""

    plan: FloorPlan
    position_m: tuple[float, float]
    heading: float
    rows: int = 64

    def image(self, height: int, width: int) -> np.ndarray:
        raise DatasetError("the room was measured, not photographed")

    def depth_m(self) -> np.ndarray:
        position = np.array([self.position_m])
        room = self.plan.room_index_at(position)
        walls = self.plan.walls_m[room]
        profile = wall_profile(position, np.array([self.heading]), walls, 2 * self.rows)
        return layout_depth(profile, np.array([CAMERA_M]), self.plan.ceiling_heights_m[room], self.rows)[0]
