"""Requests and answers of the HTTP API. Units stand in the names: `_m` metres, `_m2` m², `_deg` degrees, `_ms` ms."""

from __future__ import annotations

import math
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, WithJsonSchema, field_validator

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M, OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.floorplan import MAX_CAMERA_HEIGHT_STD_M
from lalaloc_core.localise.camera_height import DEFAULT_STD_M, UNKNOWN_RANGE_M

PlanStatus = Literal["preparing", "ready", "failed"]
Finite = Field(allow_inf_nan=False)


def _rounded(digits: int) -> AfterValidator:
    # Without the minus of what rounds to zero.
    return AfterValidator(lambda value: round(value, digits) + 0.0)


# What is measured or computed is told in millimetres, mm² and hundredths of a degree: what comes after says nothing.
# What was uploaded, and what was set, is told as it was.
Metres = Annotated[float, _rounded(3)]
SquareMetres = Annotated[float, _rounded(3)]
Variance = Annotated[float, _rounded(6)]
HeadingDeg = Annotated[float, AfterValidator(lambda value: round(value, 2) % 360.0)]
Degrees = Annotated[float, Field(ge=0), _rounded(2)]
Milliseconds = Annotated[float, _rounded(2)]
# From 0 to 1: how much is done, and probabilities.
Share = Annotated[float, Field(ge=0, le=1), _rounded(4)]
Score = Annotated[float, _rounded(4)]

HEADING_MEANING = "azimuth of the panorama's centre column, clockwise from the plan's +y seen from above"
_LATENT_DISTANCE = Field(ge=0, le=2, description="Distance of the pose's layout to the panorama's latent.")
_COST = Field(
    ge=0,
    description="What candidates are ranked by: how badly the walls around the pose fit the panorama, without unit, "
    "lower is better. Candidates that were not refined as far as the first come after those that were, and their "
    "costs, which allow for the distance of neighbouring poses, do not compare.",
)


class Answer(BaseModel):
    """Base of all answers."""

    model_config = ConfigDict(frozen=True, extra="forbid")


Point = Annotated[list[float], Field(min_length=2, max_length=2)]
Segment = Annotated[list[Point], Field(min_length=2, max_length=2)]
Ring = Annotated[list[Point], Field(min_length=3)]
RoomType = Annotated[str, WithJsonSchema({"type": "string", "enum": [*ROOM_TYPES]})]
OpeningKind = Annotated[str, WithJsonSchema({"type": "string", "enum": [*OPENING_CLASSES[1:]]})]


class RoomDocument(BaseModel):
    """One room of a plan."""

    id: str | None = Field(None, description="Tells rooms of one name apart; unique, by default made from the name.")
    name: str = Field("", description="Name of the room; by default its number.")
    type: RoomType = Field("unknown", description="What the room is for.")
    polygon: Ring = Field(
        description="Corners [x, y] in metres, in either order, x to the right and y up on the drawing."
    )
    holes: list[Ring] = Field([], description="What is no floor inside the polygon, such as columns and shafts.")
    walls: list[Segment] = Field([], description="Free-standing walls up to the ceiling.")
    ceiling_height_m: float | None = Field(None, gt=0, description="Height of this room's ceiling over its floor.")


class OpeningDocument(BaseModel):
    """A door, window or passage; one entry serves both rooms of a wall."""

    kind: OpeningKind = Field(description="A passage is an opening without a leaf.")
    line: Segment = Field(description="Both ends, along the wall.")
    sill_m: float | None = Field(None, ge=0, description="Height of its lower edge over the floor.")
    head_m: float | None = Field(None, ge=0, description="Height of its upper edge over the floor.")
    name: str | None = Field(None, description="What to call it.")
    rooms: list[str] | None = Field(
        None, description="Ids of the only rooms that it belongs to; by default all whose wall it lies on."
    )


