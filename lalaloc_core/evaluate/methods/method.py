"""Question to a localisation method, and its answer; every row of a results table is one `Method`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.dataset import Camera, Photograph
from lalaloc_core.render.sweep import profiles_at
from lalaloc_core.render.sampling import PoseSet

# "layout": the query is the true layout, as if seen without error; "panorama": a photograph, or its depth for ICP.
QueryKind = Literal["layout", "panorama"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Question:
    """One query.

    A method may look at the camera's height, at its heading where `heading_known`, at `photograph`, and, for layout
    queries, at `true_profile`; the rest of the camera is the answer.

    Attributes:
        grid: poses of the plan that retrieval chooses from, `grid_step_m` apart.
        photograph: None for layout queries.
    """

    plan: FloorPlan
    grid: PoseSet
    grid_step_m: float
    camera: Camera
    kind: QueryKind
    photograph: Photograph | None
    heading_known: bool = True

    @cached_property
    def ceiling_height_m(self) -> float:
        """Ceiling of the true room, part of the true layout."""
        return float(self.plan.ceiling_heights_m[self.camera.room_index])

    def true_profile(self, columns: int) -> Float[np.ndarray, "{columns}"]:
        """Wall profile (m) of the true pose at heading 0: what a layout query knows, and what the oracle may use."""
        room = np.array([self.camera.room_index])
        return profiles_at(self.plan, self.camera.position_m[None], room, np.zeros(1), columns)[0]

    def require_photograph(self) -> Photograph:
        """The photograph of a panorama query.

        Raises:
            InvalidInputError: a layout query has none.
        """
        if self.photograph is None:
            raise InvalidInputError(f"a {self.kind} query has no photograph")
        return self.photograph


@dataclass(frozen=True, kw_only=True)
class FoundPose:
    """A pose that a method found; `heading` in radians, `distance` by the method's own measure."""

    x_m: float
    y_m: float
    room_index: int
    heading: float
    distance: float | None = None


@dataclass(frozen=True, kw_only=True)
class FoundCandidate:
    """A rival for the answer: its pose, what each term of the evidence says of it, and its posterior probability."""

    pose: FoundPose
    terms: dict[str, float]
    probability: float


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a method found.

    Attributes:
        stages: the best pose after each stage, in order; the last is the answer. Empty: no answer.
        candidates: the answer and its rivals, best first, where the method has any.
        retrieved: number of the grid pose that retrieval chose; None for methods that do not retrieve.
        signals: by stage, what speaks for its pose and against it; see `localise.confidence`.
        information: curvature of the cost at the answer, see `localise.poses.Candidate`.
        confidence: probability of being within 1 m, where the method has a model of it.
        heading_confidence: probability that the heading is right within 5°, likewise.
        camera_height_m: the height that fits best, where it was solved for.
        timings_ms: wall-clock per stage.
    """

    stages: dict[str, FoundPose] = field(default_factory=dict)
    candidates: tuple[FoundCandidate, ...] = ()
    retrieved: int | None = None
    signals: dict[str, dict[str, float]] = field(default_factory=dict)
    information: Float[np.ndarray, "p p"] | None = None
    confidence: float | None = None
    heading_confidence: float | None = None
    camera_height_m: float | None = None
    timings_ms: dict[str, float] = field(default_factory=dict)

    def rank_of_room(self, room_index: int) -> int | None:
        """Rank of the best candidate in a room, from 1; None where there is none."""
        ranks = [rank for rank, one in enumerate(self.candidates, start=1) if one.pose.room_index == room_index]
        return ranks[0] if ranks else None


@runtime_checkable
class Method(Protocol):
    """A way to localise. Methods keep what belongs to a plan (grids, point clouds) from one question to the next."""

    def locate(self, question: Question) -> Answer:
        """Find the camera of a question."""
        ...


# Queries come scene by scene, and cameras of a scene often share a height: a few are enough.
GRIDS_CACHED = 4


def grid_key(_: object, question: Question) -> tuple[FloorPlan, float, float]:
    """Key of what is made of a question's grid; plans are compared by identity, and kept alive by the key."""
    return question.plan, question.camera.camera_height_m, question.grid_step_m


def plan_key(_: object, question: Question) -> FloorPlan:
    """Key of what is made of a question's plan."""
    return question.plan
