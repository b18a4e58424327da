"""Answers about photographs, with the field names of the HTTP API."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import Field

from lalaloc_core.answer_numbers import Cost, Degrees, Heading, LatentDistance, Metres, Share, Variance
from lalaloc_core.bundle import Bundle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.answers.views import AssumedAngle, CameraAnswer, Document, ReadView, SeenArc, ViewAnswer
from lalaloc_core.localise.belief.confidence import union_of_arcs
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import Candidate
from lalaloc_core.localise.query.query import HeadingSource
from lalaloc_core.localise.search.pipeline import Localisation, SearchStage
from lalaloc_core.photograph import Photograph

RoomId = Annotated[str, Field(description="`id` of the room, unique in the plan.")]
_Pair = Annotated[list[Variance], Field(min_length=2, max_length=2)]
Covariance = Annotated[list[_Pair], Field(min_length=2, max_length=2)]


@dataclass(frozen=True, eq=False)
class Spot:
    """A photograph, or several that were taken from one spot.

    Attributes:
        photograph: the photograph, whose heading is searched.
        others: further photographs from its place, each with its heading minus that of `photograph` (radians).
    """

    photograph: Photograph
    others: Sequence[tuple[Photograph, float]] = ()

    @property
    def arcs(self) -> list[tuple[float, float]]:
        """Azimuths (radians, first and last) that are seen, relative to the centre of `photograph`."""
        turned = [(self.photograph, 0.0), *self.others]
        return union_of_arcs([(seen.azimuths[0] + turn, seen.azimuths[1] + turn) for seen, turn in turned])

    @property
    def view(self) -> ReadView:
        """Assumptions about the photograph, and the azimuths that are seen."""
        photograph = self.photograph
        return ReadView(
            projection=photograph.projection,
            projection_source=photograph.projection_source,
            hfov=AssumedAngle.of(photograph.hfov),
            pitch=AssumedAngle.of(photograph.pitch),
            roll=AssumedAngle.of(photograph.roll),
            wall_direction=None if photograph.wall_direction is None else AssumedAngle.of(photograph.wall_direction),
            camera=CameraAnswer.of(photograph.camera),
            seen=[SeenArc(from_deg=math.degrees(begin), to_deg=math.degrees(end)) for begin, end in self.arcs],
            warnings=list(photograph.warnings),
        )


@dataclass(frozen=True)
class Placed:
    """A candidate in the frame of its own plan."""

    plan: FloorPlan
    candidate: Candidate


@dataclass(frozen=True, eq=False)
class Ground:
    """Places that photographs are compared with: a plan and its pose grid; plans side by side override the rest."""

    plan: FloorPlan
    grid: PoseGrid

    @property
    def rooms_known(self) -> bool:
        """True if rooms need not be asked for."""
        return False

    def place(self, candidate: Candidate) -> Placed:
        """Return a candidate in its own plan."""
        return Placed(self.plan, candidate)

    def share(self, found: Localisation) -> float:
        """Return the probability that the camera is in a searched plan."""
        return 1.0


@dataclass(frozen=True, kw_only=True)
class ModelAnswer(Document):
    """Model that computed the answer."""

    name: str
    version: str
    sha256: Annotated[str, Field(description="Digest over the model's files.")]

    @classmethod
    def of(cls, bundle: Bundle) -> ModelAnswer:
        """Return name, version and digest of a bundle."""
        return cls(name=bundle.manifest.name, version=bundle.manifest.version, sha256=bundle.sha256)


@dataclass(frozen=True, kw_only=True)
class Position(Document):
    """Point in the plan frame."""

    x_m: Annotated[Metres, Field(description="Metres to the right on the drawing.")]
    y_m: Annotated[Metres, Field(description="Metres up on the drawing.")]


@dataclass(frozen=True, kw_only=True)
class PossiblePose(Document):
    """Possible pose of a photograph."""

    position: Position
    heading_deg: Heading
    room: Annotated[str, Field(description="Name of the room.")]
    room_id: RoomId
    probability: Annotated[
        Share | None,
        Field(
            description="Probability that this candidate, and no better one, is right within 1 m and 25°; null for a "
            "model without confidence."
        ),
    ]
    cost: Cost
    latent_distance: LatentDistance


@dataclass(frozen=True, kw_only=True)
class FoundPose(Document):
    """Pose of a photograph, and how certain it is."""

    position: Position
    heading_deg: Heading
    room: str
    room_id: RoomId
    confidence: Annotated[
        Share | None,
        Field(
            description="Probability that the position is right within 1 m: the probability that the photograph is of "
            "this plan, times the share of this place in the posterior over all places (of all plans of a venue). Null "
            "for a model without confidence."
        ),
    ]
    heading_confidence: Annotated[
        Share | None,
        Field(description="Probability that the heading is right within 5°; null if `confidence` is null."),
    ]
    probability_elsewhere: Annotated[
        Share | None,
        Field(
            description="Probability that the photograph is of none of the places of the plan (of a venue: of the "
            "plans that were searched). It sums to 1 with the probabilities of the candidates and of all places that "
            "are near no candidate. Null if `confidence` is null."
        ),
    ] = None
    warnings: Annotated[
        list[str],
        Field(
            description="Parts of the request that were not followed, such as a hint that the photograph contradicts; "
            "what the photograph was taken for, also in `view`; or the reason of a very low confidence."
        ),
    ]
    heading_source: Annotated[
        HeadingSource,
        Field(description="Source of the heading: the request, the photograph's metadata, or the search."),
    ]
    stage: Annotated[SearchStage, Field(description="Last stage that ran.")]
    covariance_m2: Annotated[
        Covariance | None,
        Field(
            description="Covariance [[xx, xy], [xy, yy]] of the position in m², given that it is right within 1 m. "
            "Along a direction that the photograph does not constrain, as in a corridor, it is that of the whole room. "
            "Null unless `stage` is `lpo`, and for a model without confidence."
        ),
    ]
    heading_std_deg: Annotated[
        Degrees | None,
        Field(description="Standard deviation of a heading that was searched; null if `covariance_m2` is null."),
    ]
    cost: Cost
    latent_distance: LatentDistance
    camera_height_m: Annotated[Metres, Field(description="Best-fitting camera height.")]


@dataclass(frozen=True, eq=False)
class Evidence:
    """Parts that an answer was composed of, to draw it."""

    ground: Ground
    found: Localisation
    photograph: Photograph


@dataclass(frozen=True, kw_only=True)
class Answer(FoundPose):
    """Pose of a photograph.

    Attributes:
        candidates: possible poses, best first; the first is the answer.
        view: what was assumed about the photograph, and how much it tells.
        model: the model.
        evidence: the search behind the answer; no part of `document`.
    """

    candidates: list[PossiblePose]
    view: ViewAnswer
    model: ModelAnswer
    evidence: Evidence = field(repr=False, compare=False)


@dataclass(frozen=True, kw_only=True)
class DroppedFrames(Document):
    """Frames of a film that were not kept for one reason."""

    reason: str
    frames: int


@dataclass(frozen=True, kw_only=True)
class FilmAnswer(Document):
    """Reading of a film."""

    frames_read: Annotated[int, Field(description="Frames that were decoded.")]
    frames_kept: Annotated[int, Field(description="Frames that became poses.")]
    dropped: Annotated[list[DroppedFrames], Field(description="Frames that were not kept, by reason.")]
    duration_s: Annotated[float, Field(description="Time of the last frame.")]
    turned_deg: Annotated[float, Field(description="Angle that the camera turned through, by optical flow.")]
    warnings: Annotated[
        list[str],
        Field(description="Faults of the film: the camera walks, shakes or stands still, or nothing can be followed."),
    ]


@dataclass(frozen=True, kw_only=True)
class TurnAnswer(Answer):
    """Pose of photographs from one spot: that of the first, with the confidence of all together.

    Attributes:
        poses: the answer for each photograph, with its own heading.
        times_s: times of a film's frames; None for photographs.
        film: the reading of the film.
    """

    poses: list[Answer]
    times_s: list[float] | None
    film: FilmAnswer | None

    def document(self) -> dict[str, Any]:
        """Return the answer as plain data; poses of a film have their times."""
        document = super().document()
        times_s = document.pop("times_s")
        if times_s is not None:
            document["poses"] = [
                {"time_s": time_s, **pose} for time_s, pose in zip(times_s, document["poses"], strict=True)
            ]
        return document


@dataclass(frozen=True, kw_only=True)
class TrackedAnswer(Document):
    """Pose of a moving camera at a photograph.

    Attributes:
        number: number of the photograph, from 1.
        mode: "tracking": the pose is known; "searching": several places are possible; "lost": none fits.
        covariance: covariance of x_m, y_m and heading_deg in m², m·° and °².
        probability: probability that the position is right within 1 m.
        candidates: possible poses, the most probable first.
        motion_contradicted: components of the stated motion that the photographs contradict.
        warnings: contradicted motions, and warnings about the photograph.
    """

    number: int
    mode: Literal["searching", "tracking", "lost"]
    position: Position
    heading_deg: float
    room: str
    room_id: str
    covariance: list[list[float]]
    probability: float
    camera_height_m: float
    candidates: list[PossiblePose]
    motion_contradicted: list[str]
    warnings: list[str]
    view: ReadView
    model: ModelAnswer
