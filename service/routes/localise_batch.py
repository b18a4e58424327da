"""Batches: many photographs of one plan or venue in one request, each a query of its own."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Response

from lalaloc_core.errors import InvalidHintError
from service import errors
from service.capacity.admission_control import QUERY_IN_PARTS, admitted_as
from service.http.problems import problem_responses
from service.http.representations import NDJSON, LinesResponse
from service.http.uploads import Repeats
from service.query import Content, PhotographQuery, QueryContext
from service.routes.batch_lines import BatchLines
from service.routes.dependencies import Call
from service.routes.descriptions import QUERY_ERRORS
from service.routes.query_request import FEATURES, PHOTO, body_schema, keep_answer, photographs_of, read_query
from service.schemas import LocaliseAnswer, LocaliseForm
from service.schemas.localise_answer import BatchLine
from service.schemas.problem_details import Problem
from service.security import caller_of
from service.uploaded_file import UploadedFile

router = APIRouter(tags=["localisation"])
_PHOTOS_SCHEMA: dict[str, Any] = {
    "type": "array",
    "items": {"type": "string", "format": "binary"},
    "minItems": 1,
    "description": "Photographs, one part named `photo` each, as for `POST /localise`; limits: "
    "`max_batch_photographs`, and `max_sequence_bytes` together.",
}


@router.post(
    "/localise/batch",
    summary="Localise many photographs, one by one",
    status_code=200,
    response_class=LinesResponse,
    response_model=BatchLine,
    openapi_extra=body_schema(LocaliseForm, _PHOTOS_SCHEMA, idempotent=False),
    responses={200: {"description": f"`{NDJSON}`: a line of JSON per photograph, in the order of the request."}}
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
    most = settings.photographs.max_batch_photographs
    repeated = {PHOTO: Repeats(1, most, "max_batch_photographs")}
    form, parts, _ = await read_query(call, LocaliseForm, "max_sequence_bytes", repeated=repeated)
    files = parts.named(PHOTO) or parts.named(FEATURES)
    photographs = list(zip(files, photographs_of(parts, form, call), strict=True))
    await call.runtime.access_control.count_photographs(caller_of(call.request.scope), len(photographs))
    place = await call.place(form.floorplan_id, form.venue_id)

    async def answer(_index: int, _file: UploadedFile, content: Content, context: QueryContext) -> LocaliseAnswer:
        found = await call.runtime.localiser.answer(place, PhotographQuery(form, content, context))
        return await keep_answer(found, call)

    return LinesResponse(BatchLines(call, answer, _line).lines(photographs), settings.requests.request_deadline_s)


def _line(
    index: int, name: str | None, answer: LocaliseAnswer | None, problem: Problem | None, retry_after_s: int | None
) -> BatchLine:
    status = 200 if problem is None else problem.status
    return BatchLine(index=index, name=name, status=status, answer=answer, problem=problem, retry_after_s=retry_after_s)
