"""Questions and queries about poses of small plans, runs and predictions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnxruntime
import torch

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import DatasetError
from lalaloc_core.evaluate.methods.method import Pose, Question
from lalaloc_core.evaluate.runs.predictions import Prediction, RunInfo
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Appearance, Camera, DatasetPhotograph
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.query import CameraHeight, PredictedProfile, Query
from lalaloc_core.nets.layout_network import RingLayoutEncoder
from lalaloc_core.render.profile import layout_depth, wall_profile
from lalaloc_core.render.sampling import PoseSet, pose_grid

CAMERA_M = 1.4


def question_at(
    plan: FloorPlan,
    position_m: tuple[float, float] | np.ndarray,
    *,
    step_m: float = 0.5,
    heading: float = 0.0,
    heading_known: bool = True,
    photograph: DatasetPhotograph | None = None,
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
        kind="layout" if photograph is None else "photograph",
        photograph=photograph,
        heading_known=heading_known,
    )


def perfect_query(
    encoders: PhotographEncoder,
    plan: FloorPlan,
    position_m: tuple[float, float] | np.ndarray,
    *,
    hypotheses: int = 1,
    log_scale: float | None = -4.0,
    height: CameraHeight | None = None,
) -> Query:
    """Return the query of a perfect image encoder at heading 0; `log_scale` None: without a profile."""
    height = height or CameraHeight(1.5)
    rolls = np.arange(hypotheses) * (TWO_PI / hypotheses)
    positions = np.tile(np.array(position_m, dtype=float), (hypotheses, 1))
    poses = PoseSet(positions, plan.room_index_at(positions))
    latents, profile_m = encoders.layouts.poses(plan, poses, -rolls, height.height_m)
    profile = None if log_scale is None else PredictedProfile(np.log(profile_m), np.full_like(profile_m, log_scale))
    return Query(latents, rolls, 0.0, heading_known=hypotheses == 1, camera_height=height, profile=profile)


def run_info(**changes: Any) -> RunInfo:
    """Return the description of a run of layout queries."""
    values: dict[str, Any] = {"label": "test", "method": "lalaloc", "kind": "layout", "dataset": "", "split": "test"}
    return RunInfo(**(values | changes))


def prediction_of(truth: Pose, **changes: Any) -> Prediction:
    """Return the prediction of a query without an answer; `changes` sets more."""
    values: dict[str, Any] = {"scene": "a", "camera": "0", "room": "kitchen", "camera_height_m": 1.5}
    return Prediction(truth=truth, **(values | changes))


@dataclass(frozen=True, eq=False)
class BareRoom:
    """DatasetPhotograph of an empty room with the depth of its layout and no pixels."""

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


def paint(profile_m: np.ndarray) -> np.ndarray:
    """Return a sphere (4, columns, 3) whose pixels encode the wall profile in units of 0.1 mm."""
    value = np.round(profile_m / 1e-4).astype(np.int64)
    return np.repeat(np.stack([value >> 16, value >> 8 & 255, value & 255], axis=-1)[None], 4, axis=0).astype(np.uint8)


class PaintedSession(onnxruntime.InferenceSession):
    """Fake session of the image encoder: decodes the painted profile and returns its ring under a ceiling of 2.5 m."""

    def __init__(self, encoder: RingLayoutEncoder) -> None:
        self.encoder = encoder

    def run(self, output_names: Any, input_feed: Any, run_options: Any = None) -> list[np.ndarray]:
        assert output_names == ["ring", "log_profile", "log_scale"]
        pixels = torch.from_numpy(input_feed["image"].astype(np.float32))[:, 0]
        profile = (pixels[..., 0] * 65536 + pixels[..., 1] * 256 + pixels[..., 2]) * 1e-4
        camera = torch.from_numpy(input_feed["camera_height_m"])
        ring = self.encoder.ring(profile, camera, torch.full_like(camera, 2.5)).numpy()
        return [ring, np.log(profile.numpy()), np.full_like(profile.numpy(), -5.0)]


HEADINGS = 32
# Place, number of the room, and heading of each photograph.
Walk = list[tuple[tuple[float, float], int, float]]


def queries_along(encoders: PhotographEncoder, plan: FloorPlan, walk: Walk, height: CameraHeight) -> list[Query]:
    """Return the queries of a perfect image encoder along a walk, headings unknown."""
    layouts, queries = encoders.layouts, []
    for place, room, heading in walk:
        pose = PoseSet(np.array([place]), np.array([room]))
        roll = np.arange(HEADINGS) * (math.tau / HEADINGS)
        profile_m = np.concatenate([layouts.profiles(plan, pose, np.array([heading - turn])) for turn in roll])
        profile = PredictedProfile(np.log(profile_m), np.full_like(profile_m, -3.0))
        latents = layouts.latents(profile_m, np.full(HEADINGS, height.height_m), np.full(HEADINGS, 2.5))
        queries.append(Query(latents, roll, 0.0, heading_known=False, camera_height=height, profile=profile))
    return queries
