"""HTTP problem of every error: status, type and title (RFC 9457)."""

from __future__ import annotations

from dataclasses import dataclass

from lalaloc_core.errors import (
    BundleError,
    CheckpointError,
    ConfigError,
    DatasetError,
    ExportError,
    ForeignFeaturesError,
    InvalidFeaturesError,
    InvalidFloorPlanError,
    InvalidHintError,
    InvalidInputError,
    InvalidMotionError,
    InvalidPhotographError,
    InvalidPoseError,
    InvalidStateError,
    LaLaLocError,
    MissingExtraError,
    RunError,
    SeveralLevelsError,
)
from service.errors import (
    BytesInFlightError,
    ConverterNotReadyError,
    DamagedDataError,
    DeadlineExceededError,
    DecoderNotReadyError,
    DrawingFailedError,
    ExposedWithoutKeysError,
    FeaturesRequiredError,
    IdempotencyInProgressError,
    IdempotencyKeyReusedError,
    IndexTooLargeError,
    InsufficientScopeError,
    InvalidRequestError,
    IssuerUnavailableError,
    MalformedRequestError,
    NoPlanNearbyError,
    OverloadedError,
    PhotographOutOfOrderError,
    PlanFailedError,
    PlanNotReadyError,
    PlanTooLargeError,
    RateLimitedError,
    RevisionMismatchError,
    ServiceError,
    SessionBusyError,
    SessionOutdatedError,
    ShareExceededError,
    SpoolFullError,
    StoppingError,
    StorageQuotaError,
    StoreBusyError,
    StoreFullError,
    StoreUnavailableError,
    TooManyFloorPlansError,
    TooManyRefusedKeysError,
    TooManySessionsError,
    TooManyVenuesError,
    UnanchoredPlanError,
    UnauthenticatedError,
    UnknownAnswerError,
    UnknownFloorPlanError,
    UnknownKeyError,
    UnknownModelFileError,
    UnknownRevisionError,
    UnknownSessionError,
    UnknownVenueError,
    UnmeasuredModelError,
    UnsupportedEncodingError,
    UnsupportedMediaError,
    UploadTimeoutError,
    UploadTooLargeError,
    VenueNotReadyError,
    VenueUnsearchableError,
)

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

