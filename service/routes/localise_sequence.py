"""Queries with several photographs, or a film, of one turn."""

from __future__ import annotations

from fastapi import APIRouter, Response

from lalaloc_core.errors import InvalidFilmError
from service.capacity.admission_control import QUERY, admitted_as
from service.errors import InvalidRequestError, UnanchoredPlanError, UploadTooLargeError
from service.http.problems import problem_responses
from service.http.representations import preferred
from service.http.uploads import GEOJSON, GEOPOSE, JSON, Parts, Repeats, Settable
from service.query import Content, QueryContext, SequenceQuery
from service.query.geopose import geojson_features, geopose_documents
from service.routes.dependencies import ApiCall, Call
from service.routes.descriptions import (
    BINARY,
    IDEMPOTENCY_ERRORS,
    PLACE_ERRORS,
    QUERY_ERRORS,
    on_earth,
    photographs_schema,
)
from service.routes.query_request import FILM, PHOTO, answer_as, body_schema, check_anchor, photographs_of, read_query
from service.schemas import SequenceAnswer, SequenceForm
from service.settings.settings import FILM_PHOTOGRAPHS

router = APIRouter(tags=["localisation"])
_MIN_PHOTOGRAPHS = 2
_FILM_SCHEMA = BINARY | {
    "description": f"Instead of `{PHOTO}`: a film of one slow turn, once around on the spot: MP4, "
    "MOV, WebM or Matroska with H.264, HEVC, MPEG-4, VP8 or VP9. Limits: `max_film_bytes`, `max_film_s`, "
    "`max_film_pixels`, `max_film_cpu_s`. Sharp frames at equal angles become poses."
}
_PHOTOS_SCHEMA = photographs_schema(
    "Photographs in the order in which they were taken", "max_sequence_photographs", minItems=_MIN_PHOTOGRAPHS
)


_GEOPOSES = "One Basic-Quaternion of OGC GeoPose 1.0 for each photograph, in their order."
# Forms of an answer on Earth, by media type.
_ON_EARTH = {GEOJSON: geojson_features, GEOPOSE: geopose_documents}


@router.post(
    "/localise/sequence",
    summary="Localise several photographs from one spot, or a film",
    response_model=SequenceAnswer,
    openapi_extra=body_schema(SequenceForm, _PHOTOS_SCHEMA, film=_FILM_SCHEMA),
    responses={
        200: {
            "content": {
                **on_earth(geojson="A FeatureCollection of RFC 7946."),
                GEOPOSE: {"schema": {"type": "array", "items": {"type": "object"}, "description": _GEOPOSES}},
            }
        }
    }
    | problem_responses(InvalidFilmError, UnanchoredPlanError, *PLACE_ERRORS, *QUERY_ERRORS, *IDEMPOTENCY_ERRORS),
)
@admitted_as(QUERY)
async def localise_sequence(call: Call) -> Response:
    """Localise photographs that were taken while turning on one spot in a stored floor plan, or in a venue.

    They are together as certain as one with a wider field of view. Their angles follow from their overlap, and a `film`
    of the turn can be sent instead of them. Photographs of a walk go to a session or an album. In a venue, every pose
    has its `floorplan_id` and `level`. With `Accept: application/geo+json` the answer is a GeoJSON FeatureCollection,
    one Feature per photograph, with `Accept: application/geopose+json` an array of GeoPoses (Basic-Quaternion), for
    plans and venues with an `anchor`. The query waits for a plan that is still preparing. If pose refinement (`lpo`) is
    not done in time, the answer falls back to the best pose of the grid, with `"stage": "retrieval"`.
    """
    media = preferred(call.request, (JSON, *_ON_EARTH))
    idempotent = call.idempotent(media)
    limits = call.settings.photographs
    most = limits.max_sequence_photographs
    repeated = {PHOTO: Repeats(_MIN_PHOTOGRAPHS, most, "max_sequence_photographs"), FILM: Repeats(1, 1)}
    # The body can be a film or photographs.
    largest: Settable = "max_film_bytes" if limits.max_film_bytes > limits.max_sequence_bytes else "max_sequence_bytes"
    form, parts, context = await read_query(call, SequenceForm, largest, repeated=repeated, film=True)
    query = _query(parts, form, context, call)

    async def respond(_token: str) -> Response:
        place = await call.place(form.floorplan_id, form.venue_id)
        check_anchor(place, media)
        found = await call.runtime.localiser.answer(place, query)
        call.log(stage=found.stage)
        return answer_as(found, media, _ON_EARTH)

    return await idempotent.run_async(parts, respond, call.runtime.reads)


def _query(parts: Parts, form: SequenceForm, context: QueryContext, call: ApiCall) -> SequenceQuery:
    limits = call.settings.photographs
    films = parts.named(FILM)
    if not films:
        total = sum(map(len, parts.files.values()))
        if total > limits.max_sequence_bytes:
            raise UploadTooLargeError("max_sequence_bytes", limits.max_sequence_bytes, total)
        photographs = _photographs(parts, form, call)
        return SequenceQuery(form, photographs, context.for_photographs(len(photographs)))
    (film,) = films
    if faults := form.film_faults():
        raise InvalidRequestError(faults)
    if len(film) > limits.max_film_bytes:
        raise UploadTooLargeError("max_film_bytes", limits.max_film_bytes, len(film))
    context = context.for_photographs(FILM_PHOTOGRAPHS).with_time(limits.film_deadline_s)
    return SequenceQuery(form, (), context, film)


def _photographs(parts: Parts, form: SequenceForm, call: ApiCall) -> list[Content]:
    limit = call.settings.photographs.max_photograph_bytes
    if (largest := max(map(len, parts.named(PHOTO)), default=0)) > limit:
        raise UploadTooLargeError("max_photograph_bytes", limit, largest)
    contents = photographs_of(parts, form, call)
    if faults := form.faults(len(contents)):
        raise InvalidRequestError(faults)
    return contents
