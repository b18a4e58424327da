"""The query: where was this panorama taken?"""

from __future__ import annotations

import json
from functools import partial
from time import monotonic
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from lalaloc_core.draw.answer import Picture
from lalaloc_core.errors import InvalidHintError, InvalidPanoramaError, InvalidPoseError
from lalaloc_core.localise.pipeline import StageClock
from service.errors import (
    DeadlineExceededError,
    DecoderNotReadyError,
    IdempotencyInProgressError,
    IdempotencyKeyReusedError,
    InvalidRequestError,
    MalformedRequestError,
    OverloadedError,
    PlanFailedError,
    PlanNotReadyError,
    StoppingError,
    StoreUnavailableError,
    UnanchoredPlanError,
    UnknownFloorPlanError,
    UnknownVenueError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
    VenueNotReadyError,
    VenueUnsearchableError,
)
from service.http import IdempotentRequest
from service.http.accept import preferred
from service.http.idempotent_request import HEADER as IDEMPOTENCY_HEADER
from service.http.problems import problem_responses
from service.http.uploads import (
    GEOJSON,
    JSON,
    MULTIPART,
    UploadLimits,
    faults_of,
    media_type,
    read_parts,
    validate_fields,
)
from service.query.geopose import feature_of
from service.query.localiser import AskedPicture
from service.routes.dependencies import IDEMPOTENCY_KEY, Client, Running, Tenant, plan_for_query, venue_for_query
from service.runtime import Runtime
from service.schemas import LocaliseAnswer, LocaliseForm
from service.telemetry import note

router = APIRouter(tags=["localisation"])
# What a query may be refused with.
QUERY_ERRORS: tuple[type[Exception], ...] = (
    InvalidPanoramaError,
    InvalidPoseError,
    InvalidRequestError,
    MalformedRequestError,
    UnknownFloorPlanError,
    PlanFailedError,
    PlanNotReadyError,
    UnsupportedMediaError,
    UploadTooLargeError,
    UploadTimeoutError,
    OverloadedError,
    StoreUnavailableError,
    StoppingError,
    DecoderNotReadyError,
    DeadlineExceededError,
    IdempotencyKeyReusedError,
    IdempotencyInProgressError,
)

_PNG, _SVG = "image/png", "image/svg+xml"
# The photograph in an SVG is a part of it; nothing else may load, and nothing run.
_POLICY = {"Content-Security-Policy": "default-src 'none'; img-src data:; frame-ancestors 'none'"}
_VARY = {"Vary": "Accept"}


def _body_schema() -> dict[str, Any]:
    schema = LocaliseForm.model_json_schema(ref_template="#/components/schemas/{model}")
    # Told with the others, see `http.api_description`.
    schema.pop("$defs", None)
    schema["properties"]["panorama"] = {
        "type": "string",
        "format": "binary",
        "description": "Equirectangular panorama as JPEG, PNG or WebP: the full 360°, twice as wide as high, or the "
        "part of it that its photo sphere metadata (GPano in XMP) tell.",
    }
    schema["required"] = [*schema.get("required", []), "panorama"]
    body = {"required": True, "content": {MULTIPART: {"schema": schema}}}
    return {"requestBody": body, "parameters": [IDEMPOTENCY_KEY]}


