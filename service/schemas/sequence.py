"""Form fields and answer of a query with several photographs of one visit."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M
from lalaloc_core.localise.sequence import Motion
from lalaloc_core.localise.sequence.measured_motion import MAX_DISTANCE_M, MIN_ANGLE_STD, MIN_DISTANCE_STD_M
from lalaloc_core.localise.sequence.turn_localisation import EXACT, ON_THE_SPOT
from service.schemas.fields import Degrees, Finite, HeadingDeg, Metres, ResponseModel, Score, Share
from service.schemas.form_validators import needs, parse_json, reject_underscores
from service.schemas.localise_answer import CandidateAnswer, Covariance, GeoPose, ModelAnswer, Position, TimingsAnswer
from service.schemas.photographs import PhotographFields, ViewAnswer
from service.schemas.query_fields import CameraFields, PlaceFields

Angle = Annotated[float, Finite, Field(ge=-360, le=360)]
AngleStd = Annotated[float, Finite, Field(ge=math.degrees(MIN_ANGLE_STD), le=180)]
_UNKNOWN = Motion()


class StatedMotion(BaseModel):
    """Measured motion from one photograph to the next; leave out what was not measured."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        json_schema_extra={"example": {"distance_m": 2.4, "distance_std_m": 0.12, "turn_deg": 35, "turn_std_deg": 2}},
    )

    distance_m: Annotated[float, Finite] | None = Field(
        None, ge=0, le=MAX_DISTANCE_M, description="Straight-line distance between the two places."
    )
    distance_std_m: Annotated[float, Finite] = Field(
        _UNKNOWN.distance_std_m,
        ge=MIN_DISTANCE_STD_M,
        le=MAX_DISTANCE_M,
        description="Standard deviation of `distance_m`.",
    )
    turn_deg: Angle | None = Field(
        None, description="Heading of the second photograph minus that of the first, clockwise seen from above."
    )
    turn_std_deg: AngleStd = Field(
        round(math.degrees(_UNKNOWN.turn_std), 6), description="Standard deviation of `turn_deg`."
    )
    direction_deg: Angle | None = Field(
        None,
        description="Azimuth from the first place to the second minus the heading of the first photograph. Needs "
        "`distance_m`.",
    )
    direction_std_deg: AngleStd = Field(
        round(math.degrees(_UNKNOWN.direction_std), 6), description="Standard deviation of `direction_deg`."
    )

    @field_validator("direction_deg")
    @classmethod
    def _check_direction(cls, value: float | None, given: ValidationInfo) -> float | None:
        if value is not None and given.data.get("distance_m", 0.0) is None:
            raise ValueError("needs distance_m")
        return value

    @property
    def motion(self) -> Motion:
        """The motion for the core, in radians."""
        return Motion(
            distance_m=self.distance_m,
            distance_std_m=self.distance_std_m,
            turn=None if self.turn_deg is None else math.radians(self.turn_deg),
            turn_std=math.radians(self.turn_std_deg),
            direction=None if self.direction_deg is None else math.radians(self.direction_deg),
            direction_std=math.radians(self.direction_std_deg),
        )


class StatedHeading(BaseModel):
    """Given heading of one photograph."""

    heading_deg: float | None
    heading_tolerance_deg: float


# Fields that do not go with a value of `motion`, and the message about them.
_WRONG_MOTION = {
    "camera_heights_m": ("turn", "does not go with motion=turn; send camera_height_m"),
    "relative_heading_deg": ("walk", "needs motion=turn"),
    "motions": ("turn", "does not go with motion=turn; send relative_heading_deg"),
}


