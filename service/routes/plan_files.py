"""Downloads of a stored plan: original file, export, drawing, mesh, localisability."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from lalaloc_core.conditions import HeadingState, Photograph, condition_of
from lalaloc_core.draw.plan import HEAT_PLACE, Bounds, Marker, svg_around
from lalaloc_core.errors import MissingExtraError
from lalaloc_core.importers import EXPORT_FORMATS, FORMATS, ExportFormat
from service.errors import (
    ConverterNotReadyError,
    InvalidRequestError,
    StoreUnavailableError,
    UnanchoredPlanError,
    UnknownFloorPlanError,
    UnmeasuredModelError,
)
from service.http.conditional import digest_etag, not_modified, revision_etag, tagged_answer, tagged_stream
from service.http.problems import problem_responses
from service.http.uploads import JSON
from service.routes.dependencies import IF_NONE_MATCH, NOT_MODIFIED, Client, Running, Tenant, plan_summary
from service.runtime import Runtime
from service.schemas import LocalisabilityAnswer
from service.storage.records import PlanSummary
from service.stored_plan import PREDICTIONS, RenditionKind
from service.telemetry import add_log_fields

router = APIRouter(prefix="/floorplans", tags=["floor plans"])

_HEAT = HEAT_PLACE.encode()
_SVG, _GLB = "image/svg+xml", "model/gltf-binary"
# Defence in depth: drawings have no scripts. Maps are embedded pictures.
_INERT = "default-src 'none'; img-src data:"
# Tolerance for a covariance whose three numbers were rounded.
_ROUNDED = 1e-3
_PROBLEMS = problem_responses(UnknownFloorPlanError, InvalidRequestError, StoreUnavailableError)
_CONDITIONAL = {"parameters": [IF_NONE_MATCH]}
# Predictions are made by conversion workers.
_PREDICTED = problem_responses(
    UnknownFloorPlanError, InvalidRequestError, UnmeasuredModelError, StoreUnavailableError, ConverterNotReadyError
)


@router.get(
    "/{floorplan_id}/original",
    summary="Get the uploaded file",
    response_class=Response,
    openapi_extra=_CONDITIONAL,
    responses={
        200: {
            # Bytes, even of a JSON plan: generated clients must not parse what was uploaded.
            "content": {"*/*": {"schema": {"type": "string", "format": "binary"}}}
        },
        **NOT_MODIFIED,
        **_PROBLEMS,
    },
)
async def get_original(
    floorplan_id: str, request: Request, runtime: Running, tenant: Tenant, client: Client
) -> Response:
    """Return the uploaded file of the current revision, unchanged, with the media type of its content."""
    plan, originals = await _look(request, tenant, floorplan_id, runtime), runtime.store.originals
    digest = await run_in_threadpool(originals.digest, plan.revision_id)
    if digest is not None and (answer := not_modified(request, digest_etag(digest))) is not None:
        return answer
    original = await run_in_threadpool(originals.checked, plan.revision_id)
    if digest is None or original is None:
        raise UnknownFloorPlanError(floorplan_id)
    # An uploaded drawing can contain scripts, so browsers must not open it as a page of this service.
    kept = {"Content-Disposition": "attachment"} if original.media_type != JSON else None
    chunks = _chunks(plan, original.size_bytes, request, runtime, client)
    return tagged_stream(chunks, original.size_bytes, original.media_type, digest_etag(digest), kept)


@router.get(
    "/{floorplan_id}/export",
    summary="Export a floor plan",
    response_class=Response,
    openapi_extra=_CONDITIONAL,
    responses={
        200: {
            "content": {
                FORMATS[name].media_type: {"schema": {"type": "string", "format": "binary"}} for name in EXPORT_FORMATS
            }
        },
        **NOT_MODIFIED,
        **problem_responses(
            UnknownFloorPlanError,
            UnanchoredPlanError,
            MissingExtraError,
            InvalidRequestError,
            StoreUnavailableError,
            ConverterNotReadyError,
        ),
    },
)
async def get_export(
    floorplan_id: str,
    request: Request,
    runtime: Running,
    tenant: Tenant,
    client: Client,
    format: Annotated[
        ExportFormat,
        Query(description="Format of the file. IMDF needs a plan with an `anchor`; GeoJSON uses it if present."),
    ] = "native",
) -> Response:
    """Return the plan in another file format."""
    plan = await _look(request, tenant, floorplan_id, runtime)
    if format == "imdf" and not plan.anchored:
        raise UnanchoredPlanError(plan.id)
    kept = {"Content-Disposition": f'attachment; filename="plan.{FORMATS[format].suffix}"'}
    return await _rendition(request, plan, format, FORMATS[format].media_type, runtime, client, kept)


@router.get(
    "/{floorplan_id}/preview.svg",
    summary="Get a drawing",
    response_class=Response,
    openapi_extra=_CONDITIONAL,
    responses={200: {"content": {_SVG: {"schema": {"type": "string"}}}}, **NOT_MODIFIED, **_PROBLEMS},
)
async def get_preview(
    floorplan_id: str,
    request: Request,
    runtime: Running,
    tenant: Tenant,
    client: Client,
    x_m: Annotated[float | None, Query(allow_inf_nan=False, description="x of a camera to mark.")] = None,
    y_m: Annotated[float | None, Query(allow_inf_nan=False, description="y of a camera to mark.")] = None,
    heading_deg: Annotated[
        float | None, Query(ge=-360, le=360, allow_inf_nan=False, description="Heading of the marked camera.")
    ] = None,
    covariance_m2: Annotated[
        list[Annotated[float, Field(allow_inf_nan=False, ge=-1e6, le=1e6)]] | None,
        Query(
            min_length=3,
            max_length=3,
            description="Covariance of the marked position in m²: the parameter three times, for xx, xy and yy. The "
            "95 % ellipse is drawn.",
        ),
    ] = None,
) -> Response:
    """Return a drawing of the plan with room names, and optionally a camera; one SVG unit is one metre."""
    if (x_m is None) != (y_m is None):
        raise InvalidRequestError([("y_m" if y_m is None else "x_m", "is missing; give both x_m and y_m")])
    if x_m is None:
        marker_fields = {"heading_deg": heading_deg, "covariance_m2": covariance_m2}
        faults = [(name, "needs x_m and y_m") for name, value in marker_fields.items() if value is not None]
        if faults:
            raise InvalidRequestError(faults)
    marker = None
    if x_m is not None and y_m is not None:
        marker = Marker(x_m=x_m, y_m=y_m, heading_deg=heading_deg, covariance_m2=_covariance(covariance_m2))
    plan = await _look(request, tenant, floorplan_id, runtime)
    policy = {"Content-Security-Policy": _INERT}
    etag = revision_etag(plan.revision_id, "preview", marker)
    if (answer := not_modified(request, etag, policy)) is not None:
        return answer
    rooms = await runtime.renditions.get(plan.id, plan.revision_id, "preview", client)
    if marker is not None:
        _check_near(marker, rooms.bounds_m)
    head, tail = svg_around(plan.name, rooms.bounds_m, marker)
    heat, drawn = rooms.content.index(_HEAT), memoryview(rooms.content)
    parts = (head.encode(), drawn[:heat], drawn[heat + len(_HEAT) :], tail.encode())
    return tagged_answer(parts, _SVG, etag, policy)


@router.get(
    "/{floorplan_id}/mesh.glb",
    summary="Get a mesh",
    response_class=Response,
    openapi_extra=_CONDITIONAL,
    responses={
        200: {"content": {_GLB: {"schema": {"type": "string", "format": "binary"}}}},
        **NOT_MODIFIED,
        **_PROBLEMS,
    },
)
async def get_mesh(floorplan_id: str, request: Request, runtime: Running, tenant: Tenant, client: Client) -> Response:
    """Return floor, walls and ceiling of every room as binary glTF, in metres and y-up."""
    plan = await _look(request, tenant, floorplan_id, runtime)
    return await _rendition(request, plan, "mesh", _GLB, runtime, client)


@router.get(
    "/{floorplan_id}/localisability",
    summary="Predict which photographs will be found",
    response_model=LocalisabilityAnswer,
    openapi_extra=_CONDITIONAL,
    responses={**NOT_MODIFIED, **_PREDICTED},
)
async def get_localisability(
    floorplan_id: str, request: Request, runtime: Running, tenant: Tenant, client: Client
) -> Response:
    """Predict which photographs will be found, from the plan and the model's measured errors alone.

    For places spread over the plan: the probability that the answer to a photograph taken there is right, for a
    sphere, a phone photograph and three of them, with known and unknown heading. Also which rooms are confused, and
    what helps most. The first request for a revision takes seconds; the result is kept.
    """
    plan = await _look(request, tenant, floorplan_id, runtime)
    return await _rendition(request, plan, "localisability", JSON, runtime, client)


@router.get(
    "/{floorplan_id}/localisability.svg",
    summary="Get a map of the photographs that will be found",
    response_class=Response,
    openapi_extra=_CONDITIONAL,
    responses={200: {"content": {_SVG: {"schema": {"type": "string"}}}}, **NOT_MODIFIED, **_PREDICTED},
)
async def get_localisability_map(
    floorplan_id: str,
    request: Request,
    runtime: Running,
    tenant: Tenant,
    client: Client,
    photograph: Annotated[
        Photograph, Query(description="A sphere, a phone photograph of 80°, or three of these from one spot.")
    ] = "phone",
    heading: Annotated[HeadingState, Query(description="Whether the heading is known.")] = "unknown",
) -> Response:
    """Return a drawing of the plan with the probability by place that a photograph is found; darker is higher."""
    plan = await _look(request, tenant, floorplan_id, runtime)
    condition = condition_of(photograph, heading)
    return await _rendition(request, plan, condition, _SVG, runtime, client, {"Content-Security-Policy": _INERT})


async def _chunks(
    plan: PlanSummary, size_bytes: int, request: Request, runtime: Runtime, client: str
) -> AsyncIterator[bytes]:
    """Yield the uploaded file, until the client has gone.

    Raises:
        UnknownFloorPlanError: the revision was deleted meanwhile, so that the connection ends before the answer.
    """
    sent_bytes = number = 0
    while sent_bytes < size_bytes and not await request.is_disconnected():
        async with runtime.admission.reading.held(client):
            chunk = await run_in_threadpool(runtime.store.originals.chunk, plan.revision_id, number)
        if chunk is None:
            raise UnknownFloorPlanError(plan.id)
        yield chunk
        sent_bytes, number = sent_bytes + len(chunk), number + 1


async def _look(request: Request, tenant: str, floorplan_id: str, runtime: Runtime) -> PlanSummary:
    plan = await run_in_threadpool(plan_summary, tenant, floorplan_id, runtime.store.plans)
    add_log_fields(request, plan=plan.id, revision=plan.revision_id)
    return plan


async def _rendition(
    request: Request,
    plan: PlanSummary,
    kind: RenditionKind,
    media_type: str,
    runtime: Runtime,
    client: str,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """Answer with a file made from a plan, or with 304 before it is made."""
    # Predictions depend on the model.
    etag = revision_etag(plan.revision_id, kind, *([runtime.localiser.model.sha256] if kind in PREDICTIONS else []))
    if (answer := not_modified(request, etag, headers)) is not None:
        return answer
    made = await runtime.renditions.get(plan.id, plan.revision_id, kind, client)
    return tagged_answer([made.content], media_type, etag, headers)


def _check_near(marker: Marker, bounds_m: Bounds) -> None:
    """Refuse a camera that is too far from the plan to be drawn with it.

    Raises:
        InvalidRequestError: the camera is further away than the plan's larger side.
    """
    x_min, y_min, x_max, y_max = bounds_m
    margin_m = max(x_max - x_min, y_max - y_min)
    ranges = (("x_m", marker.x_m, x_min, x_max), ("y_m", marker.y_m, y_min, y_max))
    faults = [
        (name, f"is {value:g}; it must lie between {low - margin_m:g} and {high + margin_m:g}, near the plan")
        for name, value, low, high in ranges
        if not low - margin_m <= value <= high + margin_m
    ]
    if faults:
        raise InvalidRequestError(faults)


def _covariance(given: list[float] | None) -> tuple[float, float, float] | None:
    """Return (xx, xy, yy).

    Raises:
        InvalidRequestError: not a covariance.
    """
    if given is None:
        return None
    xx, xy, yy = given
    if xx < 0.0 or yy < 0.0 or xy * xy > xx * yy * (1.0 + _ROUNDED):
        raise InvalidRequestError(
            [("covariance_m2", f"is {xx:g}, {xy:g}, {yy:g}; xx and yy must be at least 0, and xy² at most xx·yy")]
        )
    return xx, xy, yy
