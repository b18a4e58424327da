"""Venues: groups of floor plans, each on a level."""

from __future__ import annotations

import unicodedata
from datetime import datetime
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from lalaloc_core.answer_numbers import Share, SquareMetres
from service.schemas.fields import ResponseModel
from service.schemas.stored_plans import PlanStatus

_NOT_TEXT = {"Cc", "Cs"}
_MAX_NAME = 200


def _text(value: str) -> str:
    if not value.strip():
        raise ValueError("must not be empty")
    if any(unicodedata.category(character) in _NOT_TEXT for character in value):
        raise ValueError("must not have control characters or lone surrogates")
    return value


Name = Annotated[str, Field(max_length=_MAX_NAME), AfterValidator(_text)]
LevelNumber = Annotated[
    float,
    Field(ge=-1000, le=1000, description="Number of the level, 0 for the ground floor; fractions for mezzanines."),
]


class Document(BaseModel):
    """Base of JSON request bodies: strict types, unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class VenueAnchorDocument(Document):
    """Place on Earth (WGS84) of the plans' common origin, for plans that are all drawn in one frame."""

    latitude: float = Field(ge=-90, le=90, description="Degrees north.")
    longitude: float = Field(ge=-180, le=180, description="Degrees east.")
    altitude_m: float | None = Field(None, ge=-12_000, le=100_000, description="Height over the ellipsoid.")
    north_deg: float = Field(
        0.0, ge=-360, le=360, description="Azimuth of true north: degrees clockwise from the plans' +y."
    )


class VenuePlanDocument(Document):
    """Plan of a venue."""

    floorplan_id: str = Field(max_length=128, description="Id of a stored floor plan.")
    level: LevelNumber = 0.0
    name: Name | None = Field(None, description="Name of the plan in the venue. Default: the plan's own name.")


class VenueDocument(Document):
    """Venue, such as a building or a campus."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "name": "12 Mill Lane",
                "anchor": {"latitude": 51.7546, "longitude": -1.2545, "altitude_m": 61.0, "north_deg": 12.5},
                "plans": [{"floorplan_id": "b653a27fccab4a5dbff0c1e0cdd572a3", "level": 1, "name": "Flat 3"}],
            }
        }
    )

    name: Name = Field("venue", description="Name of the venue.")
    anchor: VenueAnchorDocument | None = None
    plans: list[VenuePlanDocument] = Field([], description="Plans of the venue, without duplicates.")


class VenueChangeDocument(Document):
    """Changes to a venue; fields that are left out keep their value."""

    name: Name = Field("", validate_default=False, description="Name of the venue.")
    anchor: VenueAnchorDocument | None = Field(None, description="Anchor of the venue; null removes it.")
    plans: list[VenuePlanDocument] = Field([], description="Plans to add, or to give another level or name.")
    remove: list[str] = Field([], description="Ids of plans to remove.")


class VenueAnchorAnswer(ResponseModel):
    """Place on Earth (WGS84) of the plans' common origin."""

    latitude: float
    longitude: float
    altitude_m: float | None
    north_deg: float


class VenueSummary(ResponseModel):
    """Stored venue in a list."""

    id: str = Field(description="Id of the venue.")
    revision: str = Field(description="Id of the revision; it changes with the name, the anchor and the plans.")
    name: str
    anchor: VenueAnchorAnswer | None
    plans: int = Field(description="Number of floor plans.")
    created_at: datetime
    updated_at: datetime


class VenueAnswer(VenueSummary):
    """Stored venue."""

    revision_number: int = Field(ge=1, description="Number of the revision, from 1.")
    plans_ready: int = Field(description="Plans that are ready for queries.")
    plans_failed: int = Field(description="Plans that failed; replace them.")


class VenueList(ResponseModel):
    """Page of stored venues, newest first."""

    venues: list[VenueSummary]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last page.")


class VenuePlanAnswer(ResponseModel):
    """Plan of a venue."""

    floorplan_id: str
    revision: str = Field(description="Current revision of the plan.")
    level: float = Field(description="Level of the plan.")
    name: str = Field(description="Name of the plan in the venue, else the plan's own name.")
    status: PlanStatus
    progress: Share
    rooms: int = Field(description="Number of rooms.")
    area_m2: SquareMetres


class VenuePlanList(ResponseModel):
    """Page of a venue's plans, by level."""

    plans: list[VenuePlanAnswer]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last page.")
