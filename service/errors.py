"""Errors of the service, and the HTTP problem (RFC 9457) of every error, those of the core included."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from lalaloc_core import errors as core

URN = "urn:lalaloc:problem:"


@dataclass(frozen=True)
class ProblemKind:
    """HTTP status, stable type and title of an error; clients see its message if `public` is set."""

    status: int
    slug: str
    title: str
    public: bool = True

    @property
    def type(self) -> str:
        """The stable URN of RFC 9457's `type`."""
        return URN + self.slug


INTERNAL = ProblemKind(500, "internal", "Internal error", public=False)
_INTERNAL = core.LaLaLocError, core.ConfigError, core.BundleError, core.CheckpointError, core.ExportError
_INTERNAL += core.InvalidStateError, core.InvalidEntryError, core.DatasetError, core.RunError

# Problem of each class of errors; classes of the service enter theirs when they are defined.
PROBLEMS: dict[type[Exception], ProblemKind] = {
    core.InvalidFloorPlanError: ProblemKind(422, "invalid-floorplan", "Invalid floor plan"),
    core.SeveralLevelsError: ProblemKind(422, "several-levels", "Several levels: choose one"),
    core.MissingExtraError: ProblemKind(501, "missing-extra", "Package for this format not installed"),
    core.InvalidPhotographError: ProblemKind(422, "invalid-photograph", "Invalid photograph"),
    core.InvalidFilmError: ProblemKind(422, "invalid-film", "Invalid film"),
    core.InvalidFeaturesError: ProblemKind(422, "invalid-features", "Invalid features"),
    core.ForeignFeaturesError: ProblemKind(409, "foreign-features", "Features of another model"),
    core.InvalidMotionError: ProblemKind(422, "invalid-motion", "Impossible motion between photographs"),
    core.InvalidCorrectionError: ProblemKind(422, "invalid-correction", "Invalid correction of a pin"),
    core.InvalidHintError: ProblemKind(422, "invalid-hint", "Invalid hint"),
    core.InvalidPoseError: ProblemKind(422, "invalid-pose", "Invalid position, heading or height"),
    core.InvalidInputError: ProblemKind(422, "invalid-request", "Invalid request"),
    **dict.fromkeys(_INTERNAL, INTERNAL),
}

# Errors of the framework, such as an unknown route.
HTTP_PROBLEMS: dict[int, ProblemKind] = {
    400: ProblemKind(400, "malformed-request", "Malformed request"),
    404: ProblemKind(404, "not-found", "Not found"),
    405: ProblemKind(405, "method-not-allowed", "Method not allowed"),
}


def problem_kind(error: Exception) -> ProblemKind:
    """Return the entry of the error's class, or of its nearest base class."""
    return next((PROBLEMS[cls] for cls in type(error).__mro__ if cls in PROBLEMS), INTERNAL)


class ServiceError(core.LaLaLocError):
    """Base of the errors that only the service raises.

    Attributes:
        message: text with a place for each value that the constructor gets.
        retry_after_s: whole seconds until a retry makes sense; None if it does not.
    """

    message = "{}"
    retry_after_s: int | None = None

    def __init_subclass__(cls, problem: tuple[int, str, str] | None = None) -> None:
        """Enter the problem of a class: status, end of its type, title."""
        if problem is not None:
            PROBLEMS[cls] = ProblemKind(*problem)

    def __init__(self, *values: object, retry_after_s: int | None = None) -> None:
        if retry_after_s is not None:
            self.retry_after_s = retry_after_s
        super().__init__(self.message.format(*values, retry_after_s=self.retry_after_s))


class MalformedRequestError(ServiceError, problem=(400, "malformed-request", "Malformed request")):
    """The body does not follow its media type."""


class InvalidRequestError(ServiceError, problem=(422, "invalid-request", "Invalid request")):
    """A field is missing, unknown, or outside its limits; `faults` are pairs of a field and a message."""

    def __init__(self, faults: list[tuple[str, str]]) -> None:
        self.faults = faults
        super().__init__("; ".join(f"{field}: {message}" for field, message in faults))


class FeaturesRequiredError(ServiceError, problem=(403, "features-required", "Features required")):
    message = (
        "this service takes no photographs (LALALOC_REQUIRE_FEATURES): send the part features instead, which "
        "`lalaloc encode` or the Python client with on_device=True compute from the photograph"
    )


class UnknownModelFileError(ServiceError, problem=(404, "unknown-model-file", "Unknown file of the model")):
    message = "model '{1}' has no file '{0:.64}' for devices"


