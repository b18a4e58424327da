"""The walls that a camera may see: what is needed to draw a pose's layout over its photograph."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from service.schemas.fields import ResponseModel
from service.schemas.native_plan import OpeningKind, Ring

Wall = Annotated[list[float], Field(min_length=4, max_length=4)]


class OpeningFaceAnswer(ResponseModel):
    """The piece of one wall that a door, window or passage takes up."""

    kind: OpeningKind
    wall: int = Field(ge=0, description="Place of the wall in the room's `walls_m`.")
    start: float = Field(ge=0, le=1, description="Where it begins, as a share of the wall's length.")
    end: float = Field(ge=0, le=1, description="Where it ends.")
    sill_m: float | None = Field(description="Height of its lower edge over the floor, null where the plan has none.")
    head_m: float | None = Field(description="Height of its upper edge over the floor, null where the plan has none.")


class RoomLayoutAnswer(ResponseModel):
    """What a camera in one room sees of it: its own walls, with what is in them."""

    id: str
    name: str
    ceiling_height_m: float
    polygon: Ring = Field(description="Outline of the floor, counterclockwise.")
    holes: list[Ring] = Field(description="What is no floor inside it.")
    walls_m: list[Wall] = Field(description="All walls as [x0, y0, x1, y1], in metres, free-standing ones included.")
    openings: list[OpeningFaceAnswer]


class LayoutAnswer(ResponseModel):
    """The walls of a floor plan at one of its revisions, room by room."""

    floorplan_id: str
    revision: str
    rooms: list[RoomLayoutAnswer]
