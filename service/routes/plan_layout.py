"""Walls and openings of a plan, for clients that draw layouts."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from service.errors import InvalidRequestError, StoreUnavailableError, UnknownFloorPlanError, UnknownRevisionError
from service.http.conditional import not_modified, revision_etag, tagged_answer
from service.http.problems import problem_responses
from service.http.uploads import JSON
from service.routes.dependencies import (
    IF_NONE_MATCH,
    NOT_MODIFIED,
    Client,
    Running,
    Tenant,
    plan_at_revision,
    plan_summary,
)
from service.schemas import LayoutAnswer
from service.storage.records import PlanSummary
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
async def get_layout(
    floorplan_id: str,
    request: Request,
    runtime: Running,
    tenant: Tenant,
    client: Client,
    revision: Annotated[str | None, Query(description="Id of an older revision.")] = None,
) -> Response:
    """Return the walls of each room, and the part of a wall that each opening takes up.

    A client can compute from them the layout that a camera sees: the distance to the nearest wall of its room in every
    direction, and hence where floor, ceiling and openings appear in a panorama.
    """

    def look() -> PlanSummary:
        current = plan_summary(tenant, floorplan_id, runtime.store.plans)
        return plan_at_revision(tenant, current, revision, runtime.store.plans)

    plan = await run_in_threadpool(look)
    add_log_fields(request, plan=plan.id, revision=plan.revision_id)
    etag = revision_etag(plan.revision_id, "layout")
    if (answer := not_modified(request, etag)) is not None:
        return answer
    layout = await runtime.renditions.get(plan.id, plan.revision_id, "layout", client)
    return tagged_answer([layout.content], JSON, etag)
