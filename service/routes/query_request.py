"""Common parts of queries: the multipart form with its photographs, and the errors."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial
from typing import Any, TypeVar

from fastapi import Request
from pydantic import BaseModel

from lalaloc_core.errors import InvalidPanoramaError, InvalidPoseError
from lalaloc_core.localise.pipeline import StageClock
from service.errors import (
    BytesInFlightError,
    DeadlineExceededError,
    DecoderNotReadyError,
    IdempotencyInProgressError,
    IdempotencyKeyReusedError,
    InvalidRequestError,
    MalformedRequestError,
    OverloadedError,
    PlanFailedError,
    PlanNotReadyError,
    SpoolFullError,
    StoppingError,
    StoreUnavailableError,
    UnknownFloorPlanError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
)
from service.http.idempotent_request import HEADER as IDEMPOTENCY_HEADER
from service.http.uploads import (
    JSON,
    MULTIPART,
    Parts,
    Repeats,
    Settable,
    UploadLimits,
    faults_of,
    read_parts,
    validate_fields,
)
from service.query import QueryContext
from service.routes.dependencies import IDEMPOTENCY_KEY
from service.schemas import LocaliseForm, PhotographForm, SequenceForm
from service.settings import Settings
from service.telemetry import add_log_fields

PHOTO = "photo"
# Name of the part in versions up to 0.5.
PANORAMA = "panorama"
Form = TypeVar("Form", LocaliseForm, SequenceForm, PhotographForm)
# Errors of a query.
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
    BytesInFlightError,
    SpoolFullError,
    OverloadedError,
    StoreUnavailableError,
    StoppingError,
    DecoderNotReadyError,
    DeadlineExceededError,
    IdempotencyKeyReusedError,
    IdempotencyInProgressError,
)


def body_schema(form: type[BaseModel], photo: Mapping[str, Any]) -> dict[str, Any]:
    """Return the description of a query's body, given its form and the schema of its photographs."""
    schema = form.model_json_schema(ref_template="#/components/schemas/{model}")
    # `http.api_description` adds these schemas.
    schema.pop("$defs", None)
    schema["properties"][PHOTO] = dict(photo)
    schema["properties"][PANORAMA] = {**photo, "description": f"Earlier name of `{PHOTO}`.", "deprecated": True}
    # Either name is accepted. Only the current one is described as required, because of alternatives generated clients
    # make a union of types.
    schema["required"] = [*schema.get("required", []), PHOTO]
    body = {"required": True, "content": {MULTIPART: {"schema": schema}}}
    return {"requestBody": body, "parameters": [IDEMPOTENCY_KEY]}


def check_idempotent_media(request: Request, media: str) -> None:
    """Refuse an idempotency key for an answer that is not JSON.

    Raises:
        InvalidRequestError: the request has such a key.
    """
    if media != JSON and IDEMPOTENCY_HEADER in request.headers:
        raise InvalidRequestError([(IDEMPOTENCY_HEADER, "works for answers in application/json only")])


async def read_query(
    request: Request,
    settings: Settings,
    client: str,
    form_type: type[Form],
    limit: Settable,
    *,
    files: Collection[str] = (),
    repeated: Mapping[str, Repeats] | None = None,
) -> tuple[Form, Parts, QueryContext]:
    """Read the form of a query and start the clock of its deadline.

    Args:
        request: the request.
        settings: settings of the service.
        client: tenant or client address that the query counts for.
        form_type: model of the form.
        limit: name of the setting that limits the body.
        files: see `read_parts`.
        repeated: see `read_parts`.

    Returns:
        the form, all parts, and the context of the query.

    Raises:
        UploadTooLargeError, UploadTimeoutError, MalformedRequestError: see `read_parts`.
        InvalidRequestError: a part or field is missing, unknown or invalid.
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
            aliases={PANORAMA: PHOTO},
        )
    context = QueryContext.starting(client, settings.requests.request_deadline_s, clock)
    form = validate_fields(form_type, parts.fields, bounds)
    if not isinstance(form, PhotographForm) and "top_k" not in form.model_fields_set:
        form = form.model_copy(update={"top_k": min(form.top_k, settings.panoramas.max_top_k)})
    return form, parts, context
