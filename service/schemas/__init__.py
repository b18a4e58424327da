"""What the HTTP API takes and answers. Units stand in the names: `_m` metres, `_m2` m², `_deg` degrees, `_ms` ms.

fields           the base of all answers, and the types of their numbers: how far each is rounded
native_plan      a floor plan in the native format
plan_import      what may be said of the file of a plan, and what is told of reading it
stored_plans     what is told of stored floor plans
localise_query   what a query says beside the panorama
hint_fields      what it says of where the camera stood
camera_fields    what it says of the camera, and of the answer
sequence_query   what a query of several panoramas says beside them
sequence_answer  where they were taken
localise_answer  where it was taken
geopose          the same on Earth
oscp             the same as AR clients ask for it
venues           floor plans that belong together
layout           the walls that a camera may see, for who draws them
service_state    limits, health, readiness
problem_details  errors

Begin with `localise_answer.py`.
"""

from service.schemas.fields import ResponseModel
from service.schemas.geopose import GeoPose, GeoPoseAngles, GeoPosePosition
from service.schemas.hint_fields import EarthPoint, PlanPoint
from service.schemas.layout import LayoutAnswer, OpeningFaceAnswer, RoomLayoutAnswer
from service.schemas.localise_answer import (
    CandidateAnswer,
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
from service.schemas.plan_import import ImportForm, ImportReport, LayerAnswer, LevelAnswer
from service.schemas.problem_details import Fault, Problem
from service.schemas.sequence_answer import SequenceAnswer, SequencePoseAnswer
from service.schemas.sequence_query import SequenceForm, StatedHeading, StatedMotion
from service.schemas.service_state import HealthAnswer, LimitsAnswer, PoolAnswer, ReadyAnswer
from service.schemas.stored_plans import (
    BoundsAnswer,
    FloorPlanAnswer,
    FloorPlanList,
    FloorPlanSummary,
    GridAnswer,
    PlanEvent,
    PlanStatus,
    RoomAnswer,
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
    "BoundsAnswer",
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
    "LayerAnswer",
    "LayoutAnswer",
    "LevelAnswer",
    "LimitsAnswer",
    "LocaliseAnswer",
    "LocaliseForm",
    "ModelAnswer",
    "OpeningDocument",
    "OpeningFaceAnswer",
    "OpeningKind",
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
    "RoomAnswer",
    "RoomDocument",
    "RoomLayoutAnswer",
    "RoomType",
    "Segment",
    "SequenceAnswer",
    "SequenceForm",
    "SequencePoseAnswer",
    "StatedHeading",
    "StatedMotion",
    "TimingsAnswer",
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
