"""Floor plans: upload, list, look at, delete."""

from __future__ import annotations

import asyncio
import re
import uuid
from contextlib import suppress
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response, status
from pydantic import Field

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.sampling import grid_size
from service.errors import (
    InvalidRequestError,
    MalformedRequestError,
    OverloadedError,
    PlanTooLargeError,
    StoppingError,
    TooManyFloorPlansError,
    UnknownFloorPlanError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
)
from service.grids import GridState
from service.preview.mesh import plan_glb
from service.preview.svg import Marker, plan_svg
from service.problems import problem_responses
from service.runtime import Runtime, runtime_of
from service.schemas import (
    BoundsAnswer,
    FloorPlanAnswer,
    FloorPlanDocument,
    FloorPlanList,
    FloorPlanSummary,
    GridAnswer,
    RoomAnswer,
)
from service.store import PlanRecord, PlanSummary
from service.uploads import JSON, MULTIPART, UploadLimits, media_type, read_body, read_parts

router = APIRouter(prefix="/floorplans", tags=["floor plans"])
Running = Annotated[Runtime, Depends(runtime_of)]

# Three rounded numbers may be a covariance by so much less.
_ROUNDED = 1e-3
_ID = re.compile(r"[0-9a-f]{32}")
_DOCUMENT: dict[str, Any] = {"$ref": "#/components/schemas/FloorPlanDocument"}
_UPLOAD = {
    "requestBody": {
        "required": True,
        "content": {
            JSON: {"schema": _DOCUMENT},
            MULTIPART: {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {
                        "file": {
                            "type": "string",
                            "format": "binary",
                            "description": f"The same JSON ({FloorPlanDocument.__name__}) as a file.",
                        }
                    },
                },
            },
        },
    }
}


@router.post(
    "",
    status_code=status.HTTP_201_CREATED,
    summary="Upload a floor plan",
    openapi_extra=_UPLOAD,
    responses=problem_responses(
        InvalidFloorPlanError,
        InvalidRequestError,
        PlanTooLargeError,
        MalformedRequestError,
        UnsupportedMediaError,
        UploadTooLargeError,
        UploadTimeoutError,
        TooManyFloorPlansError,
        OverloadedError,
    ),
)
async def create_floorplan(request: Request, response: Response, runtime: Running) -> FloorPlanAnswer:
    """Store a floor plan; its latent grid is computed in the background (see `status` and `progress`)."""
    with runtime.slots.one():
        content = await _uploaded_plan(request, runtime)
        record = await asyncio.to_thread(_store, content, runtime)
    response.headers["Location"] = str(request.app.url_path_for("get_floorplan", floorplan_id=record.id))
    return await asyncio.to_thread(_answer, record, runtime)


@router.get("", summary="List floor plans", responses=problem_responses(InvalidRequestError))
def list_floorplans(
    runtime: Running,
    offset: Annotated[int, Query(ge=0, le=10**9, description="How many of the newest to skip.")] = 0,
    limit: Annotated[int, Query(ge=1, le=500, description="How many to return.")] = 100,
) -> FloorPlanList:
    """Stored floor plans, newest first."""
    summaries = runtime.store.plans(offset=offset, limit=limit)
    states = runtime.grids.states(summaries)
    return FloorPlanList(
        floorplans=[
            FloorPlanSummary(
                id=summary.id,
                name=summary.name,
                status=state.status,
                progress=state.progress,
                rooms=summary.room_count,
                area_m2=round(summary.area_m2, 3),
                created_at=summary.created_at,
            )
            for summary, state in zip(summaries, states, strict=True)
        ],
        total=runtime.store.plan_count(),
    )


@router.get("/{floorplan_id}", summary="A floor plan", responses=problem_responses(UnknownFloorPlanError))
def get_floorplan(floorplan_id: str, runtime: Running) -> FloorPlanAnswer:
    """A stored floor plan with the status and progress of its latent grid."""
    return _answer(stored_plan(floorplan_id, runtime), runtime)


@router.delete(
    "/{floorplan_id}",
    status_code=status.HTTP_204_NO_CONTENT,
    summary="Delete a floor plan",
    responses=problem_responses(UnknownFloorPlanError),
)
def delete_floorplan(floorplan_id: str, runtime: Running) -> None:
    """Delete a floor plan, the file it was uploaded as, and its latent grids."""
    record = stored_plan(floorplan_id, runtime)
    if not runtime.store.delete_plan(record.id):
        raise UnknownFloorPlanError(floorplan_id)
    runtime.grids.forget(record.id)


@router.get(
    "/{floorplan_id}/original",
    summary="The file as it was uploaded",
    response_class=Response,
    responses={
        200: {"content": {JSON: {"schema": _DOCUMENT}}},
        **problem_responses(UnknownFloorPlanError),
    },
)
def get_original(floorplan_id: str, runtime: Running) -> Response:
    """The bytes that were uploaded, unchanged."""
    content = runtime.store.original(stored_plan(floorplan_id, runtime).id)
    if content is None:
        raise UnknownFloorPlanError(floorplan_id)
    return Response(content, media_type=JSON, headers={"X-Content-Type-Options": "nosniff"})


