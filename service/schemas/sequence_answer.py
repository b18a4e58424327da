"""Where the panoramas of one visit were taken."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from service.schemas.fields import Degrees, HeadingDeg, Metres, ResponseModel, Score, Share
from service.schemas.geopose import GeoPose
from service.schemas.localise_answer import CandidateAnswer, Covariance, ModelAnswer, Position, TimingsAnswer


class SequencePoseAnswer(ResponseModel):
    """Where one of the panoramas was taken, by all of them together; fields as in the answer of `POST /localise`."""

    position: Position
    heading_deg: HeadingDeg = Field(ge=0, lt=360)
    heading_source: Literal["given", "panorama", "searched"]
    room: str
    room_id: str
    confidence: Share | None
    heading_confidence: Share | None
    warnings: list[str]
    covariance_m2: Covariance | None
    heading_std_deg: Degrees | None
    cost: Score
    latent_distance: Score
    geopose: GeoPose | None = None
    candidates: list[CandidateAnswer] = Field(
        description="Places on the best paths, that of the best path first; the first one is the answer."
    )


class SequenceAnswer(ResponseModel):
    """Where the panoramas of one visit were taken."""

    floorplan_id: str
    floorplan_revision: str = Field(description="The plan's revision that was searched.")
    poses: list[SequencePoseAnswer] = Field(description="One for each panorama, in their order.")
    confidence: Share | None = Field(
        description="Probability that all positions are right within 1 m: that of the path among all paths, times the "
        "least of the probabilities that a panorama is of this plan. Null for a model without it."
    )
    warnings: list[str] = Field(description="Motions that were said and not followed.")
    stage: Literal["retrieval", "lpo"] = Field(description="The last stage that produced the positions.")
    camera_height_m: Metres = Field(description="The camera height that fits all panoramas best.")
    timings_ms: TimingsAnswer
    model: ModelAnswer
