"""What a query may say of where the camera stood."""

from __future__ import annotations

import json
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from lalaloc_core.localise.hints import RADIUS_RANGE_M
from service.schemas.fields import Finite

# Longer lists are no hints.
_MAX_ROOMS = 100
_A_POINT = '{"x_m": 3.5, "y_m": 2.0}'
_ON_EARTH = '{"latitude": 48.13722, "longitude": 11.57569}'


class PlanPoint(BaseModel):
    """A point of the plan frame."""

    model_config = ConfigDict(frozen=True, extra="forbid", json_schema_extra={"example": {"x_m": 3.5, "y_m": 2.0}})

    x_m: Annotated[float, Finite] = Field(description="To the right on the drawing.")
    y_m: Annotated[float, Finite] = Field(description="Up on the drawing.")


class EarthPoint(BaseModel):
    """A place on Earth, WGS84."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", json_schema_extra={"example": {"latitude": 48.13722, "longitude": 11.57569}}
    )

    latitude: Annotated[float, Finite] = Field(ge=-90, le=90, description="Degrees north.")
    longitude: Annotated[float, Finite] = Field(ge=-180, le=180, description="Degrees east.")

    def __str__(self) -> str:
        return f"latitude {self.latitude:.7g}, longitude {self.longitude:.7g}"


class HintFields(BaseModel):
    """Fields of a form that hint at the place: priors, and fences only if they are strict."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    near: PlanPoint | EarthPoint | None = Field(
        None,
        description=f"Where the camera stood, about, as a JSON object such as `{_A_POINT}`, or for plans and venues "
        f"with an `anchor` `{_ON_EARTH}`; at most `radius_m` from a room. In a venue, `x_m` and `y_m` are in the frame "
        "that its `anchor` says all plans share.",
    )
    radius_m: Annotated[float, Finite] | None = Field(
        None,
        ge=RADIUS_RANGE_M[0],
        le=RADIUS_RANGE_M[1],
        description="How far from `near` the camera may have stood; needed with it.",
        validate_default=True,
    )
    rooms: Annotated[list[Annotated[str, Field(min_length=1)]], Field(min_length=1, max_length=_MAX_ROOMS)] | None = (
        Field(
            None,
            description="In which of the plan's rooms the camera stood, as a JSON array of ids or names; a single one "
            "may be given plainly. In a venue, those of all plans that have one.",
        )
    )
    level: Annotated[float, Finite] | None = Field(
        None, ge=-1000, le=1000, description="On which level of the venue the camera stood. Needs `venue_id`."
    )
    strict: bool = Field(
        False,
        description="Whether hints, and a given heading, are fences: nothing else is looked at. If not, the panorama "
        "overrules them where it says otherwise clearly, with a warning in the answer.",
    )

    @field_validator("near", mode="before")
    @classmethod
    def _from_json(cls, value: object) -> object:
        if not isinstance(value, str):
            return value
        try:
            found = json.loads(value)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"not a JSON object such as {_A_POINT}") from error
        if not isinstance(found, dict):
            raise ValueError(f"not a JSON object such as {_A_POINT}")
        # By its keys, so that what is said to be wrong is wrong with the kind of point that is meant.
        return (EarthPoint if found.keys() & EarthPoint.model_fields.keys() else PlanPoint).model_validate(found)

    @field_validator("rooms", mode="before")
    @classmethod
    def _one_or_more(cls, value: object) -> object:
        if not isinstance(value, str):
            return value
        if not value.lstrip().startswith("["):
            return [value]
        try:
            return json.loads(value)
        except (ValueError, RecursionError) as error:
            raise ValueError('not a JSON array such as ["kitchen", "hall"]') from error

    @field_validator("radius_m", "level", mode="before")
    @classmethod
    def _without_underscores(cls, value: object) -> object:
        if isinstance(value, str) and "_" in value:
            raise ValueError("not a number")
        return value

    @field_validator("radius_m")
    @classmethod
    def _of_a_point(cls, value: float | None, given: ValidationInfo) -> float | None:
        # What is wrong with the point is told already where it is not among the data.
        if "near" in given.data and (given.data["near"] is None) != (value is None):
            missing = (
                "near, around which it is, is missing" if value is not None else "is missing: how far off is near?"
            )
            raise ValueError(missing)
        return value
