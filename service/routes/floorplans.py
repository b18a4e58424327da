"""Floor plans: upload, list, read, replace, delete."""

from __future__ import annotations

from dataclasses import astuple
from functools import partial

from fastapi import APIRouter, Response
from starlette.concurrency import run_in_threadpool

from lalaloc_core.importers import OnStep
from service.errors import TooManyFloorPlansError, UnknownFloorPlanError, UnknownRevisionError
from service.grids import GridState
from service.http.problems import problem_responses
from service.http.representations import not_modified, revision_etag, tagged_answer
from service.http.uploads import JSON
from service.plan_documents import Rendition
from service.plan_files.renditions import describe, state_of_description, with_head
from service.routes.dependencies import ApiCall, Call, Name, Page, Revision
from service.routes.descriptions import READ_ERRORS, UPLOAD_ERRORS, changes, deletes, import_lines, reads, stores
from service.routes.plan_uploads import UPLOAD_BODY, PlanFile, PlanUpload, answer_import, prepare_plan, read_upload
from service.schemas.stored_plans import FloorPlanAnswer, FloorPlanList, FloorPlanSummary
from service.storage.records import PlanRecord, PlanSummary

router = APIRouter(prefix="/floorplans", tags=["floor plans"])


@router.post(
    "",
    summary="Upload a floor plan",
    **stores(FloorPlanAnswer, UPLOAD_BODY, *UPLOAD_ERRORS, TooManyFloorPlansError, lines=import_lines(FloorPlanAnswer)),
)
async def create_floorplan(call: Call) -> Response:
    """Store a floor plan from a plan file.

    The format is detected from the content: JSON in the native format, GeoJSON, an IMDF archive, OpenStreetMap, a
    RoomPlan scan, SVG, DXF, IFC, PDF, or a picture. `import_report` tells how the file was read; a plan read from a
    picture is a draft, so check it before use. A small plan is `ready` at once; the pose grid of a larger plan is
    computed in the background (see `status`, `progress` and `/events`). Lines tell the steps of the import.
    """
    idempotent = call.idempotent()
    uploaded = await read_upload(call)
    return await answer_import(call, idempotent, uploaded, partial(_create, call, uploaded))


def _create(call: ApiCall, uploaded: PlanUpload, token: str, on_step: OnStep | None) -> Response:
    plans, grids = call.store.plans, call.runtime.grids
    new, file = prepare_plan(uploaded, call, on_step)
    record = plans.add(call.tenant, token, new, limit=call.settings.plans.max_floorplans)
    if record.plan is new.plan:
        grids.on_plan_stored(record, new.grid)
        # Not read back, so that a stored plan is confirmed even if the database fails now.
        state = GridState.after_upload(new.grid)
    else:
        # Stored by an earlier attempt, and possibly replaced since.
        grids.on_plan_stored(record, None)
        state = grids.states([call.plan(record.id)])[0]
    return _change_answer(call, record, file, state, created=True)


@router.get("", summary="List floor plans", responses=problem_responses(*READ_ERRORS))
def list_floorplans(call: Call, page: Page, name: Name = None) -> FloorPlanList:
    """List stored floor plans, newest first.

    Paging returns every plan that exists throughout exactly once, even if others are uploaded or deleted meanwhile.
    """
    found, more = page.read(partial(call.store.plans.list_plans, call.tenant, name=name))
    return FloorPlanList(floorplans=_list_entries(found, call.runtime.grids.states(found)), next_cursor=more)


@router.get(
    "/{floorplan_id}", summary="Get a floor plan", **reads(FloorPlanAnswer, UnknownFloorPlanError, UnknownRevisionError)
)
async def get_floorplan(floorplan_id: str, call: Call, revision: Revision = None) -> Response:
    """Return a stored floor plan with the status and progress of its pose grid."""

    def look() -> tuple[PlanSummary, GridState, bool]:
        plan, superseded = call.plan_at_revision(floorplan_id, revision)
        return plan, call.runtime.grids.states([plan])[0], superseded

    plan, state, superseded = await run_in_threadpool(look)
    step_m = call.settings.grids.grid_step_m
    etag = _description_etag(plan.revision_id, state, step_m, superseded=superseded)
    if (answer := not_modified(call.request, etag)) is not None:
        return answer
    description = await call.rendition(plan, "description")
    return tagged_answer(_description_parts(description, state, step_m, superseded=superseded), JSON, etag)


