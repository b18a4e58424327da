"""Client of the LaLaLoc service: `Client` blocks, `AsyncClient` is for asyncio; both have the same methods.

from lalaloc_client import Client

with Client("http://127.0.0.1:8000") as service:
    plan = service.wait_until_ready(service.upload_floorplan("flat.json").id)
    answer = service.localise(plan.id, "kitchen.jpg", heading_deg=250)

Begin with `asynchronous/client.py`; `make client` generates `blocking/` from it.
"""

from lalaloc_client.answers import (
    Candidate,
    GeoPoseAnswer,
    Localisation,
    Model,
    PlanProbability,
    Pool,
    Posterior,
    Readiness,
    SequenceLocalisation,
    SequencePose,
)
from lalaloc_client.asynchronous.client import AsyncClient
from lalaloc_client.blocking.client import Client
from lalaloc_client.errors import (
    ClientError,
    ConflictError,
    ConnectionFailedError,
    FloorPlanFailedError,
    InvalidError,
    MalformedAnswerError,
    NotFoundError,
    NotReadyError,
    OverloadedError,
    ProblemError,
    UnauthorisedError,
)
from lalaloc_client.model import (
    Bounds,
    FloorPlan,
    FloorPlanSummary,
    Grid,
    Layout,
    OpeningPiece,
    PlanEvent,
    Position,
    Room,
    RoomLayout,
    Venue,
    VenueAnchor,
    VenuePlan,
)
from lalaloc_client.requests import QueryOptions
from lalaloc_client.retry import RetryPolicy

__all__ = [
    "AsyncClient",
    "Bounds",
    "Candidate",
    "Client",
    "ClientError",
    "ConflictError",
    "ConnectionFailedError",
    "FloorPlan",
    "FloorPlanFailedError",
    "FloorPlanSummary",
    "GeoPoseAnswer",
    "Grid",
    "InvalidError",
    "Layout",
    "Localisation",
    "MalformedAnswerError",
    "Model",
    "NotFoundError",
    "NotReadyError",
    "OpeningPiece",
    "OverloadedError",
    "PlanEvent",
    "PlanProbability",
    "Pool",
    "Position",
    "Posterior",
    "ProblemError",
    "QueryOptions",
    "Readiness",
    "RetryPolicy",
    "Room",
    "RoomLayout",
    "SequenceLocalisation",
    "SequencePose",
    "UnauthorisedError",
    "Venue",
    "VenueAnchor",
    "VenuePlan",
]
