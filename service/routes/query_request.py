"""Common parts of queries: the multipart form with its photographs, and the errors."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

from fastapi import Request
from pydantic import BaseModel

from lalaloc_core.bundle import Bundle
from lalaloc_core.errors import ForeignFeaturesError, InvalidFeaturesError, InvalidPhotographError, InvalidPoseError
from lalaloc_core.localise.encode.features import MAX_BYTES, read_features
from lalaloc_core.localise.search.pipeline import StageClock
from service.errors import (
    BytesInFlightError,
    DeadlineExceededError,
    DecoderNotReadyError,
    FeaturesRequiredError,
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
from service.query import Content, QueryContext
from service.routes.dependencies import IDEMPOTENCY_KEY
from service.schemas import LocaliseForm, PhotographForm, SequenceForm
from service.schemas.photographs import PhotographFields
from service.settings import Settings
from service.telemetry import add_log_fields

PHOTO, FEATURES = "photo", "features"
# Name of the part in versions up to 0.5.
PANORAMA = "panorama"
Form = TypeVar("Form", LocaliseForm, SequenceForm, PhotographForm)
# Errors of a query.
QUERY_ERRORS: tuple[type[Exception], ...] = (
    InvalidPhotographError,
    InvalidFeaturesError,
    ForeignFeaturesError,
    FeaturesRequiredError,
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
    kind = {"type": "string", "format": "binary"}
    schema["properties"][FEATURES] = {
        **({"type": "array", "items": kind} if photo["type"] == "array" else kind),
        "description": f"Instead of `{PHOTO}`: its features, computed on the device with the image encoder of this "
        "service (`GET /model/{file}`; docs/reference/features.md), so that the photograph stays there.",
    }
    # One of the three is needed. None is described as required, because of alternatives generated clients make a union
    # of types.
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
        FeaturesRequiredError: a photograph was sent to a service that takes features only.
    """
    clock = StageClock()
    add_log_fields(request, clock=clock)
    bounds = {"max_top_k": settings.photographs.max_top_k}
    limits = UploadLimits.of(settings, limit)
    if settings.photographs.require_features:
        # Small, and never written to disk.
        count = max((repeats.most for repeats in (repeated or {}).values()), default=1)
        limits = replace(limits, max_bytes=min(limits.max_bytes, count * MAX_BYTES), memory_bytes=0)
    with clock.stage("upload"):
        try:
            parts = await read_parts(
                request,
                limits,
                files=set(files),
                fields=set(form_type.model_fields),
                check=partial(faults_of, form_type, context=bounds),
                repeated=repeated or {},
                aliases={PANORAMA: PHOTO},
                substitutes={FEATURES: PHOTO},
            )
        except UploadTooLargeError as error:
            if settings.photographs.require_features:
                raise FeaturesRequiredError from error
            raise
    if settings.photographs.require_features and parts.named(PHOTO):
        raise FeaturesRequiredError
    context = QueryContext.starting(client, settings.requests.request_deadline_s, clock)
    form = validate_fields(form_type, parts.fields, bounds)
    if not isinstance(form, PhotographForm) and "top_k" not in form.model_fields_set:
        form = form.model_copy(update={"top_k": min(form.top_k, settings.photographs.max_top_k)})
    return form, parts, context


def photographs_of(parts: Parts, form: PhotographFields, bundle: Bundle) -> list[Content]:
    """Return the photographs of a query in order: their files, or what was read of their features.

    Raises:
        InvalidFeaturesError, ForeignFeaturesError: see `read_features`.
        InvalidRequestError: features come with fields about the camera.
    """
    features = parts.named(FEATURES)
    if not features:
        return [*parts.named(PHOTO)]
    if stated := sorted(form.model_fields_set & PhotographFields.model_fields.keys()):
        raise InvalidRequestError(
            [(name, f"is stated when {FEATURES} are computed; leave it out of the query") for name in stated]
        )
    for index, file in enumerate(features):
        if len(file) > MAX_BYTES:
            raise InvalidFeaturesError(f"{FEATURES}[{index}] has {len(file)} bytes; the limit is {MAX_BYTES}")
    return [read_features(file.read(), bundle) for file in features]
