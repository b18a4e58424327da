"""Walls and openings of a plan, for clients that draw layouts."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from lalaloc_core.floorplan import FloorPlan, OpeningFace
from service.errors import InvalidRequestError, StoreUnavailableError, UnknownFloorPlanError, UnknownRevisionError
from service.http.conditional import conditional_answer, content_etag
from service.http.problems import problem_responses
from service.http.uploads import JSON
from service.routes.dependencies import (
    IF_NONE_MATCH,
    NOT_MODIFIED,
    Running,
    Tenant,
    plan_at_revision,
    stored_plan,
)
from service.schemas import LayoutAnswer, OpeningFaceAnswer, RoomLayoutAnswer
from service.storage.records import PlanRecord
from service.telemetry import add_log_fields

router = APIRouter(prefix="/floorplans", tags=["floor plans"])


@router.get(
    "/{floorplan_id}/layout",
    summary="Get the walls of a floor plan",
    response_model=LayoutAnswer,
    openapi_extra={"parameters": [IF_NONE_MATCH]},
    responses=NOT_MODIFIED
    | problem_responses(UnknownFloorPlanError, UnknownRevisionError, InvalidRequestError, StoreUnavailableError),
)
def get_layout(
    floorplan_id: str,
    request: Request,
    runtime: Running,
    tenant: Tenant,
    revision: Annotated[str | None, Query(description="Id of an older revision.")] = None,
) -> Response:
    """Return the walls of each room, and the part of a wall that each opening takes up.

    A client can compute from them the layout that a camera sees: the distance to the nearest wall of its room in every
    direction, and hence where floor, ceiling and openings appear in a panorama.
    """
    record = stored_plan(tenant, floorplan_id, runtime.store.plans)
    if revision is not None:
        record = plan_at_revision(record, revision, runtime.store.plans)
    add_log_fields(request, plan=record.id, revision=record.revision_id)
    content = _layout(record).model_dump_json().encode()
    return conditional_answer(request, content, JSON, content_etag(content))


def _layout(record: PlanRecord) -> LayoutAnswer:
    plan = record.plan
    rooms = [
        RoomLayoutAnswer(
            id=room.id,
            name=room.name,
            ceiling_height_m=room.ceiling_height_m,
            polygon=room.polygon_m.tolist(),
            holes=[hole.tolist() for hole in room.holes_m],
            walls_m=room.walls_m.tolist(),
            openings=[_opening(plan, face) for face in plan.room_faces[index]],
        )
        for index, room in enumerate(plan.rooms)
    ]
    return LayoutAnswer(floorplan_id=record.id, revision=record.revision_id, rooms=rooms)


def _opening(plan: FloorPlan, face: OpeningFace) -> OpeningFaceAnswer:
    opening = plan.openings[face.opening]
    return OpeningFaceAnswer(
        kind=opening.kind,
        wall=face.wall,
        start=face.start,
        end=face.end,
        sill_m=opening.sill_m,
        head_m=opening.head_m,
    )
