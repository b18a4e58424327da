"""Errors of the service; `problem_kinds` says what each means over HTTP.

LaLaLocError
└── ServiceError
    ├── MalformedRequestError       a body that does not follow its media type
    ├── InvalidRequestError         a field that is missing, unknown or outside its limits
    ├── UnknownFloorPlanError       no floor plan with this id
    ├── UnknownVenueError           no venue with this id
    ├── UnknownRevisionError        no such revision of the floor plan
    ├── UnknownAnswerError          no answer is kept under this id
    ├── UnanchoredPlanError         the floor plan does not say where on Earth it lies
    ├── NoPlanNearbyError           no floor plan lies near a place on Earth
    ├── UploadTooLargeError         more bytes than allowed
    ├── UploadTimeoutError          the upload took too long
    ├── UnsupportedMediaError       a body of a type that is not read here
    │   └── UnsupportedEncodingError    a compressed body
    ├── PlanTooLargeError           the latent grid would have more poses than allowed
    ├── PlanFailedError             the plan's latent grid could not be computed
    ├── PlanNotReadyError           still preparing at the request's deadline
    ├── TooManyFloorPlansError      the tenant has as many as allowed
    ├── TooManyVenuesError          the tenant has as many as allowed
    ├── VenueUnsearchableError      the venue has no plan, or none that will ever be ready
    ├── VenueNotReadyError          no plan of the venue can be asked about yet
    ├── RevisionMismatchError       the plan or venue has another revision than the one expected
    ├── IdempotencyKeyReusedError   the key was sent with another body before
    ├── IdempotencyInProgressError  the same request is being carried out
    ├── DamagedDataError            what is stored is not what was
    ├── StoreUnavailableError       the database cannot be reached
    │   ├── StoreBusyError          it answers, but all connections to it are in use
    │   └── StoreFullError          it has no room left
    ├── UnauthenticatedError        no valid API key
    ├── InsufficientScopeError      the API key is not good for this
    ├── ExposedWithoutKeysError     asked from elsewhere while there are no API keys
    ├── RateLimitedError            more requests of an API key than allowed
    ├── TooManyRefusedKeysError     more invalid API keys from one client than allowed
    ├── OverloadedError             more requests in flight than allowed
    │   └── ShareExceededError      more of one tenant than allowed while others may come
    ├── DecoderNotReadyError        panoramas cannot be decoded at the moment
    ├── ConverterNotReadyError      files of plans cannot be read or written at the moment
    ├── DeadlineExceededError       the query could not be computed in time
    └── StoppingError               the service is shutting down
"""

from __future__ import annotations

from collections.abc import Iterable

from lalaloc_core.errors import LaLaLocError


class ServiceError(LaLaLocError):
    """Base of the errors that only the service raises.

    Attributes:
        retry_after_s: whole seconds after which trying again makes sense, None when it does not.
    """

    retry_after_s: int | None = None


class MalformedRequestError(ServiceError):
    """The body does not follow its media type."""


class InvalidRequestError(ServiceError):
    """A field is missing, unknown, or outside its limits.

    Attributes:
        faults: one (field, message) for each fault.
    """

    def __init__(self, faults: list[tuple[str, str]]) -> None:
        self.faults = faults
        super().__init__("; ".join(f"{field}: {message}" for field, message in faults))


class UnknownFloorPlanError(ServiceError):
    """No floor plan has this id."""

    def __init__(self, plan_id: str) -> None:
        super().__init__(f"there is no floor plan '{plan_id[:64]}'")


class UnknownVenueError(ServiceError):
    """No venue has this id."""

    def __init__(self, venue_id: str) -> None:
        super().__init__(f"there is no venue '{venue_id[:64]}'")


class UnknownRevisionError(ServiceError):
    """The floor plan has no such revision, or it is no longer kept."""

    def __init__(self, plan_id: str, revision_id: str) -> None:
        super().__init__(f"floor plan '{plan_id}' has no revision '{revision_id[:64]}', or has it no more")


class UnknownAnswerError(ServiceError):
    """No answer is kept under this id, or it is no longer."""

    def __init__(self, answer_id: str) -> None:
        super().__init__(
            f"no answer is kept under '{answer_id[:64]}': it was forgotten after a while (keep_answers_s) or with its "
            "floor plan, or never was"
        )


