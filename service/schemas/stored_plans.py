"""Answers about stored floor plans: description, list, events, walls."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, WithJsonSchema

from lalaloc_core.answer_numbers import Metres, Share, SquareMetres
from service.schemas.fields import ResponseModel
from service.schemas.native_plan import KnownRoomType, OpeningKind, Ring, RoomType
from service.schemas.plan_import import ImportReport

PlanStatus = Literal["preparing", "ready", "failed"]


class RoomAnswer(ResponseModel):
    """Room of a stored plan."""

    id: str = Field(description="Unique id of the room.")
    name: str
    type: RoomType = Field(description="Use of the room, the first of several.")
    types: list[KnownRoomType] = Field([], description="All uses; empty if unknown.")
    area_m2: SquareMetres = Field(description="Floor area, without holes.")
    ceiling_height_m: float = Field(description="Height of the ceiling over the floor.")
    vertices: int = Field(description="Corners of the polygon.")


class GridAnswer(ResponseModel):
    """Pose grid of a plan."""

    step_m: float = Field(description="Distance between neighbouring poses.")
    poses: int = Field(description="Number of poses; an estimate until the plan is ready.")


class BoundsAnswer(ResponseModel):
    """Bounding box of the plan."""

    x_min_m: Metres
    y_min_m: Metres
    x_max_m: Metres
    y_max_m: Metres


class PlanHeadAnswer(ResponseModel):
    """Part of a stored plan's description: how it is stored."""

    id: str = Field(description="Id of the plan.")
    revision: str = Field(description="Id of the revision; it changes when the plan is replaced.")
    revision_number: int = Field(ge=1, description="Number of the revision, from 1.")
    created_at: datetime = Field(description="Time of the first upload, UTC.")
    updated_at: datetime = Field(description="Time of this revision's upload, UTC.")


class PlanStateAnswer(ResponseModel):
    """Part of a stored plan's description: the state of its pose grid."""

    status: PlanStatus | Literal["superseded"] = Field(
        description="`preparing` while the pose grid is computed, then `ready` or `failed`; `superseded` for an old "
        "revision."
    )
    progress: Share = Field(description="Fraction of the pose grid that is computed.")
    reason: str | None = Field(description="Reason of a failure; null if there is none.")
    grid: GridAnswer


class PlanContentAnswer(ResponseModel):
    """Part of a stored plan's description: what the plan says."""

    name: str
    rooms: list[RoomAnswer]
    area_m2: SquareMetres = Field(description="Sum of the rooms' floor areas.")
    bounds: BoundsAnswer
    camera_height_m: float = Field(description="Camera height of photographs of this plan.")
    warnings: list[str] = Field(
        description="Likely mistakes in the plan, such as overlapping rooms, rooms without a door or improbable "
        "ceilings."
    )
    import_report: ImportReport | None = Field(
        description="Report on reading the file; null for plans stored by an old version of the service."
    )
    plan: Annotated[dict[str, Any], WithJsonSchema({"allOf": [{"$ref": "#/components/schemas/FloorPlanDocument"}]})] = (
        Field(description="Plan in the native format.")
    )


class FloorPlanAnswer(PlanContentAnswer, PlanStateAnswer, PlanHeadAnswer):
    """Stored floor plan."""


class FloorPlanSummary(ResponseModel):
    """Stored floor plan in a list."""

    id: str
    revision: str
    revision_number: int = Field(ge=1, description="Number of the revision, from 1.")
    name: str
    status: PlanStatus
    progress: Share
    rooms: int = Field(description="Number of rooms.")
    area_m2: SquareMetres
    created_at: datetime
    updated_at: datetime


class FloorPlanList(ResponseModel):
    """Page of stored floor plans, newest first."""

    floorplans: list[FloorPlanSummary]
    next_cursor: str | None = Field(description="`cursor` of the next page; null on the last page.")


class PlanEvent(ResponseModel):
    """Event of a stream: the state of a floor plan."""

    status: PlanStatus | Literal["deleted"]
    progress: Share | None = Field(
        default=None, description="Fraction of the pose grid that is computed; absent for a deleted plan."
    )
    revision: str | None = Field(default=None, description="Current revision; it changes when the plan is replaced.")
    reason: str | None = Field(default=None, description="Reason of a failure.")


Wall = Annotated[list[float], Field(min_length=4, max_length=4)]


class OpeningFaceAnswer(ResponseModel):
    """Part of a wall that a door, window or passage takes up."""

    kind: OpeningKind
    wall: int = Field(ge=0, description="Index of the wall in the room's `walls_m`.")
    start: float = Field(ge=0, le=1, description="Start, as a fraction of the wall's length.")
    end: float = Field(ge=0, le=1, description="End, as a fraction of the wall's length.")
    sill_m: float | None = Field(description="Height of the lower edge over the floor; null if the plan has none.")
    head_m: float | None = Field(description="Height of the upper edge over the floor; null if the plan has none.")


class RoomLayoutAnswer(ResponseModel):
    """Walls and openings of one room."""

    id: str
    name: str
    ceiling_height_m: float
    polygon: Ring = Field(description="Outline of the floor, counterclockwise.")
    holes: list[Ring] = Field(description="Holes in the floor.")
    walls_m: list[Wall] = Field(description="Walls as [x0, y0, x1, y1] in metres, including free-standing walls.")
    openings: list[OpeningFaceAnswer]


class LayoutAnswer(ResponseModel):
    """Walls of a floor plan at one revision, by room."""

    floorplan_id: str
    revision: str
    rooms: list[RoomLayoutAnswer]