PROBLEMS: dict[type[Exception], ProblemKind] = {
    InvalidFloorPlanError: ProblemKind(422, "invalid-floorplan", "Invalid floor plan"),
    SeveralLevelsError: ProblemKind(422, "several-levels", "Several levels: choose one"),
    MissingExtraError: ProblemKind(501, "missing-extra", "Package for this format not installed"),
    InvalidPhotographError: ProblemKind(422, "invalid-panorama", "Invalid photograph"),
    InvalidFeaturesError: ProblemKind(422, "invalid-features", "Invalid features"),
    ForeignFeaturesError: ProblemKind(409, "foreign-features", "Features of another model"),
    FeaturesRequiredError: ProblemKind(403, "features-required", "Features required"),
    UnknownModelFileError: ProblemKind(404, "unknown-model-file", "Unknown file of the model"),
    InvalidMotionError: ProblemKind(422, "invalid-motion", "Impossible motion between photographs"),
    InvalidHintError: ProblemKind(422, "invalid-hint", "Invalid hint"),
    InvalidPoseError: ProblemKind(422, "invalid-pose", "Invalid position, heading or height"),
    InvalidInputError: ProblemKind(422, "invalid-request", "Invalid request"),
    MalformedRequestError: ProblemKind(400, "malformed-request", "Malformed request"),
    InvalidRequestError: ProblemKind(422, "invalid-request", "Invalid request"),
    UnknownFloorPlanError: ProblemKind(404, "unknown-floorplan", "Unknown floor plan"),
    UnknownVenueError: ProblemKind(404, "unknown-venue", "Unknown venue"),
    UnknownRevisionError: ProblemKind(404, "unknown-revision", "Unknown revision"),
    UnknownAnswerError: ProblemKind(404, "unknown-answer", "Unknown answer"),
    UnknownSessionError: ProblemKind(404, "unknown-session", "Unknown session"),
    SessionBusyError: ProblemKind(409, "session-busy", "Photograph of the session in progress"),
    SessionOutdatedError: ProblemKind(409, "session-outdated", "Session cannot go on"),
    PhotographOutOfOrderError: ProblemKind(409, "photograph-out-of-order", "Photograph out of order"),
    TooManySessionsError: ProblemKind(507, "too-many-sessions", "Too many sessions"),
    UnanchoredPlanError: ProblemKind(409, "floorplan-unanchored", "Floor plan has no anchor"),
    UnmeasuredModelError: ProblemKind(501, "model-unmeasured", "Model without measured errors"),
    NoPlanNearbyError: ProblemKind(404, "no-floorplan-nearby", "No floor plan nearby"),
    UploadTooLargeError: ProblemKind(413, "upload-too-large", "Upload too large"),
    BytesInFlightError: ProblemKind(503, "overloaded", "Overloaded"),
    SpoolFullError: ProblemKind(507, "store-full", "Storage full"),
    UploadTimeoutError: ProblemKind(408, "upload-timeout", "Upload timed out"),
    UnsupportedMediaError: ProblemKind(415, "unsupported-media", "Unsupported media type"),
    UnsupportedEncodingError: ProblemKind(415, "unsupported-media", "Unsupported media type"),
    PlanTooLargeError: ProblemKind(422, "floorplan-too-large", "Floor plan too large"),
    PlanFailedError: ProblemKind(409, "floorplan-failed", "Floor plan could not be prepared"),
    PlanNotReadyError: ProblemKind(503, "floorplan-not-ready", "Floor plan not ready"),
    TooManyFloorPlansError: ProblemKind(507, "too-many-floorplans", "Too many floor plans"),
    TooManyVenuesError: ProblemKind(507, "too-many-venues", "Too many venues"),
    StorageQuotaError: ProblemKind(507, "storage-quota", "Storage quota used up"),
    VenueUnsearchableError: ProblemKind(409, "venue-unsearchable", "No searchable floor plan in the venue"),
    VenueNotReadyError: ProblemKind(503, "venue-not-ready", "Venue not ready"),
    RevisionMismatchError: ProblemKind(412, "revision-mismatch", "Revision mismatch"),
    IdempotencyKeyReusedError: ProblemKind(422, "idempotency-key-reused", "Idempotency key used for another request"),
    IdempotencyInProgressError: ProblemKind(
        409, "idempotency-in-progress", "Request with this idempotency key in progress"
    ),
    StoreUnavailableError: ProblemKind(503, "store-unavailable", "Storage unavailable"),
    StoreBusyError: ProblemKind(503, "store-unavailable", "Storage unavailable"),
    StoreFullError: ProblemKind(507, "store-full", "Storage full"),
    UnauthenticatedError: ProblemKind(401, "unauthenticated", "API key or token required"),
    InsufficientScopeError: ProblemKind(403, "insufficient-scope", "API key or token lacks the scope"),
    IssuerUnavailableError: ProblemKind(503, "issuer-unavailable", "Issuer of tokens unavailable"),
    UnknownKeyError: ProblemKind(404, "unknown-key", "Unknown API key"),
    ExposedWithoutKeysError: ProblemKind(403, "exposed-without-keys", "Local requests only without API keys"),
    RateLimitedError: ProblemKind(429, "rate-limited", "Too many requests"),
    TooManyRefusedKeysError: ProblemKind(429, "too-many-refused-keys", "Too many invalid API keys"),
    OverloadedError: ProblemKind(503, "overloaded", "Overloaded"),
    ShareExceededError: ProblemKind(503, "overloaded", "Overloaded"),
    IndexTooLargeError: ProblemKind(503, "overloaded", "Overloaded"),
    DecoderNotReadyError: ProblemKind(503, "decoder-not-ready", "Decoder not ready"),
    ConverterNotReadyError: ProblemKind(503, "converter-not-ready", "Converter not ready"),
    DeadlineExceededError: ProblemKind(504, "deadline-exceeded", "Deadline exceeded"),
    StoppingError: ProblemKind(503, "stopping", "Service stopping"),
    DamagedDataError: INTERNAL,
    DrawingFailedError: INTERNAL,
    ServiceError: INTERNAL,
    LaLaLocError: INTERNAL,
    ConfigError: INTERNAL,
    BundleError: INTERNAL,
    CheckpointError: INTERNAL,
    ExportError: INTERNAL,
    InvalidStateError: INTERNAL,
    DatasetError: INTERNAL,
    RunError: INTERNAL,
}

# Errors of the framework, such as an unknown route.
HTTP_PROBLEMS: dict[int, ProblemKind] = {
    400: ProblemKind(400, "malformed-request", "Malformed request"),
    404: ProblemKind(404, "not-found", "Not found"),
    405: ProblemKind(405, "method-not-allowed", "Method not allowed"),
}


def problem_kind(error: Exception) -> ProblemKind:
    """Return the entry of the error's class, or of its nearest base class."""
    for cls in type(error).__mro__:
        if cls in PROBLEMS:
            return PROBLEMS[cls]
    return INTERNAL
