"""Errors of the service; `problem_kinds.py` maps each to an HTTP status and a problem type."""

from __future__ import annotations

from collections.abc import Iterable

from lalaloc_core.errors import LaLaLocError


class ServiceError(LaLaLocError):
    """Base of the errors that only the service raises.

    Attributes:
        retry_after_s: whole seconds until a retry makes sense; None if it does not.
    """

    retry_after_s: int | None = None


class MalformedRequestError(ServiceError):
    """The body does not follow its media type."""


class InvalidRequestError(ServiceError):
    """A field is missing, unknown, or outside its limits.

    Attributes:
        faults: (field, message) pairs.
    """

    def __init__(self, faults: list[tuple[str, str]]) -> None:
        self.faults = faults
        super().__init__("; ".join(f"{field}: {message}" for field, message in faults))


class UnknownFloorPlanError(ServiceError):
    """No floor plan has this id."""

    def __init__(self, plan_id: str) -> None:
        super().__init__(f"floor plan '{plan_id[:64]}' does not exist")


class UnknownVenueError(ServiceError):
    """No venue has this id."""

    def __init__(self, venue_id: str) -> None:
        super().__init__(f"venue '{venue_id[:64]}' does not exist")


class UnknownRevisionError(ServiceError):
    """The floor plan has no such revision, or the revision was dropped."""

    def __init__(self, plan_id: str, revision_id: str) -> None:
        super().__init__(f"floor plan '{plan_id}' has no revision '{revision_id[:64]}'; old revisions are dropped")


class UnknownAnswerError(ServiceError):
    """No answer is kept under this id."""

    def __init__(self, answer_id: str) -> None:
        super().__init__(
            f"no answer is kept under '{answer_id[:64]}'; answers expire (keep_answers_s) and are deleted with their "
            "floor plan"
        )


class UnknownSessionError(ServiceError):
    """No session has this id."""

    def __init__(self, session_id: str) -> None:
        super().__init__(
            f"session '{session_id[:64]}' does not exist; sessions expire (session_ttl_s) and are deleted with their "
            "floor plan or venue"
        )


class SessionBusyError(ServiceError):
    """Another photograph of the session is in progress."""

    retry_after_s = 1

    def __init__(self, session_id: str) -> None:
        super().__init__(
            f"session '{session_id}' has a photograph in progress; send the next one after the answer to it"
        )


class SessionOutdatedError(ServiceError):
    """The plan, the venue or the model has changed since the session began."""

    def __init__(self, session_id: str, reason: str) -> None:
        super().__init__(f"session '{session_id}' cannot go on: {reason}; begin a new session")


class PhotographOutOfOrderError(ServiceError):
    """The photograph is not the next one of its session."""

    def __init__(self, session_id: str, number: int, expected: int) -> None:
        super().__init__(f"number is {number}; the next photograph of session '{session_id}' is number {expected}")


class TooManySessionsError(ServiceError):
    """The tenant's quota of sessions is used up."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"{limit} sessions are open; the limit is {limit} (max_sessions): delete some")


class UnknownAlbumError(ServiceError):
    """No album has this id."""

    def __init__(self, album_id: str) -> None:
        super().__init__(
            f"album '{album_id[:64]}' does not exist; albums expire (album_ttl_s) and are deleted with their floor "
            "plan or venue"
        )


class UnknownAlbumPhotographError(ServiceError):
    """The album has no photograph with this id."""

    def __init__(self, album_id: str, photograph_id: str) -> None:
        super().__init__(f"album '{album_id}' has no photograph '{photograph_id[:64]}'")


class AlbumOutdatedError(ServiceError):
    """Another model than the running one encoded the photographs of the album."""

    def __init__(self, album_id: str) -> None:
        super().__init__(
            f"album '{album_id}' has the features of an earlier model and can only be read: create a new album and "
            "send its photographs again"
        )


class FeaturelessModelError(ServiceError):
    """The model gives no features, which albums need."""

    def __init__(self, model: str) -> None:
        super().__init__(f"model '{model}' gives no features of photographs, of which albums are made; use another one")


class TooManyAlbumsError(ServiceError):
    """The tenant's quota of albums is used up."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"the limit of {limit} albums is reached (max_albums); delete one")


