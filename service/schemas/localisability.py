"""Answer about the photographs of a plan that will be found."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from lalaloc_core.answer_numbers import Metres, Score, Share
from lalaloc_core.conditions import Condition
from lalaloc_core.localise.answers.documents import ModelAnswer
from service.schemas.fields import ResponseModel

RoomId = Annotated[str, Field(description="`id` of a room.")]


class ProbabilitiesAnswer(ResponseModel):
    """Probability by kind of photograph that it is found.

    A sphere, a phone photograph of 80°, and three of these from one spot, a third of a turn apart; with known and
    unknown heading.
    """

    sphere_known_heading: Share
    phone_known_heading: Share
    three_phone_known_heading: Share
    sphere_unknown_heading: Share
    phone_unknown_heading: Share
    three_phone_unknown_heading: Share


class RatedRoomAnswer(ResponseModel):
    """Room, and the mean of its places; null if none of the places lies in it."""

    id: str
    name: str
    probability: ProbabilitiesAnswer | None


class RatedPlaceAnswer(ResponseModel):
    """Place of drawn photographs."""

    x_m: Metres
    y_m: Metres
    room: RoomId
    probability: ProbabilitiesAnswer


class ConfusedRoomsAnswer(ResponseModel):
    """Two rooms, and the share of photographs of either that are answered in the other."""

    rooms: list[RoomId] = Field(min_length=2, max_length=2)
    condition: Condition = Field(description="Kind of photograph that confuses them most.")
    share: Share


class GainsAnswer(ResponseModel):
    """Increase of the plan's probability by remedy, for phone photographs with unknown heading."""

    heading: Score
    three_photographs: Score
    sphere: Score
    room_hint: Score
    doors: Score | None = Field(description="That of the openings that the plan shows; null if it shows none.")


class LocalisabilityAnswer(ResponseModel):
    """Prediction of the photographs that will be found, from the plan and the model's measured errors alone."""

    floorplan_id: str
    revision: str
    model: ModelAnswer
    coarse: bool = Field(
        default=False, description="The prediction is rough: few places, one draw at each, no `advice`."
    )
    spacing_m: Metres = Field(
        description="Distance of the poses that are compared: 0.5 m, more in large plans. A photograph counts as found "
        "if its answer is right within 1 m, or within this distance if it is longer."
    )
    probability: ProbabilitiesAnswer = Field(description="Mean over the plan's area.")
    rooms: list[RatedRoomAnswer]
    places: list[RatedPlaceAnswer]
    confused: list[ConfusedRoomsAnswer] = Field(description="Pairs of rooms, the most confused first; at most 10.")
    measured_on: Condition = Field(description="Kind of photograph that `gains` are measured on.")
    gains: GainsAnswer
    advice: list[str] = Field(description="Sentences about confused rooms and what helps most.")
