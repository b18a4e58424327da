"""Queries with several photographs of one visit."""

from __future__ import annotations

import json
from typing import Any

from fastapi import APIRouter, Request, Response

from lalaloc_core.errors import InvalidMotionError
from service.errors import (
    InvalidRequestError,
    UnanchoredPlanError,
    UnknownVenueError,
    UploadTooLargeError,
    VenueNotReadyError,
    VenueUnsearchableError,
)
from service.http import IdempotentRequest
from service.http.accept import preferred
from service.http.problems import problem_responses
from service.http.uploads import GEOJSON, JSON, MULTIPART, Parts, Repeats, media_type
from service.query import Content, SequenceQuery
from service.query.geopose import geojson_features
from service.routes.dependencies import Client, Running, Tenant, plan_for_query, venue_for_query
from service.routes.query_request import (
    PHOTO,
    QUERY_ERRORS,
    body_schema,
    check_idempotent_media,
    photographs_of,
    read_query,
)
from service.runtime import Runtime
from service.schemas import SequenceAnswer, SequenceForm
from service.telemetry import add_log_fields

router = APIRouter(tags=["localisation"])
_MIN_PHOTOGRAPHS = 2
_PHOTOS_SCHEMA: dict[str, Any] = {
    "type": "array",
    "items": {"type": "string", "format": "binary"},
    "minItems": _MIN_PHOTOGRAPHS,
    "description": "Photographs in the order in which they were taken, one part named `photo` each, as for "
    "`POST /localise`; limits: `max_sequence_photographs`, and `max_sequence_bytes` together.",
}


@router.post(
    "/localise/sequence",
    summary="Localise several photographs of one visit",
    response_model=SequenceAnswer,
    openapi_extra=body_schema(SequenceForm, _PHOTOS_SCHEMA),
    responses={
        200: {"content": {GEOJSON: {"schema": {"type": "object", "description": "A FeatureCollection of RFC 7946."}}}}
    }
    | problem_responses(
        InvalidMotionError,
        UnanchoredPlanError,
        UnknownVenueError,
        VenueUnsearchableError,
        VenueNotReadyError,
        *QUERY_ERRORS,
    ),
)
async def localise_sequence(request: Request, runtime: Running, tenant: Tenant, client: Client) -> Response:
    """Localise several photographs of one visit together in a stored floor plan, or in the plans of a venue.

    Measured motions between them resolve places that look alike. Photographs that were taken while turning on one spot
    (`motion=turn`) are together as certain as one with a wider field of view; send `relative_heading_deg` if it is
    known. In a venue, every pose has its `floorplan_id` and `level`. With `Accept: application/geo+json` the answer is
    a GeoJSON FeatureCollection, one Feature per photograph, for plans and venues with an `anchor`. The query waits for
    a plan that is still preparing. If pose refinement (`lpo`) is not done in time, the answer falls back to the best
    path on the pose grid, with `"stage": "retrieval"`.
    """
    settings = runtime.settings
    media = preferred(request, (JSON, GEOJSON))
    check_idempotent_media(request, media)
    idempotent = IdempotentRequest(runtime.store.idempotency_keys, request, tenant, "POST /localise/sequence")
    media_type(request, (MULTIPART,))
    most = settings.photographs.max_sequence_photographs
    repeated = {PHOTO: Repeats(_MIN_PHOTOGRAPHS, most, "max_sequence_photographs")}
    form, parts, context = await read_query(
        request, settings, client, SequenceForm, "max_sequence_bytes", repeated=repeated
    )
    photographs = _photographs(parts, form, runtime)
    query = SequenceQuery(form, photographs, context.for_photographs(len(photographs)))

    async def respond() -> Response:
        if form.venue_id is not None:
            venue = await venue_for_query(tenant, form.venue_id, runtime)
            add_log_fields(request, venue=venue.id)
            found = await runtime.localiser.localise_sequence(venue, query)
        else:
            assert form.floorplan_id is not None
            record = await plan_for_query(tenant, form.floorplan_id, runtime)
            add_log_fields(request, plan=record.id, revision=record.revision_id)
            if media == GEOJSON and record.plan.anchor is None:
                raise UnanchoredPlanError(record.id)
            found = await runtime.localiser.localise_sequence(record, query)
        add_log_fields(request, stage=found.stage)
        features = geojson_features(found) if media == GEOJSON else None
        if media == GEOJSON and features is None:
            raise UnanchoredPlanError(found.floorplan_id, found.venue_id)
        content = found.model_dump_json() if media == JSON else json.dumps(features)
        return Response(content, headers={"Vary": "Accept"}, media_type=media)

    return await idempotent.run_async(parts, respond, runtime.reads)


def _photographs(parts: Parts, form: SequenceForm, runtime: Runtime) -> list[Content]:
    """Return the photographs in order.

    Raises:
        UploadTooLargeError: a photograph is larger than allowed.
        InvalidFeaturesError, ForeignFeaturesError: see `photographs_of`.
        InvalidRequestError: fields that do not fit the number of photographs.
    """
    limit = runtime.settings.photographs.max_photograph_bytes
    if (largest := max(map(len, parts.named(PHOTO)), default=0)) > limit:
        raise UploadTooLargeError("max_photograph_bytes", limit, largest)
    contents = photographs_of(parts, form, runtime.bundle)
    if faults := form.faults(len(contents)):
        raise InvalidRequestError(faults)
    return contents
