"""Form fields that queries share: camera height, number of candidates, hints about the place; form of a query."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from lalaloc_core.answer_numbers import HEADING_MEANING
from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M
from lalaloc_core.floorplan import MAX_CAMERA_HEIGHT_STD_M
from lalaloc_core.localise.query import DEFAULT_STD_M, UNKNOWN_RANGE_M
from lalaloc_core.localise.query.hints import RADIUS_RANGE_M
from service.schemas.fields import Finite, needs, parse_json, reject_underscores
from service.schemas.photographs import PhotographFields


class HeightFields(BaseModel):
    """Form fields for the camera height."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    camera_height_m: Annotated[float, Finite] | None = Field(
        None,
        ge=MIN_CAMERA_HEIGHT_M,
        description="Height of the camera over the floor. Default: the plan's camera height; if the plan has none, all "
        f"heights from {UNKNOWN_RANGE_M[0]:g} to {UNKNOWN_RANGE_M[1]:g} are searched.",
    )
    camera_height_std_m: Annotated[float, Finite] | None = Field(
        None,
        ge=0,
        le=MAX_CAMERA_HEIGHT_STD_M,
        description="Standard deviation of the camera height, whose exact value is then solved for. 0: the height is "
        f"exact. Default: the plan's, else {DEFAULT_STD_M:g}.",
    )
    _check_heights = field_validator("camera_height_m", "camera_height_std_m", mode="before")(reject_underscores)


class CameraFields(HeightFields):
    """Form fields for the camera height and the number of candidates."""

    top_k: int = Field(
        5,
        ge=1,
        description="Number of distinct candidates to return, up to `max_top_k`.",
        json_schema_extra={"maximum": 100},
    )

    _check_count = field_validator("top_k", mode="before")(reject_underscores)

    @field_validator("top_k")
    @classmethod
    def _check_limit(cls, value: int, info: ValidationInfo) -> int:
        limit = (info.context or {}).get("max_top_k", math.inf)
        if value > limit:
            raise ValueError(f"the limit is {limit} (max_top_k)")
        return value


class PlaceFields(BaseModel):
    """Form fields for the plan or the venue that is searched."""

    venue_id: str | None = Field(None, min_length=1, description="Id of a venue, to search all its plans.")
    floorplan_id: str | None = Field(
        None,
        min_length=1,
        description="Id of the floor plan. Either this or `venue_id` is required.",
        validate_default=True,
    )

    @field_validator("floorplan_id")
    @classmethod
    def _check_place(cls, value: str | None, given: ValidationInfo) -> str | None:
        # An invalid venue is missing from the data and reported already.
        if "venue_id" in given.data:
            if value is None and given.data["venue_id"] is None:
                raise PydanticCustomError("missing", "missing")
            if value is not None and given.data["venue_id"] is not None:
                raise ValueError("set floorplan_id or venue_id, not both")
        return value


_MAX_ROOMS = 100
_A_POINT = '{"x_m": 3.5, "y_m": 2.0}'
_parse_point = parse_json(f"a JSON object such as {_A_POINT}", dict)
_parse_rooms = parse_json('a JSON array such as ["kitchen", "hall"]')
_ON_EARTH = '{"latitude": 48.13722, "longitude": 11.57569}'


class PlanPoint(BaseModel, frozen=True, extra="forbid", json_schema_extra={"example": {"x_m": 3.5, "y_m": 2.0}}):
    """Point in the plan frame."""

    x_m: Annotated[float, Finite] = Field(description="Metres to the right on the drawing.")
    y_m: Annotated[float, Finite] = Field(description="Metres up on the drawing.")


class EarthPoint(
    BaseModel, frozen=True, extra="forbid", json_schema_extra={"example": {"latitude": 48.13722, "longitude": 11.57569}}
):
    """Place on Earth, WGS84."""

    latitude: Annotated[float, Finite] = Field(ge=-90, le=90, description="Degrees north.")
    longitude: Annotated[float, Finite] = Field(ge=-180, le=180, description="Degrees east.")

    def __str__(self) -> str:
        return f"latitude {self.latitude:.7g}, longitude {self.longitude:.7g}"