class UnanchoredPlanError(ServiceError):
    """The floor plan does not say where on Earth it lies, which the answer that is wanted needs."""

    def __init__(self, plan_id: str, venue_id: str | None = None) -> None:
        nor = "" if venue_id is None else f", nor has venue '{venue_id}'"
        super().__init__(f"floor plan '{plan_id}' has no anchor{nor}, so there is no answer in latitude and longitude")


class NoPlanNearbyError(ServiceError):
    """No floor plan with an anchor lies near a place on Earth."""

    def __init__(self, place: str, within_m: float) -> None:
        super().__init__(
            f"no floor plan with an anchor lies within {within_m:g} m of {place}: say which by floorplan_id or venue_id"
        )


class UploadTooLargeError(ServiceError):
    """The body has more bytes than allowed."""

    def __init__(self, name: str, limit: int, stated: int | None = None) -> None:
        size = f"{stated} bytes" if stated is not None else "too large"
        super().__init__(f"the body is {size}, at most {limit} bytes are allowed ({name})")


class UploadTimeoutError(ServiceError):
    """The upload did not finish in time, or came too slowly."""


class UnsupportedMediaError(ServiceError):
    """The body is of a type that is not read here."""

    def __init__(self, given: str, accepted: tuple[str, ...]) -> None:
        self.accepted = accepted
        stated = f"content type '{given[:100]}'" if given else "a body without content type"
        super().__init__(f"{stated} is not read here, send {' or '.join(accepted)}")


class UnsupportedEncodingError(UnsupportedMediaError):
    """The body is compressed."""

    def __init__(self, encoding: str) -> None:
        ServiceError.__init__(
            self, f"bodies are not read here in Content-Encoding '{encoding[:100]}', send them as they are"
        )


class PlanTooLargeError(ServiceError):
    """The plan's latent grid would have more poses than allowed."""

    def __init__(self, estimate: int, limit: int, step_m: float) -> None:
        super().__init__(
            f"the plan needs about {estimate} grid poses at a step of {step_m:g} m, at most {limit} are allowed "
            "(max_grid_poses); are the coordinates in metres?"
        )


class PlanFailedError(ServiceError):
    """The plan's latent grid could not be computed.

    Attributes:
        reason: why, as the plan itself tells it.
    """

    def __init__(self, plan_id: str, reason: str) -> None:
        self.reason = reason
        super().__init__(f"floor plan '{plan_id}' could not be prepared: {reason}")


class PlanNotReadyError(ServiceError):
    """The latent grid was not finished within the request's deadline."""

    retry_after_s = 5

    def __init__(self, plan_id: str, waited_s: float, progress: float) -> None:
        super().__init__(
            f"floor plan '{plan_id}' is still preparing ({progress:.0%} done after waiting {waited_s:.1f} s)"
        )


class TooManyFloorPlansError(ServiceError):
    """The tenant has as many plans as allowed."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"{limit} floor plans are stored, no more are allowed (max_floorplans); delete some")


class TooManyVenuesError(ServiceError):
    """The tenant has as many venues as allowed."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"{limit} venues are stored, no more are allowed (max_venues); delete some")


class VenueUnsearchableError(ServiceError):
    """The venue has no plans, or the latent grids of all of them failed."""

    def __init__(self, venue_id: str, plans: int) -> None:
        reason = f"all of its {plans} floor plans failed" if plans else "it has no floor plans"
        super().__init__(f"nothing can be found in venue '{venue_id}': {reason}")


class VenueNotReadyError(ServiceError):
    """None of the venue's plans has a latent grid yet."""

    retry_after_s = 5

    def __init__(self, venue_id: str, plans: int, waited_s: float) -> None:
        super().__init__(
            f"none of the {plans} floor plans of venue '{venue_id}' is ready (after waiting {waited_s:.1f} s)"
        )


class RevisionMismatchError(ServiceError):
    """The plan or venue has another revision than the one that the caller expects.

    Attributes:
        current: id of the revision that it has.
    """

    def __init__(self, of_id: str, expected: str, current: str, *, what: str = "floor plan") -> None:
        self.current = current
        super().__init__(f"{what} '{of_id}' has revision '{current}', not '{expected[:64]}'")


