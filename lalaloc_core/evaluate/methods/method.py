"""Question to a localisation method, and its answer; every row of a results table is one `Method`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import heading_from_degrees, heading_to_degrees
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Camera, DatasetPhotograph
from lalaloc_core.render.sampling import PoseSet
from lalaloc_core.render.sweep import profiles_at

# "layout": the query is the error-free layout of the true pose; "photograph": a photograph, or its depth for ICP.
QueryKind = Literal["layout", "photograph"]
EARLIER_KINDS = {"panorama": "photograph"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Question:
    """Query for a localisation method.

    A method may use the camera's height, its heading if `heading_known`, `photograph`, and, for layout queries,
    `true_profile`. The rest of the camera is the truth to predict. Poses of the grid are `grid_step_m` apart.
    """

    plan: FloorPlan
    grid: PoseSet
    grid_step_m: float
    camera: Camera
    kind: QueryKind
    photograph: DatasetPhotograph | None
    heading_known: bool = True

    @cached_property
    def ceiling_height_m(self) -> float:
        """Ceiling height of the true room, part of the true layout."""
        return float(self.plan.ceiling_heights_m[self.camera.room_index])

    def pose_of(self, poses: PoseSet, index: int, distance: float | None = None) -> Pose:
        """Return one of some poses, with the camera's heading."""
        return Pose.at(poses.position_m[index], poses.room_index[index], self.camera.heading, distance)

    def true_profile(self, columns: int) -> Float[np.ndarray, "{columns}"]:
        """Return the wall profile (m) of the true pose at heading 0, for layout queries and oracles."""
        room = np.array([self.camera.room_index])
        return profiles_at(self.plan, self.camera.position_m[None], room, np.zeros(1), columns)[0]

    def require_photograph(self) -> DatasetPhotograph:
        """Return the photograph of the query."""
        if self.photograph is None:
            raise InvalidInputError(f"this {self.kind} query has no photograph; the method needs one")
        return self.photograph


@dataclass(frozen=True, kw_only=True)
class Pose:
    """Pose in a plan; `distance` to the query by the method's own measure, None without one."""

    x_m: float
    y_m: float
    room_index: int
    heading_deg: float
    distance: float | None = None

    @classmethod
    def at(
        cls,
        position_m: Float[np.ndarray, "2"],
        room_index: int | np.integer,
        heading: float,
        distance: float | None = None,
    ) -> Pose:
        """Return the pose at a position, with a heading in radians."""
        x_m, y_m = map(float, position_m)
        heading_deg = heading_to_degrees(heading)
        return cls(x_m=x_m, y_m=y_m, room_index=int(room_index), heading_deg=heading_deg, distance=distance)

    @property
    def position_m(self) -> Float[np.ndarray, "2"]:
        """Position in the plan frame."""
        return np.array([self.x_m, self.y_m])

    @property
    def heading(self) -> float:
        """Heading in radians."""
        return heading_from_degrees(self.heading_deg)


@dataclass(frozen=True, kw_only=True)
class PredictedCandidate:
    """Candidate pose with its terms of the matching cost and its posterior probability."""

    pose: Pose
    terms: dict[str, float]
    probability: float


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Result of a method.

    Attributes:
        stages: the best pose after each stage, in order; the last is the final pose. Empty without an answer.
        retrieved: index of the retrieved grid pose; None for methods without retrieval.
        signals: inputs of the confidence model by stage; see `localise.belief.confidence`.
        information: curvature of the cost at the final pose; see `localise.query.poses.Candidate`.
        confidence: probability of a position error below 1 m; None without a confidence model.
        heading_confidence: probability of a heading error below 5°; None without a confidence model.
    """

    stages: dict[str, Pose] = field(default_factory=dict)
    candidates: tuple[PredictedCandidate, ...] = ()
    retrieved: int | None = None
    signals: dict[str, dict[str, float]] = field(default_factory=dict)
    information: Float[np.ndarray, "p p"] | None = None
    confidence: float | None = None
    heading_confidence: float | None = None
    camera_height_m: float | None = None
    timings_ms: dict[str, float] = field(default_factory=dict)

    def rank_of_room(self, room_index: int) -> int | None:
        """Return the rank of the best candidate in a room, from 1; None without a candidate there."""
        ranks = [rank for rank, candidate in enumerate(self.candidates, 1) if candidate.pose.room_index == room_index]
        return ranks[0] if ranks else None


@runtime_checkable
class Method(Protocol):
    """Localisation method. It caches what belongs to a plan (grids, point clouds) between questions."""

    def locate(self, question: Question) -> Answer:
        """Predict the camera pose of a question."""
        ...


# Queries arrive scene by scene and often share a camera height, so a small cache is enough.
GRIDS_CACHED = 4


def grid_key(_: object, question: Question) -> tuple[FloorPlan, float, float]:
    """Return the cache key of a grid. Plans compare by identity; the key keeps them alive."""
    return question.plan, question.camera.camera_height_m, question.grid_step_m
