"""Form fields of a query."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from service.schemas.fields import Finite
from service.schemas.form_validators import needs, reject_underscores
from service.schemas.photographs import PhotographFields
from service.schemas.query_fields import CameraFields, HintFields, PlaceFields

HEADING_MEANING = "azimuth of the photograph's centre, clockwise from the plan's +y seen from above"


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