class IdempotencyKeyReusedError(ServiceError):
    """The idempotency key was sent with another body before."""

    def __init__(self, key: str) -> None:
        super().__init__(f"Idempotency-Key '{key[:64]}' was sent with another body before; take a new one")


class IdempotencyInProgressError(ServiceError):
    """The same request, under the same idempotency key, is being carried out."""

    retry_after_s = 1

    def __init__(self, key: str) -> None:
        super().__init__(f"the request with Idempotency-Key '{key[:64]}' is being carried out; ask again later")


class DamagedDataError(ServiceError):
    """What is stored is not what was, by its digest. It can be replaced and deleted, not read."""


class StoreUnavailableError(ServiceError):
    """The database cannot be reached, or did not answer in time."""

    retry_after_s = 2

    def __init__(self, reason: str = "the database cannot be reached at the moment") -> None:
        super().__init__(reason)


class StoreBusyError(StoreUnavailableError):
    """The database answers others, but no connection to it became free in time.

    No reason to go by what was read earlier, as while it is away: what it says may be another thing by now.
    """

    def __init__(self) -> None:
        super().__init__("too many requests use the database at the moment")


class StoreFullError(StoreUnavailableError):
    """The database answers, but has no room left for what is to be stored."""

    retry_after_s = 60

    def __init__(self) -> None:
        super().__init__("the disk of the database is full, nothing can be stored until there is room")


class UnauthenticatedError(ServiceError):
    """The request has no valid API key. An unknown key and a revoked one are told in the same words."""


class InsufficientScopeError(ServiceError):
    """The API key is not good for this."""

    def __init__(self, needed: str, given: Iterable[str]) -> None:
        scopes = ", ".join(sorted(given))
        super().__init__(f"this needs an API key with the scope '{needed}', the one given has: {scopes}")


class ExposedWithoutKeysError(ServiceError):
    """The request came from elsewhere than this machine, or a page from elsewhere made it, while keys are off."""

    def __init__(self, wanted: str) -> None:
        super().__init__(
            f"API keys are off, so only requests {wanted} are answered; see LALALOC_API_KEYS, LALALOC_ALLOW_ANONYMOUS "
            "and LALALOC_ALLOWED_HOSTS"
        )


class RateLimitedError(ServiceError):
    """The API key sent more requests than allowed."""

    def __init__(self, limit: int, period: str, retry_after_s: int) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(f"this API key may send {limit} requests per {period}, and has")


class TooManyRefusedKeysError(ServiceError):
    """The client sent more invalid API keys than allowed."""

    def __init__(self, limit: int, retry_after_s: int) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(
            f"{limit} invalid API keys came from this address within a minute (refused_keys_per_minute), no more are "
            "looked at for now"
        )


class OverloadedError(ServiceError):
    """More requests are in flight, or more grids asked for, than allowed."""

    def __init__(self, limit: int, retry_after_s: int = 1) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(f"{limit} others are waiting to be answered, no more are taken")


class ShareExceededError(OverloadedError):
    """As many requests of one tenant, or without keys of one client address, are in flight as it may have."""

    def __init__(self, held: int, limit: int, retry_after_s: int = 1) -> None:
        ServiceError.__init__(
            self, f"{held} of your requests are in work, no more are taken: the rest of {limit} is left to others"
        )
        self.retry_after_s = retry_after_s


class DrawingFailedError(ServiceError):
    """A drawing of this service's own could not be made into pixels."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"the picture could not be made: {reason}")


class DecoderNotReadyError(ServiceError):
    """No process that decodes panoramas is running, nor will be before the request's deadline."""

    retry_after_s = 2

    def __init__(self) -> None:
        super().__init__("panoramas cannot be decoded at the moment")


class ConverterNotReadyError(ServiceError):
    """No process that reads and writes files of plans is running, nor will be before the deadline."""

    retry_after_s = 2

    def __init__(self) -> None:
        super().__init__("files of plans, but for the native format, cannot be read or written at the moment")


class DeadlineExceededError(ServiceError):
    """What was asked for could not be done within its deadline."""

    retry_after_s = 1

    def __init__(self, limit_s: float, what: str = "the query was not answered") -> None:
        super().__init__(f"{what} within {limit_s:g} s")


class StoppingError(ServiceError):
    """The service is shutting down."""

    retry_after_s = 5

    def __init__(self) -> None:
        super().__init__("the service is shutting down")
