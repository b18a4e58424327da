"""Dependencies of routes: the running service, the tenant, and the plan or venue in the path."""

from __future__ import annotations

import re
from typing import Annotated, Any

from fastapi import Depends, Request

from service.errors import UnknownFloorPlanError, UnknownRevisionError, UnknownVenueError
from service.http.idempotent_request import HEADER, MAX_KEY_CHARACTERS
from service.runtime import Runtime, get_runtime
from service.security import caller_of
from service.storage.plans import Plans
from service.storage.records import PlanRecord, PlanSummary, VenueRecord

_ID = re.compile(r"[0-9a-f]{32}")


async def _tenant_of(request: Request) -> str:
    return caller_of(request.scope).tenant


async def _client_of(request: Request) -> str:
    return caller_of(request.scope).client


Running = Annotated[Runtime, Depends(get_runtime)]
Tenant = Annotated[str, Depends(_tenant_of)]
# Tenant or client address that the request's share of slots counts for; see `service.capacity.fair_share`.
Client = Annotated[str, Depends(_client_of)]


def plan_summary(tenant: str, floorplan_id: str, plans: Plans) -> PlanSummary:
    """Return a stored plan without its rooms, so that damaged plans can be replaced or deleted.

    Raises:
        UnknownFloorPlanError: no such plan.
        StoreUnavailableError: the database is away.
    """
    summary = plans.summary(tenant, floorplan_id) if is_id(floorplan_id) else None
    if summary is None:
        raise UnknownFloorPlanError(floorplan_id)
    return summary


def plan_at_revision(tenant: str, current: PlanSummary, revision_id: str | None, plans: Plans) -> PlanSummary:
    """Return a stored plan at one of its revisions; None names the current one.

    Raises:
        UnknownRevisionError: no such revision is kept.
        StoreUnavailableError: the database is away.
    """
    if revision_id is None or revision_id == current.revision_id:
        return current
    found = plans.summary(tenant, current.id, revision_id) if is_id(revision_id) else None
    if found is None:
        raise UnknownRevisionError(current.id, revision_id)
    return found


async def plan_for_query(tenant: str, floorplan_id: str, runtime: Runtime) -> PlanRecord:
    """Return a plan for a query: from the database, or from memory while the database is away.

    Raises:
        UnknownFloorPlanError: no such plan.
        StoreUnavailableError: the database is away and the plan is not in memory, or the database is busy.
    """
    record = await runtime.plan_lookup.find(tenant, floorplan_id, runtime.reads) if is_id(floorplan_id) else None
    if record is None:
        raise UnknownFloorPlanError(floorplan_id)
    return record


async def venue_for_query(tenant: str, venue_id: str, runtime: Runtime) -> VenueRecord:
    """Return a venue for a query.

    Raises:
        UnknownVenueError: no such venue.
        StoreUnavailableError: the database is away or busy.
    """
    record = await runtime.reads.run(tenant, runtime.store.venues.get, tenant, venue_id) if is_id(venue_id) else None
    if record is None:
        raise UnknownVenueError(venue_id)
    return record


def is_id(text: str) -> bool:
    """Return True for 32 hexadecimal digits; other texts are never looked up in the database."""
    return _ID.fullmatch(text) is not None


def header(name: str, description: str) -> dict[str, Any]:
    """Describe an optional request header for the API description."""
    return {"name": name, "in": "header", "required": False, "description": description, "schema": {"type": "string"}}


IDEMPOTENCY_KEY = header(
    HEADER,
    f"1 to {MAX_KEY_CHARACTERS} visible ASCII characters. A second request with the same key and content within 24 "
    "hours is not executed again; it gets the first answer with `Idempotency-Replayed: true`.",
)
IF_NONE_MATCH = header("If-None-Match", "Entity tags that the client has, or `*`; if one matches, the answer is 304.")
NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "The client has this representation already."}}
UNLESS_CHANGED = [
    header("If-Match", "Entity tags of the expected revision, or `*`; 412 if none matches."),
    header("If-None-Match", "Entity tags of revisions; 412 if one matches."),
]
# Pattern of filters by name.
NO_CONTROLS = r"^[^\x00-\x1f\x7f]*$"
