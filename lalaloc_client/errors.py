"""Errors of the client."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import httpx

_SHOWN_CHARACTERS = 500


class ClientError(Exception):
    """Base of all errors of the client."""


class ConnectionFailedError(ClientError):
    """The service did not answer; the cause is httpx's error."""


class MalformedAnswerError(ClientError):
    """The answer has another form than the API's; the message names the field."""


class FloorPlanFailedError(ClientError):
    """The service could not prepare the plan."""

    def __init__(self, floorplan_id: str, reason: str | None) -> None:
        self.reason = reason
        super().__init__(f"floor plan '{floorplan_id}' could not be prepared: {reason or 'no reason given'}")


class AlbumFailedError(ClientError):
    """The service could not solve the album."""

    def __init__(self, album_id: str, reason: str | None) -> None:
        self.reason = reason
        super().__init__(f"album '{album_id}' could not be solved: {reason or 'no reason given'}")


class OnDeviceError(ClientError):
    """The features of a photograph cannot be computed on this device."""


class NotReadyError(ClientError, TimeoutError):
    """The plan was still preparing, or the album still being solved, at the timeout."""

    def __init__(self, resource_id: str, waited_s: float, progress: float, what: str = "floor plan") -> None:
        super().__init__(f"{what} '{resource_id}' is still preparing after {waited_s:.1f} s ({progress:.0%} done)")


class ProblemError(ClientError):
    """The service answered with a problem.

    Attributes:
        type: stable identifier of the kind of problem; `about:blank` if the answer has none.
        faults: (field, message) of every invalid field.
    """

    def __init__(
        self,
        type: str,
        status: int,
        detail: str,
        *,
        request_id: str | None = None,
        faults: Sequence[tuple[str, str]] = (),
    ) -> None:
        self.type = type
        self.status = status
        self.detail = detail
        self.request_id = request_id
        self.faults = tuple(faults)
        suffix = f" (request {request_id})" if request_id else ""
        super().__init__(f"{status} {type}: {detail}{suffix}")


class InvalidError(ProblemError):
    """The request is wrong; repeating it does not help."""


class UnauthorisedError(ProblemError):
    """The key is missing, invalid, or lacks the scope."""


class NotFoundError(ProblemError):
    """The resource does not exist or belongs to another tenant."""


class ConflictError(ProblemError):
    """The resource is in another state than the request assumes."""


class OverloadedError(ProblemError):
    """The service is overloaded, or the key's rate limit is exceeded."""


_STATUSES: Mapping[type[ProblemError], tuple[int, ...]] = {
    InvalidError: (400, 413, 415, 422),
    UnauthorisedError: (401, 403),
    NotFoundError: (404,),
    ConflictError: (409, 412),
    OverloadedError: (429, 503),
}
_BY_STATUS = {status: kind for kind, statuses in _STATUSES.items() for status in statuses}


def problem_of(response: httpx.Response) -> ProblemError:
    """Return the error for an answer, which a proxy may have sent without a problem document."""
    try:
        document = json.loads(response.content)
    except ValueError:
        document = None
    text = response.text.strip()[:_SHOWN_CHARACTERS] or response.reason_phrase
    return problem_from(
        document if isinstance(document, dict) else {}, response.status_code, text, response.headers.get("x-request-id")
    )


def problem_from(
    document: Mapping[str, Any], status: int, text: str = "no detail given", request_id: str | None = None
) -> ProblemError:
    """Return the error for a problem document; `text` and `request_id` stand for what it does not state."""
    faults = document.get("errors")
    return _BY_STATUS.get(status, ProblemError)(
        str(document.get("type", "about:blank")),
        status,
        str(document.get("detail", text)),
        request_id=document.get("request_id") or request_id,
        faults=[
            (str(fault.get("field")), str(fault.get("message")))
            for fault in (faults if isinstance(faults, list) else [])
            if isinstance(fault, dict)
        ],
    )
