"""Errors of the client.

ClientError
├── ConnectionFailedError     no answer came, also not after the retries
├── MalformedAnswerError      an answer that this client does not understand
├── FloorPlanFailedError      the service could not prepare the plan
├── NotReadyError             the plan was still preparing when the time was up (a TimeoutError, too)
└── ProblemError              the service answered with a problem (RFC 9457)
    ├── InvalidError          what was sent is wrong: 400, 413, 415, 422
    ├── UnauthorisedError     no key, one that is not valid, or without the scope: 401, 403
    ├── NotFoundError         there is no such thing: 404
    ├── ConflictError         the plan is in another state: 409, 412
    └── OverloadedError       too much at once, also after the retries: 429, 503
"""

from __future__ import annotations

from collections.abc import Sequence


class ClientError(Exception):
    """Base of all errors of the client."""


class ConnectionFailedError(ClientError):
    """No answer came; the cause is httpx's error."""


class MalformedAnswerError(ClientError):
    """The answer is not what this client understands; says which field."""


class FloorPlanFailedError(ClientError):
    """The service could not prepare the plan.

    Attributes:
        reason: what the service says.
    """

    def __init__(self, floorplan_id: str, reason: str | None) -> None:
        self.reason = reason
        super().__init__(f"floor plan '{floorplan_id}' could not be prepared: {reason or 'no reason given'}")


class NotReadyError(ClientError, TimeoutError):
    """The plan was still preparing when the time was up."""

    def __init__(self, floorplan_id: str, waited_s: float, progress: float) -> None:
        super().__init__(f"floor plan '{floorplan_id}' is still preparing after {waited_s:.1f} s ({progress:.0%} done)")


class ProblemError(ClientError):
    """The service answered with a problem.

    Attributes:
        type: stable identifier of the kind of problem, `about:blank` where the answer has none.
        status: of HTTP.
        detail: what is wrong, with value and limit.
        request_id: names the request in the service's log.
        faults: (field, message) of every field at fault.
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
        named = f" (request {request_id})" if request_id else ""
        super().__init__(f"{status} {type}: {detail}{named}")


class InvalidError(ProblemError):
    """What was sent is wrong; sending it again does not help."""


class UnauthorisedError(ProblemError):
    """There is no key, it is not valid, or lacks the scope."""


class NotFoundError(ProblemError):
    """There is no such thing, or it belongs to somebody else."""


class ConflictError(ProblemError):
    """The plan is in another state than the request assumes."""


class OverloadedError(ProblemError):
    """The service has too much to do, or allows this key no more for now."""


_BY_STATUS: dict[int, type[ProblemError]] = {
    400: InvalidError,
    401: UnauthorisedError,
    403: UnauthorisedError,
    404: NotFoundError,
    409: ConflictError,
    412: ConflictError,
    413: InvalidError,
    415: InvalidError,
    422: InvalidError,
    429: OverloadedError,
    503: OverloadedError,
}


def problem_class(status: int) -> type[ProblemError]:
    """The class of problems with a status of HTTP."""
    return _BY_STATUS.get(status, ProblemError)
