"""Venues: floor plans that belong together, on levels of their own."""

from __future__ import annotations

import unicodedata
from datetime import datetime
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from service.schemas.fields import ResponseModel, Share, SquareMetres
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
    Field(ge=-1000, le=1000, description="Number of the level, 0 for the ground; mezzanines have numbers in between."),
]


class Document(BaseModel):
    """Base of what is sent as JSON: numbers are numbers, and unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class VenueAnchorDocument(Document):
    """Where on Earth the origin of a venue's plans lies, WGS84, for plans that are all drawn in one frame."""

    latitude: float = Field(ge=-90, le=90, description="Degrees north.")
    longitude: float = Field(ge=-180, le=180, description="Degrees east.")
    altitude_m: float | None = Field(None, ge=-12_000, le=100_000, description="Height over the ellipsoid.")
    north_deg: float = Field(
        0.0, ge=-360, le=360, description="Azimuth of true north: degrees clockwise from the plans' +y."
    )


class VenuePlanDocument(Document):
    """A plan of a venue."""

    floorplan_id: str = Field(max_length=128, description="Id of a stored floor plan.")
    level: LevelNumber = 0.0
    name: Name | None = Field(None, description="What to call the plan here; by default its own name.")


class VenueDocument(Document):
    """A venue: a building, a campus, everything that is let in a street."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "name": "12 Mill Lane",
                "anchor": {"latitude": 51.7546, "longitude": -1.2545, "altitude_m": 61.0, "north_deg": 12.5},
                "plans": [{"floorplan_id": "b653a27fccab4a5dbff0c1e0cdd572a3", "level": 1, "name": "Flat 3"}],
            }
        }
    )

    name: Name = Field("venue", description="What to call the venue.")
    anchor: VenueAnchorDocument | None = None
    plans: list[VenuePlanDocument] = Field([], description="Its plans, each once.")


class VenueChangeDocument(Document):
    """What changes of a venue; what is left out stays as it is."""

    name: Name = Field("", validate_default=False, description="What to call the venue.")
    anchor: VenueAnchorDocument | None = Field(None, description="Its anchor; null takes it away.")
    plans: list[VenuePlanDocument] = Field([], description="Plans that come in, or change their level or name.")
    remove: list[str] = Field([], description="Ids of plans that leave the venue.")


class VenueAnchorAnswer(ResponseModel):
    """Where on Earth the origin of a venue's plans lies, WGS84."""

    latitude: float
    longitude: float
    altitude_m: float | None
    north_deg: float


class VenueSummary(ResponseModel):
    """A stored venue in a listing."""

    id: str = Field(description="Identifier for later requests.")
    revision: str = Field(description="Changes with the name, the anchor and the plans that belong to the venue.")
    name: str
    anchor: VenueAnchorAnswer | None
    plans: int = Field(description="Number of floor plans.")
    created_at: datetime
    updated_at: datetime


class VenueAnswer(VenueSummary):
    """A stored venue."""

    revision_number: int = Field(ge=1, description="How many revisions there have been, this one included.")
    plans_ready: int = Field(description="Plans that can be asked about.")
    plans_failed: int = Field(description="Plans that never will be, unless they are replaced.")


class VenueList(ResponseModel):
    """A page of stored venues, newest first."""

    venues: list[VenueSummary]
    next_cursor: str | None = Field(description="The `cursor` of the next page, null on the last one.")


class VenuePlanAnswer(ResponseModel):
    """A plan of a venue."""

    floorplan_id: str
    revision: str = Field(description="The plan's current revision.")
    level: float = Field(description="Number of its level.")
    name: str = Field(description="What it is called in the venue, else its own name.")
    status: PlanStatus
    progress: Share
    rooms: int = Field(description="Number of rooms.")
    area_m2: SquareMetres


class VenuePlanList(ResponseModel):
    """A page of the plans of a venue, by level."""

    plans: list[VenuePlanAnswer]
    next_cursor: str | None = Field(description="The `cursor` of the next page, null on the last one.")
