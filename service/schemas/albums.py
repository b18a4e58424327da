"""Albums: photographs of a plan or venue that are solved together, their corrections and their pins."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal, Self

from pydantic import AliasChoices, BaseModel, ConfigDict, Field, model_validator

from lalaloc_core.answer_numbers import HEADING_MEANING, Degrees, HeadingDeg, Metres, Score, Share, SignedDegrees
from lalaloc_core.localise.answers.documents import Position
from lalaloc_core.localise.answers.views import ReadView
from service.schemas.fields import CoreAnswer, Problem, ResponseModel
from service.schemas.localise_answer import GeoPose
from service.schemas.photographs import PhotographFields
from service.schemas.query_fields import HeightFields, PlaceFields, PlanPoint
from service.schemas.venues import Document, Name

PinStateName = Literal["sure", "uncertain", "set_aside", "corrected"]
AlbumStateName = Literal["empty", "solving", "solved", "failed", "outdated"]
_MAX_ID = 128


class AlbumDocument(PlaceFields, HeightFields, PhotographFields):
    """Album of a plan or venue, and what is known about the camera of its photographs."""

    model_config = ConfigDict(json_schema_extra={"example": {"floorplan_id": "0" * 32, "name": "Visit in May"}})

    name: Name = Field("album", description="Name of the album.")


class AlbumPhotographForm(BaseModel, frozen=True, extra="forbid"):
    """Form fields beside the photographs of an album: none, as the album states its camera."""


class CorrectionDocument(Document):
    """Place of a photograph as a person states it: one of `room_id`, `position`, `elsewhere` and `confirmed`."""

    room_id: Annotated[str, Field(min_length=1, max_length=_MAX_ID)] | None = Field(
        default=None, description="`id` of the room of the photograph."
    )
    position: PlanPoint | None = Field(default=None, description="Place of the camera, in a room of the plan.")
    heading_deg: float | None = Field(
        default=None, ge=-360, le=360, description=f"The {HEADING_MEANING}. Goes with `position`; null: unknown."
    )
    elsewhere: Literal[True] | None = Field(default=None, description="The photograph is of none of the rooms.")
    confirmed: Literal[True] | None = Field(default=None, description="The pin is right as it is.")
    floorplan_id: Annotated[str, Field(min_length=1, max_length=_MAX_ID)] | None = Field(
        default=None,
        description="Floor plan of `room_id` or `position`. Default: the album's plan; in a venue, that of the pin.",
    )

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        kinds = ("room_id", "position", "elsewhere", "confirmed")
        given = [name for name in kinds if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of {', '.join(kinds)}")
        if self.heading_deg is not None and self.position is None:
            raise ValueError("heading_deg goes with position")
        if self.floorplan_id is not None and given[0] in kinds[2:]:
            raise ValueError(f"floorplan_id does not go with {given[0]}")
        return self


class PhotographChangeDocument(Document):
    """Change of a photograph in an album."""

    model_config = ConfigDict(
        json_schema_extra={"example": {"correction": {"position": {"x_m": 3.5, "y_m": 2.0}, "heading_deg": 90}}}
    )

    correction: CorrectionDocument | None = Field(description="The correction; null undoes it.")


class PinPlace(ResponseModel):
    """Place and direction of a photograph."""

    floorplan_id: str = Field(description="Plan of the position.")
    floorplan_revision: str = Field(description="Revision of the plan that the place is in.")
    level: float | None = Field(description="Level of the plan in the venue; null for an album of one plan.")
    room: str
    room_id: str = Field(description="`id` of the room, unique in the plan.")
    position: Position
    heading_deg: HeadingDeg | None = Field(description=f"The {HEADING_MEANING}; null where it is unknown.")


class PinSuggestion(PinPlace):
    """Place that the photograph can have been taken at."""

    probability: Share


class RoomProbability(ResponseModel):
    """Probability of one room."""

    floorplan_id: str
    room: str
    room_id: str
    probability: Share


class MovedFrom(ResponseModel):
    """Change of a pin by a new revision of the plan: more than 0.5 m, or another room."""

    before: PinPlace | None = Field(description="The pin in the earlier revision; null where it was set aside.")
    distance_m: Metres | None = Field(description="Distance to it; null between plans and for pins set aside.")
    new_room: bool = Field(description="The room is another one.")


class PinAnswer(ResponseModel):
    """Pin of a photograph: its place, and how sure it is."""

    state: PinStateName = Field(
        description="`sure`: the room is probably right; `uncertain`: look at `suggestions`; `set_aside`: of none of "
        "the rooms, for `reason`; `corrected`: a person stated it."
    )
    place: PinPlace | None = Field(description="Null for a photograph that is set aside.")
    room_confidence: Share = Field(
        # Stored pins of earlier versions have the other name alone.
        validation_alias=AliasChoices("room_confidence", "confidence"),
        description="Probability that the room is right; 1 for a corrected pin.",
    )
    confidence: Share = Field(description="The same as `room_confidence`, its earlier name.")
    within_1m: Share = Field(description="Probability that the position is right within 1 m.")
    reason: str = Field(description="Reason why the pin is uncertain or set aside; else empty.")
    rooms: list[RoomProbability] = Field(description="Probable rooms, the most probable first.")
    suggestions: list[PinSuggestion] = Field(description="Up to five places, the most probable first.")
    warnings: list[str]
    geopose: GeoPose | None = Field(
        description="Pose on Earth, from the `anchor` of the plan, else of the venue; null without one."
    )
    moved: MovedFrom | None = Field(description="Change by the latest revision of the plan; null if there was none.")


class PhotographFacts(CoreAnswer, ReadView, frozen=True):
    """Facts about a photograph that are kept beside its features. Positions and names in its metadata are not kept."""

    taken_at: str | None = Field(description="Time by the camera's clock, without a time zone.")
    make: str | None = Field(description="Maker of the camera.")
    model: str | None = Field(description="Model of the camera.")
    width: int | None = Field(description="Size of the upright picture, pixels; null for features.")
    height: int | None


class AlbumPhotographAnswer(ResponseModel):
    """Photograph of an album."""

    id: str = Field(description="Id of the photograph.")
    number: int = Field(ge=1, description="Position in the album, in the order of uploads; numbers of pins.")
    revision: str = Field(description="Id of the revision; it changes with the correction. `If-Match` compares it.")
    name: str | None = Field(description="Name of the file.")
    sha256: str = Field(description="Digest of the file, by which the same picture is added once.")
    added_at: datetime
    view: PhotographFacts
    correction: CorrectionDocument | None
    pin: PinAnswer | None = Field(description="Null until the album is solved with this photograph.")


class AlbumPhotographList(ResponseModel):
    """Page of the photographs of an album, in the order of uploads."""

    photographs: list[AlbumPhotographAnswer]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last page.")


class AlbumLine(ResponseModel):
    """Line of the answer to an upload of photographs: a photograph, or a problem."""

    index: int = Field(description="Number of the photograph in the request, from 0.")
    name: str | None = Field(default=None, description="File name of the photograph in the request.")
    status: int = Field(description="201 for a new photograph, 200 for one that the album has already, else an error.")
    photograph: AlbumPhotographAnswer | None = Field(
        default=None, description="The stored photograph; null for a problem."
    )
    problem: Problem | None = Field(default=None, description="Null if the photograph is in the album.")
    retry_after_s: int | None = Field(
        default=None, description="Seconds after which the photograph can be sent again; null if that does not help."
    )


class PinCounts(ResponseModel):
    """Numbers of photographs by the state of their pins, as of the last solution."""

    sure: int
    uncertain: int
    set_aside: int
    corrected: int
    moved: int = Field(description="Pins that the latest revision of the plan moved.")


class SharedCameraAnswer(ResponseModel):
    """Camera whose photographs share their field of view."""

    make: str
    model: str
    width: int = Field(description="The longer side, pixels.")
    height: int = Field(description="The shorter side, pixels.")
    photographs: int
    hfov_deg: Degrees = Field(description="Horizontal field of view of its first photograph.")
    hfov_std_deg: Degrees


class AlbumSolution(ResponseModel):
    """Properties that all photographs of an album have in common."""

    pins: PinCounts
    cameras: list[SharedCameraAnswer]
    camera_height_m: Metres | None = Field(description="Height of the cameras over the floor.")
    scale: Score = Field(description="Factor of the plan's lengths that fits the photographs best.")
    compass_bias_deg: SignedDegrees | None = Field(
        description="Error of the compass; null without photographs that have a compass heading."
    )
    warnings: list[str]


class AlbumSummary(ResponseModel):
    """Album in a list."""

    id: str = Field(description="Id of the album.")
    revision: str = Field(description="Id of the revision; it changes with the photographs and their corrections.")
    revision_number: int = Field(ge=1, description="Number of the revision, from 1.")
    name: str
    floorplan_id: str | None = Field(description="Plan of the album; null for an album of a venue.")
    venue_id: str | None = Field(description="Venue of the album; null for an album of one plan.")
    state: AlbumStateName = Field(
        description="`empty`; `solving`: pins are those before the latest change; `solved`; `failed`, for `reason`; "
        "`outdated`: the features are those of an earlier model, so that the album can only be read."
    )
    progress: Share = Field(description="Share of the photographs that were compared while it is solved.")
    reason: str | None = Field(description="Reason why the album could not be solved.")
    photographs: int = Field(description="Number of photographs.")
    solved_revision_number: int = Field(description="Revision that the pins are of; 0 before the first solution.")
    created_at: datetime
    updated_at: datetime
    expires_at: datetime = Field(description="Time at which the album is deleted, unless it changes before.")


class AlbumAnswer(AlbumSummary):
    """Album."""

    place_revision: str | None = Field(description="Revision of the plan or venue that the pins are of.")
    model_sha256: str = Field(description="Digest of the model that encoded the photographs.")
    solution: AlbumSolution | None = Field(description="Null before the first solution.")


class AlbumList(ResponseModel):
    """Page of albums, newest first."""

    albums: list[AlbumSummary]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last page.")


class AlbumEvent(ResponseModel):
    """Event about an album."""

    status: Literal["empty", "solving", "solved", "failed", "outdated", "deleted"] = Field(
        description="State of the album, or that it was deleted."
    )
    progress: Share = 0.0
    photographs: int = 0
    revision_number: int | None = None
    solved_revision_number: int | None = None
