"""Floor plans: upload, list, read, replace, delete."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response, status
from starlette.concurrency import run_in_threadpool

from lalaloc_core.importers import building_name
from service.errors import (
    IdempotencyInProgressError,
    IdempotencyKeyReusedError,
    InvalidRequestError,
    RevisionMismatchError,
    StoreUnavailableError,
    TooManyFloorPlansError,
    UnknownFloorPlanError,
    UnknownRevisionError,
)
from service.grids import GridState
from service.http import IdempotentRequest
from service.http.conditional import expected_revision, not_modified, tagged_answer
from service.http.cursors import cursor_text, parse_cursor
from service.http.problems import problem_responses
from service.http.uploads import JSON
from service.plan_files.plan_description import describe, with_head
from service.plan_files.plan_file import PlanFile, convert
from service.routes.dependencies import (
    IDEMPOTENCY_KEY,
    IF_NONE_MATCH,
    NO_CONTROLS,
    NOT_MODIFIED,
    UNLESS_CHANGED,
    Client,
    Running,
    Tenant,
    plan_at_revision,
    plan_summary,
)
from service.routes.plan_answers import description_etag, description_parts, list_entries
from service.routes.plan_uploads import REFUSED_UPLOADS, UPLOAD_BODY, PlanUpload, read_upload
from service.runtime import Runtime
from service.schemas import FloorPlanAnswer, FloorPlanList
from service.storage.records import ComputedGrid, Cursor, Original, PlanRecord, PlanSummary
from service.telemetry import add_log_fields

router = APIRouter(prefix="/floorplans", tags=["floor plans"])

_MAX_LISTED = 500


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    summary="Upload a floor plan",
    response_model=FloorPlanAnswer,
    openapi_extra={"requestBody": UPLOAD_BODY, "parameters": [IDEMPOTENCY_KEY]},
    responses=problem_responses(
        *REFUSED_UPLOADS, TooManyFloorPlansError, IdempotencyKeyReusedError, IdempotencyInProgressError
    ),
)
async def create_floorplan(request: Request, runtime: Running, tenant: Tenant, client: Client) -> Response:
    """Store a floor plan from a plan file.

    The format is detected from the content: JSON in the native format, GeoJSON, an IMDF archive, OpenStreetMap, a
    RoomPlan scan, SVG, DXF, IFC, PDF, or a picture. `import_report` tells how the file was read; a plan read from a
    picture is a draft, so check it before use. A small plan is `ready` at once; the pose grid of a larger plan is
    computed in the background (see `status`, `progress` and `/events`).
    """
    idempotent = IdempotentRequest(runtime.store.idempotency_keys, request, tenant, "POST /floorplans")
    uploaded = await read_upload(request, runtime)

    def store(token: str) -> Response:
        file, original, grid = _prepared(uploaded, runtime, client)
        limit = runtime.settings.plans.max_floorplans
        later_bytes = runtime.grids.expected_bytes(file.plan) if grid is None else 0
        record = runtime.store.plans.add(
            tenant,
            token,
            file.plan,
            original=original,
            limit=limit,
            document=file.document,
            grid=grid,
            later_bytes=later_bytes,
        )
        if record.plan is file.plan:
            runtime.grids.on_plan_stored(record, grid)
            # Not read back, so that a stored plan is confirmed even if the database fails now.
            state = GridState.after_upload(grid)
        else:
            # Stored by an earlier attempt, and possibly replaced since.
            runtime.grids.on_plan_stored(record, None)
            state = runtime.grids.states([plan_summary(tenant, record.id, runtime.store.plans)])[0]
        return _written(request, record, file, state, runtime, status.HTTP_201_CREATED)

    # One call from claim to answer, so that a disconnect does not interrupt it.
    return await uploaded.threads(runtime).run(client, idempotent.run, uploaded.parts, store)


@router.get("", summary="List floor plans", responses=problem_responses(InvalidRequestError, StoreUnavailableError))
def list_floorplans(
    runtime: Running,
    tenant: Tenant,
    name: Annotated[
        str | None,
        Query(max_length=200, pattern=NO_CONTROLS, description="Part of the name; case is ignored."),
    ] = None,
    limit: Annotated[int, Query(ge=1, le=_MAX_LISTED, description="Maximum number of items.")] = 100,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the previous page.")] = None,
) -> FloorPlanList:
    """List stored floor plans, newest first.

    Paging returns every plan that exists throughout exactly once, even if others are uploaded or deleted meanwhile.
    """
    after = None if cursor is None else parse_cursor(cursor)
    # One extra item shows that there is another page.
    found = runtime.store.plans.list_plans(tenant, limit=limit + 1, after=after, name=name)
    page = found[:limit]
    more = cursor_text(Cursor(page[-1].created_at, page[-1].id)) if len(found) > limit else None
    return FloorPlanList(floorplans=list_entries(page, runtime.grids), next_cursor=more)


@router.get(
    "/{floorplan_id}",
    summary="Get a floor plan",
    response_model=FloorPlanAnswer,
    openapi_extra={"parameters": [IF_NONE_MATCH]},
    responses=NOT_MODIFIED
    | problem_responses(UnknownFloorPlanError, UnknownRevisionError, InvalidRequestError, StoreUnavailableError),
)
async def get_floorplan(
    floorplan_id: str,
    request: Request,
    runtime: Running,
    tenant: Tenant,
    client: Client,
    revision: Annotated[str | None, Query(description="Id of an older revision.")] = None,
) -> Response:
    """Return a stored floor plan with the status and progress of its pose grid."""

    def look() -> tuple[PlanSummary, GridState, bool]:
        current = plan_summary(tenant, floorplan_id, runtime.store.plans)
        plan = plan_at_revision(tenant, current, revision, runtime.store.plans)
        return plan, runtime.grids.states([plan])[0], plan.revision_id != current.revision_id

    plan, state, superseded = await run_in_threadpool(look)
    add_log_fields(request, plan=plan.id, revision=plan.revision_id)
    step_m = runtime.settings.grids.grid_step_m
    etag = description_etag(plan.revision_id, state, step_m, superseded=superseded)
    if (answer := not_modified(request, etag)) is not None:
        return answer
    description = await runtime.renditions.get(plan.id, plan.revision_id, "description", client)
    return tagged_answer(description_parts(description, state, step_m, superseded=superseded), JSON, etag)


@router.put(
    "/{floorplan_id}",
    summary="Replace a floor plan",
    response_model=FloorPlanAnswer,
    openapi_extra={"requestBody": UPLOAD_BODY, "parameters": UNLESS_CHANGED},
    responses=problem_responses(*REFUSED_UPLOADS, UnknownFloorPlanError, RevisionMismatchError),
)
async def replace_floorplan(
    floorplan_id: str, request: Request, runtime: Running, tenant: Tenant, client: Client
) -> Response:
    """Store a new revision of a floor plan, from a file of any format that `POST /floorplans` accepts.

    Queries in progress use the revision that they began with, and return it as `floorplan_revision`.
    """
    current = await runtime.uploads.run(client, plan_summary, tenant, floorplan_id, runtime.store.plans)
    expected = expected_revision(request, current.id, current.revision_id)
    uploaded = await read_upload(request, runtime)

    def store() -> Response:
        file, original, grid = _prepared(uploaded, runtime, client)
        keep = runtime.settings.plans.max_revisions
        later_bytes = runtime.grids.expected_bytes(file.plan) if grid is None else 0
        record = runtime.store.plans.add_revision(
            tenant,
            current.id,
            file.plan,
            original=original,
            keep=keep,
            expected=expected,
            document=file.document,
            grid=grid,
            later_bytes=later_bytes,
        )
        # Before the new grid starts. The old grid stays in memory for queries in progress.
        runtime.grids.cancel(current.revision_id)
        runtime.grids.on_plan_stored(record, grid)
        return _written(request, record, file, GridState.after_upload(grid), runtime, status.HTTP_200_OK)

    return await uploaded.threads(runtime).run(client, store)


@router.delete(
    "/{floorplan_id}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a floor plan",
    openapi_extra={"parameters": UNLESS_CHANGED},
    responses=problem_responses(
        UnknownFloorPlanError, RevisionMismatchError, InvalidRequestError, StoreUnavailableError
    ),
)
def delete_floorplan(floorplan_id: str, request: Request, runtime: Running, tenant: Tenant) -> None:
    """Delete a floor plan with all its revisions, uploaded files and pose grids.

    The computation of its pose grid is cancelled. Venues with this plan get a new revision without it.
    """
    current = plan_summary(tenant, floorplan_id, runtime.store.plans)
    add_log_fields(request, plan=current.id, revision=current.revision_id)
    expected = expected_revision(request, current.id, current.revision_id)
    if not runtime.store.plans.delete(tenant, current.id, expected=expected):
        raise UnknownFloorPlanError(floorplan_id)
    runtime.grids.forget({current.revision_id})


def _prepared(uploaded: PlanUpload, runtime: Runtime, client: str) -> tuple[PlanFile, Original, ComputedGrid | None]:
    """Return the plan in an uploaded file, the file as stored, and the pose grid if it is computed at once."""
    content = uploaded.file.read()
    name = building_name(uploaded.file.name)
    file = convert(content, uploaded.options, name, runtime.converter, runtime.settings, client, runtime.permits)
    runtime.grids.check_size(file.plan)
    original = Original(content, file.media_type, file.report)
    return file, original, runtime.grids.prepare(file.plan, client)


def _written(
    request: Request, record: PlanRecord, file: PlanFile, state: GridState, runtime: Runtime, code: int
) -> Response:
    add_log_fields(request, plan=record.id, revision=record.revision_id)
    step_m = runtime.settings.grids.grid_step_m
    if file.description is None or record.plan is not file.plan:
        description = describe(record.plan, record, step_m)
    else:
        description = with_head(file.description, record)
    runtime.renditions.put(record.revision_id, "description", description)
    content = b"".join(description_parts(description, state, step_m))
    path = str(request.app.url_path_for("get_floorplan", floorplan_id=record.id))
    # The tag of this answer, which is also that of a GET from this location.
    headers = {"Content-Location": path, "ETag": description_etag(record.revision_id, state, step_m)}
    if code == status.HTTP_201_CREATED:
        headers["Location"] = path
    return Response(content, code, headers, JSON)