class ChangedModelFileError(ServiceError, problem=(503, "model-file-changed", "File of the model changed")):
    message = "the model's file '{}' was changed on the disk: restore the bundle, and restart the service"
    retry_after_s = 60


class RangeError(ServiceError, problem=(416, "range-not-satisfiable", "Range not satisfiable")):
    message = "the file has {} bytes; ask for a range within them"

    def __init__(self, size_bytes: int) -> None:
        self.size_bytes = size_bytes
        super().__init__(size_bytes)


class UnknownFloorPlanError(ServiceError, problem=(404, "unknown-floorplan", "Unknown floor plan")):
    message = "floor plan '{:.64}' does not exist"


class UnknownVenueError(ServiceError, problem=(404, "unknown-venue", "Unknown venue")):
    message = "venue '{:.64}' does not exist"


class UnknownRevisionError(ServiceError, problem=(404, "unknown-revision", "Unknown revision")):
    message = "floor plan '{}' has no revision '{:.64}'; old revisions are dropped"


class UnknownAnswerError(ServiceError, problem=(404, "unknown-answer", "Unknown answer")):
    message = "no answer is kept under '{:.64}'; answers expire (keep_answers_s) and are deleted with their floor plan"


class UnknownSessionError(ServiceError, problem=(404, "unknown-session", "Unknown session")):
    message = (
        "session '{:.64}' does not exist; sessions expire (session_ttl_s) and are deleted with their floor plan or "
        "venue"
    )


class SessionBusyError(ServiceError, problem=(409, "session-busy", "Photograph of the session in progress")):
    message = "session '{}' has a photograph in progress; send the next one after the answer to it"
    retry_after_s = 1


class SessionOutdatedError(ServiceError, problem=(409, "session-outdated", "Session cannot go on")):
    message = "session '{}' cannot go on: {}; begin a new session"


class PhotographOutOfOrderError(ServiceError, problem=(409, "photograph-out-of-order", "Photograph out of order")):
    message = "number is {1}; the next photograph of session '{0}' is number {2}"


class TooManySessionsError(ServiceError, problem=(507, "too-many-sessions", "Too many sessions")):
    message = "{0} sessions are open; the limit is {0} (max_sessions): delete some"


class UnknownAlbumError(ServiceError, problem=(404, "unknown-album", "Unknown album")):
    message = (
        "album '{:.64}' does not exist; albums expire (album_ttl_s) and are deleted with their floor plan or venue"
    )


class UnknownAlbumPhotographError(ServiceError, problem=(404, "unknown-photograph", "Unknown photograph")):
    message = "album '{}' has no photograph '{:.64}'"


class AlbumOutdatedError(ServiceError, problem=(409, "album-outdated", "Album of an earlier model")):
    message = (
        "album '{}' has the features of an earlier model and can only be read: create a new album and send its "
        "photographs again"
    )


class FeaturelessModelError(ServiceError, problem=(501, "model-without-features", "Model without features")):
    message = "model '{}' gives no features of photographs, of which albums are made; use another one"


class TooManyAlbumsError(ServiceError, problem=(507, "too-many-albums", "Too many albums")):
    message = "the limit of {} albums is reached (max_albums); delete one"


class TooManyPhotographsError(ServiceError, problem=(507, "too-many-photographs", "Album is full")):
    message = (
        "album '{0}' has {1} photographs; the limit is {1} (max_album_photographs): create another album for the rest"
    )


class UnanchoredPlanError(ServiceError, problem=(409, "floorplan-unanchored", "Floor plan has no anchor")):
    message = "floor plan '{}' has no anchor{}; add one for answers in latitude and longitude"

    def __init__(self, plan_id: str, venue_id: str | None = None) -> None:
        super().__init__(plan_id, "" if venue_id is None else f", nor has venue '{venue_id}'")


class UnmeasuredModelError(ServiceError, problem=(501, "model-unmeasured", "Model without measured errors")):
    """The model has no measured errors, which predictions need."""


class UploadTooLargeError(ServiceError, problem=(413, "upload-too-large", "Upload too large")):
    message = "the body {}; the limit is {} bytes (LALALOC_{}): {}"

    def __init__(self, setting: str, limit: int, stated: int | None = None) -> None:
        size = "is too large" if stated is None else f"has {stated} bytes"
        is_plan = "plan" in setting or "venue" in setting
        remedy = "divide or simplify the plan" if is_plan else "send fewer or smaller files, and a film in Full HD"
        super().__init__(size, limit, setting.upper(), remedy)


class BytesInFlightError(ServiceError, problem=(503, "overloaded", "Overloaded")):
    message = "the body needs {} bytes; {} in progress have {} of {} bytes ({}). Retry after {retry_after_s} s"
    retry_after_s = 2


