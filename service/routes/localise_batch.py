"""Batches: many photographs of one plan or venue in one request, each a query of its own."""

from __future__ import annotations

import asyncio
import json
import logging
from collections import deque
from collections.abc import AsyncGenerator, Sequence
from typing import Any

from fastapi import APIRouter, Response

from lalaloc_core.errors import InvalidHintError, LaLaLocError
from service import errors
from service.capacity.admission_control import BATCH
from service.http.piecewise import NDJSON, LinesResponse
from service.http.problems import problem_document, problem_responses
from service.http.uploads import Repeats
from service.query import Content, PhotographQuery, QueryContext
from service.routes.dependencies import ApiCall, Call
from service.routes.descriptions import QUERY_ERRORS
from service.routes.query_request import FEATURES, PHOTO, body_schema, keep_answer, photographs_of, read_query
from service.schemas import LocaliseAnswer, LocaliseForm
from service.schemas.localise_answer import BatchLine
from service.security import caller_of
from service.storage.records import PlanRecord, VenueRecord
from service.telemetry import LOGGER_NAME
from service.uploaded_file import UploadedFile

router = APIRouter(tags=["localisation"])
_PHOTOS_SCHEMA: dict[str, Any] = {
    "type": "array",
    "items": {"type": "string", "format": "binary"},
    "minItems": 1,
    "description": "Photographs, one part named `photo` each, as for `POST /localise`; limits: "
    "`max_batch_photographs`, and `max_sequence_bytes` together.",
}
# Errors that every further photograph of the batch would meet.
_COMMON_ERRORS = (
    InvalidHintError,
    errors.PlanFailedError,
    errors.PlanNotReadyError,
    errors.StoppingError,
    errors.VenueNotReadyError,
    errors.VenueUnsearchableError,
)
# Pause (s) before a photograph asks again for a slot, while the tenant's other queries have them.
_BUSY_PAUSE_S = 0.25
_MAX_NAME = 255


@router.post(
    BATCH,
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
    batch = _Batch(call, form, await call.place(form.floorplan_id, form.venue_id))
    return LinesResponse(batch.lines(photographs), settings.requests.request_deadline_s)


class _Batch:
    """Photographs of one request; as many at a time as there are cores that compute."""

    def __init__(self, call: ApiCall, form: LocaliseForm, place: PlanRecord | VenueRecord) -> None:
        self._call = call
        self._form = form
        self._place = place
        self._common_error: Exception | None = None

    async def lines(self, photographs: Sequence[tuple[UploadedFile, Content]]) -> AsyncGenerator[str]:
        """Yield the line of every photograph, in order. While a line is not taken, no further photograph begins."""
        cores = self._call.settings.cores
        at_a_time = max(cores.workers + cores.compute_threads, 1)
        begun = deque[asyncio.Task[str]]()
        try:
            for index, (file, photograph) in enumerate(photographs):
                begun.append(asyncio.create_task(self._charged_line(index, file, photograph)))
                if len(begun) >= at_a_time:
                    yield await begun[0]
                    begun.popleft()
            while begun:
                yield await begun[0]
                begun.popleft()
        finally:
            for task in begun:
                task.cancel()
            await asyncio.gather(*begun, return_exceptions=True)

    async def _charged_line(self, index: int, file: UploadedFile, photograph: Content) -> str:
        # A task is not part of the request's own steps.
        line = self._line(index, file, photograph)
        return await self._call.runtime.admission.cpu_accounts.charged_steps(self._call.client, line)

    async def _line(self, index: int, file: UploadedFile, photograph: Content) -> str:
        answer = problem = retry_after_s = None
        try:
            answer = await self._answer(file, photograph)
        except Exception as error:
            if not isinstance(error, LaLaLocError):
                logging.getLogger(LOGGER_NAME).exception("unexpected error")
            if isinstance(error, _COMMON_ERRORS):
                self._common_error = error
            problem = problem_document(self._call.request, error)
            retry_after_s = error.retry_after_s if isinstance(error, errors.ServiceError) else None
        finally:
            file.close()
        line = BatchLine(
            index=index,
            name=None if file.name is None else file.name[:_MAX_NAME],
            status=200 if problem is None else problem.status,
            answer=answer,
            problem=problem,
            retry_after_s=retry_after_s,
        )
        # In ASCII: names and details quote the request, which is not always encodable as UTF-8.
        return json.dumps(line.model_dump(mode="json", exclude_none=problem is not None))

    async def _answer(self, file: UploadedFile, photograph: Content) -> LocaliseAnswer:
        """Localise one photograph; wait for a slot while the tenant's other queries have them all."""
        settings = self._call.settings
        limit = settings.photographs.max_photograph_bytes
        if len(file) > limit:
            raise errors.UploadTooLargeError("max_photograph_bytes", limit, len(file))
        context = QueryContext.starting(self._call.client, settings.requests.request_deadline_s)
        while True:
            if self._call.runtime.admission.stopping:
                raise errors.StoppingError()
            if self._common_error is not None:
                raise self._common_error
            try:
                query = PhotographQuery(self._form, photograph, context)
                answer = await self._call.runtime.localiser.localise(self._place, query)
                return await keep_answer(answer, self._call)
            except errors.OverloadedError:
                if context.left_s < _BUSY_PAUSE_S:
                    raise
            await asyncio.sleep(_BUSY_PAUSE_S)
