"""Sessions of tracked cameras: the request that begins one, its photographs, and the answer."""

from __future__ import annotations

import math
from datetime import datetime
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field, field_validator, model_validator

from lalaloc_core.answer_numbers import HEADING_MEANING, Heading, HeadingDeg, Metres, Share, Variance
from lalaloc_core.localise.answers.documents import ModelAnswer, Position
from lalaloc_core.localise.answers.views import ReadView
from lalaloc_core.localise.tracking import Odometry
from lalaloc_core.localise.tracking.walk_motion import MAX_STEP_M, MAX_TURN, usual_stds
from service.schemas.fields import Finite, ResponseModel, needs, parse_json, reject_underscores
from service.schemas.localise_answer import GeoPose, TimingsAnswer
from service.schemas.photographs import PhotographFields
from service.schemas.query_fields import CameraFields, EarthPoint, PlaceFields, PlanPoint

# `Odometry` checks the limits of motions, which this only describes.
Step = Annotated[float, Finite, Field(json_schema_extra={"minimum": -MAX_STEP_M, "maximum": MAX_STEP_M})]
StepStd = Annotated[float, Finite, Field(json_schema_extra={"minimum": 0, "maximum": MAX_STEP_M})]
Row = Annotated[list[Annotated[float, Finite]], Field(min_length=3, max_length=3)]
_MAX_TURN_DEG = math.degrees(MAX_TURN)
_ROOMS = 100
PLAN_OF_POSE = "Floor plan of the pose, in whose frame it is; null for photographs of earlier versions."
LEVEL_OF_POSE = "Level of this plan in the venue; null for a session in one plan."
MAX_PATH = 200


class SessionDocument(PlaceFields, CameraFields):
    """Begin of a session: the plan or venue, the camera, and what is known about the place of the first photograph."""

    model_config = ConfigDict(json_schema_extra={"example": {"floorplan_id": "0" * 32, "camera_height_m": 1.5}})

    venue_id: str | None = Field(
        None, min_length=1, description="Id of a venue; the camera can move between its plans."
    )
    near: PlanPoint | EarthPoint | None = Field(
        None,
        description="Approximate place of the first photograph. Needs `radius_m`. In a venue, `x_m` and `y_m` need the "
        "venue's `anchor`.",
    )
    radius_m: Annotated[float, Finite] | None = Field(
        None, gt=0, le=1000, description="Largest distance of the first photograph from `near`."
    )
    rooms: Annotated[list[Annotated[str, Field(min_length=1)]], Field(min_length=1, max_length=_ROOMS)] | None = Field(
        None, description="Rooms that the first photograph can be in, by id or name."
    )
    level: Annotated[float, Finite] | None = Field(
        None, description="Level of the venue that the first photograph is on. Needs `venue_id`."
    )

    @model_validator(mode="after")
    def _check_near(self) -> Self:
        if self.level is not None and self.venue_id is None:
            raise ValueError("level needs venue_id instead of floorplan_id")
        if (self.near is None) != (self.radius_m is None):
            raise ValueError("near and radius_m are needed together")
        return self


class PhotographForm(PhotographFields):
    """Form fields of a photograph of a session; an empty field counts as left out.

    The motion is that since the photograph before, in the frame of the camera at that photograph.
    """

    number: int | None = Field(
        None, ge=1, description="Number of the photograph, from 1: 409 if it is not the next one of the session."
    )
    forward_m: Step | None = Field(None, description="Motion along the heading of the photograph before.")
    right_m: Step | None = Field(None, description="Motion to its right. Default: 0 if `forward_m` is given.")
    turn_deg: Annotated[float, Finite] | None = Field(
        None,
        json_schema_extra={"minimum": -_MAX_TURN_DEG, "maximum": _MAX_TURN_DEG},
        description="Heading of this photograph minus that of the one before, clockwise seen from above. Needs "
        "`forward_m`, which needs it.",
    )
    forward_std_m: StepStd | None = Field(
        None, description="Standard deviation of `forward_m`. Default: 5 % of the distance and 2 cm."
    )
    right_std_m: StepStd | None = Field(None, description="Standard deviation of `right_m`; default as before.")
    turn_std_deg: Annotated[float, Finite] | None = Field(
        None,
        json_schema_extra={"minimum": 0, "maximum": 360},
        description="Standard deviation of `turn_deg`. Default: 2° per metre and 1°.",
    )
    covariance: Annotated[list[Row], Field(min_length=3, max_length=3)] | None = Field(
        None,
        description="Covariance of `forward_m`, `right_m` and `turn_deg` as a JSON array of three rows, in m², m·° and "
        "°², instead of the standard deviations.",
    )
    heading_deg: Annotated[float, Finite] | None = Field(
        None, ge=-360, le=360, description=f"The {HEADING_MEANING}, if it is known."
    )
    heading_tolerance_deg: Annotated[float, Finite] = Field(
        0.0, ge=0, le=45, description="Largest error of `heading_deg`, as in `POST /localise`. Needs `heading_deg`."
    )

    _parse_covariance = field_validator("covariance", mode="before")(parse_json("a JSON array of three rows"))
    _check_numbers = field_validator("*", mode="before")(reject_underscores)
    _check_tolerance = field_validator("heading_tolerance_deg")(needs("heading_deg"))

    @model_validator(mode="after")
    def _check_motion(self) -> Self:
        if (self.forward_m is None) != (self.turn_deg is None):
            raise ValueError("forward_m and turn_deg are needed together")
        stds = self.forward_std_m, self.right_std_m, self.turn_std_deg
        rest = (self.right_m, *stds, self.covariance)
        if self.forward_m is None and any(value is not None for value in rest):
            raise ValueError("right_m, standard deviations and covariance need forward_m and turn_deg")
        if self.covariance is not None and any(value is not None for value in stds):
            raise ValueError("give the covariance or the standard deviations, not both")
        return self

    @property
    def odometry(self) -> Odometry | None:
        """The motion for the core, in radians; None if it was not measured."""
        if self.forward_m is None or self.turn_deg is None:
            return None
        right_m, turn = self.right_m or 0.0, math.radians(self.turn_deg)
        if self.covariance is not None:
            scale = np.array([1.0, 1.0, math.radians(1.0)])
            return Odometry(self.forward_m, right_m, turn, np.array(self.covariance) * np.outer(scale, scale))
        usual = usual_stds(math.hypot(self.forward_m, right_m))
        turn_std = None if self.turn_std_deg is None else math.radians(self.turn_std_deg)
        forward_std, right_std, turn_std = (
            default if given is None else given
            for given, default in zip((self.forward_std_m, self.right_std_m, turn_std), usual, strict=True)
        )
        return Odometry.of_stds(self.forward_m, right_m, turn, (forward_std, right_std, turn_std))