class SpoolFullError(ServiceError, problem=(507, "store-full", "Storage full")):
    message = (
        "an upload of more than {} bytes (upload_memory_bytes) could not be written to a temporary file: the disk is "
        "full or read-only (TMPDIR)"
    )
    retry_after_s = 60


class UploadTimeoutError(ServiceError, problem=(408, "upload-timeout", "Upload timed out")):
    """The upload did not finish in time, or was too slow."""


class UnsupportedMediaError(ServiceError, problem=(415, "unsupported-media", "Unsupported media type")):
    message = "{} is not supported; send {}"

    def __init__(self, given: str, accepted: tuple[str, ...]) -> None:
        self.accepted = accepted
        stated = f"content type '{given[:100]}'" if given else "a body without content type"
        super().__init__(stated, " or ".join(accepted))


class UnsupportedEncodingError(ServiceError, problem=(415, "unsupported-media", "Unsupported media type")):
    message = "Content-Encoding '{:.100}' is not supported; send the body uncompressed"


class PlanTooLargeError(ServiceError, problem=(422, "floorplan-too-large", "Floor plan too large")):
    message = (
        "the plan{} needs about {} grid poses at a step of {:g} m; the limit is {} (max_grid_poses); check that the "
        "coordinates are in metres"
    )

    def __init__(self, estimate: int, limit: int, step_m: float, level: str | None = None) -> None:
        super().__init__("" if level is None else f" of level '{level}'", estimate, step_m, limit)


class PlanFailedError(ServiceError, problem=(409, "floorplan-failed", "Floor plan could not be prepared")):
    """The plan's pose grid could not be computed; `reason` is the value of the plan's field of this name."""

    message = "floor plan '{}' could not be prepared: {}"

    def __init__(self, plan_id: str, reason: str) -> None:
        self.reason = reason
        super().__init__(plan_id, reason)


class PlanNotReadyError(ServiceError, problem=(503, "floorplan-not-ready", "Floor plan not ready")):
    message = "floor plan '{0}' is still preparing ({2:.0%} done after waiting {1:.1f} s)"
    retry_after_s = 5


class TooManyFloorPlansError(ServiceError, problem=(507, "too-many-floorplans", "Too many floor plans")):
    message = "the limit of {} stored floor plans is reached (LALALOC_MAX_FLOORPLANS); delete one"


class TooManyVenuesError(ServiceError, problem=(507, "too-many-venues", "Too many venues")):
    message = "the limit of {} stored venues is reached (max_venues); delete one"


class StorageQuotaError(ServiceError, problem=(507, "storage-quota", "Storage quota used up")):
    message = (
        "{} bytes are stored, and this needs {} more; the limit is {} bytes ({}); delete floor plans, or raise the "
        "limit"
    )


class VenueUnsearchableError(
    ServiceError, problem=(409, "venue-unsearchable", "No searchable floor plan in the venue")
):
    message = "venue '{}' cannot be searched: {}"


class VenueNotReadyError(ServiceError, problem=(503, "venue-not-ready", "Venue not ready")):
    message = "none of the {1} floor plans of venue '{0}' is ready (after waiting {2:.1f} s)"
    retry_after_s = 5


class RevisionMismatchError(ServiceError, problem=(412, "revision-mismatch", "Revision mismatch")):
    """The plan or venue is not at the revision that the caller expects; `current` is the id of its revision."""

    message = "{} '{}' has revision '{}', not '{:.64}'"

    def __init__(self, resource_id: str, expected: str, current: str, *, what: str = "floor plan") -> None:
        self.current = current
        super().__init__(what, resource_id, current, expected)


class IdempotencyKeyReusedError(
    ServiceError, problem=(422, "idempotency-key-reused", "Idempotency key used for another request")
):
    message = "Idempotency-Key '{:.64}' was already used with another body; use a new key"


class IdempotencyInProgressError(
    ServiceError, problem=(409, "idempotency-in-progress", "Request with this idempotency key in progress")
):
    message = "the request with Idempotency-Key '{:.64}' is still running; retry later"
    retry_after_s = 1


class DamagedDataError(ServiceError):
    """Stored data does not match its digest. It can be replaced or deleted, but not read."""


class StoreUnavailableError(ServiceError, problem=(503, "store-unavailable", "Storage unavailable")):
    """The database cannot be reached, or did not answer in time."""

    retry_after_s = 2

    def __init__(self, reason: str = "the database cannot be reached") -> None:
        super().__init__(reason)


class StoreBusyError(StoreUnavailableError, problem=(503, "store-unavailable", "Storage unavailable")):
    """No database connection became free in time.

    The database is up, so cached data must not be used in its place: it may be out of date.
    """

    def __init__(self) -> None:
        super().__init__("all database connections are in use")


