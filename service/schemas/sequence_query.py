"""What a query of several panoramas says beside them."""

from __future__ import annotations

import json
import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from lalaloc_core.localise.sequence import Motion
from lalaloc_core.localise.sequence.motion import MAX_DISTANCE_M, MIN_ANGLE_STD, MIN_DISTANCE_STD_M
from service.schemas.camera_fields import CameraFields
from service.schemas.fields import Finite

Angle = Annotated[float, Finite, Field(ge=-360, le=360)]
AngleStd = Annotated[float, Finite, Field(ge=math.degrees(MIN_ANGLE_STD), le=180)]
_UNKNOWN = Motion()


class StatedMotion(BaseModel):
    """What was measured of the motion from one panorama to the next; what was not is left out."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        json_schema_extra={"example": {"distance_m": 2.4, "distance_std_m": 0.12, "turn_deg": 35, "turn_std_deg": 2}},
    )

    distance_m: Annotated[float, Finite] | None = Field(
        None, ge=0, le=MAX_DISTANCE_M, description="Between the two places, as the crow flies."
    )
    distance_std_m: Annotated[float, Finite] = Field(
        _UNKNOWN.distance_std_m, ge=MIN_DISTANCE_STD_M, le=MAX_DISTANCE_M, description="Its standard deviation."
    )
    turn_deg: Angle | None = Field(
        None, description="Heading of the second panorama minus that of the first, clockwise seen from above."
    )
    turn_std_deg: AngleStd = Field(round(math.degrees(_UNKNOWN.turn_std), 6), description="Its standard deviation.")
    direction_deg: Angle | None = Field(
        None,
        description="Azimuth of the way from the first place to the second minus the heading of the first panorama. "
        "Needs `distance_m`.",
    )
    direction_std_deg: AngleStd = Field(
        round(math.degrees(_UNKNOWN.direction_std), 6), description="Its standard deviation."
    )

    @field_validator("direction_deg")
    @classmethod
    def _of_a_distance(cls, value: float | None, given: ValidationInfo) -> float | None:
        if value is not None and given.data.get("distance_m", 0.0) is None:
            raise ValueError("distance_m, whose direction this is, is missing")
        return value

    @property
    def motion(self) -> Motion:
        """The same in radians."""
        return Motion(
            distance_m=self.distance_m,
            distance_std_m=self.distance_std_m,
            turn=None if self.turn_deg is None else math.radians(self.turn_deg),
            turn_std=math.radians(self.turn_std_deg),
            direction=None if self.direction_deg is None else math.radians(self.direction_deg),
            direction_std=math.radians(self.direction_std_deg),
        )


class StatedHeading(BaseModel):
    """What is said of the heading of one panorama."""

    heading_deg: float | None
    heading_tolerance_deg: float


class SequenceForm(CameraFields):
    """Fields of a query of several panoramas; an empty field counts as left out."""

    floorplan_id: str = Field(min_length=1, description="Id of the floor plan the panoramas were taken in.")
    motions: list[StatedMotion | None] | None = Field(
        None,
        description="The motions between neighbouring panoramas, one less than there are of these, as a JSON array; "
        "null where nothing was measured. Left out: the panoramas have the plan and the camera's height in common.",
    )
    headings_deg: list[Angle | None] | None = Field(
        None,
        description="The heading of every panorama as a JSON array, null where it is unknown; see `heading_deg` of "
        "`POST /localise`. Left out: what their metadata say, else unknown.",
    )
    heading_tolerance_deg: Annotated[float, Finite] = Field(
        0.0, ge=0, le=45, description="How far off `headings_deg` may be; needs them."
    )
    refine: Literal["none", "lpo"] = Field(
        "lpo", description="How far to refine: nearest grid poses, or poses that are optimised together."
    )

    @field_validator("motions", "headings_deg", mode="before")
    @classmethod
    def _from_json(cls, value: object) -> object:
        if not isinstance(value, str):
            return value
        try:
            found = json.loads(value)
        except (ValueError, RecursionError) as error:
            raise ValueError("not a JSON array") from error
        if not isinstance(found, list):
            raise ValueError("not a JSON array")
        return found

    @field_validator("heading_tolerance_deg", mode="before")
    @classmethod
    def _plain_number(cls, value: object) -> object:
        if isinstance(value, str) and "_" in value:
            raise ValueError("not a number")
        return value

    @field_validator("heading_tolerance_deg")
    @classmethod
    def _of_headings(cls, value: float, given: ValidationInfo) -> float:
        if given.data.get("headings_deg", ()) is None:
            raise ValueError("headings_deg, whose tolerance this is, is missing")
        return value

    def faults(self, panoramas: int) -> list[tuple[str, str]]:
        """What does not go with so many panoramas."""
        wanted = {"motions": (self.motions, panoramas - 1), "headings_deg": (self.headings_deg, panoramas)}
        return [
            (name, f"has {len(given)} items, {panoramas} panoramas need {count}")
            for name, (given, count) in wanted.items()
            if given is not None and len(given) != count
        ]

    def steps(self, panoramas: int) -> list[Motion]:
        """The motions between so many panoramas."""
        given = self.motions or [None] * (panoramas - 1)
        return [_UNKNOWN if one is None else one.motion for one in given]

    def heading_of(self, index: int) -> StatedHeading:
        """What is said of the heading of one of the panoramas."""
        heading_deg = None if self.headings_deg is None else self.headings_deg[index]
        return StatedHeading(heading_deg=heading_deg, heading_tolerance_deg=self.heading_tolerance_deg)