class FloorPlanDocument(BaseModel):
    """A floor plan in the native format; coordinates in metres."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "name": "Flat 3",
                "ceiling_height_m": 2.5,
                "camera_height_m": 1.5,
                "rooms": [{"name": "kitchen", "polygon": [[0, 0], [4, 0], [4, 3], [0, 3]], "ceiling_height_m": 2.5}],
            }
        }
    )

    name: str = Field("floor plan", description="What to call the plan.")
    ceiling_height_m: float | None = Field(None, gt=0, description="Ceiling of rooms without their own.")
    camera_height_m: float = Field(
        1.5, ge=MIN_CAMERA_HEIGHT_M, description="Height of the camera assumed for panoramas of this plan."
    )
    north_deg: float | None = Field(
        None, ge=-360, le=360, description="Azimuth of true north: degrees clockwise from the plan's +y."
    )
    camera_height_std_m: float | None = Field(
        None, ge=0, le=2, description="How far off `camera_height_m` may be: one standard deviation."
    )
    rooms: list[RoomDocument] = Field(min_length=1, description="Closed rooms.")
    openings: list[OpeningDocument] = Field([], description="Doors, windows and passages; they may touch, not overlap.")
    opening_kinds: list[OpeningKind] | None = Field(
        None, description="The kinds that the plan shows completely; by default those that occur in it."
    )
    opening_tolerance_m: float = Field(
        0.35, ge=0.01, le=1.5, description="How far from a room's wall an opening may be drawn."
    )


class RoomAnswer(Answer):
    """One room of a stored plan."""

    id: str = Field(description="Tells rooms of one name apart.")
    name: str
    type: RoomType = Field(description="What the room is for.")
    area_m2: SquareMetres = Field(description="Floor area, without holes.")
    ceiling_height_m: float = Field(description="Height of the ceiling over the floor.")
    vertices: int = Field(description="Corners of the polygon.")


class GridAnswer(Answer):
    """The plan's latent grid."""

    step_m: float = Field(description="Distance of neighbouring poses.")
    poses: int = Field(description="Number of poses; an estimate until the plan is ready.")


class BoundsAnswer(Answer):
    """Smallest axis-parallel box around the plan."""

    x_min_m: Metres
    y_min_m: Metres
    x_max_m: Metres
    y_max_m: Metres


class FloorPlanAnswer(Answer):
    """A stored floor plan."""

    id: str = Field(description="Identifier for later requests.")
    revision: str = Field(description="Identifier of what was uploaded; a replaced plan has another one.")
    revision_number: int = Field(ge=1, description="How often the plan was uploaded up to this revision.")
    name: str
    status: PlanStatus | Literal["superseded"] = Field(
        description="`preparing` while the latent grid is computed, then `ready` or `failed`; `superseded` for a "
        "revision that is not the current one."
    )
    progress: Share = Field(description="Share of the latent grid that is computed.")
    reason: str | None = Field(description="Why the plan failed, null unless it did.")
    rooms: list[RoomAnswer]
    area_m2: SquareMetres = Field(description="Sum of the rooms' floor areas.")
    bounds: BoundsAnswer
    camera_height_m: float = Field(description="Camera height assumed for panoramas of this plan.")
    grid: GridAnswer
    warnings: list[str] = Field(description="What is odd about the plan but usable, such as overlapping rooms.")
    plan: Annotated[dict[str, Any], WithJsonSchema({"allOf": [{"$ref": "#/components/schemas/FloorPlanDocument"}]})] = (
        Field(description="The plan itself in the native format.")
    )
    created_at: datetime = Field(description="When the plan was first uploaded, UTC.")
    updated_at: datetime = Field(description="When this revision was uploaded, UTC.")


class FloorPlanSummary(Answer):
    """A stored floor plan in a listing."""

    id: str
    revision: str
    name: str
    status: PlanStatus
    progress: Share
    rooms: int = Field(description="Number of rooms.")
    area_m2: SquareMetres
    created_at: datetime
    updated_at: datetime


class FloorPlanList(Answer):
    """A page of stored floor plans, newest first."""

    floorplans: list[FloorPlanSummary]
    next_cursor: str | None = Field(description="The `cursor` of the next page, null on the last one.")


class PlanEvent(Answer):
    """How far a floor plan is; one event of a stream."""

    status: PlanStatus | Literal["deleted"]
    progress: Share | None = Field(
        default=None, description="Share of the latent grid that is computed; not of a deleted plan."
    )
    revision: str | None = Field(default=None, description="The current revision; a plan may get another meanwhile.")
    reason: str | None = Field(default=None, description="Why the plan failed.")


