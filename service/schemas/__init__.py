"""Requests and answers of the HTTP API.

Units stand in the names: `_m` metres, `_m2` m², `_deg` degrees, `_ms` milliseconds.

fields           base class of answers, and number types with their rounding
native_plan      floor plans in the native format
plan_import      options for reading a plan file, and the report on it
stored_plans     stored floor plans, their events and walls
query_fields     form fields that queries share
localise_query   form of a query
localise_answer  its answer
localisability   photographs of a plan that will be found
sequence         queries with several panoramas
sessions         sessions of tracked cameras
oscp             queries of AR clients
venues           groups of floor plans
service_state    limits, health, readiness
admin            API keys, limits of tenants, audit log
problem_details  errors

Begin with `localise_answer.py`.
"""

from service.schemas.admin import (
    AuditEntryAnswer,
    AuditList,
    KeyAnswer,
    KeyDocument,
    KeyList,
    NewKeyAnswer,
    RotationDocument,
    TenantAnswer,
    TenantLimitsDocument,
    TenantList,
)
from service.schemas.fields import ResponseModel
from service.schemas.localisability import LocalisabilityAnswer
from service.schemas.localise_answer import (
    BatchLine,
    CandidateAnswer,
    GeoPose,
    GeoPoseAngles,
    GeoPosePosition,
    LocaliseAnswer,
    ModelAnswer,
    PlanProbability,
    Position,
    PosteriorAnswer,
    TimingsAnswer,
)
from service.schemas.localise_query import LocaliseForm
from service.schemas.native_plan import (
    FloorPlanDocument,
    OpeningDocument,
    OpeningKind,
    Point,
    Ring,
    RoomDocument,
    RoomType,
    Segment,
)
from service.schemas.plan_import import ImportForm, ImportReport, LayerAnswer, LevelAnswer, LevelsForm
from service.schemas.problem_details import Fault, Problem
from service.schemas.query_fields import EarthPoint, PlanPoint
from service.schemas.sequence import SequenceAnswer, SequenceForm, SequencePoseAnswer, StatedHeading, StatedMotion
from service.schemas.service_state import (
    BytesInFlightAnswer,
    HealthAnswer,
    LimitsAnswer,
    PoolAnswer,
    ReadyAnswer,
    StoredBytesAnswer,
    StoredBytesByKind,
    UsageAnswer,
)
from service.schemas.sessions import (
    PathPoint,
    PhotographForm,
    RivalAnswer,
    SessionAnswer,
    SessionDocument,
    StoredPose,
    TrackedPoseAnswer,
)
from service.schemas.stored_plans import (
    BoundsAnswer,
    FloorPlanAnswer,
    FloorPlanList,
    FloorPlanSummary,
    GridAnswer,
    LayoutAnswer,
    OpeningFaceAnswer,
    PlanEvent,
    PlanStatus,
    RoomAnswer,
    RoomLayoutAnswer,
)
from service.schemas.venues import (
    VenueAnchorAnswer,
    VenueAnchorDocument,
    VenueAnswer,
    VenueChangeDocument,
    VenueDocument,
    VenueList,
    VenuePlanAnswer,
    VenuePlanDocument,
    VenuePlanList,
    VenueSummary,
)

__all__ = [
    "AuditEntryAnswer",
    "AuditList",
    "BatchLine",
    "BoundsAnswer",
    "BytesInFlightAnswer",
    "CandidateAnswer",
    "EarthPoint",
    "Fault",
    "FloorPlanAnswer",
    "FloorPlanDocument",
    "FloorPlanList",
    "FloorPlanSummary",
    "GeoPose",
    "GeoPoseAngles",
    "GeoPosePosition",
    "GridAnswer",
    "HealthAnswer",
    "ImportForm",
    "ImportReport",
    "KeyAnswer",
    "KeyDocument",
    "KeyList",
    "LayerAnswer",
    "LayoutAnswer",
    "LevelAnswer",
    "LevelsForm",
    "LimitsAnswer",
    "LocalisabilityAnswer",
    "LocaliseAnswer",
    "LocaliseForm",
    "ModelAnswer",
    "NewKeyAnswer",
    "OpeningDocument",
    "OpeningFaceAnswer",
    "OpeningKind",
    "PathPoint",
    "PhotographForm",
    "PlanEvent",
    "PlanPoint",
    "PlanProbability",
    "PlanStatus",
    "Point",
    "PoolAnswer",
    "Position",
    "PosteriorAnswer",
    "Problem",
    "ReadyAnswer",
    "ResponseModel",
    "Ring",
    "RivalAnswer",
    "RoomAnswer",
    "RoomDocument",
    "RoomLayoutAnswer",
    "RoomType",
    "RotationDocument",
    "Segment",
    "SequenceAnswer",
    "SequenceForm",
    "SequencePoseAnswer",
    "SessionAnswer",
    "SessionDocument",
    "StatedHeading",
    "StatedMotion",
    "StoredBytesAnswer",
    "StoredBytesByKind",
    "StoredPose",
    "TenantAnswer",
    "TenantLimitsDocument",
    "TenantList",
    "TimingsAnswer",
    "TrackedPoseAnswer",
    "UsageAnswer",
    "VenueAnchorAnswer",
    "VenueAnchorDocument",
    "VenueAnswer",
    "VenueChangeDocument",
    "VenueDocument",
    "VenueList",
    "VenuePlanAnswer",
    "VenuePlanDocument",
    "VenuePlanList",
    "VenueSummary",
]
