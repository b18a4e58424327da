"""Client of the LaLaLoc service: `Client` blocks, `AsyncClient` is for asyncio; both have the same methods.

from lalaloc_client import Client

with Client("http://127.0.0.1:8000") as service:
    plan = service.wait_until_ready(service.upload_floorplan("flat.json").id)
    answer = service.localise(plan.id, "kitchen.jpg", heading_deg=250)

Begin with `asynchronous/client.py`; `make client` generates `blocking/` from it.
"""

from lalaloc_client.albums import AddedPhotograph, Album, AlbumPhotograph, MovedPin, Pin, PinPlace
from lalaloc_client.answers import (
    BatchAnswer,
    Candidate,
    FilmReading,
    Localisation,
    Model,
    NextStep,
    PlanProbability,
    Pool,
    Posterior,
    Readiness,
    ReadView,
    SequenceLocalisation,
    SequencePose,
    View,
)
from lalaloc_client.asynchronous.client import AsyncClient
from lalaloc_client.asynchronous.tracker import AsyncTracker
from lalaloc_client.blocking.client import Client
from lalaloc_client.blocking.tracker import Tracker
from lalaloc_client.errors import (
    AlbumFailedError,
    ClientError,
    ConflictError,
    ConnectionFailedError,
    FloorPlanFailedError,
    InvalidError,
    MalformedAnswerError,
    NotFoundError,
    NotReadyError,
    OnDeviceError,
    OverloadedError,
    ProblemError,
    UnauthorisedError,
)
from lalaloc_client.frames import (
    RosPose,
    camera_matrix,
    heading_of,
    misfit_m,
    ros_covariance,
    ros_pose,
    world_from_plan,
    yaw_of,
)
from lalaloc_client.model import (
    Bounds,
    ConfusedRooms,
    FloorPlan,
    FloorPlanSummary,
    Grid,
    ImportStep,
    Layout,
    Localisability,
    OpeningPiece,
    PlanEvent,
    Position,
    RatedPlace,
    RatedRoom,
    Room,
    RoomLayout,
    Venue,
    VenueAnchor,
    VenuePlan,
)
from lalaloc_client.on_device import TurnFeatures
from lalaloc_client.options import FilmOptions, QueryOptions, SequenceOptions, ViewOptions
from lalaloc_client.retry import RetryPolicy
from lalaloc_client.tracking import Motion, PathPoint, Rival, Session, SessionOptions, TrackedPose

__all__ = [
    "AddedPhotograph", "Album", "AlbumFailedError", "AlbumPhotograph", "AsyncClient", "AsyncTracker", "BatchAnswer",
    "Bounds", "Candidate", "Client", "ClientError", "ConflictError", "ConfusedRooms", "ConnectionFailedError",
    "FilmOptions", "FilmReading", "FloorPlan", "FloorPlanFailedError", "FloorPlanSummary", "Grid", "ImportStep",
    "InvalidError", "Layout", "Localisability", "Localisation", "MalformedAnswerError", "Model", "Motion",
    "MovedPin", "NextStep", "NotFoundError", "NotReadyError", "OnDeviceError", "OpeningPiece", "OverloadedError",
    "PathPoint", "Pin", "PinPlace", "PlanEvent", "PlanProbability", "Pool", "Position", "Posterior", "ProblemError",
    "QueryOptions", "RatedPlace", "RatedRoom", "ReadView", "Readiness", "RetryPolicy", "Rival", "Room",
    "RoomLayout", "RosPose", "SequenceLocalisation", "SequenceOptions", "SequencePose", "Session", "SessionOptions",
    "TrackedPose", "Tracker", "TurnFeatures", "UnauthorisedError", "Venue", "VenueAnchor", "VenuePlan", "View",
    "ViewOptions", "camera_matrix", "heading_of", "misfit_m", "ros_covariance", "ros_pose", "world_from_plan",
    "yaw_of",
]  # fmt: skip