class LocaliseForm(BaseModel):
    """Fields of a query besides the panorama itself; an empty field counts as left out."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    floorplan_id: str = Field(min_length=1, description="Id of the floor plan the panorama was taken in.")
    heading_deg: Annotated[float, Finite] | None = Field(
        None,
        ge=-360,
        le=360,
        description=f"The {HEADING_MEANING}; left out: what the panorama's metadata say (`GPano:PoseHeadingDegrees`), "
        "where the plan has `north_deg`, else unknown and searched over.",
    )
    heading_tolerance_deg: Annotated[float, Finite] = Field(
        0,
        ge=0,
        le=45,
        description="How far off `heading_deg` may be: it is then searched for within that, to the next sector of the "
        "model's ring, and refined. 0: it is exact. Needs `heading_deg`.",
    )
    camera_height_m: Annotated[float, Finite] | None = Field(
        None,
        ge=MIN_CAMERA_HEIGHT_M,
        description="Height of the camera over the floor; left out: the plan's, and where that has none either, any "
        f"between {UNKNOWN_RANGE_M[0]:g} and {UNKNOWN_RANGE_M[1]:g}.",
    )
    camera_height_std_m: Annotated[float, Finite] | None = Field(
        None,
        ge=0,
        le=MAX_CAMERA_HEIGHT_STD_M,
        description="Standard deviation of the error of the camera height, which is solved for; 0: it is exact. Left "
        f"out: the plan's, else {DEFAULT_STD_M:g}.",
    )
    refine: Literal["none", "vdr", "lpo"] = Field(
        "lpo", description="How far to refine: nearest grid pose, denser poses around it, or optimised pose."
    )
    top_k: int = Field(
        5,
        ge=1,
        description="How many distinct candidates to return, at most `max_top_k`.",
        json_schema_extra={"maximum": 100},
    )

    @field_validator(
        "heading_deg", "heading_tolerance_deg", "camera_height_m", "camera_height_std_m", "top_k", mode="before"
    )
    @classmethod
    def _plain_number(cls, value: object) -> object:
        if isinstance(value, str) and "_" in value:
            raise ValueError("not a number")
        return value

    @field_validator("top_k")
    @classmethod
    def _as_many_as_allowed(cls, value: int, told: ValidationInfo) -> int:
        most = (told.context or {}).get("max_top_k", math.inf)
        if value > most:
            raise ValueError(f"at most {most} are allowed (max_top_k)")
        return value

    @field_validator("heading_tolerance_deg")
    @classmethod
    def _of_a_heading(cls, value: float, given: ValidationInfo) -> float:
        if given.data.get("heading_deg", 0.0) is None:
            raise ValueError("heading_deg, whose tolerance this is, is missing")
        return value


Pair = Annotated[list[Variance], Field(min_length=2, max_length=2)]
Covariance = Annotated[list[Pair], Field(min_length=2, max_length=2)]


class Position(Answer):
    """A point of the plan frame."""

    x_m: Metres = Field(description="To the right on the drawing.")
    y_m: Metres = Field(description="Up on the drawing.")


class CandidateAnswer(Answer):
    """One possible pose; no two candidates are closer than 1 m."""

    position: Position
    heading_deg: HeadingDeg = Field(ge=0, lt=360, description=f"The {HEADING_MEANING}.")
    room: str = Field(description="Name of the room the position lies in.")
    room_id: str = Field(description="Its `id` in the plan, which is unique.")
    probability: Share | None = Field(
        description="Probability that the position is right within 1 m, and no better candidate's is; null for a model "
        "without confidence.",
    )
    cost: Score = _COST
    latent_distance: Score = _LATENT_DISTANCE


class TimingsAnswer(Answer):
    """Milliseconds per stage, 0 where a stage did not run."""

    decode: Milliseconds
    encode: Milliseconds
    retrieve: Milliseconds
    vdr: Milliseconds
    lpo: Milliseconds
    total: Milliseconds = Field(description="From the complete upload to the answer, waits included.")


class ModelAnswer(Answer):
    """The model that answered."""

    name: str
    version: str
    sha256: str = Field(description="Digest over the model's files.")


class LocaliseAnswer(Answer):
    """Where the panorama was taken."""

    floorplan_id: str
    floorplan_revision: str = Field(description="The plan's revision that was searched.")
    position: Position
    heading_deg: HeadingDeg = Field(ge=0, lt=360, description=f"The {HEADING_MEANING}.")
    room: str
    room_id: str = Field(description="`id` of the room in the plan, which is unique.")
    confidence: Share | None = Field(
        description="Probability that the position is right within 1 m: that of the panorama being of this plan, "
        "times the share that this place has in the posterior over all places. Null for a model without it.",
    )
    heading_confidence: Share | None = Field(
        description="Probability that the heading is right within 5°; null where `confidence` is."
    )
    warnings: list[str] = Field(
        description="What was said and not followed, such as a heading that the panorama contradicts."
    )
    heading_source: Literal["given", "panorama", "searched"] = Field(
        description="Where the heading came from: the request, the panorama's metadata, or the search."
    )
    stage: Literal["retrieval", "vdr", "lpo"] = Field(description="The last stage that produced the position.")
    covariance_m2: Covariance | None = Field(
        description="Covariance [[xx, xy], [xy, yy]] of the position in m², given that it is right within 1 m; along "
        "what the panorama does not tell, as in a corridor, that of a place anywhere in the room. Null unless `stage` "
        "is `lpo`, and for a model without it."
    )
    heading_std_deg: Degrees | None = Field(
        description="Standard deviation of the heading where it was searched; null where `covariance_m2` is."
    )
    cost: Score = _COST
    latent_distance: Score = _LATENT_DISTANCE
    camera_height_m: Metres = Field(description="The camera height that fits best.")
    candidates: list[CandidateAnswer] = Field(description="Best first; the first one is the answer.")
    timings_ms: TimingsAnswer
    model: ModelAnswer


class LimitsAnswer(Answer):
    """What requests may be; each is the setting of the same name, and named by the error about it."""

    max_plan_bytes: int = Field(description="Upload of a floor plan.")
    max_floorplans: int = Field(description="Stored floor plans per tenant.")
    max_rooms: int = Field(description="Rooms per floor plan.")
    max_vertices: int = Field(description="Vertices per room.")
    max_plan_vertices: int = Field(description="Vertices of all rooms of a floor plan.")
    max_extent_m: float = Field(description="Width or height of a floor plan.")
    max_area_m2: float = Field(description="Floor area of all rooms of a floor plan.")
    max_bounds_area_m2: float = Field(description="Area of the boxes around all rooms of a floor plan.")
    max_openings: int = Field(description="Doors, windows and passages of a floor plan.")
    max_grid_poses: int = Field(description="Poses that a plan's latent grid may have.")
    max_panorama_bytes: int = Field(description="Upload of a panorama.")
    max_pixels: int = Field(description="Pixels of a panorama.")
    max_scans: int = Field(description="Scans of a panorama that is a progressive JPEG.")
    max_top_k: int = Field(description="Candidates of an answer.")
    max_pending_requests: int = Field(description="Uploads and queries in flight.")
    max_queries: int = Field(description="Queries in work; more get a 503 at once.")
    max_reads: int = Field(description="Requests in work that change nothing; more get a 503 at once.")
    max_streams: int = Field(description="Clients that follow events; more get a 503 at once.")
    max_revisions: int = Field(description="Kept revisions of a floor plan.")
    upload_deadline_s: float = Field(description="Longest an upload may take.")
    upload_idle_s: float = Field(description="Longest wait for the next bytes of an upload.")
    upload_bytes_per_s: float = Field(description="Slowest an upload may be, once it is `upload_idle_s` behind.")
    request_deadline_s: float = Field(description="Longest a query may take once it is uploaded.")


class HealthAnswer(Answer):
    """The process is alive."""

    status: Literal["ok"]


class PoolAnswer(Answer):
    """State of a pool of worker processes."""

    workers: int = Field(description="Worker processes wanted.")
    ready: int = Field(description="Worker processes that are warm now.")
    warmed_up: bool = Field(description="Whether every worker has been warm once.")
    fault: str | None = Field(description="Why a worker could not start last time, null when all is well.")


class ReadyAnswer(Answer):
    """Whether the service can answer at full quality."""

    ready: bool
    model: ModelAnswer
    lpo_pool: PoolAnswer
    decode_pool: PoolAnswer
    plans_preparing: int = Field(description="Plans whose latent grid is being computed, or will be.")


class Fault(Answer):
    """One field at fault."""

    field: str
    message: str


class Problem(BaseModel):
    """An error as of RFC 9457."""

    type: str = Field(description="Stable identifier of the kind of error.")
    title: str
    status: int
    detail: str = Field(description="What is wrong with this request, with value and limit.")
    request_id: str | None = Field(None, description="Names this request in the service's log.")
    room: str | None = Field(None, description="The room at fault, for an invalid floor plan.")
    errors: list[Fault] | None = Field(None, description="Every field at fault, for an invalid request.")
