"""Reads of a stored plan: original file, export, drawing, mesh, localisability, walls, events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Response
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from lalaloc_core.conditions import HeadingState, Photograph, condition_of
from lalaloc_core.draw.plan import HEAT_PLACE, Bounds, Marker, svg_around
from lalaloc_core.errors import MissingExtraError
from lalaloc_core.importers import EXPORT_FORMATS, FORMATS, ExportFormat
from service import errors
from service.capacity.admission_control import STREAM, admitted_as
from service.http.problems import problem_responses
from service.http.representations import digest_etag, not_modified, revision_etag, tagged_answer, tagged_stream
from service.http.uploads import JSON
from service.plan_documents import PREDICTIONS, RenditionKind
from service.routes.dependencies import ApiCall, Call, Revision
from service.routes.descriptions import PLAN_RESPONSES, READ_ERRORS, event_stream, reads, reads_file
from service.schemas.localisability import LocalisabilityAnswer
from service.schemas.stored_plans import LayoutAnswer
from service.storage.records import PlanSummary

router = APIRouter(prefix="/floorplans", tags=["floor plans"])

_HEAT = HEAT_PLACE.encode()
_SVG, _GLB = "image/svg+xml", "model/gltf-binary"
# Defence in depth: drawings have no scripts. Maps are embedded pictures.
_INERT = "default-src 'none'; img-src data:"
# Tolerance for a covariance whose three numbers were rounded.
_ROUNDED = 1e-3
# Predictions are made by conversion workers.
_PREDICTION_ERRORS = (errors.UnknownFloorPlanError, errors.UnmeasuredModelError, errors.ConverterNotReadyError)
_TEXT = {"type": "string"}


@router.get(
    "/{floorplan_id}/original",
    summary="Get the uploaded file",
    # Bytes, even of a JSON plan: generated clients must not parse what was uploaded.
    **reads_file("*/*", responses=PLAN_RESPONSES),
)
async def get_original(floorplan_id: str, call: Call) -> Response:
    """Return the uploaded file of the current revision, unchanged, with the media type of its content."""
    plan, originals = await run_in_threadpool(call.plan, floorplan_id), call.store.originals
    digest = await run_in_threadpool(originals.digest, plan.revision_id)
    if digest is not None and (answer := not_modified(call.request, digest_etag(digest))) is not None:
        return answer
    original = await run_in_threadpool(originals.checked, plan.revision_id)
    if digest is None or original is None:
        raise errors.UnknownFloorPlanError(floorplan_id)
    media_type, size_bytes = original
    # An uploaded drawing can contain scripts, so browsers must not open it as a page of this service.
    kept = {"Content-Disposition": "attachment"} if media_type != JSON else None
    return tagged_stream(_chunks(plan, size_bytes, call), size_bytes, media_type, digest_etag(digest), kept)


@router.get(
    "/{floorplan_id}/export",
    summary="Export a floor plan",
    **reads_file(
        *(FORMATS[name].media_type for name in EXPORT_FORMATS),
        responses=problem_responses(
            errors.UnknownFloorPlanError,
            errors.UnanchoredPlanError,
            MissingExtraError,
            *READ_ERRORS,
            errors.ConverterNotReadyError,
        ),
    ),
)
async def get_export(
    floorplan_id: str,
    call: Call,
    format: Annotated[
        ExportFormat,
        Query(description="Format of the file. IMDF needs a plan with an `anchor`; GeoJSON uses it if present."),
    ] = "native",
) -> Response:
    """Return the plan in another file format."""
    plan = await run_in_threadpool(call.plan, floorplan_id)
    if format == "imdf" and not plan.anchored:
        raise errors.UnanchoredPlanError(plan.id)
    kept = {"Content-Disposition": f'attachment; filename="plan.{FORMATS[format].suffix}"'}
    return await _rendition(call, plan, format, FORMATS[format].media_type, kept)


@router.get(
    "/{floorplan_id}/preview.svg", summary="Get a drawing", **reads_file(_SVG, responses=PLAN_RESPONSES, schema=_TEXT)
)
async def get_preview(
    floorplan_id: str,
    call: Call,
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
        raise errors.InvalidRequestError([("y_m" if y_m is None else "x_m", "is missing; give both x_m and y_m")])
    if x_m is None:
        marker_fields = {"heading_deg": heading_deg, "covariance_m2": covariance_m2}
        faults = [(name, "needs x_m and y_m") for name, value in marker_fields.items() if value is not None]
        if faults:
            raise errors.InvalidRequestError(faults)
    marker = None
    if x_m is not None and y_m is not None:
        marker = Marker(x_m=x_m, y_m=y_m, heading_deg=heading_deg, covariance_m2=_covariance(covariance_m2))
    plan = await run_in_threadpool(call.plan, floorplan_id)
    policy = {"Content-Security-Policy": _INERT}
    etag = revision_etag(plan.revision_id, "preview", marker)
    if (answer := not_modified(call.request, etag, policy)) is not None:
        return answer
    rooms = await call.rendition(plan, "preview")
    if marker is not None:
        _check_near(marker, rooms.bounds_m)
    head, tail = svg_around(plan.name, rooms.bounds_m, marker)
    heat, drawn = rooms.content.index(_HEAT), memoryview(rooms.content)
    parts = (head.encode(), drawn[:heat], drawn[heat + len(_HEAT) :], tail.encode())
    return tagged_answer(parts, _SVG, etag, policy)


@router.get("/{floorplan_id}/mesh.glb", summary="Get a mesh", **reads_file(_GLB, responses=PLAN_RESPONSES))
async def get_mesh(floorplan_id: str, call: Call) -> Response:
    """Return floor, walls and ceiling of every room as binary glTF, in metres and y-up."""
    plan = await run_in_threadpool(call.plan, floorplan_id)
    return await _rendition(call, plan, "mesh", _GLB)


@router.get(
    "/{floorplan_id}/localisability",
    summary="Predict which photographs will be found",
    **reads(LocalisabilityAnswer, *_PREDICTION_ERRORS),
)
async def get_localisability(
    floorplan_id: str,
    call: Call,
    coarse: Annotated[
        bool, Query(description="A rough prediction without `advice`, in about a fifth of the time, to show at first.")
    ] = False,
) -> Response:
    """Predict which photographs will be found, from the plan and the model's measured errors alone.

    For places spread over the plan: the probability that the answer to a photograph taken there is right, for a
    sphere, a phone photograph and three of them, with known and unknown heading. Also which rooms are confused, and
    what helps most. The first request for a revision takes seconds; the result is kept.
    """
    plan = await run_in_threadpool(call.plan, floorplan_id)
    return await _rendition(call, plan, "coarse localisability" if coarse else "localisability", JSON)


@router.get(
    "/{floorplan_id}/localisability.svg",
    summary="Get a map of the photographs that will be found",
    **reads_file(_SVG, responses=problem_responses(*_PREDICTION_ERRORS, *READ_ERRORS), schema=_TEXT),
)
async def get_localisability_map(
    floorplan_id: str,
    call: Call,
    photograph: Annotated[
        Photograph, Query(description="A sphere, a phone photograph of 80°, or three of these from one spot.")
    ] = "phone",
    heading: Annotated[HeadingState, Query(description="Whether the heading is known.")] = "unknown",
) -> Response:
    """Return a drawing of the plan with the probability by place that a photograph is found; darker is higher."""
    plan = await run_in_threadpool(call.plan, floorplan_id)
    condition = condition_of(photograph, heading)
    return await _rendition(call, plan, condition, _SVG, {"Content-Security-Policy": _INERT})


@router.get(
    "/{floorplan_id}/layout",
    summary="Get the walls of a floor plan",
    **reads(LayoutAnswer, errors.UnknownFloorPlanError, errors.UnknownRevisionError),
)
async def get_layout(floorplan_id: str, call: Call, revision: Revision = None) -> Response:
    """Return the walls of each room, and the part of a wall that each opening takes up.

    A client can compute from them the layout that a camera sees: the distance to the nearest wall of its room in every
    direction, and hence where floor, ceiling and openings appear in a photograph.
    """
    plan, _ = await run_in_threadpool(call.plan_at_revision, floorplan_id, revision)
    return await _rendition(call, plan, "layout", JSON)


@router.get("/{floorplan_id}/events", summary="Follow a floor plan", **event_stream("a PlanEvent", PLAN_RESPONSES))
@admitted_as(STREAM)
async def follow_floorplan(floorplan_id: str, call: Call) -> Response:
    """Stream server-sent events about the plan's pose grid.

    `progress` comes at once and after each change, up to four times a second; `ready`, `failed` or `deleted` is the
    last event. A comment is sent at least every 15 s. The stream also ends after 15 minutes, soon after the API key is
    revoked, and when the service stops; reconnect then.
    """
    current = await asyncio.to_thread(call.plan, floorplan_id)
    return call.runtime.events.event_stream(
        current.id, partial(call.runtime.access_control.still_authorised, call.request)
    )


async def _chunks(plan: PlanSummary, size_bytes: int, call: ApiCall) -> AsyncIterator[bytes]:
    """Yield the uploaded file, until the client has gone."""
    sent_bytes = number = 0
    while sent_bytes < size_bytes and not await call.request.is_disconnected():
        async with call.reading():
            chunk = await run_in_threadpool(call.store.originals.chunk, plan.revision_id, number)
        if chunk is None:
            raise errors.UnknownFloorPlanError(plan.id)
        yield chunk
        sent_bytes, number = sent_bytes + len(chunk), number + 1


async def _rendition(
    call: ApiCall, plan: PlanSummary, kind: RenditionKind, media_type: str, headers: Mapping[str, str] | None = None
) -> Response:
    """Answer with a file made from a plan, or with 304 before it is made."""
    # Predictions depend on the model.
    etag = revision_etag(plan.revision_id, kind, *([call.runtime.bundle.sha256] if kind in PREDICTIONS else []))
    if (answer := not_modified(call.request, etag, headers)) is not None:
        return answer
    made = await call.rendition(plan, kind)
    return tagged_answer([made.content], media_type, etag, headers)


def _check_near(marker: Marker, bounds_m: Bounds) -> None:
    """Refuse a camera that is too far from the plan to be drawn with it."""
    x_min, y_min, x_max, y_max = bounds_m
    margin_m = max(x_max - x_min, y_max - y_min)
    ranges = (("x_m", marker.x_m, x_min, x_max), ("y_m", marker.y_m, y_min, y_max))
    faults = [
        (name, f"is {value:g}; it must lie between {low - margin_m:g} and {high + margin_m:g}, near the plan")
        for name, value, low, high in ranges
        if not low - margin_m <= value <= high + margin_m
    ]
    if faults:
        raise errors.InvalidRequestError(faults)


def _covariance(given: list[float] | None) -> tuple[float, float, float] | None:
    if given is None:
        return None
    xx, xy, yy = given
    if xx < 0.0 or yy < 0.0 or xy * xy > xx * yy * (1.0 + _ROUNDED):
        fault = f"is {xx:g}, {xy:g}, {yy:g}; xx and yy must be at least 0, and xy² at most xx·yy"
        raise errors.InvalidRequestError([("covariance_m2", fault)])
    return xx, xy, yy
