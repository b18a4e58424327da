"""Event streams about floor plans."""

from __future__ import annotations

import asyncio
from functools import partial

from fastapi import APIRouter, Request, Response
from fastapi.responses import StreamingResponse

from service.errors import InvalidRequestError, StoreUnavailableError, UnknownFloorPlanError
from service.http.events import EventStream
from service.http.problems import problem_responses
from service.routes.dependencies import Running, Tenant, plan_summary
from service.telemetry import add_log_fields

router = APIRouter(prefix="/floorplans", tags=["floor plans"])


@router.get(
    "/{floorplan_id}/events",
    summary="Follow a floor plan",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "Server-sent events; their data is a PlanEvent.",
            "content": {EventStream.media_type: {"schema": {"type": "string"}}},
        },
        **problem_responses(UnknownFloorPlanError, InvalidRequestError, StoreUnavailableError),
    },
)
async def follow_floorplan(floorplan_id: str, request: Request, runtime: Running, tenant: Tenant) -> Response:
    """Stream server-sent events about the plan's pose grid.

    `progress` comes at once and after each change, up to four times a second; `ready`, `failed` or `deleted` is the
    last event. A comment is sent at least every 15 s. The stream also ends after 15 minutes, soon after the API key is
    revoked, and when the service stops; reconnect then.
    """
    current = await asyncio.to_thread(plan_summary, tenant, floorplan_id, runtime.store.plans)
    add_log_fields(request, plan=current.id, revision=current.revision_id)
    return runtime.events.event_stream(current.id, partial(runtime.access_control.still_authorised, request))
