"""Where a panorama was taken: the answer to a query."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from service.schemas.fields import (
    Degrees,
    HeadingDeg,
    Mass,
    Metres,
    Milliseconds,
    ResponseModel,
    Score,
    Share,
    Variance,
)
from service.schemas.geopose import GeoPose
from service.schemas.localise_query import HEADING_MEANING

_LATENT_DISTANCE = Field(ge=0, le=2, description="Distance of the pose's layout to the panorama's latent.")
_COST = Field(
    ge=0,
    description="What candidates are ranked by, together with hints: how badly the walls around the pose fit the "
    "panorama, without unit, lower is better. Candidates that were not refined as far as the first come after those "
    "that were, and their costs, which allow for the distance of neighbouring poses, do not compare.",
)

_GEOPOSE = (
    "The pose on Earth: by the `anchor` of the plan, else by that of the venue that was asked about; null without one."
)

Pair = Annotated[list[Variance], Field(min_length=2, max_length=2)]
Covariance = Annotated[list[Pair], Field(min_length=2, max_length=2)]


class Position(ResponseModel):
    """A point of the plan frame."""

    x_m: Metres = Field(description="To the right on the drawing.")
    y_m: Metres = Field(description="Up on the drawing.")


class CandidateAnswer(ResponseModel):
    """One possible pose; no two candidates are closer than 1 m and turned alike."""

    floorplan_id: str = Field(description="The plan that it lies in.")
    level: float | None = Field(description="Level of the plan in the venue, null where none was asked about.")
    position: Position
    heading_deg: HeadingDeg = Field(ge=0, lt=360, description=f"The {HEADING_MEANING}.")
    room: str = Field(description="Name of the room the position lies in.")
    room_id: str = Field(description="Its `id` in the plan, which is unique.")
    probability: Share | None = Field(
        description="Probability that the position is right within 1 m and the heading within 25°, and no better "
        "candidate's are; null for a model without confidence.",
    )
    cost: Score = _COST
    latent_distance: Score = _LATENT_DISTANCE
    geopose: GeoPose | None = Field(None, description=_GEOPOSE)


class PosteriorAnswer(ResponseModel):
    """How probable places are, given that the panorama is of this plan: lists of one length, a place each."""

    step_m: float = Field(
        description="How wide a part of its room each place stands for: the distance of neighbours on the plan's grid."
    )
    x_m: list[Metres]
    y_m: list[Metres]
    probability: list[Mass] = Field(description="They sum to 1; places of less than 0.0000005 are left out.")


class PlanProbability(ResponseModel):
    """How probable it is that a panorama was taken in one plan of a venue."""

    floorplan_id: str
    level: float = Field(description="Number of its level.")
    name: str = Field(description="What it is called in the venue, else its own name.")
    probability: Share | None = Field(description="Null for a model without confidence.")


class TimingsAnswer(ResponseModel):
    """Milliseconds per stage, 0 where a stage did not run."""

    decode: Milliseconds
    encode: Milliseconds
    shortlist: Milliseconds = Field(description="Choosing and loading the plans of a venue.")
    retrieve: Milliseconds
    vdr: Milliseconds
    lpo: Milliseconds
    total: Milliseconds = Field(description="From the complete upload to the answer, waits included.")


class ModelAnswer(ResponseModel):
    """The model that answered."""

    name: str
    version: str
    sha256: str = Field(description="Digest over the model's files.")


class LocaliseAnswer(ResponseModel):
    """Where the panorama was taken."""

    floorplan_id: str = Field(description="The plan that the position lies in.")
    floorplan_revision: str = Field(description="The plan's revision that was searched.")
    venue_id: str | None = Field(default=None, description="The venue that was asked about; null where it was a plan.")
    level: float | None = Field(description="Level of the plan in the venue; null where `venue_id` is.")
    plans: list[PlanProbability] | None = Field(
        default=None,
        description="The most probable plans of the venue, the most probable first; null where `venue_id` is.",
    )
    position: Position
    heading_deg: HeadingDeg = Field(ge=0, lt=360, description=f"The {HEADING_MEANING}.")
    room: str
    room_id: str = Field(description="`id` of the room in the plan, which is unique.")
    confidence: Share | None = Field(
        description="Probability that the position is right within 1 m: that of the panorama being of this plan, "
        "times the share that this place has in the posterior over all places, of a venue those of all its plans. Null "
        "for a model without it.",
    )
    heading_confidence: Share | None = Field(
        description="Probability that the heading is right within 5°; null where `confidence` is."
    )
    warnings: list[str] = Field(
        description="What was said and not followed, such as a heading or a hint that the panorama contradicts."
    )
    heading_source: Literal["given", "panorama", "searched"] = Field(
        description="Where the heading came from: the request, the panorama's metadata, or the search."
    )
    stage: Literal["retrieval", "vdr", "lpo"] = Field(description="The last stage that produced the position.")
    covariance_m2: Covariance | None = Field(
        description="Covariance [[xx, xy], [xy, yy]] of the position in m², given that it is right within 1 m; along "
        "what the panorama does not tell, as in a corridor, that of a place anywhere in the room. Null unless `stage` "
        "is `lpo`, and for a model without it."
    )
    heading_std_deg: Degrees | None = Field(
        description="Standard deviation of the heading where it was searched; null where `covariance_m2` is."
    )
    cost: Score = _COST
    latent_distance: Score = _LATENT_DISTANCE
    camera_height_m: Metres = Field(description="The camera height that fits best.")
    candidates: list[CandidateAnswer] = Field(
        description="Best first, of a venue the most probable first; the first one is the answer."
    )
    answer_id: str | None = Field(
        default=None,
        description="Under which `GET /answers/{answer_id}` tells the same again, for `keep_answers_s`; null where "
        "answers are not kept.",
    )
    geopose: GeoPose | None = Field(None, description=_GEOPOSE)
    posterior: PosteriorAnswer | None = Field(
        default=None, description="How probable all places are; null unless asked for with `include`."
    )
    timings_ms: TimingsAnswer
    model: ModelAnswer