class TooManyPhotographsError(ServiceError):
    """The album is full."""

    def __init__(self, album_id: str, limit: int) -> None:
        super().__init__(
            f"album '{album_id}' has {limit} photographs; the limit is {limit} (max_album_photographs): create "
            "another album for the rest"
        )


class UnanchoredPlanError(ServiceError):
    """The floor plan has no anchor, and the requested answer needs latitude and longitude."""

    def __init__(self, plan_id: str, venue_id: str | None = None) -> None:
        nor = "" if venue_id is None else f", nor has venue '{venue_id}'"
        super().__init__(f"floor plan '{plan_id}' has no anchor{nor}; add one for answers in latitude and longitude")


class UnmeasuredModelError(ServiceError):
    """The model has no measured errors, which predictions need."""


class UploadTooLargeError(ServiceError):
    """The body exceeds its size limit."""

    def __init__(self, name: str, limit: int, stated: int | None = None) -> None:
        size = "is too large" if stated is None else f"has {stated} bytes"
        super().__init__(f"the body {size}; the limit is {limit} bytes (LALALOC_{name.upper()})")


class BytesInFlightError(ServiceError):
    """The bodies in progress, of the tenant or of all together, leave no room for this one."""

    retry_after_s = 2

    def __init__(self, count: int, in_use: int, limit: int, setting: str) -> None:
        whose = "all uploads" if setting.endswith("TOTAL_BYTES") else "your uploads"
        super().__init__(
            f"the body needs {count} bytes; {whose} in progress have {in_use} of {limit} bytes ({setting}). Retry "
            f"after {self.retry_after_s} s"
        )


class UploadTimeoutError(ServiceError):
    """The upload did not finish in time, or was too slow."""


class UnsupportedMediaError(ServiceError):
    """The body has an unsupported media type."""

    def __init__(self, given: str, accepted: tuple[str, ...]) -> None:
        self.accepted = accepted
        stated = f"content type '{given[:100]}'" if given else "a body without content type"
        super().__init__(f"{stated} is not supported; send {' or '.join(accepted)}")


class UnsupportedEncodingError(UnsupportedMediaError):
    """The body is compressed."""

    def __init__(self, encoding: str) -> None:
        ServiceError.__init__(self, f"Content-Encoding '{encoding[:100]}' is not supported; send the body uncompressed")


class PlanTooLargeError(ServiceError):
    """The plan's pose grid would exceed the limit of poses."""

    def __init__(self, estimate: int, limit: int, step_m: float, level: str | None = None) -> None:
        of_level = "" if level is None else f" of level '{level}'"
        super().__init__(
            f"the plan{of_level} needs about {estimate} grid poses at a step of {step_m:g} m; the limit is {limit} "
            "(max_grid_poses); check that the coordinates are in metres"
        )


class PlanFailedError(ServiceError):
    """The plan's pose grid could not be computed.

    Attributes:
        reason: value of the plan's `reason` field.
    """

    def __init__(self, plan_id: str, reason: str) -> None:
        self.reason = reason
        super().__init__(f"floor plan '{plan_id}' could not be prepared: {reason}")


class PlanNotReadyError(ServiceError):
    """The pose grid was not finished within the request's deadline."""

    retry_after_s = 5

    def __init__(self, plan_id: str, waited_s: float, progress: float) -> None:
        super().__init__(
            f"floor plan '{plan_id}' is still preparing ({progress:.0%} done after waiting {waited_s:.1f} s)"
        )


class TooManyFloorPlansError(ServiceError):
    """The tenant's quota of floor plans is used up."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"the limit of {limit} stored floor plans is reached (LALALOC_MAX_FLOORPLANS); delete one")


class TooManyVenuesError(ServiceError):
    """The tenant's quota of venues is used up."""

    def __init__(self, limit: int) -> None:
        super().__init__(f"the limit of {limit} stored venues is reached (max_venues); delete one")


class StorageQuotaError(ServiceError):
    """The tenant's quota of stored bytes is used up."""

    def __init__(self, used: int, growth: int, limit: int, setting: str = "LALALOC_MAX_STORED_BYTES") -> None:
        super().__init__(
            f"{used} bytes are stored, and this needs {growth} more; the limit is {limit} bytes ({setting}); delete "
            "floor plans, or raise the limit"
        )


