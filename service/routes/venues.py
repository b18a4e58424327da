"""Venues: groups of floor plans that are searched together."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response, status
from pydantic import BaseModel

from lalaloc_core.floorplan.earth import Anchor
from service.errors import (
    BytesInFlightError,
    IdempotencyInProgressError,
    IdempotencyKeyReusedError,
    InvalidRequestError,
    MalformedRequestError,
    RevisionMismatchError,
    SpoolFullError,
    StorageQuotaError,
    StoreFullError,
    StoreUnavailableError,
    TooManyFloorPlansError,
    TooManyVenuesError,
    UnknownVenueError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
)
from service.http import IdempotentRequest
from service.http.conditional import expected_revision, not_modified, tagged_answer
from service.http.cursors import cursor_text, parse_cursor, parse_venue_cursor, venue_cursor_text
from service.http.fields import Model, parse_document
from service.http.problems import problem_responses
from service.http.uploads import JSON, MULTIPART, Parts, UploadLimits, media_type, read_body
from service.routes.dependencies import (
    IDEMPOTENCY_KEY,
    IF_NONE_MATCH,
    NO_CONTROLS,
    NOT_MODIFIED,
    UNLESS_CHANGED,
    Client,
    Running,
    Tenant,
    is_id,
)
from service.routes.plan_uploads import LEVELS_FORM, REFUSED_UPLOADS, read_upload
from service.routes.venue_answers import plan_entries, venue_representation, venue_summary
from service.routes.venue_levels import add_levels_to_venue, store_venue_of_levels
from service.runtime import Runtime
from service.schemas import (
    LevelsForm,
    VenueAnchorDocument,
    VenueAnswer,
    VenueChangeDocument,
    VenueDocument,
    VenueList,
    VenuePlanDocument,
    VenuePlanList,
)
from service.storage.records import Cursor, VenueMember, VenuePlace, VenueRecord
from service.telemetry import add_log_fields
from service.uploaded_file import UploadedFile

router = APIRouter(prefix="/venues", tags=["venues"])

_MAX_LISTED = 500
# Characters of a route that idempotency keys belong to, enough for any id of a venue.
_MAX_ROUTE = 64
# Lists, objects and further items of a venue document, besides those of its plans.
_FURTHER_VALUES = 1000
_REFUSED_BODIES = (
    InvalidRequestError,
    MalformedRequestError,
    UnsupportedMediaError,
    UploadTooLargeError,
    UploadTimeoutError,
    BytesInFlightError,
    SpoolFullError,
    StoreUnavailableError,
    StoreFullError,
    StorageQuotaError,
)


def _body(model: type[BaseModel]) -> dict[str, Any]:
    return {"required": True, "content": {JSON: {"schema": {"$ref": f"#/components/schemas/{model.__name__}"}}}}


_NEW_VENUE = _body(VenueDocument)
_VENUE_CHANGE = _body(VenueChangeDocument)
for _described in (_NEW_VENUE, _VENUE_CHANGE):
    _described["content"][MULTIPART] = LEVELS_FORM


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    summary="Create a venue",
    response_model=VenueAnswer,
    openapi_extra={"requestBody": _NEW_VENUE, "parameters": [IDEMPOTENCY_KEY]},
    responses=problem_responses(
        *REFUSED_UPLOADS,
        TooManyFloorPlansError,
        TooManyVenuesError,
        IdempotencyKeyReusedError,
        IdempotencyInProgressError,
    ),
)
async def create_venue(request: Request, runtime: Running, tenant: Tenant, client: Client) -> Response:
    """Group floor plans, each on a level, so that one query searches all of them.

    A JSON body lists stored plans. A form has a plan file of any format: every level with rooms becomes a plan, and all
    of them a venue, or nothing is stored. A plan can belong to several venues. Deleting a plan removes it from its
    venues.
    """
    idempotent = IdempotentRequest(runtime.store.idempotency_keys, request, tenant, "POST /venues")
    if media_type(request, (JSON, MULTIPART)) == MULTIPART:
        uploaded = await read_upload(request, runtime, LevelsForm)

        def store_levels(token: str) -> Response:
            record = store_venue_of_levels(uploaded, runtime, tenant, client, token)
            return _written(request, record, runtime, status.HTTP_201_CREATED)

        return await uploaded.threads(runtime).run(client, idempotent.run, uploaded.parts, store_levels)
    content = await _read(request, runtime)

    def store(token: str) -> Response:
        document = _document(VenueDocument, content.read(), runtime)
        members = _members(document.plans, runtime)
        limit = runtime.settings.plans.max_venues
        record = runtime.store.venues.add(tenant, token, document.name, _anchor(document.anchor), members, limit=limit)
        return _written(request, record, runtime, status.HTTP_201_CREATED)

    return await runtime.uploads.run(client, idempotent.run, Parts({}, {"body": content}), store)


@router.get("", summary="List venues", responses=problem_responses(InvalidRequestError, StoreUnavailableError))
def list_venues(
    runtime: Running,
    tenant: Tenant,
    name: Annotated[
        str | None,
        Query(max_length=200, pattern=NO_CONTROLS, description="Part of the name; case is ignored."),
    ] = None,
    limit: Annotated[int, Query(ge=1, le=_MAX_LISTED, description="Maximum number of items.")] = 100,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the previous page.")] = None,
) -> VenueList:
    """List stored venues, newest first."""
    after = None if cursor is None else parse_cursor(cursor)
    found = runtime.store.venues.list_venues(tenant, limit=limit + 1, after=after, name=name)
    page = found[:limit]
    more = cursor_text(Cursor(page[-1].created_at, page[-1].id)) if len(found) > limit else None
    return VenueList(venues=[venue_summary(record) for record in page], next_cursor=more)


@router.get(
    "/{venue_id}",
    summary="Get a venue",
    response_model=VenueAnswer,
    openapi_extra={"parameters": [IF_NONE_MATCH]},
    responses=NOT_MODIFIED | problem_responses(UnknownVenueError, InvalidRequestError, StoreUnavailableError),
)
def get_venue(venue_id: str, request: Request, runtime: Running, tenant: Tenant) -> Response:
    """Return a stored venue with the number of plans that are ready."""
    record = _stored(tenant, venue_id, runtime)
    content, etag = venue_representation(record, runtime)
    return not_modified(request, etag) or tagged_answer([content], JSON, etag)


@router.get(
    "/{venue_id}/plans",
    summary="List the plans of a venue",
    responses=problem_responses(UnknownVenueError, InvalidRequestError, StoreUnavailableError),
)
def list_venue_plans(
    venue_id: str,
    runtime: Running,
    tenant: Tenant,
    level: Annotated[
        float | None, Query(ge=-1000, le=1000, allow_inf_nan=False, description="Level of the plans.")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=_MAX_LISTED, description="Maximum number of items.")] = 100,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the previous page.")] = None,
) -> VenuePlanList:
    """List the plans of a venue from the lowest level up, with the state of their pose grids.

    Paging returns every plan that stays in the venue on the same level exactly once.
    """
    record = _stored(tenant, venue_id, runtime)
    after = None if cursor is None else parse_venue_cursor(cursor)
    found = runtime.store.venues.plans(record.id, limit=limit + 1, after=after, level=level)
    page = found[:limit]
    more = venue_cursor_text(VenuePlace(page[-1].level, page[-1].plan_id)) if len(found) > limit else None
    return VenuePlanList(plans=plan_entries(page, runtime), next_cursor=more)


@router.put(
    "/{venue_id}",
    summary="Replace a venue",
    response_model=VenueAnswer,
    openapi_extra={"requestBody": _body(VenueDocument), "parameters": UNLESS_CHANGED},
    responses=problem_responses(*_REFUSED_BODIES, UnknownVenueError, RevisionMismatchError),
)
async def replace_venue(venue_id: str, request: Request, runtime: Running, tenant: Tenant, client: Client) -> Response:
    """Replace the name, anchor and plans of a venue; fields that are left out are reset."""
    content = await _read(request, runtime)

    def store() -> Response:
        current = _stored(tenant, venue_id, runtime)
        expected = expected_revision(request, current.id, current.revision_id, what="venue")
        document = _document(VenueDocument, content.read(), runtime)
        record = runtime.store.venues.change(
            tenant,
            current.id,
            name=document.name,
            anchor=_anchor(document.anchor),
            drop_anchor=document.anchor is None,
            members=_members(document.plans, runtime),
            replace_members=True,
            max_plans=runtime.settings.plans.max_venue_plans,
            expected=expected,
        )
        return _written(request, record, runtime, status.HTTP_200_OK)

    return await runtime.uploads.run(client, store)


@router.patch(
    "/{venue_id}",
    summary="Change a venue",
    response_model=VenueAnswer,
    openapi_extra={"requestBody": _VENUE_CHANGE, "parameters": [*UNLESS_CHANGED, IDEMPOTENCY_KEY]},
    responses=problem_responses(
        *REFUSED_UPLOADS,
        UnknownVenueError,
        RevisionMismatchError,
        TooManyFloorPlansError,
        IdempotencyKeyReusedError,
        IdempotencyInProgressError,
    ),
)
async def change_venue(venue_id: str, request: Request, runtime: Running, tenant: Tenant, client: Client) -> Response:
    """Change the name, the anchor or some plans of a venue.

    A form has a plan file as for `POST /venues`: every level with rooms becomes a plan of the venue, or nothing is
    stored. With an idempotency key, a repeated request does not add the plans again.
    """
    if media_type(request, (JSON, MULTIPART)) == MULTIPART:
        return await _add_levels(venue_id, request, runtime, tenant, client)
    content = await _read(request, runtime)

    def store() -> Response:
        current = _stored(tenant, venue_id, runtime)
        expected = expected_revision(request, current.id, current.revision_id, what="venue")
        document = _document(VenueChangeDocument, content.read(), runtime)
        given = document.model_fields_set
        if not given:
            raise InvalidRequestError([("body", "changes nothing; give name, anchor, plans or remove")])
        record = runtime.store.venues.change(
            tenant,
            current.id,
            name=document.name if "name" in given else None,
            anchor=_anchor(document.anchor),
            drop_anchor="anchor" in given and document.anchor is None,
            members=_members(document.plans, runtime),
            removed=_removed(document),
            max_plans=runtime.settings.plans.max_venue_plans,
            expected=expected,
        )
        return _written(request, record, runtime, status.HTTP_200_OK)

    return await runtime.uploads.run(client, store)


@router.delete(
    "/{venue_id}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a venue",
    openapi_extra={"parameters": UNLESS_CHANGED},
    responses=problem_responses(UnknownVenueError, RevisionMismatchError, InvalidRequestError, StoreUnavailableError),
)
def delete_venue(venue_id: str, request: Request, runtime: Running, tenant: Tenant) -> None:
    """Delete a venue; its floor plans are kept."""
    current = _stored(tenant, venue_id, runtime)
    expected = expected_revision(request, current.id, current.revision_id, what="venue")
    if not runtime.store.venues.delete(tenant, current.id, expected=expected):
        raise UnknownVenueError(venue_id)


async def _add_levels(venue_id: str, request: Request, runtime: Runtime, tenant: str, client: str) -> Response:
    idempotent = IdempotentRequest(
        runtime.store.idempotency_keys, request, tenant, f"PATCH /venues/{venue_id}"[:_MAX_ROUTE]
    )
    uploaded = await read_upload(request, runtime, LevelsForm)

    def store(token: str) -> Response:
        current = _stored(tenant, venue_id, runtime)
        expected = expected_revision(request, current.id, current.revision_id, what="venue")
        record = add_levels_to_venue(uploaded, runtime, tenant, client, current, token, expected)
        return _written(request, record, runtime, status.HTTP_200_OK)

    return await uploaded.threads(runtime).run(client, idempotent.run, uploaded.parts, store)


def _stored(tenant: str, venue_id: str, runtime: Runtime) -> VenueRecord:
    record = runtime.store.venues.get(tenant, venue_id) if is_id(venue_id) else None
    if record is None:
        raise UnknownVenueError(venue_id)
    return record


async def _read(request: Request, runtime: Runtime) -> UploadedFile:
    media_type(request, (JSON,))
    return await read_body(request, UploadLimits.of(runtime.settings, "max_venue_bytes"))


def _document(model: type[Model], content: bytes, runtime: Runtime) -> Model:
    # A plan has four values, and one more to remove it.
    return parse_document(model, content, 5 * runtime.settings.plans.max_venue_plans + _FURTHER_VALUES)


def _anchor(document: VenueAnchorDocument | None) -> Anchor | None:
    return None if document is None else Anchor(**document.model_dump())


def _members(documents: list[VenuePlanDocument], runtime: Runtime) -> list[VenueMember]:
    """Return the plans of a venue in a request.

    Raises:
        InvalidRequestError: too many plans, duplicates, or invalid ids.
    """
    limit = runtime.settings.plans.max_venue_plans
    if len(documents) > limit:
        raise InvalidRequestError(
            [("plans", f"has {len(documents)} floor plans; the limit is {limit} (LALALOC_MAX_VENUE_PLANS)")]
        )
    counted = Counter(document.floorplan_id for document in documents)
    twice = [plan_id for plan_id, count in counted.items() if count > 1]
    if twice:
        raise InvalidRequestError([("plans", f"has floor plan '{twice[0]}' {counted[twice[0]]} times; give it once")])
    if wrong := [plan_id for plan_id in counted if not is_id(plan_id)]:
        raise InvalidRequestError([("plans", f"floor plan '{wrong[0]}' does not exist")])
    return [VenueMember(document.floorplan_id, document.level, document.name) for document in documents]


def _removed(document: VenueChangeDocument) -> set[str]:
    removed = set(document.remove)
    if both := removed & {plan.floorplan_id for plan in document.plans}:
        raise InvalidRequestError(
            [("remove", f"has floor plan '{min(both)[:64]}', which is also in plans; give it in one of them")]
        )
    return removed


def _written(request: Request, record: VenueRecord, runtime: Runtime, code: int) -> Response:
    add_log_fields(request, venue=record.id, revision=record.revision_id)
    content, etag = venue_representation(record, runtime)
    path = str(request.app.url_path_for("get_venue", venue_id=record.id))
    headers = {"Content-Location": path, "ETag": etag}
    if code == status.HTTP_201_CREATED:
        headers["Location"] = path
    return Response(content, code, headers, JSON)
