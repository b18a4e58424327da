"""Requests and answers of the HTTP API.

Units stand in the names: `_m` metres, `_m2` m², `_deg` degrees, `_ms` milliseconds.

fields           base class of answers, number types with their rounding, checks of form fields, errors
native_plan      floor plans in the native format
plan_import      options for reading a plan file, and the report on it
stored_plans     stored floor plans, their events and walls
query_fields     form fields that queries share, form of a query
localise_answer  its answer
localisability   photographs of a plan that will be found
sequence         queries with several photographs
sessions         sessions of tracked cameras
venues           groups of floor plans
service_state    limits, health, readiness
admin            API keys, limits of tenants, audit log

Begin with `localise_answer.py`. The package exports the forms and answers of queries; other schemas have few users,
which import them from their modules.
"""

from service.schemas.localise_answer import (
    CandidateAnswer,
    GeoPose,
    GeoPoseAngles,
    GeoPosePosition,
    LocaliseAnswer,
    PlanProbability,
    PosteriorAnswer,
    TimingsAnswer,
)
from service.schemas.query_fields import EarthPoint, LocaliseForm
from service.schemas.sequence import SequenceAnswer, SequenceForm, SequencePoseAnswer
from service.schemas.sessions import PathPoint, PhotographForm, SessionDocument, StoredPose, TrackedPoseAnswer