class VenueUnsearchableError(ServiceError):
    """The venue has no plans, or all of them failed."""

    def __init__(self, venue_id: str, plans: int, reason: str = "") -> None:
        reason = reason or (f"all of its {plans} floor plans failed" if plans else "it has no floor plans")
        super().__init__(f"venue '{venue_id}' cannot be searched: {reason}")


class VenueNotReadyError(ServiceError):
    """None of the venue's plans has a pose grid yet."""

    retry_after_s = 5

    def __init__(self, venue_id: str, plans: int, waited_s: float) -> None:
        super().__init__(
            f"none of the {plans} floor plans of venue '{venue_id}' is ready (after waiting {waited_s:.1f} s)"
        )


class RevisionMismatchError(ServiceError):
    """The plan or venue is not at the revision that the caller expects.

    Attributes:
        current: id of its current revision.
    """

    def __init__(self, resource_id: str, expected: str, current: str, *, what: str = "floor plan") -> None:
        self.current = current
        super().__init__(f"{what} '{resource_id}' has revision '{current}', not '{expected[:64]}'")


class IdempotencyKeyReusedError(ServiceError):
    """The idempotency key was already used with another body."""

    def __init__(self, key: str) -> None:
        super().__init__(f"Idempotency-Key '{key[:64]}' was already used with another body; use a new key")


class IdempotencyInProgressError(ServiceError):
    """A request with the same idempotency key is still running."""

    retry_after_s = 1

    def __init__(self, key: str) -> None:
        super().__init__(f"the request with Idempotency-Key '{key[:64]}' is still running; retry later")


class DamagedDataError(ServiceError):
    """Stored data does not match its digest. It can be replaced or deleted, but not read."""


class StoreUnavailableError(ServiceError):
    """The database cannot be reached, or did not answer in time."""

    retry_after_s = 2

    def __init__(self, reason: str = "the database cannot be reached") -> None:
        super().__init__(reason)


class StoreBusyError(StoreUnavailableError):
    """No database connection became free in time.

    The database is up, so cached data must not be used in its place: it may be out of date.
    """

    def __init__(self) -> None:
        super().__init__("all database connections are in use")


class StoreFullError(StoreUnavailableError):
    """The database's disk is full."""

    retry_after_s = 60

    def __init__(self) -> None:
        super().__init__("the database's disk is full; nothing can be stored until space is freed")


class SpoolFullError(ServiceError):
    """An upload could not be written to a temporary file."""

    retry_after_s = 60

    def __init__(self, memory_bytes: int) -> None:
        super().__init__(
            f"an upload of more than {memory_bytes} bytes (upload_memory_bytes) could not be written to a "
            "temporary file: the disk is full or read-only (TMPDIR)"
        )


class UnauthenticatedError(ServiceError):
    """The request has no valid API key or token. Unknown and revoked keys get the same message."""


class InsufficientScopeError(ServiceError):
    """The API key or token lacks the scope that the route needs."""

    def __init__(self, needed: str, given: Iterable[str] | None) -> None:
        """Create the error; `given` is None while keys are off."""
        if given is None:
            text = f"API keys are off, and this request needs one with scope '{needed}': set LALALOC_API_KEYS=on"
        else:
            scopes = ", ".join(sorted(given)) or "none"
            text = (
                f"this request needs an API key or token with scope '{needed}'; it has: {scopes}. Use another one, or "
                "ask the operator of the service for the scope"
            )
        super().__init__(text)


class IssuerUnavailableError(ServiceError):
    """The keys of the tokens' issuer are not known, because it cannot be reached."""

    retry_after_s = 10

    def __init__(self) -> None:
        super().__init__(
            "the keys of the OpenID Connect issuer could not be fetched; try again later or use an API key"
        )


class UnknownKeyError(ServiceError):
    """No API key has this id, or it cannot be changed any more."""

    def __init__(self, key_id: str, state: str = "") -> None:
        super().__init__(f"no {state}API key has the id '{key_id[:64]}'; list keys with GET /admin/keys")


class ExposedWithoutKeysError(ServiceError):
    """A request from another machine, or from a page of another site, while API keys are off."""

    def __init__(self, accepted: str, given: str) -> None:
        super().__init__(
            f"API keys are off, so only requests {accepted} are answered, not '{given[:100]}'; set LALALOC_API_KEYS, "
            "LALALOC_ALLOW_ANONYMOUS or LALALOC_ALLOWED_HOSTS"
        )