@router.put(
    "/{floorplan_id}",
    summary="Replace a floor plan",
    **changes(FloorPlanAnswer, UPLOAD_BODY, *UPLOAD_ERRORS, UnknownFloorPlanError),
)
async def replace_floorplan(floorplan_id: str, call: Call) -> Response:
    """Store a new revision of a floor plan, from a file of any format that `POST /floorplans` accepts.

    Queries in progress use the revision that they began with, and return it as `floorplan_revision`.
    """
    current = await call.upload(call.plan, floorplan_id)
    expected = call.expected_revision(current)
    uploaded = await read_upload(call)
    return await uploaded.on_thread(call, _replace, call, uploaded, current, expected)


def _replace(call: ApiCall, uploaded: PlanUpload, current: PlanSummary, expected: str | None) -> Response:
    plans, grids = call.store.plans, call.runtime.grids
    new, file = prepare_plan(uploaded, call)
    keep = call.settings.plans.max_revisions
    record = plans.add_revision(call.tenant, current.id, new, keep=keep, expected=expected)
    # Before the new grid starts. The old grid stays in memory for queries in progress.
    grids.cancel(current.revision_id)
    grids.on_plan_stored(record, new.grid)
    return _change_answer(call, record, file, GridState.after_upload(new.grid), created=False)


@router.delete("/{floorplan_id}", summary="Delete a floor plan", **deletes(UnknownFloorPlanError))
def delete_floorplan(floorplan_id: str, call: Call) -> None:
    """Delete a floor plan with all its revisions, uploaded files and pose grids.

    The computation of its pose grid is cancelled. Venues with this plan get a new revision without it.
    """
    current = call.plan(floorplan_id)
    if not call.store.plans.delete(call.tenant, current.id, expected=call.expected_revision(current)):
        raise UnknownFloorPlanError(floorplan_id)
    call.runtime.grids.forget({current.revision_id})


def _change_answer(call: ApiCall, record: PlanRecord, file: PlanFile, state: GridState, *, created: bool) -> Response:
    call.log(plan=record.id, revision=record.revision_id)
    step_m = call.settings.grids.grid_step_m
    if file.description is None or record.plan is not file.plan:
        description = describe(record.plan, record, step_m)
    else:
        description = with_head(file.description, record)
    call.runtime.renditions.put(record.revision_id, "description", description)
    content = b"".join(_description_parts(description, state, step_m))
    path = call.path_of("get_floorplan", floorplan_id=record.id)
    return call.change_answer(content, _description_etag(record.revision_id, state, step_m), path, created=created)


def _description_etag(revision_id: str, state: GridState, step_m: float, *, superseded: bool = False) -> str:
    """Return the entity tag of a plan's description; `superseded` marks an old revision."""
    return revision_etag(revision_id, "description", superseded, astuple(state), step_m)


def _description_parts(
    description: Rendition, state: GridState, step_m: float, *, superseded: bool = False
) -> tuple[bytes, bytes]:
    """Return a plan as JSON in two parts; `superseded` marks an old revision."""
    head = state_of_description(
        "superseded" if superseded else state.status,
        state.progress,
        state.reason,
        poses=description.poses if state.poses is None else state.poses,
        step_m=step_m,
    )
    return head, description.content


def _list_entries(summaries: list[PlanSummary], states: list[GridState]) -> list[FloorPlanSummary]:
    return [
        FloorPlanSummary(
            id=summary.id,
            revision=summary.revision_id,
            revision_number=summary.revision,
            name=summary.name,
            status=state.status,
            progress=state.progress,
            rooms=summary.room_count,
            area_m2=summary.area_m2,
            created_at=summary.created_at,
            updated_at=summary.updated_at,
        )
        for summary, state in zip(summaries, states, strict=True)
    ]
