"""Queries: localise a photograph in a floor plan or a venue."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from lalaloc_core.draw.answer import Picture
from lalaloc_core.errors import InvalidHintError
from service.capacity.admission_control import QUERY, admitted_as
from service.errors import InvalidRequestError, UnanchoredPlanError
from service.http.problems import problem_responses
from service.http.representations import preferred
from service.http.uploads import GEOJSON, GEOPOSE, JSON
from service.query import PhotographQuery, PictureQuery
from service.query.geopose import geojson_feature, geopose_document
from service.routes.dependencies import Call
from service.routes.descriptions import IDEMPOTENCY_ERRORS, PLACE_ERRORS, QUERY_ERRORS
from service.routes.query_request import (
    FEATURES,
    PHOTO,
    VARY,
    answer_as,
    body_schema,
    check_anchor,
    keep_answer,
    photographs_of,
    read_query,
)
from service.schemas import LocaliseAnswer, LocaliseForm
from service.storage.records import PlanRecord

router = APIRouter(tags=["localisation"])
_PNG, _SVG = "image/png", "image/svg+xml"
# An SVG embeds its photograph as a data URL; nothing else can load or run.
_POLICY = {"Content-Security-Policy": "default-src 'none'; img-src data:; frame-ancestors 'none'"}


_PHOTO_SCHEMA = {
    "type": "string",
    "format": "binary",
    "description": "Photograph as JPEG, PNG, WebP or, with the extra `heic`, HEIC: a 360° sphere, twice as wide as "
    "high, or a part of it with photo sphere metadata (GPano in XMP), or, for models with an encoder of views, an "
    "ordinary or fisheye photograph, or a strip of a phone's panorama mode. Its EXIF metadata state the field of view.",
}


# Forms of an answer on Earth, by media type.
_ON_EARTH = {GEOJSON: geojson_feature, GEOPOSE: geopose_document}


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
            "content": {
                GEOJSON: {"schema": {"type": "object", "description": "A Feature of RFC 7946."}},
                GEOPOSE: {"schema": {"type": "object", "description": "A Basic-Quaternion of OGC GeoPose 1.0."}},
            },
        }
    }
    | problem_responses(InvalidHintError, UnanchoredPlanError, *PLACE_ERRORS, *QUERY_ERRORS, *IDEMPOTENCY_ERRORS),
)
@admitted_as(QUERY)
async def localise(
    call: Call,
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
    application/geo+json` it is a GeoJSON Feature on Earth, with `Accept: application/geopose+json` a GeoPose
    (Basic-Quaternion), for plans and venues with an `anchor`.

    The query waits for a plan that is still preparing. In a venue it searches the plans that are ready, warns about the
    others, and waits if none is ready. If pose refinement (`lpo`) is not done in time, the answer falls back to the VDR
    pose, with `"stage": "vdr"`.
    """
    media = preferred(call.request, (JSON, _PNG, _SVG, *_ON_EARTH))
    is_picture = media in (_PNG, _SVG)
    if picture is not None and not is_picture:
        raise InvalidRequestError([("picture", f"needs the header Accept: {_PNG} or Accept: {_SVG}")])
    idempotent = call.idempotent(media)
    form, parts, context = await read_query(call, LocaliseForm, "max_photograph_bytes", files={PHOTO})
    if form.venue_id is not None and is_picture:
        raise InvalidRequestError(
            [("venue_id", f"cannot be drawn as {media}: a picture shows one plan; set floorplan_id")]
        )
    (content,) = photographs_of(parts, form, call)
    if parts.named(FEATURES):
        if picture in ("both", "photograph"):
            raise InvalidRequestError([("picture", f"is '{picture}', but {FEATURES} have no photograph; set plan")])
        picture = "plan" if is_picture else None

    async def respond(_token: str) -> Response:
        place = await call.place(form.floorplan_id, form.venue_id)
        check_anchor(place, media)
        if not is_picture:
            answer = await call.runtime.localiser.answer(place, PhotographQuery(form, content, context))
            call.log(plan=answer.floorplan_id, revision=answer.floorplan_revision, stage=answer.stage)
            kept = await keep_answer(answer, call) if media == JSON else answer
            return answer_as(kept, media, _ON_EARTH)
        assert isinstance(place, PlanRecord)
        rooms = await call.rendition(place, "drawing")
        query = PictureQuery(
            form=form,
            content=content,
            context=context,
            picture=picture or "both",
            as_png=media == _PNG,
            rooms=rooms.content.decode(),
        )
        answer, drawing = await call.runtime.localiser.answer(place, query)
        call.log(stage=answer.stage)
        return Response(drawing, headers=VARY | _POLICY, media_type=media)

    return await idempotent.run_async(parts, respond, call.runtime.reads)