class PoseInPlan(ResponseModel):
    """Pose with its probability."""

    position: Position
    heading_deg: HeadingDeg = Field(ge=0, lt=360)
    room_id: str
    probability: Share
    floorplan_id: str | None = Field(None, description=PLAN_OF_POSE)
    level: float | None = Field(None, description=LEVEL_OF_POSE)


class RivalAnswer(PoseInPlan):
    """Possible pose of the last photograph."""

    room: str


class PathPoint(PoseInPlan):
    """Pose of one photograph of the path."""

    number: int = Field(description="Number of the photograph, from 1.")


TrackingMode = Literal["searching", "tracking", "lost"]
CovarianceRow = Annotated[list[Variance], Field(min_length=3, max_length=3)]


class TrackedPoseAnswer(ResponseModel):
    """Pose of the last photograph of a session."""

    number: int = Field(description="Number of the photograph, from 1.")
    position: Position
    heading_deg: Heading
    room: str
    room_id: str = Field(description="`id` of the room, unique in the plan.")
    floorplan_id: str | None = Field(None, description=PLAN_OF_POSE)
    level: float | None = Field(None, description=LEVEL_OF_POSE)
    covariance: Annotated[list[CovarianceRow], Field(min_length=3, max_length=3)] = Field(
        description="Covariance of x_m, y_m and heading_deg in m², m·° and °², given that the position is right within "
        "1 m."
    )
    probability: Share = Field(description="Probability that the position is right within 1 m.")
    camera_height_m: Metres = Field(description="Best-fitting camera height.")
    candidates: list[RivalAnswer] = Field(description="Possible poses, most probable first; the first is the answer.")
    motion_contradicted: list[Literal["forward_m", "right_m", "turn_deg"]] = Field(
        description="Components of the stated motion that the photographs contradict by more than 4 deviations."
    )
    warnings: list[str] = Field(
        description="Contradicted motions, odometry that is wrong again and again, plans that were not searched, and "
        "warnings about the photograph, also in `view`."
    )
    geopose: GeoPose | None = Field(None, description="Pose on Earth; null for a plan without an anchor.")
    view: ReadView | None = Field(
        None, description="Assumptions about the photograph; null for photographs of earlier versions."
    )
    timings_ms: TimingsAnswer
    model: ModelAnswer


class SessionAnswer(ResponseModel):
    """Session of a tracked camera."""

    id: str
    floorplan_id: str | None = Field(description="Id of the floor plan; null for a session in a venue.")
    floorplan_revision: str | None = Field(
        description="Revision of the plan, with which the session ends; null for a session in a venue."
    )
    venue_id: str | None = Field(None, description="Id of the venue; null for a session in one plan.")
    venue_revision: str | None = Field(
        None, description="Revision of the venue, with which the session ends; null for a session in one plan."
    )
    expires_at: datetime = Field(description="End of the session, unless a photograph comes before.")
    photographs: int = Field(description="Photographs so far.")
    mode: TrackingMode = Field(
        description="`tracking`: the pose is known; `searching`: several places are possible; `lost`: the photographs "
        "do not fit the plan."
    )
    pose: TrackedPoseAnswer | None = Field(description="Pose of the last photograph; null before the first.")
    path: list[PathPoint] = Field(description=f"Poses of the last {MAX_PATH} photographs.")


class StoredPose(ResponseModel):
    """Part of the answer that is stored with a session."""

    mode: TrackingMode
    pose: TrackedPoseAnswer
    path: list[PathPoint]

    def after(self, before: StoredPose | None) -> StoredPose:
        """Return the same with the end of the path before it."""
        path = [] if before is None else before.path
        return self.model_copy(update={"path": [*path, *self.path][-MAX_PATH:]})
