"""Parts of the API description that routes share: errors in groups, bodies, headers, files."""

from __future__ import annotations

from typing import Any

from fastapi import Response, status
from fastapi.responses import StreamingResponse
from pydantic import BaseModel

from lalaloc_core import errors as core
from service import errors
from service.http.events import EventStream
from service.http.idempotent_request import HEADER, MAX_KEY_CHARACTERS
from service.http.problems import problem_responses
from service.http.representations import NDJSON
from service.http.uploads import GEOJSON, GEOPOSE, JSON

Errors = tuple[type[Exception], ...]
Responses = dict[int | str, dict[str, Any]]

READ_ERRORS: Errors = (errors.InvalidRequestError, errors.StoreUnavailableError)
# Errors of reading a body.
BODY_ERRORS: Errors = (
    errors.MalformedRequestError,
    errors.UnsupportedMediaError,
    errors.UploadTooLargeError,
    errors.UploadTimeoutError,
    errors.BytesInFlightError,
    errors.SpoolFullError,
)
STORE_ERRORS: Errors = (errors.StoreUnavailableError, errors.StoreFullError, errors.StorageQuotaError)
IDEMPOTENCY_ERRORS: Errors = (errors.IdempotencyKeyReusedError, errors.IdempotencyInProgressError)
# Errors of uploading a plan file.
UPLOAD_ERRORS: Errors = (
    core.InvalidFloorPlanError,
    core.SeveralLevelsError,
    core.MissingExtraError,
    errors.InvalidRequestError,
    errors.PlanTooLargeError,
    *BODY_ERRORS,
    errors.ConverterNotReadyError,
    *STORE_ERRORS,
)
# Errors about the plan or venue of a query.
PLACE_ERRORS: Errors = (
    errors.UnknownVenueError,
    errors.VenueUnsearchableError,
    errors.VenueNotReadyError,
    errors.UnknownFloorPlanError,
)
QUERY_ERRORS: Errors = (
    core.InvalidPhotographError,
    core.InvalidFeaturesError,
    core.ForeignFeaturesError,
    errors.FeaturesRequiredError,
    core.InvalidPoseError,
    errors.InvalidRequestError,
    errors.PlanFailedError,
    errors.PlanNotReadyError,
    *BODY_ERRORS,
    errors.OverloadedError,
    errors.StoreUnavailableError,
    errors.StoppingError,
    errors.DecoderNotReadyError,
    errors.DeadlineExceededError,
)

# Errors of beginning something that lasts, such as a session, in a plan or venue.
BEGIN_ERRORS: Errors = (
    core.InvalidPoseError,
    errors.InvalidRequestError,
    *BODY_ERRORS,
    *STORE_ERRORS,
    errors.UnknownFloorPlanError,
    errors.UnknownVenueError,
    errors.VenueUnsearchableError,
)

BINARY: dict[str, Any] = {"type": "string", "format": "binary"}
PARTIAL_CONTENT: Responses = {206: {"description": "The bytes that the request asks for."}}
_NOT_MODIFIED: Responses = {304: {"description": "The client has this representation already."}}
PLAN_RESPONSES = problem_responses(errors.UnknownFloorPlanError, *READ_ERRORS)
PHOTOGRAPH_LINES: Responses = {
    200: {"description": f"`{NDJSON}`: a line of JSON per photograph, in the order of the request."}
}


def photographs_schema(text: str, limit: str, **further: Any) -> dict[str, Any]:
    """Describe the part of a form that has photographs; `text` tells their order, `limit` is that of their number."""
    description = f"{text}, one part named `photo` each, as for `POST /localise`; limits: `{limit}`, and "
    return {"type": "array", "items": BINARY, **further, "description": f"{description}`max_sequence_bytes` together."}


def on_earth(**texts: str) -> dict[str, Any]:
    """Describe answers in latitude and longitude; `geojson` and `geopose` tell of what they are one."""
    media = {"geojson": GEOJSON, "geopose": GEOPOSE}
    return {media[name]: {"schema": {"type": "object", "description": text}} for name, text in texts.items()}


def event_stream(event: str, responses: Responses) -> dict[str, Any]:
    """Describe a route that answers with server-sent events."""
    content = {EventStream.media_type: {"schema": {"type": "string"}}}
    answer = {"description": f"Server-sent events; their data is {event}.", "content": content}
    return {"response_class": StreamingResponse, "responses": {200: answer, **responses}}


