"""HTTP problem of every error: status, type and title (RFC 9457)."""

from __future__ import annotations

from dataclasses import dataclass

from lalaloc_core import errors as core
from service import errors

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
    core.InvalidFloorPlanError: ProblemKind(422, "invalid-floorplan", "Invalid floor plan"),
    core.SeveralLevelsError: ProblemKind(422, "several-levels", "Several levels: choose one"),
    core.MissingExtraError: ProblemKind(501, "missing-extra", "Package for this format not installed"),
    core.InvalidPhotographError: ProblemKind(422, "invalid-photograph", "Invalid photograph"),
    core.InvalidFilmError: ProblemKind(422, "invalid-film", "Invalid film"),
    core.InvalidFeaturesError: ProblemKind(422, "invalid-features", "Invalid features"),
    core.ForeignFeaturesError: ProblemKind(409, "foreign-features", "Features of another model"),
    errors.FeaturesRequiredError: ProblemKind(403, "features-required", "Features required"),
    errors.UnknownModelFileError: ProblemKind(404, "unknown-model-file", "Unknown file of the model"),
    errors.ChangedModelFileError: ProblemKind(503, "model-file-changed", "File of the model changed"),
    errors.RangeError: ProblemKind(416, "range-not-satisfiable", "Range not satisfiable"),
    core.InvalidMotionError: ProblemKind(422, "invalid-motion", "Impossible motion between photographs"),
    core.InvalidCorrectionError: ProblemKind(422, "invalid-correction", "Invalid correction of a pin"),
    core.InvalidHintError: ProblemKind(422, "invalid-hint", "Invalid hint"),
    core.InvalidPoseError: ProblemKind(422, "invalid-pose", "Invalid position, heading or height"),
    core.InvalidInputError: ProblemKind(422, "invalid-request", "Invalid request"),
    errors.MalformedRequestError: ProblemKind(400, "malformed-request", "Malformed request"),
    errors.InvalidRequestError: ProblemKind(422, "invalid-request", "Invalid request"),
    errors.UnknownFloorPlanError: ProblemKind(404, "unknown-floorplan", "Unknown floor plan"),
    errors.UnknownVenueError: ProblemKind(404, "unknown-venue", "Unknown venue"),
    errors.UnknownRevisionError: ProblemKind(404, "unknown-revision", "Unknown revision"),
    errors.UnknownAnswerError: ProblemKind(404, "unknown-answer", "Unknown answer"),
    errors.UnknownSessionError: ProblemKind(404, "unknown-session", "Unknown session"),
    errors.SessionBusyError: ProblemKind(409, "session-busy", "Photograph of the session in progress"),
    errors.SessionOutdatedError: ProblemKind(409, "session-outdated", "Session cannot go on"),
    errors.PhotographOutOfOrderError: ProblemKind(409, "photograph-out-of-order", "Photograph out of order"),
    errors.TooManySessionsError: ProblemKind(507, "too-many-sessions", "Too many sessions"),
    errors.UnknownAlbumError: ProblemKind(404, "unknown-album", "Unknown album"),
    errors.UnknownAlbumPhotographError: ProblemKind(404, "unknown-photograph", "Unknown photograph"),
    errors.AlbumOutdatedError: ProblemKind(409, "album-outdated", "Album of an earlier model"),
    errors.FeaturelessModelError: ProblemKind(501, "model-without-features", "Model without features"),
    errors.TooManyAlbumsError: ProblemKind(507, "too-many-albums", "Too many albums"),
    errors.TooManyPhotographsError: ProblemKind(507, "too-many-photographs", "Album is full"),
    errors.UnanchoredPlanError: ProblemKind(409, "floorplan-unanchored", "Floor plan has no anchor"),
    errors.UnmeasuredModelError: ProblemKind(501, "model-unmeasured", "Model without measured errors"),
    errors.UploadTooLargeError: ProblemKind(413, "upload-too-large", "Upload too large"),
    errors.BytesInFlightError: ProblemKind(503, "overloaded", "Overloaded"),
    errors.SpoolFullError: ProblemKind(507, "store-full", "Storage full"),
    errors.UploadTimeoutError: ProblemKind(408, "upload-timeout", "Upload timed out"),
    errors.UnsupportedMediaError: ProblemKind(415, "unsupported-media", "Unsupported media type"),
    errors.UnsupportedEncodingError: ProblemKind(415, "unsupported-media", "Unsupported media type"),
    errors.PlanTooLargeError: ProblemKind(422, "floorplan-too-large", "Floor plan too large"),
    errors.PlanFailedError: ProblemKind(409, "floorplan-failed", "Floor plan could not be prepared"),
    errors.PlanNotReadyError: ProblemKind(503, "floorplan-not-ready", "Floor plan not ready"),
    errors.TooManyFloorPlansError: ProblemKind(507, "too-many-floorplans", "Too many floor plans"),
    errors.TooManyVenuesError: ProblemKind(507, "too-many-venues", "Too many venues"),
    errors.StorageQuotaError: ProblemKind(507, "storage-quota", "Storage quota used up"),
    errors.VenueUnsearchableError: ProblemKind(409, "venue-unsearchable", "No searchable floor plan in the venue"),
    errors.VenueNotReadyError: ProblemKind(503, "venue-not-ready", "Venue not ready"),
    errors.RevisionMismatchError: ProblemKind(412, "revision-mismatch", "Revision mismatch"),
    errors.IdempotencyKeyReusedError: ProblemKind(
        422, "idempotency-key-reused", "Idempotency key used for another request"
    ),
    errors.IdempotencyInProgressError: ProblemKind(
        409, "idempotency-in-progress", "Request with this idempotency key in progress"
    ),
    errors.StoreUnavailableError: ProblemKind(503, "store-unavailable", "Storage unavailable"),
    errors.StoreBusyError: ProblemKind(503, "store-unavailable", "Storage unavailable"),
    errors.StoreFullError: ProblemKind(507, "store-full", "Storage full"),
    errors.UnauthenticatedError: ProblemKind(401, "unauthenticated", "API key or token required"),
    errors.InsufficientScopeError: ProblemKind(403, "insufficient-scope", "API key or token lacks the scope"),
    errors.IssuerUnavailableError: ProblemKind(503, "issuer-unavailable", "Issuer of tokens unavailable"),
    errors.UnknownKeyError: ProblemKind(404, "unknown-key", "Unknown API key"),
    errors.ExposedWithoutKeysError: ProblemKind(403, "exposed-without-keys", "Local requests only without API keys"),
    errors.RateLimitedError: ProblemKind(429, "rate-limited", "Too many requests"),
    errors.TooManyRefusedKeysError: ProblemKind(429, "too-many-refused-keys", "Too many invalid API keys"),
    errors.OverloadedError: ProblemKind(503, "overloaded", "Overloaded"),
    errors.ShareExceededError: ProblemKind(503, "overloaded", "Overloaded"),
    errors.ExpectedTooLateError: ProblemKind(503, "overloaded", "Overloaded"),
    errors.IndexTooLargeError: ProblemKind(503, "overloaded", "Overloaded"),
    errors.DecoderNotReadyError: ProblemKind(503, "decoder-not-ready", "Decoder not ready"),
    errors.ConverterNotReadyError: ProblemKind(503, "converter-not-ready", "Converter not ready"),
    errors.DeadlineExceededError: ProblemKind(504, "deadline-exceeded", "Deadline exceeded"),
    errors.StoppingError: ProblemKind(503, "stopping", "Service stopping"),
    **dict.fromkeys((errors.DamagedDataError, errors.DrawingFailedError, errors.ServiceError), INTERNAL),
    core.LaLaLocError: INTERNAL,
    core.ConfigError: INTERNAL,
    core.BundleError: INTERNAL,
    core.CheckpointError: INTERNAL,
    core.ExportError: INTERNAL,
    core.InvalidStateError: INTERNAL,
    core.InvalidEntryError: INTERNAL,
    core.DatasetError: INTERNAL,
    core.RunError: INTERNAL,
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
