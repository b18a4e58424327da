"""Form fields and answer of a query with several photographs, or a film, of one turn."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from lalaloc_core.answer_numbers import Degrees, HeadingDeg, Metres, Score, Share
from lalaloc_core.localise.answers.documents import Covariance, FilmAnswer, ModelAnswer, Position
from lalaloc_core.localise.answers.views import ViewAnswer
from service.schemas.fields import Finite, ResponseModel, needs, parse_json, reject_underscores
from service.schemas.localise_answer import CandidateAnswer, GeoPose, TimingsAnswer
from service.schemas.photographs import PhotographFields
from service.schemas.query_fields import CameraFields, PlaceFields

Angle = Annotated[float, Finite, Field(ge=-360, le=360)]
AngleStd = Annotated[float, Finite, Field(ge=0.01, le=180)]
_WALK = (
    "photographs of a walk are no query of their own: send them to a session (POST /sessions), or to an album "
    "(POST /albums); photographs from one spot need motion=turn"
)


class SequenceForm(PlaceFields, CameraFields, PhotographFields):
    """Form fields of a query with several photographs from one spot; an empty field counts as left out.

    The fields about the camera hold for all photographs.
    """

    motion: Literal["turn"] = Field(description="All photographs were taken from one spot.")
    relative_heading_deg: list[Angle | None] | None = Field(
        None,
        description="Headings of all photographs relative to each other, clockwise seen from above, as a "
        "JSON array with one angle per photograph, such as `[0, 26, 51]` by a gyroscope. Without the list, they follow "
        "from what the photographs show twice: turn by at most half the field of view from one to the next. Null, and "
        "photographs that overlap no other: searched.",
    )
    relative_heading_std_deg: AngleStd = Field(
        2.0, description="Standard deviation of the angle between two photographs by `relative_heading_deg`."
    )
    headings_deg: list[Angle | None] | None = Field(
        None,
        description="Headings of all photographs as a JSON array, null for an unknown heading; see `heading_deg` of "
        "`POST /localise`. Default: the headings in the photographs' metadata, else unknown.",
    )
    heading_tolerance_deg: Annotated[float, Finite] = Field(
        0.0, ge=0, le=45, description="Tolerance of `headings_deg`. Needs `headings_deg`."
    )
    # Fields of walks in earlier versions, which are refused.
    motions: SkipJsonSchema[str | None] = None
    camera_heights_m: SkipJsonSchema[str | None] = None
    refine: Literal["none", "lpo"] = Field(
        "lpo", description="Last stage: nearest poses of the grid (`none`), or joint pose refinement (`lpo`)."
    )

    _parse_lists = field_validator("headings_deg", "relative_heading_deg", mode="before")(
        parse_json("a JSON array", list)
    )
    _check_numbers = field_validator("heading_tolerance_deg", "relative_heading_std_deg", mode="before")(
        reject_underscores
    )
    _check_tolerance = field_validator("heading_tolerance_deg")(needs("headings_deg"))

    @model_validator(mode="before")
    @classmethod
    def _without_motion(cls, fields: dict[str, object]) -> dict[str, object]:
        # The default of earlier versions.
        return {"motion": "walk"} | fields

    @field_validator("motion", "motions", "camera_heights_m", mode="before")
    @classmethod
    def _refuse_walk(cls, value: object, given: ValidationInfo) -> object:
        if given.field_name != "motion" or value == "walk":
            raise ValueError(_WALK)
        return value

    def faults(self, photographs: int) -> list[tuple[str, str]]:
        """Return (field, message) for fields that do not fit the number of photographs."""
        wanted = {"headings_deg": self.headings_deg, "relative_heading_deg": self.relative_heading_deg}
        return [
            (name, f"has {len(given)} items, {photographs} photographs need {photographs}")
            for name, given in wanted.items()
            if given is not None and len(given) != photographs
        ]

    def film_faults(self) -> list[tuple[str, str]]:
        """Return (field, message) for fields that do not go with a film."""
        given = [name for name in ("relative_heading_deg", "headings_deg") if getattr(self, name) is not None]
        return [(name, "does not go with a film, whose frames are chosen by the service") for name in given]


class SequencePoseAnswer(ResponseModel):
    """Pose of one photograph, from all photographs together; fields as in the answer of `POST /localise`."""

    floorplan_id: str
    level: float | None = Field(default=None, description="Level of the plan in the venue; null outside of venues.")
    position: Position
    heading_deg: HeadingDeg = Field(ge=0, lt=360)
    heading_source: Literal["given", "photograph", "searched"]
    room: str
    room_id: str
    confidence: Share | None
    heading_confidence: Share | None
    probability_elsewhere: Share | None = None
    warnings: list[str]
    covariance_m2: Covariance | None
    heading_std_deg: Degrees | None
    camera_height_m: Metres = Field(description="Best-fitting height of the camera of this photograph.")
    cost: Score
    latent_distance: Score
    geopose: GeoPose | None = None
    view: ViewAnswer | None = None
    time_s: float | None = Field(default=None, description="Time of the frame in the film; null for photographs.")
    candidates: list[CandidateAnswer] = Field(
        description="Poses on the best paths, best path first; the first is the answer."
    )


class SequenceAnswer(ResponseModel):
    """Poses of the photographs of one turn."""

    floorplan_id: str = Field(description="Plan of the first pose.")
    floorplan_revision: str = Field(description="Revision of that plan.")
    venue_id: str | None = Field(default=None, description="Venue in the request; null for a query about one plan.")
    poses: list[SequencePoseAnswer] = Field(description="Poses, one per photograph, in the order sent.")
    confidence: Share | None = Field(
        description="Probability that the position is right within 1 m. Null for a model without confidence."
    )
    warnings: list[str] = Field(
        description="Photographs that do not overlap, plans of a venue that were not searched, and warnings about "
        "photographs, such as `photo[0]: …`."
    )
    film: FilmAnswer | None = Field(default=None, description="Reading of the film; null for photographs.")
    stage: Literal["retrieval", "lpo"] = Field(description="Last stage that ran.")
    camera_height_m: Metres = Field(description="Camera height of the first photograph that fits all photographs best.")
    timings_ms: TimingsAnswer
    model: ModelAnswer
