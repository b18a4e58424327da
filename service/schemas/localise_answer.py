"""Answer to a query: the pose of a photograph, in the plan and on Earth."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from lalaloc_core.answer_numbers import Degrees, HeadingDeg, Mass, Metres, Milliseconds, Score, Share, Variance
from lalaloc_core.localise.answers import documents
from service.schemas.fields import CoreAnswer, Problem, ResponseModel
from service.schemas.photographs import ViewAnswer
from service.schemas.query_fields import HEADING_MEANING


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


_LATENT_DISTANCE = Field(
    ge=0, le=2, description="Distance between the latents of the pose's layout and of the photograph."
)
_COST = Field(
    ge=0,
    description="Matching cost between the walls around the pose and the photograph, dimensionless; lower is better. "
    "Candidates are ranked by it and by hints. Candidates that were refined less than the first come last, and their "
    "costs are not comparable with the others.",
)

_GEOPOSE = "Pose on Earth, from the `anchor` of the plan, else of the venue in the request; null without an anchor."

Pair = Annotated[list[Variance], Field(min_length=2, max_length=2)]
Covariance = Annotated[list[Pair], Field(min_length=2, max_length=2)]


class Position(CoreAnswer, documents.Position, frozen=True):
    """Point in the plan frame."""


class CandidateAnswer(ResponseModel):
    """Possible pose; two candidates differ by at least 1 m or in heading."""

    floorplan_id: str = Field(description="Plan of the candidate.")
    level: float | None = Field(description="Level of the plan in the venue; null for a query about one plan.")
    position: Position
    heading_deg: HeadingDeg = Field(ge=0, lt=360, description=f"The {HEADING_MEANING}.")
    room: str = Field(description="Name of the room.")
    room_id: str = Field(description="`id` of the room, unique in the plan.")
    probability: Share | None = Field(
        description="Probability that this candidate, and no better one, is right within 1 m and 25°; null for a model "
        "without confidence."
    )
    cost: Score = _COST
    latent_distance: Score = _LATENT_DISTANCE
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
    total: Milliseconds = Field(description="Time from the complete upload to the answer, waiting included.")


class ModelAnswer(CoreAnswer, documents.Model, frozen=True):
    """Model that computed the answer."""


class LocaliseAnswer(ResponseModel):
    """Pose of a photograph."""

    floorplan_id: str = Field(description="Plan of the position.")
    floorplan_revision: str = Field(description="Revision of the plan that was searched.")
    venue_id: str | None = Field(default=None, description="Venue in the request; null for a query about one plan.")
    level: float | None = Field(description="Level of the plan in the venue; null if `venue_id` is null.")
    plans: list[PlanProbability] | None = Field(
        default=None, description="Most probable plans of the venue, best first; null if `venue_id` is null."
    )
    position: Position
    heading_deg: HeadingDeg = Field(ge=0, lt=360, description=f"The {HEADING_MEANING}.")
    room: str
    room_id: str = Field(description="`id` of the room, unique in the plan.")
    confidence: Share | None = Field(
        description="Probability that the position is right within 1 m: the probability that the photograph is of this "
        "plan, times the share of this place in the posterior over all places (of all plans of a venue). Null for a "
        "model without confidence."
    )
    heading_confidence: Share | None = Field(
        description="Probability that the heading is right within 5°; null if `confidence` is null."
    )
    probability_elsewhere: Share | None = Field(
        default=None,
        description="Probability that the photograph is of none of the places of the plan (of a venue: of the plans "
        "that were searched). It sums to 1 with the probabilities of the candidates and of all places that are near no "
        "candidate. Null if `confidence` is null.",
    )
    warnings: list[str] = Field(
        description="Parts of the request that were not followed, such as a hint that the photograph contradicts; what "
        "the photograph was taken for, also in `view`; or the reason of a very low confidence."
    )
    heading_source: Literal["given", "photograph", "searched"] = Field(
        description="Source of the heading: the request, the photograph's metadata, or the search."
    )
    stage: Literal["retrieval", "vdr", "lpo"] = Field(description="Last stage that ran.")
    covariance_m2: Covariance | None = Field(
        description="Covariance [[xx, xy], [xy, yy]] of the position in m², given that it is right within 1 m. Along a "
        "direction that the photograph does not constrain, as in a corridor, it is that of the whole room. Null unless "
        "`stage` is `lpo`, and for a model without confidence."
    )
    heading_std_deg: Degrees | None = Field(
        description="Standard deviation of a heading that was searched; null if `covariance_m2` is null."
    )
    cost: Score = _COST
    latent_distance: Score = _LATENT_DISTANCE
    camera_height_m: Metres = Field(description="Best-fitting camera height.")
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