class SequenceForm(PlaceFields, CameraFields, PhotographFields):
    """Form fields of a query with several photographs; an empty field counts as left out.

    The fields about the camera hold for all photographs.
    """

    venue_id: str | None = Field(
        None,
        min_length=1,
        description="Id of a venue, to search all its plans. A measured motion links places of one plan.",
    )
    motion: Literal["walk", "turn"] = Field(
        "walk",
        description="`walk`: each photograph has a place of its own, see `motions`. `turn`: all were taken from one "
        "spot, see `relative_heading_deg`.",
    )
    relative_heading_deg: list[Angle | None] | None = Field(
        None,
        description="For `turn`: headings of all photographs relative to each other, clockwise seen from above, as a "
        "JSON array with one angle per photograph, such as `[0, 26, 51]` by a gyroscope. Without the list, they follow "
        "from what the photographs show twice: turn by at most half the field of view from one to the next. Null, and "
        "photographs that overlap no other: searched.",
    )
    relative_heading_std_deg: AngleStd = Field(
        2.0, description="Standard deviation of the angle between two photographs by `relative_heading_deg`."
    )
    motions: list[StatedMotion | None] | None = Field(
        None,
        description="Motions between successive photographs as a JSON array, one fewer than photographs; null for a "
        "motion that was not measured. Without motions, the photographs share the plan and the camera height only.",
    )
    headings_deg: list[Angle | None] | None = Field(
        None,
        description="Headings of all photographs as a JSON array, null for an unknown heading; see `heading_deg` of "
        "`POST /localise`. Default: the headings in the photographs' metadata, else unknown.",
    )
    heading_tolerance_deg: Annotated[float, Finite] = Field(
        0.0, ge=0, le=45, description="Tolerance of `headings_deg`. Needs `headings_deg`."
    )
    camera_heights_m: list[Annotated[float, Finite, Field(ge=MIN_CAMERA_HEIGHT_M)] | None] | None = Field(
        None,
        description="Camera heights of all photographs as a JSON array, null for the common one (`camera_height_m`, "
        "else the plan's). The photographs share one relative error; `camera_height_std_m` is that of the common "
        "height.",
    )
    refine: Literal["none", "lpo"] = Field(
        "lpo", description="Last stage: nearest poses of the grid (`none`), or joint pose refinement (`lpo`)."
    )

    _parse_lists = field_validator(
        "motions", "headings_deg", "relative_heading_deg", "camera_heights_m", mode="before"
    )(parse_json("a JSON array", list))
    _check_numbers = field_validator("heading_tolerance_deg", "relative_heading_std_deg", mode="before")(
        reject_underscores
    )
    _check_tolerance = field_validator("heading_tolerance_deg")(needs("headings_deg"))

    @field_validator(*_WRONG_MOTION)
    @classmethod
    def _check_motion(cls, value: object, given: ValidationInfo) -> object:
        motion, fault = _WRONG_MOTION[given.field_name or ""]
        if value is not None and given.data.get("motion") == motion:
            raise ValueError(fault)
        return value

    def faults(self, photographs: int) -> list[tuple[str, str]]:
        """Return (field, message) for fields that do not fit the number of photographs."""
        wanted = {
            "motions": (self.motions, photographs - 1),
            "headings_deg": (self.headings_deg, photographs),
            "camera_heights_m": (self.camera_heights_m, photographs),
            "relative_heading_deg": (self.relative_heading_deg, photographs),
        }
        return [
            (name, f"has {len(given)} items, {photographs} photographs need {count}")
            for name, (given, count) in wanted.items()
            if given is not None and len(given) != count
        ]

    def film_faults(self) -> list[tuple[str, str]]:
        """Return (field, message) for fields that do not go with a film."""
        faults = [] if self.motion == "turn" else [("motion", "is 'walk'; a film needs motion=turn")]
        names = ("relative_heading_deg", "headings_deg")
        given = [name for name in names if getattr(self, name) is not None]
        return faults + [(name, "does not go with a film, whose frames are chosen by the service") for name in given]

    def steps(self, photographs: int) -> list[Motion]:
        """Return the motions between the photographs, unknown ones included."""
        if self.motion == "turn":
            relative = self.relative_heading_deg or [None] * photographs
            return [self._turn(*pair) for pair in itertools.pairwise(relative)]
        given = self.motions or [None] * (photographs - 1)
        return [_UNKNOWN if motion is None else motion.motion for motion in given]

    @property
    def known_turns(self) -> list[float] | None:
        """Headings (radians) minus that of the first photograph; None unless all are known well enough to be exact."""
        given = [] if self.motion == "walk" else self.relative_heading_deg or []
        known = [angle for angle in given if angle is not None]
        if not known or len(known) < len(given) or math.radians(self.relative_heading_std_deg) > EXACT:
            return None
        return [math.radians(angle - known[0]) for angle in known]

    def _turn(self, first_deg: float | None, second_deg: float | None) -> Motion:
        """Return the motion between two photographs from one spot."""
        if first_deg is None or second_deg is None:
            return ON_THE_SPOT
        std = math.radians(self.relative_heading_std_deg)
        return replace(ON_THE_SPOT, turn=math.radians(second_deg - first_deg), turn_std=std)

    def heading_of(self, index: int) -> StatedHeading:
        """Return the given heading of a photograph."""
        heading_deg = None if self.headings_deg is None else self.headings_deg[index]
        return StatedHeading(heading_deg=heading_deg, heading_tolerance_deg=self.heading_tolerance_deg)


class SequencePoseAnswer(ResponseModel):
    """Pose of one photograph, from all photographs together; fields as in the answer of `POST /localise`."""

    floorplan_id: str
    level: float | None = Field(default=None, description="Level of the plan in the venue; null outside of venues.")
    position: Position
    heading_deg: HeadingDeg = Field(ge=0, lt=360)
    heading_source: Literal["given", "panorama", "searched"]
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


class DroppedFrames(ResponseModel):
    """Frames of a film that were not kept for one reason."""

    reason: str
    frames: int


class FilmAnswer(ResponseModel):
    """Reading of a film."""

    frames_read: int = Field(description="Frames that were decoded.")
    frames_kept: int = Field(description="Frames that became poses.")
    dropped: list[DroppedFrames] = Field(description="Frames that were not kept, by reason.")
    duration_s: float = Field(description="Time of the last frame.")
    turned_deg: float = Field(description="Angle that the camera turned through, by optical flow.")
    warnings: list[str] = Field(
        description="Faults of the film: the camera walks, shakes or stands still, or nothing can be followed."
    )


class SequenceAnswer(ResponseModel):
    """Poses of the photographs of one visit."""

    floorplan_id: str = Field(description="Plan of the first pose.")
    floorplan_revision: str = Field(description="Revision of that plan.")
    venue_id: str | None = Field(default=None, description="Venue in the request; null for a query about one plan.")
    poses: list[SequencePoseAnswer] = Field(description="Poses, one per photograph, in the order sent.")
    confidence: Share | None = Field(
        description="Probability that all positions are right within 1 m: the probability of the path among all paths, "
        "times the lowest probability that a photograph shows this plan. Null for a model without confidence."
    )
    warnings: list[str] = Field(
        description="Motions in the request that were ignored, because the photographs contradict them, photographs of "
        "a turn that do not overlap, plans of a venue that were not searched, and warnings about photographs, such as "
        "`photo[0]: …`."
    )
    film: FilmAnswer | None = Field(default=None, description="Reading of the film; null for photographs.")
    stage: Literal["retrieval", "lpo"] = Field(description="Last stage that ran.")
    camera_height_m: Metres = Field(description="Camera height of the first photograph that fits all photographs best.")
    timings_ms: TimingsAnswer
    model: ModelAnswer
