"""Queries: localise a photograph in a floor plan or a venue."""

from __future__ import annotations

import json
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from lalaloc_core.draw.answer import Picture
from lalaloc_core.errors import InvalidHintError
from service.errors import (
    InvalidRequestError,
    StorageQuotaError,
    StoreUnavailableError,
    UnanchoredPlanError,
    UnknownVenueError,
    VenueNotReadyError,
    VenueUnsearchableError,
)
from service.http import IdempotentRequest
from service.http.accept import preferred
from service.http.problems import problem_responses
from service.http.uploads import GEOJSON, JSON, MULTIPART, media_type
from service.query import PhotographQuery, PictureRequest
from service.query.geopose import geojson_feature
from service.routes.dependencies import Client, Running, Tenant, plan_for_query, venue_for_query
from service.routes.query_request import (
    FEATURES,
    PHOTO,
    QUERY_ERRORS,
    body_schema,
    check_idempotent_media,
    photographs_of,
    read_query,
)
from service.runtime import Runtime
from service.schemas import LocaliseAnswer, LocaliseForm
from service.telemetry import add_log_fields

router = APIRouter(tags=["localisation"])
_PNG, _SVG = "image/png", "image/svg+xml"
# An SVG embeds its photograph as a data URL; nothing else can load or run.
_POLICY = {"Content-Security-Policy": "default-src 'none'; img-src data:; frame-ancestors 'none'"}
_VARY = {"Vary": "Accept"}


_PHOTO_SCHEMA = {
    "type": "string",
    "format": "binary",
    "description": "Photograph as JPEG, PNG, WebP or, with the extra `heic`, HEIC: a 360° panorama, twice as wide as "
    "high, or a part of it with photo sphere metadata (GPano in XMP), or, for models with an encoder of views, an "
    "ordinary photograph, a fisheye photograph or a phone's panorama. Its EXIF metadata state the field of view.",
}


@router.post(
    "/localise",
    summary="Localise a photograph",
    response_model=LocaliseAnswer,
    openapi_extra=body_schema(LocaliseForm, _PHOTO_SCHEMA),
    responses={
        200: {
            # Pictures are not listed under `content`, which would make the type of an answer in generated clients a
            # union with strings.
            "description": f"The answer; with `Accept: {_PNG}` or `Accept: {_SVG}`, its picture.",
            "content": {GEOJSON: {"schema": {"type": "object", "description": "A Feature of RFC 7946."}}},
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
            description="Content of the picture: the `plan` with the posterior as a heat map, the answer, its "
            "covariance ellipse and the other candidates; the `photograph` with the layout drawn in; or `both` (the "
            "default, without a photograph: `plan`). Needs `Accept: image/png` or `Accept: image/svg+xml`."
        ),
    ] = None,
) -> Response:
    """Localise a photograph in a stored floor plan, or in the plans of a venue.

    With `Accept: image/png` or `Accept: image/svg+xml` the answer is a picture, 1600 pixels wide; with `Accept:
    application/geo+json` it is a GeoJSON Feature on Earth, for plans and venues with an `anchor`.

    The query waits for a plan that is still preparing. In a venue it searches the plans that are ready, warns about the
    others, and waits if none is ready. If pose refinement (`lpo`) is not done in time, the answer falls back to the VDR
    pose, with `"stage": "vdr"`.
    """
    media = preferred(request, (JSON, _PNG, _SVG, GEOJSON))
    _check_picture(media, picture)
    check_idempotent_media(request, media)
    idempotent = IdempotentRequest(runtime.store.idempotency_keys, request, tenant, "POST /localise")
    media_type(request, (MULTIPART,))
    form, parts, context = await read_query(
        request, runtime.settings, client, LocaliseForm, "max_photograph_bytes", files={PHOTO}
    )
    if form.venue_id is not None and media in (_PNG, _SVG):
        raise InvalidRequestError(
            [("venue_id", f"cannot be drawn as {media}: a picture shows one plan; set floorplan_id")]
        )
    (content,) = photographs_of(parts, form, runtime.bundle)
    if parts.named(FEATURES):
        if picture in ("both", "photograph"):
            raise InvalidRequestError([("picture", f"is '{picture}', but {FEATURES} have no photograph; set plan")])
        picture = None if picture is None and media in (JSON, GEOJSON) else "plan"

    async def respond() -> Response:
        query = PhotographQuery(form, content, context)
        if form.venue_id is not None:
            venue = await venue_for_query(tenant, form.venue_id, runtime)
            add_log_fields(request, venue=venue.id)
            answer = await runtime.localiser.localise(venue, query)
            add_log_fields(request, plan=answer.floorplan_id, revision=answer.floorplan_revision, stage=answer.stage)
            return await _response(answer, media, tenant, runtime)
        assert form.floorplan_id is not None
        record = await plan_for_query(tenant, form.floorplan_id, runtime)
        add_log_fields(request, plan=record.id, revision=record.revision_id)
        if media == GEOJSON and record.plan.anchor is None:
            raise UnanchoredPlanError(record.id)
        if media in (JSON, GEOJSON):
            answer = await runtime.localiser.localise(record, query)
            add_log_fields(request, stage=answer.stage)
            return await _response(answer, media, tenant, runtime)
        rooms = await runtime.renditions.get(record.id, record.revision_id, "drawing", client)
        drawn = rooms.content.decode()
        picture_request = PictureRequest(picture=picture or "both", as_png=media == _PNG, rooms=drawn)
        answer, drawing = await runtime.localiser.localise_and_draw(record, query, picture_request)
        add_log_fields(request, stage=answer.stage)
        return Response(drawing, headers=_VARY | _POLICY, media_type=media)

    return await idempotent.run_async(parts, respond, runtime.reads)


def _check_picture(media: str, picture: Picture | None) -> None:
    """Refuse the parameter `picture` unless the answer is a picture.

    Raises:
        InvalidRequestError: the answer is JSON or GeoJSON.
    """
    if media in (JSON, GEOJSON) and picture is not None:
        raise InvalidRequestError([("picture", f"needs the header Accept: {_PNG} or Accept: {_SVG}")])


async def _response(answer: LocaliseAnswer, media: str, tenant: str, runtime: Runtime) -> Response:
    """Return an answer as JSON or GeoJSON.

    Raises:
        UnanchoredPlanError: GeoJSON is requested, and neither the plan nor the venue has an anchor.
    """
    if media != GEOJSON:
        kept = await kept_answer(answer, tenant, runtime)
        return Response(kept.model_dump_json(), headers=_VARY, media_type=JSON)
    feature = geojson_feature(answer)
    if feature is None:
        raise UnanchoredPlanError(answer.floorplan_id, answer.venue_id)
    return Response(json.dumps(feature), headers=_VARY, media_type=GEOJSON)


async def kept_answer(answer: LocaliseAnswer, tenant: str, runtime: Runtime) -> LocaliseAnswer:
    """Store an answer if `keep_answers_s` is set; return it with its id."""
    if runtime.settings.storage.keep_answers_s == 0.0:
        return answer

    def with_id(answer_id: str) -> str:
        return answer.model_copy(update={"answer_id": answer_id}).model_dump_json()

    keep = partial(runtime.store.answers.add, limit=runtime.settings.storage.max_kept_answers)
    try:
        answer_id = await runtime.reads.run(tenant, keep, tenant, answer.floorplan_id, with_id)
    except (StoreUnavailableError, StorageQuotaError):
        # The answer is valid although it could not be kept.
        return answer
    return answer.model_copy(update={"answer_id": answer_id})