@router.get(
    "/{floorplan_id}/preview.svg",
    summary="A drawing",
    response_class=Response,
    responses={
        200: {"content": {"image/svg+xml": {"schema": {"type": "string"}}}},
        **problem_responses(UnknownFloorPlanError, InvalidRequestError),
    },
)
def get_preview(
    floorplan_id: str,
    runtime: Running,
    x_m: Annotated[float | None, Query(allow_inf_nan=False, description="Mark a camera at this x.")] = None,
    y_m: Annotated[float | None, Query(allow_inf_nan=False, description="Mark a camera at this y.")] = None,
    heading_deg: Annotated[
        float | None, Query(ge=-360, le=360, allow_inf_nan=False, description="Heading of the marked camera.")
    ] = None,
    covariance_m2: Annotated[
        list[Annotated[float, Field(allow_inf_nan=False, ge=-1e6, le=1e6)]] | None,
        Query(
            min_length=3,
            max_length=3,
            description="Covariance of the marked position in m², given three times as xx, xy and yy: the ellipse that "
            "holds 95 % is drawn.",
        ),
    ] = None,
) -> Response:
    """The plan with the names of its rooms, optionally with a camera drawn in; one SVG unit is one metre."""
    if (x_m is None) != (y_m is None):
        raise InvalidRequestError([("y_m" if y_m is None else "x_m", "is missing; x_m and y_m belong together")])
    record = stored_plan(floorplan_id, runtime)
    marker = None
    if x_m is not None and y_m is not None:
        marker = Marker(x_m=x_m, y_m=y_m, heading_deg=heading_deg, covariance_m2=_covariance(covariance_m2))
    return Response(
        plan_svg(record.plan, marker),
        media_type="image/svg+xml",
        # An SVG can carry scripts; ours never does, and must not be talked into it.
        headers={"Content-Security-Policy": "default-src 'none'", "X-Content-Type-Options": "nosniff"},
    )


@router.get(
    "/{floorplan_id}/mesh.glb",
    summary="A mesh",
    response_class=Response,
    responses={
        200: {"content": {"model/gltf-binary": {"schema": {"type": "string", "format": "binary"}}}},
        **problem_responses(UnknownFloorPlanError),
    },
)
def get_mesh(floorplan_id: str, runtime: Running) -> Response:
    """Floor, walls and ceiling of every room as binary glTF, in metres and y-up."""
    return Response(plan_glb(stored_plan(floorplan_id, runtime).plan), media_type="model/gltf-binary")


def _covariance(given: list[float] | None) -> tuple[float, float, float] | None:
    """Three numbers as (xx, xy, yy).

    Raises:
        InvalidRequestError: no covariance has these.
    """
    if given is None:
        return None
    xx, xy, yy = given
    if xx < 0.0 or yy < 0.0 or xy * xy > xx * yy * (1.0 + _ROUNDED):
        raise InvalidRequestError(
            [("covariance_m2", f"is {xx:g}, {xy:g}, {yy:g}: xx and yy must not be negative, nor xy² above xx·yy")]
        )
    return xx, xy, yy


def stored_plan(floorplan_id: str, runtime: Runtime) -> PlanRecord:
    """A stored plan.

    Raises:
        UnknownFloorPlanError: there is none.
    """
    # Ids are made here; whatever looks different need not reach the database.
    record = runtime.store.plan(floorplan_id) if _ID.fullmatch(floorplan_id) else None
    if record is None:
        raise UnknownFloorPlanError(floorplan_id)
    return record


async def _uploaded_plan(request: Request, runtime: Runtime) -> bytes:
    limits = UploadLimits(runtime.settings.max_plan_bytes, runtime.settings.upload_deadline_s)
    if media_type(request, (JSON, MULTIPART)) == JSON:
        content = await read_body(request, limits)
    else:
        content = (await read_parts(request, limits, files={"file"}, fields=set())).files["file"]
    if not content.strip():
        raise InvalidFloorPlanError("the body is empty, a floor plan in JSON is needed")
    return content


def _store(content: bytes, runtime: Runtime) -> PlanRecord:
    plan = FloorPlan.from_json(content, runtime.settings.plan_limits)
    runtime.grids.check_size(plan)
    record = runtime.store.add_plan(uuid.uuid4().hex, plan, original=content, limit=runtime.settings.max_floorplans)
    # A service that is stopping has the plan stored all the same, and takes its grid up at the next start.
    with suppress(StoppingError):
        runtime.grids.compute(runtime.grids.key(record.id, plan.camera_height_m))
    return record


def _answer(record: PlanRecord, runtime: Runtime) -> FloorPlanAnswer:
    plan = record.plan
    state: GridState = runtime.grids.states([_summary(record)])[0]
    x_min, y_min, x_max, y_max = plan.bounds_m
    step_m = runtime.settings.grid_step_m
    return FloorPlanAnswer(
        id=record.id,
        name=plan.name,
        status=state.status,
        progress=state.progress,
        reason=state.reason,
        rooms=[
            RoomAnswer(
                name=room.name,
                area_m2=round(room.area_m2, 3),
                ceiling_height_m=room.ceiling_height_m,
                vertices=len(room.polygon_m),
            )
            for room in plan.rooms
        ],
        area_m2=round(plan.area_m2, 3),
        bounds=BoundsAnswer(x_min_m=x_min, y_min_m=y_min, x_max_m=x_max, y_max_m=y_max),
        camera_height_m=plan.camera_height_m,
        grid=GridAnswer(step_m=step_m, poses=grid_size(plan, step_m) if state.poses is None else state.poses),
        warnings=list(plan.warnings),
        created_at=record.created_at,
    )


def _summary(record: PlanRecord) -> PlanSummary:
    return PlanSummary(
        id=record.id,
        created_at=record.created_at,
        name=record.plan.name,
        room_count=len(record.plan.rooms),
        area_m2=record.plan.area_m2,
        camera_height_m=record.plan.camera_height_m,
        failure=record.failure,
    )