class HintFields(BaseModel):
    """Form fields with hints about the place: priors, or hard limits if `strict` is set."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    near: PlanPoint | EarthPoint | None = Field(
        None,
        description=f"Approximate place of the camera as a JSON object, such as `{_A_POINT}`, or `{_ON_EARTH}` for "
        "plans and venues with an `anchor`. It must lie within `radius_m` of a room. In a venue, `x_m` and `y_m` need "
        "the venue's `anchor`, which puts all its plans into one frame.",
    )
    radius_m: Annotated[float, Finite] | None = Field(
        None,
        ge=RADIUS_RANGE_M[0],
        le=RADIUS_RANGE_M[1],
        description="Largest distance of the camera from `near` in metres; required with `near`.",
        validate_default=True,
    )
    rooms: Annotated[list[Annotated[str, Field(min_length=1)]], Field(min_length=1, max_length=_MAX_ROOMS)] | None = (
        Field(
            None,
            description="Rooms that the camera can be in, as a JSON array of ids or names; a single room can be given "
            "without brackets. In a venue, rooms of all plans count.",
        )
    )
    level: Annotated[float, Finite] | None = Field(
        None, ge=-1000, le=1000, description="Level of the venue that the camera is on. Needs `venue_id`."
    )
    strict: bool = Field(
        False,
        description="Search only places that agree with the hints and the given heading. Otherwise a photograph that "
        "clearly contradicts them overrules them, with a warning in the answer.",
    )

    @field_validator("near", mode="before")
    @classmethod
    def _parse_point(cls, value: object) -> object:
        if not isinstance(value, str):
            return value
        found: Any = _parse_point(value)
        # Chosen by the keys, so that errors are about the kind of point that was meant.
        return (EarthPoint if found.keys() & EarthPoint.model_fields.keys() else PlanPoint).model_validate(found)

    @field_validator("rooms", mode="before")
    @classmethod
    def _parse_rooms(cls, value: object) -> object:
        if not isinstance(value, str):
            return value
        if not value.lstrip().startswith("["):
            return [value]
        return _parse_rooms(value)

    _check_hint_numbers = field_validator("radius_m", "level", mode="before")(reject_underscores)

    @field_validator("radius_m")
    @classmethod
    def _check_radius(cls, value: float | None, given: ValidationInfo) -> float | None:
        # An invalid point is missing from the data and reported already.
        if "near" in given.data and (given.data["near"] is None) != (value is None):
            raise ValueError("needs near" if value is not None else "is missing; near needs a radius")
        return value


class LocaliseForm(PlaceFields, CameraFields, HintFields, PhotographFields):
    """Form fields of a query, without the photograph; an empty field counts as left out."""

    heading_deg: Annotated[float, Finite] | None = Field(
        None,
        ge=-360,
        le=360,
        description=f"The {HEADING_MEANING}. Default: the heading in the photograph's metadata "
        "(`GPano:PoseHeadingDegrees`) if the plan has `north_deg`; else all headings are searched.",
    )
    heading_tolerance_deg: Annotated[float, Finite] = Field(
        0.0,
        ge=0,
        le=45,
        description="Tolerance of `heading_deg`: headings within it are searched and refined. 0: the heading is exact. "
        "Needs `heading_deg`.",
    )
    refine: Literal["none", "vdr", "lpo"] = Field(
        "lpo",
        description="Last stage: nearest pose of the grid (`none`), denser poses around it (`vdr`), or pose refinement "
        "(`lpo`).",
    )

    include: Literal["posterior"] | None = Field(
        None, description="Extra part of the answer: the posterior over all places of the plan."
    )

    @field_validator("include")
    @classmethod
    def _check_include(cls, value: str | None, given: ValidationInfo) -> str | None:
        if value is not None and given.data.get("venue_id") is not None:
            raise ValueError("works for one plan, not for a venue")
        return value

    _check_numbers = field_validator("heading_deg", "heading_tolerance_deg", mode="before")(reject_underscores)
    _check_tolerance = field_validator("heading_tolerance_deg")(needs("heading_deg"))

    @field_validator("floorplan_id")
    @classmethod
    def _check_level(cls, value: str | None, given: ValidationInfo) -> str | None:
        if value is not None and given.data.get("level") is not None:
            raise ValueError("level needs venue_id instead of floorplan_id")
        return value
