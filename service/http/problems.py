"""Error answers: `application/problem+json` (RFC 9457), without stack traces."""

from __future__ import annotations

import json
import logging
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from lalaloc_core.errors import InvalidFloorPlanError, LaLaLocError, SeveralLevelsError
from service.errors import (
    HTTP_PROBLEMS,
    INTERNAL,
    PROBLEMS,
    InvalidRequestError,
    ProblemKind,
    RangeError,
    ServiceError,
    UnauthenticatedError,
    UnsupportedEncodingError,
    UnsupportedMediaError,
    problem_kind,
)
from service.http.fields import describe_fault
from service.schemas.fields import Fault, Problem
from service.security.access_control import routed_path
from service.security.permissions import permissions_needed
from service.telemetry import LOGGER_NAME, add_log_fields, request_id_of

PROBLEM_JSON = "application/problem+json"
_HIDDEN = "internal error; the service's log has the details under this request_id"


def install_problem_handlers(app: FastAPI) -> None:
    """Answer every error, expected or not, with a problem document."""
    app.add_exception_handler(LaLaLocError, problem_answer)
    app.add_exception_handler(RequestValidationError, _on_invalid_request)
    app.add_exception_handler(HTTPException, http_problem_answer)
    app.add_exception_handler(Exception, _on_unexpected_error)


def problem_responses(*errors: type[Exception]) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses for the errors of a route."""
    titles: dict[int, list[str]] = {}
    for kind in (*(PROBLEMS[error] for error in errors), INTERNAL):
        line = f"{kind.title} (`{kind.type}`)"
        if line not in titles.setdefault(kind.status, []):
            titles[kind.status].append(line)
    schema = {"schema": {"$ref": "#/components/schemas/Problem"}}
    return {
        status: {"description": "; ".join(lines), "content": {PROBLEM_JSON: schema}}
        for status, lines in sorted(titles.items())
    }


def add_problems(operation: dict[str, Any], *errors: type[Exception]) -> None:
    """Add errors to the responses of an operation in an OpenAPI document."""
    responses = operation["responses"]
    for status, added in problem_responses(*errors).items():
        response = responses.setdefault(str(status), added)
        lines = response["description"].split("; ")
        lines += [line for line in added["description"].split("; ") if line not in lines]
        response["description"] = "; ".join(lines)
    operation["responses"] = dict(sorted(responses.items()))


def problem_document(request: Request, error: Exception) -> Problem:
    """Return the problem document of an error, and note its kind for the request's log line."""
    kind = problem_kind(error)
    faults = error.faults if isinstance(error, InvalidRequestError) else None
    return _document(
        request,
        kind,
        str(error) if kind.public else _HIDDEN,
        room=error.room if isinstance(error, InvalidFloorPlanError) else None,
        levels=list(error.levels) if isinstance(error, SeveralLevelsError) else None,
        errors=faults and [Fault(field=field, message=message) for field, message in faults],
    )


def problem_in_line(request: Request, error: Exception) -> tuple[Problem, int | None]:
    """Return the problem document of an error that is handled, and its `retry_after_s`, for a line of an answer."""
    if not isinstance(error, LaLaLocError):
        logging.getLogger(LOGGER_NAME).exception("unexpected error")
    return problem_document(request, error), error.retry_after_s if isinstance(error, ServiceError) else None


def problem_answer(request: Request, error: Exception) -> JSONResponse:
    """Return the answer to a request that failed: the problem document of an error."""
    headers = {}
    if isinstance(error, ServiceError) and error.retry_after_s is not None:
        headers["Retry-After"] = str(error.retry_after_s)
    if isinstance(error, RangeError):
        headers["Content-Range"] = f"bytes */{error.size_bytes}"
    if isinstance(error, UnauthenticatedError):
        headers["WWW-Authenticate"] = "Bearer"
    if isinstance(error, UnsupportedEncodingError):
        headers["Accept-Encoding"] = "identity"
    if isinstance(error, UnsupportedMediaError):
        headers["Accept-Post"] = ", ".join(error.accepted)
    return _answer(problem_document(request, error), headers)


def http_problem_answer(request: Request, error: Exception) -> JSONResponse:
    """Return the problem document of an error of the framework, such as an unknown route."""
    assert isinstance(error, HTTPException)
    kind = HTTP_PROBLEMS.get(error.status_code, ProblemKind(error.status_code, "http-error", "HTTP error"))
    detail = f"{request.method} {request.url.path[:200]}: {error.detail}"
    headers = dict(error.headers or {})
    # The framework lists the methods of the first matching route; the path can have more routes.
    if error.status_code == 405 and (methods := [*permissions_needed(routed_path(request.scope))]):
        headers["Allow"] = ", ".join([*methods, *(["HEAD"] if "GET" in methods else [])])
    return _answer(_document(request, kind, detail), headers)


def _on_invalid_request(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    return problem_answer(request, InvalidRequestError([describe_fault(fault) for fault in error.errors()]))


def _on_unexpected_error(request: Request, _error: Exception) -> JSONResponse:
    return _answer(_document(request, INTERNAL, _HIDDEN))


def _document(request: Request, kind: ProblemKind, detail: str, **further: Any) -> Problem:
    if kind is not INTERNAL:
        add_log_fields(request, rejection=kind.slug)
    return Problem(
        type=kind.type,
        title=kind.title,
        status=kind.status,
        detail=detail,
        request_id=request_id_of(request.scope),
        **further,
    )


def _answer(problem: Problem, headers: dict[str, str] | None = None) -> JSONResponse:
    return _ProblemResponse(problem.model_dump(exclude_none=True), status_code=problem.status, headers=headers)


class _ProblemResponse(JSONResponse):
    """Answer in ASCII JSON: details quote client input, which is not always encodable as UTF-8."""

    media_type = PROBLEM_JSON

    def render(self, content: Any) -> bytes:
        return json.dumps(content).encode("ascii")