@router.post(
    "/localise",
    summary="Localise a panorama",
    response_model=LocaliseAnswer,
    openapi_extra=_body_schema(),
    responses={
        200: {
            "content": {
                GEOJSON: {"schema": {"type": "object", "description": "A Feature of RFC 7946."}},
                _PNG: {"schema": {"type": "string", "format": "binary"}},
                _SVG: {"schema": {"type": "string"}},
            }
        }
    }
    | problem_responses(
        InvalidHintError,
        UnanchoredPlanError,
        UnknownVenueError,
        VenueUnsearchableError,
        VenueNotReadyError,
        *QUERY_ERRORS,
    ),
)
async def localise(
    request: Request,
    runtime: Running,
    tenant: Tenant,
    client: Client,
    picture: Annotated[
        Picture | None,
        Query(
            description="What a picture shows: the `plan` with the posterior as a heat map, the answer, its covariance "
            "ellipse and its rivals; the `photograph` with the found layout drawn in; or `both`, as when it is left "
            "out. Needs `Accept: image/png` or `Accept: image/svg+xml`."
        ),
    ] = None,
) -> Response:
    """Find where in a stored floor plan, or in which plan of a venue and where in it, a panorama was taken.

    With `Accept: image/png` or `Accept: image/svg+xml` the answer is a picture, 1600 pixels wide; with `Accept:
    application/geo+json` a GeoJSON Feature at the place on Earth, for plans and venues with an `anchor`.

    A plan that is still preparing is waited for. Of a venue the plans that are ready are searched, and the answer warns
    of others; while none is, the venue is waited for. When optimisation (`lpo`) cannot answer in time, the answer is
    the one before it, with `"stage": "vdr"`.
    """
    settings = runtime.settings
    media = preferred(request, (JSON, _PNG, _SVG, GEOJSON))
    _check_asked(request, media, picture)
    idempotent = IdempotentRequest(runtime.store.idempotency_keys, request, tenant, "POST /localise")
    media_type(request, (MULTIPART,))
    limits = UploadLimits.of(settings, "max_panorama_bytes")
    clock = StageClock()
    note(request, clock=clock)
    with clock.stage("upload"):
        known, told = set(LocaliseForm.model_fields), {"max_top_k": settings.max_top_k}
        check = partial(faults_of, LocaliseForm, context=told)
        parts = await read_parts(request, limits, files={"panorama"}, fields=known, check=check)
    begin = monotonic()
    form = validate_fields(LocaliseForm, parts.fields, told)
    if "top_k" not in form.model_fields_set:
        form = form.model_copy(update={"top_k": min(form.top_k, settings.max_top_k)})

    if form.venue_id is not None and media in (_PNG, _SVG):
        raise InvalidRequestError([("venue_id", f"is not answered in {media}: a picture is of one plan")])

    async def answer() -> Response:
        content = parts.files["panorama"]
        if form.venue_id is not None:
            venue = await venue_for_query(tenant, form.venue_id, runtime)
            note(request, venue=venue.id)
            found = await runtime.venue_localiser.answer(venue, form, content, begin, clock, client)
            note(request, plan=found.floorplan_id, revision=found.floorplan_revision, stage=found.stage)
            return await _told(found, media, tenant, runtime)
        assert form.floorplan_id is not None
        record = await plan_for_query(tenant, form.floorplan_id, runtime)
        note(request, plan=record.id, revision=record.revision_id)
        if media == GEOJSON and record.plan.anchor is None:
            raise UnanchoredPlanError(record.id)
        if media in (JSON, GEOJSON):
            found = await runtime.localiser.answer(record, form, content, begin, clock, client)
            note(request, stage=found.stage)
            return await _told(found, media, tenant, runtime)
        rooms = await runtime.drawings.rooms(record)
        asked = AskedPicture(picture=picture or "both", pixels=media == _PNG, rooms=rooms)
        found, drawn = await runtime.localiser.picture(record, form, content, begin, clock, client, asked)
        note(request, stage=found.stage)
        return Response(drawn, headers=_VARY | _POLICY, media_type=media)

    return await idempotent.run_async(parts, answer, runtime.reads)


def _check_asked(request: Request, media: str, picture: Picture | None) -> None:
    """Raises:
    InvalidRequestError: what is said of a picture and none is wanted, or what is for JSON alone.
    """
    if media in (JSON, GEOJSON) and picture is not None:
        raise InvalidRequestError([("picture", f"needs the header Accept: {_PNG} or Accept: {_SVG}")])
    if media != JSON and IDEMPOTENCY_HEADER in request.headers:
        raise InvalidRequestError([(IDEMPOTENCY_HEADER, "is for answers in application/json, others are not kept")])


async def _told(answer: LocaliseAnswer, media: str, tenant: str, runtime: Runtime) -> Response:
    """An answer as JSON or as GeoJSON.

    Raises:
        UnanchoredPlanError: GeoJSON is wanted of an answer that is nowhere on Earth.
    """
    if media != GEOJSON:
        return Response(await _text(answer, tenant, runtime), headers=_VARY, media_type=JSON)
    feature = feature_of(answer)
    if feature is None:
        raise UnanchoredPlanError(answer.floorplan_id, answer.venue_id)
    return Response(json.dumps(feature), headers=_VARY, media_type=GEOJSON)


async def _text(answer: LocaliseAnswer, tenant: str, runtime: Runtime) -> str:
    """An answer as JSON; under its id it is the same, where answers are kept."""
    if runtime.settings.keep_answers_s == 0.0:
        return answer.model_dump_json()
    told = {"": answer.model_dump_json()}

    def with_id(answer_id: str) -> str:
        told[answer_id] = answer.model_copy(update={"answer_id": answer_id}).model_dump_json()
        return told[answer_id]

    keep = partial(runtime.store.answers.add, limit=runtime.settings.max_kept_answers)
    try:
        return told[await runtime.reads.run(keep, tenant, answer.floorplan_id, with_id) or ""]
    except StoreUnavailableError:
        # It was found all the same.
        return told[""]
