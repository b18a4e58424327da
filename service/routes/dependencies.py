"""What routes about plans have in common: the running service, whose plans it is about, and the one in the path."""

from __future__ import annotations

import re
from typing import Annotated, Any

from fastapi import Depends, Request

from service.errors import UnknownFloorPlanError, UnknownRevisionError, UnknownVenueError
from service.http.idempotent_request import HEADER, MAX_KEY_CHARACTERS
from service.runtime import Runtime, runtime_of
from service.security import caller_of
from service.storage.plans import Plans
from service.storage.records import PlanRecord, PlanSummary, VenueRecord

_ID = re.compile(r"[0-9a-f]{32}")


async def _tenant_of(request: Request) -> str:
    return caller_of(request.scope).tenant


async def _client_of(request: Request) -> str:
    return caller_of(request.scope).client


Running = Annotated[Runtime, Depends(runtime_of)]
Tenant = Annotated[str, Depends(_tenant_of)]
# With whom the request shares what the service can do at a time; see `service.fair_share`.
Client = Annotated[str, Depends(_client_of)]


def stored_plan(tenant: str, floorplan_id: str, plans: Plans) -> PlanRecord:
    """A stored plan of a tenant.

    Raises:
        UnknownFloorPlanError: there is none.
        StoreUnavailableError: the database is away.
    """
    record = plans.get(tenant, floorplan_id) if is_id(floorplan_id) else None
    if record is None:
        raise UnknownFloorPlanError(floorplan_id)
    return record


def plan_at_revision(current: PlanRecord, revision_id: str, plans: Plans) -> PlanRecord:
    """A stored plan at any of its revisions.

    Raises:
        UnknownRevisionError: it is not kept, or never was.
        StoreUnavailableError: the database is away.
    """
    if revision_id == current.revision_id:
        return current
    found = plans.get_revision(current.tenant, current.id, revision_id) if is_id(revision_id) else None
    if found is None:
        raise UnknownRevisionError(current.id, revision_id)
    return found


def plan_summary(tenant: str, floorplan_id: str, plans: Plans) -> PlanSummary:
    """A stored plan of a tenant without its rooms: whoever replaces or deletes it need not be able to read it.

    Raises:
        UnknownFloorPlanError: there is none.
        StoreUnavailableError: the database is away.
    """
    summary = plans.summary(tenant, floorplan_id) if is_id(floorplan_id) else None
    if summary is None:
        raise UnknownFloorPlanError(floorplan_id)
    return summary


async def plan_for_query(tenant: str, floorplan_id: str, runtime: Runtime) -> PlanRecord:
    """A plan for a query: as the database has it, or as it was read lately when the database is away or silent.

    Raises:
        UnknownFloorPlanError: there is none.
        StoreUnavailableError: the database is away, and the plan was not read lately; or too many use it.
    """
    record = await runtime.plan_lookup.find(tenant, floorplan_id, runtime.reads) if is_id(floorplan_id) else None
    if record is None:
        raise UnknownFloorPlanError(floorplan_id)
    return record


async def venue_for_query(tenant: str, venue_id: str, runtime: Runtime) -> VenueRecord:
    """A venue for a query, as the database has it.

    Raises:
        UnknownVenueError: there is none.
        StoreUnavailableError: the database is away, or too many use it.
    """
    record = await runtime.reads.run(runtime.store.venues.get, tenant, venue_id) if is_id(venue_id) else None
    if record is None:
        raise UnknownVenueError(venue_id)
    return record


def is_id(text: str) -> bool:
    """Whether a text looks like an id; they are made here, and whatever looks different need not reach the database."""
    return _ID.fullmatch(text) is not None


def header(name: str, description: str) -> dict[str, Any]:
    """An optional header of a request in the API description."""
    return {"name": name, "in": "header", "required": False, "description": description, "schema": {"type": "string"}}


IDEMPOTENCY_KEY = header(
    HEADER,
    f"1 to {MAX_KEY_CHARACTERS} visible ASCII characters. The same key with the same content within 24 hours is the "
    "same request, and answered alike, with `Idempotency-Replayed: true`.",
)
IF_NONE_MATCH = header("If-None-Match", "Entity tags that the caller has, or `*`; with one of them the answer is 304.")
NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "The caller has this representation."}}
UNLESS_CHANGED = [
    header("If-Match", "Entity tags of the revision that it must still have, or `*`; 412 when it has another."),
    header("If-None-Match", "Entity tags of revisions that it must not have; 412 when it has one of them."),
]
# What a filter by name may be.
NO_CONTROLS = r"^[^\x00-\x1f\x7f]*$"
