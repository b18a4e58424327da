"""Parts of the API description that routes share: errors in groups, bodies, headers, files."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel

from lalaloc_core.errors import (
    ForeignFeaturesError,
    InvalidFeaturesError,
    InvalidFloorPlanError,
    InvalidPhotographError,
    InvalidPoseError,
    MissingExtraError,
    SeveralLevelsError,
)
from service import errors
from service.http.idempotent_request import HEADER, MAX_KEY_CHARACTERS
from service.http.problems import problem_responses
from service.http.representations import NDJSON
from service.http.uploads import JSON

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
    InvalidFloorPlanError,
    SeveralLevelsError,
    MissingExtraError,
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
    InvalidPhotographError,
    InvalidFeaturesError,
    ForeignFeaturesError,
    errors.FeaturesRequiredError,
    InvalidPoseError,
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

PARTIAL_CONTENT: Responses = {206: {"description": "The bytes that the request asks for."}}
NOT_MODIFIED: Responses = {304: {"description": "The client has this representation already."}}
PLAN_RESPONSES = problem_responses(errors.UnknownFloorPlanError, *READ_ERRORS)
REVISION_RESPONSES = NOT_MODIFIED | problem_responses(
    errors.UnknownFloorPlanError, errors.UnknownRevisionError, *READ_ERRORS
)


def file_response(*media_types: str, schema_format: str | None = "binary") -> Responses:
    """Describe an answer that is a file; `schema_format` is None for text."""
    schema = {"type": "string"} if schema_format is None else {"type": "string", "format": schema_format}
    return {200: {"content": {name: {"schema": schema} for name in media_types}}} | NOT_MODIFIED


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
