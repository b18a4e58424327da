"""What is told of stored floor plans."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, WithJsonSchema

from service.schemas.fields import Metres, ResponseModel, Share, SquareMetres
from service.schemas.native_plan import RoomType
from service.schemas.plan_import import ImportReport

PlanStatus = Literal["preparing", "ready", "failed"]


class RoomAnswer(ResponseModel):
    """One room of a stored plan."""

    id: str = Field(description="Tells rooms of one name apart.")
    name: str
    type: RoomType = Field(description="What the room is for.")
    area_m2: SquareMetres = Field(description="Floor area, without holes.")
    ceiling_height_m: float = Field(description="Height of the ceiling over the floor.")
    vertices: int = Field(description="Corners of the polygon.")


class GridAnswer(ResponseModel):
    """The plan's latent grid."""

    step_m: float = Field(description="Distance of neighbouring poses.")
    poses: int = Field(description="Number of poses; an estimate until the plan is ready.")


class BoundsAnswer(ResponseModel):
    """Smallest axis-parallel box around the plan."""

    x_min_m: Metres
    y_min_m: Metres
    x_max_m: Metres
    y_max_m: Metres


class FloorPlanAnswer(ResponseModel):
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
    warnings: list[str] = Field(
        description="What is likely wrong with the plan but usable: overlapping rooms, rooms that no door reaches, "
        "improbable ceilings."
    )
    import_report: ImportReport | None = Field(
        description="How its file was read; null for plans that an earlier version of the service stored."
    )
    plan: Annotated[dict[str, Any], WithJsonSchema({"allOf": [{"$ref": "#/components/schemas/FloorPlanDocument"}]})] = (
        Field(description="The plan itself in the native format.")
    )
    created_at: datetime = Field(description="When the plan was first uploaded, UTC.")
    updated_at: datetime = Field(description="When this revision was uploaded, UTC.")


class FloorPlanSummary(ResponseModel):
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


class FloorPlanList(ResponseModel):
    """A page of stored floor plans, newest first."""

    floorplans: list[FloorPlanSummary]
    next_cursor: str | None = Field(description="The `cursor` of the next page, null on the last one.")


class PlanEvent(ResponseModel):
    """How far a floor plan is; one event of a stream."""

    status: PlanStatus | Literal["deleted"]
    progress: Share | None = Field(
        default=None, description="Share of the latent grid that is computed; not of a deleted plan."
    )
    revision: str | None = Field(default=None, description="The current revision; a plan may get another meanwhile.")
    reason: str | None = Field(default=None, description="Why the plan failed.")
