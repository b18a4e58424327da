"""Queries about single photographs in a floor plan or a venue, batches of them, and kept answers."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response, status

from lalaloc_core.draw.answer import Picture
from lalaloc_core.errors import InvalidHintError
from service import errors
from service.capacity.admission_control import QUERY, QUERY_IN_PARTS, admitted_as
from service.http.problems import problem_responses
from service.http.representations import NDJSON, LinesResponse, preferred
from service.http.uploads import GEOJSON, GEOPOSE, JSON, Repeats
from service.query import Content, PhotographQuery, PictureQuery, QueryContext
from service.query.geopose import geojson_feature, geopose_document
from service.routes.batch_lines import BatchLines
from service.routes.dependencies import Call, is_id
from service.routes.descriptions import (
    BINARY,
    IDEMPOTENCY_ERRORS,
    PHOTOGRAPH_LINES,
    PLACE_ERRORS,
    QUERY_ERRORS,
    READ_ERRORS,
    on_earth,
    photographs_schema,
)
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
from service.schemas.localise_answer import BatchLine
from service.security import caller_of
from service.storage.records import PlanRecord
from service.uploaded_file import UploadedFile

router = APIRouter(tags=["localisation"])
_PNG, _SVG = "image/png", "image/svg+xml"
# An SVG embeds its photograph as a data URL; nothing else can load or run.
_POLICY = {"Content-Security-Policy": "default-src 'none'; img-src data:; frame-ancestors 'none'"}


_PHOTO_SCHEMA = BINARY | {
    "description": "Photograph as JPEG, PNG, WebP or HEIC: a 360° sphere, twice as wide as high, or a part of it with "
    "photo sphere metadata (GPano in XMP), or, for models with an encoder of views, an ordinary or fisheye photograph, "
    "or a strip of a phone's panorama mode. Its EXIF metadata state the field of view."
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
            "content": on_earth(geojson="A Feature of RFC 7946.", geopose="A Basic-Quaternion of OGC GeoPose 1.0."),
        }
    }
    | problem_responses(
        InvalidHintError, errors.UnanchoredPlanError, *PLACE_ERRORS, *QUERY_ERRORS, *IDEMPOTENCY_ERRORS
    ),
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
        raise errors.InvalidRequestError([("picture", f"needs the header Accept: {_PNG} or Accept: {_SVG}")])
    idempotent = call.idempotent(media)
    form, parts, context = await read_query(call, LocaliseForm, "max_photograph_bytes", files={PHOTO})
    if form.venue_id is not None and is_picture:
        fault = f"cannot be drawn as {media}: a picture shows one plan; set floorplan_id"
        raise errors.InvalidRequestError([("venue_id", fault)])
    (content,) = photographs_of(parts, form, call)
    if parts.named(FEATURES):
        if picture in ("both", "photograph"):
            fault = f"is '{picture}', but {FEATURES} have no photograph; set plan"
            raise errors.InvalidRequestError([("picture", fault)])
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


_PHOTOS_SCHEMA = photographs_schema("Photographs", "max_batch_photographs", minItems=1)


@router.post(
    "/localise/batch",
    summary="Localise many photographs, one by one",
    status_code=200,
    response_class=LinesResponse,
    response_model=BatchLine,
    openapi_extra=body_schema(LocaliseForm, _PHOTOS_SCHEMA, idempotent=False),
    responses=PHOTOGRAPH_LINES
    | problem_responses(
        InvalidHintError, errors.RateLimitedError, errors.UnknownVenueError, errors.UnknownFloorPlanError, *QUERY_ERRORS
    ),
)
@admitted_as(QUERY_IN_PARTS)
async def localise_batch(call: Call) -> Response:
    """Localise many photographs, each by itself, in a stored floor plan or in the plans of a venue.

    The fields hold for all photographs. The answer is a stream of lines of JSON, one per photograph in the order of the
    request, each sent as soon as it is computed. A photograph that cannot be localised gets a line with the problem
    that `POST /localise` would answer with; the others continue. Each photograph has the deadline of a query and counts
    as a request for the rate limit. The batch ends if its client leaves, or does not take a line within
    `request_deadline_s`.
    """
    call.idempotent(NDJSON)
    settings = call.settings
    repeated = {PHOTO: Repeats(1, settings.photographs.max_batch_photographs, "max_batch_photographs")}
    form, parts, _ = await read_query(call, LocaliseForm, "max_sequence_bytes", repeated=repeated)
    files = parts.named(PHOTO) or parts.named(FEATURES)
    photographs = list(zip(files, photographs_of(parts, form, call), strict=True))
    await call.runtime.access_control.count_photographs(caller_of(call.request.scope), len(photographs))
    place = await call.place(form.floorplan_id, form.venue_id)

    async def answer(_index: int, _file: UploadedFile, content: Content, context: QueryContext) -> dict[str, Any]:
        found = await call.runtime.localiser.answer(place, PhotographQuery(form, content, context))
        return {"status": 200, "answer": await keep_answer(found, call)}

    lines = BatchLines(call, BatchLine, answer).lines(photographs)
    return LinesResponse(lines, settings.requests.request_deadline_s)


_KEPT = problem_responses(errors.UnknownAnswerError, *READ_ERRORS)


@router.get("/answers/{answer_id}", summary="Get a kept answer", response_model=LocaliseAnswer, responses=_KEPT)
def get_answer(answer_id: str, call: Call) -> Response:
    """Return the answer to an earlier query, byte for byte, while it is kept. Photographs are never kept."""
    kept_s = call.settings.storage.keep_answers_s
    content = call.store.answers.get(call.tenant, answer_id, kept_s=kept_s) if is_id(answer_id) else None
    if content is None:
        raise errors.UnknownAnswerError(answer_id)
    return Response(content, media_type=JSON)


@router.delete(
    "/answers/{answer_id}", status_code=status.HTTP_204_NO_CONTENT, summary="Delete a kept answer", responses=_KEPT
)
def delete_answer(answer_id: str, call: Call) -> None:
    """Delete a kept answer before it expires."""
    if not is_id(answer_id) or not call.store.answers.delete(call.tenant, answer_id):
        raise errors.UnknownAnswerError(answer_id)
