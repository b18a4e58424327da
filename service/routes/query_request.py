"""What the requests that ask about panoramas have in common: a form with pictures, and what it may be refused with."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial
from typing import Any, TypeVar

from fastapi import Request
from pydantic import BaseModel

from lalaloc_core.errors import InvalidPanoramaError, InvalidPoseError
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
    UnknownFloorPlanError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
)
from service.http.idempotent_request import HEADER as IDEMPOTENCY_HEADER
from service.http.uploads import JSON, MULTIPART, Parts, Settable, UploadLimits, faults_of, read_parts, validate_fields
from service.query import QueryContext
from service.routes.dependencies import IDEMPOTENCY_KEY
from service.schemas import LocaliseForm, SequenceForm
from service.settings import Settings
from service.telemetry import add_log_fields

PANORAMA = "panorama"
Form = TypeVar("Form", LocaliseForm, SequenceForm)
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


def body_schema(form: type[BaseModel], panorama: Mapping[str, Any]) -> dict[str, Any]:
    """How an operation describes its body.

    Args:
        panorama: the schema of the picture, or of the pictures.
    """
    schema = form.model_json_schema(ref_template="#/components/schemas/{model}")
    # Told with the others, see `http.api_description`.
    schema.pop("$defs", None)
    schema["properties"][PANORAMA] = dict(panorama)
    schema["required"] = [*schema.get("required", []), PANORAMA]
    body = {"required": True, "content": {MULTIPART: {"schema": schema}}}
    return {"requestBody": body, "parameters": [IDEMPOTENCY_KEY]}


def check_idempotent_media(request: Request, media: str) -> None:
    """Raises:
    InvalidRequestError: an idempotency key where another answer than JSON is wanted.
    """
    if media != JSON and IDEMPOTENCY_HEADER in request.headers:
        raise InvalidRequestError([(IDEMPOTENCY_HEADER, "is for answers in application/json, others are not kept")])


async def read_query(
    request: Request,
    settings: Settings,
    client: str,
    form_type: type[Form],
    limit: Settable,
    *,
    files: Collection[str] = (),
    repeated: Mapping[str, tuple[int, int]] | None = None,
) -> tuple[Form, Parts, QueryContext]:
    """The form in a request, all its parts, and the context of the query that begins as it is there as a whole.

    Args:
        limit: the setting of how large the body may be.
        files, repeated: see `read_parts`.

    Raises:
        UploadTooLargeError, UploadTimeoutError, MalformedRequestError: see `read_parts`.
        InvalidRequestError: a part or a field that is missing, unknown, or has a value that it cannot have.
    """
    clock = StageClock()
    add_log_fields(request, clock=clock)
    bounds = {"max_top_k": settings.panoramas.max_top_k}
    with clock.stage("upload"):
        parts = await read_parts(
            request,
            UploadLimits.of(settings, limit),
            files=set(files),
            fields=set(form_type.model_fields),
            check=partial(faults_of, form_type, context=bounds),
            repeated=repeated or {},
        )
    context = QueryContext.starting(client, settings.requests.request_deadline_s, clock)
    form = validate_fields(form_type, parts.fields, bounds)
    if "top_k" not in form.model_fields_set:
        form = form.model_copy(update={"top_k": min(form.top_k, settings.panoramas.max_top_k)})
    return form, parts, context
