"""What a query says beside the panorama."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from service.schemas.camera_fields import CameraFields
from service.schemas.fields import Finite
from service.schemas.hint_fields import HintFields

HEADING_MEANING = "azimuth of the panorama's centre column, clockwise from the plan's +y seen from above"


class LocaliseForm(CameraFields, HintFields):
    """Fields of a query besides the panorama itself; an empty field counts as left out."""

    venue_id: str | None = Field(
        None, min_length=1, description="Id of the venue in one of whose plans the panorama was taken, not known which."
    )
    floorplan_id: str | None = Field(
        None,
        min_length=1,
        description="Id of the floor plan the panorama was taken in. Either this or `venue_id` is needed.",
        validate_default=True,
    )
    heading_deg: Annotated[float, Finite] | None = Field(
        None,
        ge=-360,
        le=360,
        description=f"The {HEADING_MEANING}; left out: what the panorama's metadata say (`GPano:PoseHeadingDegrees`), "
        "where the plan has `north_deg`, else unknown and searched over.",
    )
    heading_tolerance_deg: Annotated[float, Finite] = Field(
        0.0,
        ge=0,
        le=45,
        description="How far off `heading_deg` may be: it is then searched for within that, to the next sector of the "
        "model's ring, and refined. 0: it is exact. Needs `heading_deg`.",
    )
    refine: Literal["none", "vdr", "lpo"] = Field(
        "lpo", description="How far to refine: nearest grid pose, denser poses around it, or optimised pose."
    )

    include: Literal["posterior"] | None = Field(
        None, description="What else to tell: how probable all places of the plan are."
    )

    @field_validator("include")
    @classmethod
    def _of_one_plan(cls, value: str | None, given: ValidationInfo) -> str | None:
        if value is not None and given.data.get("venue_id") is not None:
            raise ValueError("is about the places of one plan, and not of a venue")
        return value

    @field_validator("heading_deg", "heading_tolerance_deg", mode="before")
    @classmethod
    def _plain_number(cls, value: object) -> object:
        if isinstance(value, str) and "_" in value:
            raise ValueError("not a number")
        return value

    @field_validator("floorplan_id")
    @classmethod
    def _plan_or_venue(cls, value: str | None, given: ValidationInfo) -> str | None:
        venue_id = given.data.get("venue_id")
        if value is None and venue_id is None and "venue_id" in given.data:
            raise PydanticCustomError("missing", "missing")
        if venue_id is not None and value is not None:
            raise ValueError("venue_id is given as well, one of the two is needed")
        if value is not None and given.data.get("level") is not None:
            raise ValueError("level is given as well, which is of the plans of a venue: one plan is on one level")
        return value

    @field_validator("heading_tolerance_deg")
    @classmethod
    def _of_a_heading(cls, value: float, given: ValidationInfo) -> float:
        if given.data.get("heading_deg", 0.0) is None:
            raise ValueError("heading_deg, whose tolerance this is, is missing")
        return value