def reads(model: type[BaseModel], *failures: type[Exception]) -> dict[str, Any]:
    """Describe a route that answers with a representation, or with 304."""
    responses = _NOT_MODIFIED | problem_responses(*failures, *READ_ERRORS)
    return {"response_model": model, "openapi_extra": CONDITIONAL, "responses": responses}


def reads_file(
    *media: str, responses: Responses, schema: dict[str, Any] = BINARY, parameters: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Describe a route that answers with a file, or with 304."""
    answer: Responses = {200: {"content": {name: {"schema": schema} for name in media}}}
    return {
        "response_class": Response,
        "openapi_extra": parameters or CONDITIONAL,
        "responses": answer | _NOT_MODIFIED | responses,
    }


def stores(
    model: type[BaseModel], body: dict[str, Any], *failures: type[Exception], lines: Responses | None = None
) -> dict[str, Any]:
    """Describe a route that stores something new, once for an idempotency key."""
    return {
        "status_code": status.HTTP_201_CREATED,
        "response_model": model,
        "openapi_extra": {"requestBody": body, "parameters": [IDEMPOTENCY_KEY]},
        "responses": (lines or {}) | problem_responses(*failures, *IDEMPOTENCY_ERRORS),
    }


def changes(
    model: type[BaseModel], body: dict[str, Any], *failures: type[Exception], idempotent: bool = False
) -> dict[str, Any]:
    """Describe a route that changes something stored, under preconditions."""
    known = (*failures, errors.RevisionMismatchError, *(IDEMPOTENCY_ERRORS if idempotent else ()))
    parameters = [*UNLESS_CHANGED, IDEMPOTENCY_KEY] if idempotent else UNLESS_CHANGED
    return {
        "response_model": model,
        "openapi_extra": {"requestBody": body, "parameters": parameters},
        "responses": problem_responses(*known),
    }


def deletes(*failures: type[Exception]) -> dict[str, Any]:
    """Describe a route that deletes something stored, under preconditions."""
    return {
        "status_code": status.HTTP_204_NO_CONTENT,
        "openapi_extra": {"parameters": UNLESS_CHANGED},
        "responses": problem_responses(*failures, errors.RevisionMismatchError, *READ_ERRORS),
    }


def import_lines(model: type[BaseModel]) -> Responses:
    """Describe the answer to an import that is sent as lines."""
    line = {"$ref": "#/components/schemas/ImportLine"}
    answer = {"answer": {"$ref": f"#/components/schemas/{model.__name__}"}}
    schema = {"allOf": [line, {"type": "object", "properties": answer}]}
    text = (
        f"With `Accept: {NDJSON}`: a line of JSON for each step as it begins, and at the end one with the status that "
        "the request would have without lines, and the answer or the problem."
    )
    return {200: {"description": text, "content": {NDJSON: {"schema": schema}}}}


def json_body(model: type[BaseModel], **further: Any) -> dict[str, Any]:
    """Describe a request body in JSON that a route parses itself; `further`: schemas of other media types."""
    content = {JSON: {"schema": {"$ref": f"#/components/schemas/{model.__name__}"}}}
    return {"required": True, "content": content | further}


def _header(name: str, description: str) -> dict[str, Any]:
    """Describe an optional request header."""
    return {"name": name, "in": "header", "required": False, "description": description, "schema": {"type": "string"}}


IDEMPOTENCY_KEY = _header(
    HEADER,
    f"1 to {MAX_KEY_CHARACTERS} visible ASCII characters. A second request with the same key and content within 24 "
    "hours is not executed again; it gets the first answer with `Idempotency-Replayed: true`.",
)
CONDITIONAL = {
    "parameters": [
        _header("If-None-Match", "Entity tags that the client has, or `*`; if one matches, the answer is 304.")
    ]
}
PARTIAL = {
    "parameters": [
        *CONDITIONAL["parameters"],
        _header("Range", "Bytes of the file, such as `bytes=1048576-`; several ranges are answered with all bytes."),
        _header("If-Range", "Entity tag of the part that the client has; all bytes are sent if it is another one."),
    ]
}
UNLESS_CHANGED = [
    _header("If-Match", "Entity tags of the expected revision, or `*`; 412 if none matches."),
    _header("If-None-Match", "Entity tags of revisions; 412 if one matches."),
]
