"""Answer to a query: the pose of a photograph, in the plan and on Earth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from lalaloc_core.answer_numbers import Mass, Metres, Milliseconds, Share
from lalaloc_core.localise.answers.documents import FoundPose, ModelAnswer, PossiblePose
from lalaloc_core.localise.answers.views import ViewAnswer
from service.schemas.fields import CoreAnswer, Problem, ResponseModel


class GeoPosePosition(ResponseModel):
    """Position on Earth, WGS84."""

    lat: float = Field(ge=-90, le=90, description="Latitude, degrees.")
    lon: float = Field(ge=-180, le=180, description="Longitude, degrees.")
    h: float = Field(
        description="Height in metres: over the ellipsoid, or over the plan's floor if its anchor has no `altitude_m`. "
        "With the anchor of a venue: the venue's altitude plus the camera height, on every level."
    )


class GeoPoseAngles(ResponseModel):
    """Rotations about up, north and east in degrees; all are 0 for a level camera facing north."""

    yaw: float = Field(gt=-180, le=180, description="Counterclockwise from north, seen from above.")
    pitch: float = Field(description="Always 0: the pose is that of a level camera.")
    roll: float = Field(description="Always 0.")


class GeoPose(ResponseModel):
    """Pose on Earth in OGC GeoPose 1.0 (21-056r11), Basic-YPR."""

    position: GeoPosePosition
    angles: GeoPoseAngles


_GEOPOSE = "Pose on Earth, from the `anchor` of the plan, else of the venue in the request; null without an anchor."


# Fields of the last base come first: answers begin with the plan.
@dataclass(frozen=True, kw_only=True)
class _CandidatePlan:
    floorplan_id: Annotated[str, Field(description="Plan of the candidate.")]
    level: Annotated[
        float | None, Field(description="Level of the plan in the venue; null for a query about one plan.")
    ]


class CandidateAnswer(CoreAnswer, PossiblePose, _CandidatePlan, frozen=True):
    """Possible pose; two candidates differ by at least 1 m or in heading."""

    geopose: GeoPose | None = Field(None, description=_GEOPOSE)


class PosteriorAnswer(ResponseModel):
    """Posterior over places, given that the photograph is of this plan; all lists have one entry per place."""

    step_m: float = Field(description="Distance between neighbouring places on the plan's pose grid.")
    x_m: list[Metres]
    y_m: list[Metres]
    probability: list[Mass] = Field(description="Sums to 1; places below 0.0000005 are left out.")


class PlanProbability(ResponseModel):
    """Probability of one plan of a venue."""

    floorplan_id: str
    level: float = Field(description="Level of the plan.")
    name: str = Field(description="Name of the plan in the venue, else the plan's own name.")
    probability: Share | None = Field(description="Null for a model without confidence.")


class TimingsAnswer(ResponseModel):
    """Milliseconds per stage; 0 for a stage that did not run."""

    decode: Milliseconds
    encode: Milliseconds
    shortlist: Milliseconds = Field(description="Choosing and loading the plans of a venue.")
    retrieve: Milliseconds
    vdr: Milliseconds
    lpo: Milliseconds
    next_step: Milliseconds = Field(0.0, description="Search for `view.next_step`, after an answer that is not sure.")
    total: Milliseconds = Field(description="Time from the complete upload to the answer, waiting included.")


@dataclass(frozen=True, kw_only=True)
class _AnswerPlan:
    floorplan_id: Annotated[str, Field(description="Plan of the position.")]
    floorplan_revision: Annotated[str, Field(description="Revision of the plan that was searched.")]
    venue_id: Annotated[str | None, Field(description="Venue in the request; null for a query about one plan.")] = None
    level: Annotated[float | None, Field(description="Level of the plan in the venue; null if `venue_id` is null.")]
    plans: Annotated[
        list[PlanProbability] | None,
        Field(description="Most probable plans of the venue, best first; null if `venue_id` is null."),
    ] = None


class LocaliseAnswer(CoreAnswer, FoundPose, _AnswerPlan, frozen=True):
    """Pose of a photograph."""

    candidates: list[CandidateAnswer] = Field(
        description="Candidates, best first (most probable first in a venue); the first is the answer."
    )
    answer_id: str | None = Field(
        default=None,
        description="Id for `GET /answers/{answer_id}`, valid for `keep_answers_s`; null if answers are not kept.",
    )
    geopose: GeoPose | None = Field(None, description=_GEOPOSE)
    posterior: PosteriorAnswer | None = Field(
        default=None, description="Posterior over all places; null unless requested with `include`."
    )
    view: ViewAnswer | None = Field(
        default=None,
        description="Assumptions about the photograph, and how much it could tell; null in answers that "
        "version 0.5 kept.",
    )
    timings_ms: TimingsAnswer
    model: ModelAnswer


class BatchLine(ResponseModel):
    """Line of the answer to a batch: the answer to one photograph, or a problem."""

    index: int = Field(description="Number of the photograph in the request, from 0.")
    name: str | None = Field(None, description="File name of the photograph in the request.")
    status: int = Field(description="HTTP status that `POST /localise` would answer with.")
    answer: LocaliseAnswer | None = Field(None, description="Null if `status` is not 200.")
    problem: Problem | None = Field(None, description="Null if `status` is 200.")
    retry_after_s: int | None = Field(
        None, description="Seconds after which the photograph can be sent again; null if that does not help."
    )