class RateLimitedError(ServiceError):
    """The API key exceeded its rate limit."""

    def __init__(self, limit: int, period: str, retry_after_s: int) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(f"Rate limit exceeded: {limit} requests per {period}. Retry after {retry_after_s} s.")


class TooManyRefusedKeysError(ServiceError):
    """The client address sent too many invalid API keys."""

    def __init__(self, limit: int, retry_after_s: int) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(
            f"Too many invalid API keys from this address: the limit is {limit} per minute. Retry with a valid key "
            f"after {retry_after_s} s."
        )


class OverloadedError(ServiceError):
    """All slots for requests, or all places in a queue, are in use."""

    def __init__(self, limit: int, retry_after_s: int = 1) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(f"The service is full: {limit} requests are in progress. Retry after {retry_after_s} s.")


class ShareExceededError(OverloadedError):
    """One tenant (without API keys: one client address) uses its whole share of the slots."""

    def __init__(self, held: int, limit: int, retry_after_s: int = 1) -> None:
        ServiceError.__init__(
            self,
            f"{held} of your requests are in progress, and the rest of the {limit} slots is reserved for other tenants."
            f" Retry after {retry_after_s} s.",
        )
        self.retry_after_s = retry_after_s


class ExpectedTooLateError(OverloadedError):
    """The client's queries in progress leave too little time for one more."""

    def __init__(self, others: int, retry_after_s: int) -> None:
        ServiceError.__init__(
            self,
            f"Beside your {others} queries in progress, one more is expected to miss its deadline. Send fewer at once. "
            f"Retry after {retry_after_s} s.",
        )
        self.retry_after_s = retry_after_s


class DrawingFailedError(ServiceError):
    """A drawing made by this service could not be rasterised."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"the picture could not be drawn: {reason}")


class DecoderNotReadyError(ServiceError):
    """No decoder process will be running before the request's deadline."""

    retry_after_s = 2

    def __init__(self) -> None:
        super().__init__("no process for decoding photographs is running yet")


class ConverterNotReadyError(ServiceError):
    """No converter process will be running before the deadline."""

    retry_after_s = 2

    def __init__(self) -> None:
        super().__init__("no process for reading and writing plan files is running yet; the native format needs none")


class IndexTooLargeError(ServiceError):
    """The index of some plans exceeds the memory for indices."""

    def __init__(self, plans: int, limit: int) -> None:
        super().__init__(
            f"the index of {plans} floor plans exceeds the limit of {limit} bytes: raise LALALOC_VENUE_CACHE_BYTES, or "
            "divide the index into more shards"
        )


class DeadlineExceededError(ServiceError):
    """The request missed its deadline."""

    retry_after_s = 1

    def __init__(self, limit_s: float, what: str = "the query was not answered") -> None:
        super().__init__(f"{what} within {limit_s:g} s")


class FeaturesRequiredError(ServiceError):
    """A photograph was sent to a service that takes features only."""

    def __init__(self) -> None:
        super().__init__(
            "this service takes no photographs (LALALOC_REQUIRE_FEATURES): send the part features instead, which "
            "`lalaloc encode` or the Python client with on_device=True compute from the photograph"
        )


class UnknownModelFileError(ServiceError):
    """The model has no such file for devices."""

    def __init__(self, name: str, model: str) -> None:
        super().__init__(f"model '{model}' has no file '{name[:64]}' for devices")


class ChangedModelFileError(ServiceError):
    """A file of the model was changed or removed while the service runs."""

    retry_after_s = 60

    def __init__(self, name: str) -> None:
        super().__init__(
            f"the model's file '{name}' was changed on the disk: restore the bundle, and restart the service"
        )


class RangeError(ServiceError):
    """The range of bytes lies behind the end of the file."""

    def __init__(self, size_bytes: int) -> None:
        self.size_bytes = size_bytes
        super().__init__(f"the file has {size_bytes} bytes; ask for a range within them")


class StoppingError(ServiceError):
    """The service is shutting down."""

    retry_after_s = 5

    def __init__(self) -> None:
        super().__init__("the service is shutting down")