class StoreFullError(StoreUnavailableError, problem=(507, "store-full", "Storage full")):
    retry_after_s = 60

    def __init__(self) -> None:
        super().__init__("the database's disk is full; nothing can be stored until space is freed")


class UnauthenticatedError(ServiceError, problem=(401, "unauthenticated", "API key or token required")):
    """The request has no valid API key or token. Unknown and revoked keys get the same message."""


class InsufficientScopeError(ServiceError, problem=(403, "insufficient-scope", "API key or token lacks the scope")):
    """The API key or token lacks the scope that the route needs; `given` is None while keys are off."""

    def __init__(self, needed: str, given: Iterable[str] | None) -> None:
        if given is None:
            text = f"API keys are off, and this request needs one with scope '{needed}': set LALALOC_API_KEYS=on"
        else:
            scopes = ", ".join(sorted(given)) or "none"
            text = (
                f"this request needs an API key or token with scope '{needed}'; it has: {scopes}. Use another one, or "
                "ask the operator of the service for the scope"
            )
        super().__init__(text)


class IssuerUnavailableError(ServiceError, problem=(503, "issuer-unavailable", "Issuer of tokens unavailable")):
    message = "the keys of the OpenID Connect issuer could not be fetched; try again later or use an API key"
    retry_after_s = 10


class UnknownKeyError(ServiceError, problem=(404, "unknown-key", "Unknown API key")):
    """No API key has this id, or it is in another state than the one that a change needs."""

    message = "no {1}API key has the id '{0:.64}'; list keys with GET /admin/keys"


class ExposedWithoutKeysError(
    ServiceError, problem=(403, "exposed-without-keys", "Local requests only without API keys")
):
    """A request from another machine, or from a page of another site, while API keys are off."""

    message = (
        "API keys are off, so only requests {} are answered, not '{:.100}'; set LALALOC_API_KEYS, "
        "LALALOC_ALLOW_ANONYMOUS or LALALOC_ALLOWED_HOSTS"
    )


class RateLimitedError(ServiceError, problem=(429, "rate-limited", "Too many requests")):
    message = "Rate limit exceeded: {} requests per {}. Retry after {retry_after_s} s."


class TooManyRefusedKeysError(ServiceError, problem=(429, "too-many-refused-keys", "Too many invalid API keys")):
    message = (
        "Too many invalid API keys from this address: the limit is {} per minute. Retry with a valid key after "
        "{retry_after_s} s."
    )


class OverloadedError(ServiceError, problem=(503, "overloaded", "Overloaded")):
    """All slots for requests, or all places in a queue, are in use."""

    message = "The service is full: {} requests are in progress. Retry after {retry_after_s} s."
    retry_after_s = 1


class ShareExceededError(OverloadedError, problem=(503, "overloaded", "Overloaded")):
    message = (
        "{} of your requests are in progress, and the rest of the {} slots is reserved for other tenants. Retry after "
        "{retry_after_s} s."
    )


class ExpectedTooLateError(OverloadedError, problem=(503, "overloaded", "Overloaded")):
    message = (
        "Beside your {} queries in progress, one more is expected to miss its deadline. Send fewer at once. Retry "
        "after {retry_after_s} s."
    )


class DrawingFailedError(ServiceError):
    message = "the picture could not be drawn: {}"


class DecoderNotReadyError(ServiceError, problem=(503, "decoder-not-ready", "Decoder not ready")):
    message = "no process for decoding photographs is running yet"
    retry_after_s = 2


class ConverterNotReadyError(ServiceError, problem=(503, "converter-not-ready", "Converter not ready")):
    message = "no process for reading and writing plan files is running yet; the native format needs none"
    retry_after_s = 2


class IndexTooLargeError(ServiceError, problem=(503, "overloaded", "Overloaded")):
    message = (
        "the index of {} floor plans exceeds the limit of {} bytes: raise LALALOC_VENUE_CACHE_BYTES, or divide the "
        "index into more shards"
    )


class DeadlineExceededError(ServiceError, problem=(504, "deadline-exceeded", "Deadline exceeded")):
    message = "{} within {:g} s"
    retry_after_s = 1

    def __init__(self, limit_s: float, what: str = "the query was not answered") -> None:
        super().__init__(what, limit_s)


class StoppingError(ServiceError, problem=(503, "stopping", "Service stopping")):
    message = "the service is shutting down"
    retry_after_s = 5


PROBLEMS |= dict.fromkeys((ServiceError, DamagedDataError, DrawingFailedError), INTERNAL)
