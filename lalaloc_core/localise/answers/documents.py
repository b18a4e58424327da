"""Answers about photographs, with the field names of the HTTP API."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import ConfigDict, Field

from lalaloc_core.answer_numbers import Degrees, Metres, Score, Share, SignedDegrees
from lalaloc_core.bundle import Bundle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import union_of_arcs
from lalaloc_core.localise.localisability.reports import AdvisedStep
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.query import Candidate
from lalaloc_core.localise.query.query import HeadingSource
from lalaloc_core.localise.search.pipeline import Localisation, SearchStage
from lalaloc_core.photograph import Assumed, Photograph
from lalaloc_core.photograph.projection import Source


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


class _Document:
    """Base of answers, which are plain data but for fields that `repr` leaves out."""

    def document(self) -> dict[str, Any]:
        """Return the answer as plain data, for JSON."""
        return _plain(self)


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {entry.name: _plain(getattr(value, entry.name)) for entry in fields(value) if entry.repr}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


@dataclass(frozen=True, kw_only=True)
class Model(_Document):
    """Name, version and digest of a model."""

    name: str
    version: str
    sha256: Annotated[str, Field(description="Digest over the model's files.")]

    @classmethod
    def of(cls, bundle: Bundle) -> Self:
        """Return name, version and digest of a bundle."""
        return cls(name=bundle.manifest.name, version=bundle.manifest.version, sha256=bundle.sha256)


@dataclass(frozen=True, kw_only=True)
class Position:
    """Point in the frame of the plan, metres."""

    x_m: Annotated[Metres, Field(description="Metres to the right on the drawing.")]
    y_m: Annotated[Metres, Field(description="Metres up on the drawing.")]


@dataclass(frozen=True, kw_only=True)
class Angle:
    """Angle, its standard deviation, and where it is from."""

    value_deg: SignedDegrees
    std_deg: Annotated[Degrees, Field(description="Standard deviation; 0 where it does not apply.")]
    source: Annotated[
        Source,
        Field(
            description="Origin: the request (`given`), metadata (`gpano`, `exif`), the picture (`estimated`), or a "
            "usual value (`assumed`)."
        ),
    ]

    @classmethod
    def of(cls, assumed: Assumed) -> Angle:
        """Return an angle of a photograph."""
        return cls(value_deg=math.degrees(assumed.value), std_deg=math.degrees(assumed.sd), source=assumed.source)


@dataclass(frozen=True, kw_only=True)
class CameraMatrix:
    """Camera matrix and distortion of the upright photograph, pixels."""

    width: Annotated[int, Field(description="Size of the upright photograph, pixels.")]
    height: int
    fx: Score
    fy: Score
    cx: Score
    cy: Score
    distortion: Annotated[
        list[float],
        Field(
            description="k1, k2, p1, p2 and k3 of a perspective camera, k1 to k4 of a fisheye camera: OpenCV's order."
        ),
    ]


@dataclass(frozen=True, kw_only=True)
class SeenArc:
    """Azimuths that photographs show, relative to the centre of the first, clockwise."""

    from_deg: SignedDegrees
    to_deg: Annotated[
        SignedDegrees, Field(description="Greater than `from_deg`; above 180 for an arc that passes the back.")
    ]


@dataclass(frozen=True, kw_only=True)
class SeenObject:
    """Object that the photograph shows."""

    name: Annotated[str, Field(description="Object, such as `stove`.")]
    probability: Share
    azimuth_deg: Annotated[
        SignedDegrees, Field(description="Direction relative to the photograph's centre, clockwise.")
    ]


@dataclass(frozen=True, kw_only=True)
class ReadPhotograph(_Document):
    """Assumptions about a photograph.

    Attributes:
        projection: projection, and in `projection_source` where it is from.
        hfov: horizontal field of view.
        pitch: elevation of the centre above the horizon.
        roll: clockwise rotation of the camera about its optical axis.
        wall_direction: azimuth of walls relative to the centre, up to quarter turns; None without straight lines.
        camera: camera model; None for full spheres and strips.
        seen: azimuths that the photographs of the spot show.
        warnings: metadata that were ignored, and estimates to check.
    """

    projection: str
    projection_source: str
    hfov: Angle
    pitch: Angle
    roll: Angle
    wall_direction: Angle | None
    camera: CameraMatrix | None
    seen: list[SeenArc]
    warnings: list[str]


@dataclass(frozen=True, kw_only=True)
class ToldPhotograph(ReadPhotograph):
    """Assumptions about a photograph, and how much it tells.

    Attributes:
        information_bits: information about the place; one more bit halves the area that is left.
        ruled_out: share of the searched area that this rules out.
        relative_heading: heading minus that of the first photograph of a turn; None if it was searched.
        advice: how to photograph the place for a sure answer; None if more surroundings would not help.
        next_step: the step that raises the confidence most; None if none does.
        room_types: probability of each type of room by recognised objects; None if the model recognises none.
        objects: these objects, the most probable first.
    """

    information_bits: float
    ruled_out: float
    relative_heading: Angle | None
    advice: str | None
    next_step: AdvisedStep | None
    room_types: dict[str, float] | None
    objects: list[SeenObject] | None


@dataclass(frozen=True, kw_only=True)
class PossiblePose:
    """Possible pose of a photograph.

    Attributes:
        position: position in the plan.
        heading_deg: azimuth of the photograph's centre, degrees clockwise from the plan's +y.
        room: name of the room, and in `room_id` its id.
        probability: probability that this pose, and no better one, is right within 1 m and 25°.
        cost: matching cost; lower is better.
        latent_distance: distance between the latents of the layout and of the photograph.
    """

    position: Position
    heading_deg: float
    room: str
    room_id: str
    probability: float | None
    cost: float
    latent_distance: float


@dataclass(frozen=True, eq=False)
class Evidence:
    """Parts that an answer was composed of, to draw it."""

    ground: Ground
    found: Localisation
    photograph: Photograph


@dataclass(frozen=True, kw_only=True)
class Answer(_Document):
    """Pose of a photograph.

    Attributes:
        position: position in the plan.
        heading_deg: azimuth of the photograph's centre, degrees clockwise from the plan's +y.
        heading_source: source of the heading: the caller, the photograph's compass, or the search.
        room: name of the room, and in `room_id` its id.
        confidence: probability that the position is right within 1 m; None for a model without confidence.
        heading_confidence: probability that the heading is right within 5°.
        probability_elsewhere: probability that the photograph shows none of the places of the plan.
        warnings: statements that were not followed, estimates to check, or the reason of a very low confidence.
        covariance_m2: covariance ((xx, xy), (xy, yy)) of the position in m²; None where it is unknown.
        heading_std_deg: standard deviation of a heading that was searched.
        stage: last stage that ran.
        cost: matching cost; lower is better.
        latent_distance: distance between the latents of the layout and of the photograph.
        camera_height_m: camera height over the floor that fits best.
        candidates: possible poses, best first; the first is the answer.
        view: what was assumed about the photograph, and how much it tells.
        model: the model.
        evidence: the search behind the answer; no part of `document`.
    """

    position: Position
    heading_deg: float
    heading_source: HeadingSource
    room: str
    room_id: str
    confidence: float | None
    heading_confidence: float | None
    probability_elsewhere: float | None
    warnings: list[str]
    covariance_m2: tuple[tuple[float, float], tuple[float, float]] | None
    heading_std_deg: float | None
    stage: SearchStage
    cost: float
    latent_distance: float
    camera_height_m: float
    candidates: list[PossiblePose]
    view: ToldPhotograph
    model: Model
    evidence: Evidence = field(repr=False, compare=False)


@dataclass(frozen=True, kw_only=True)
class DroppedFrames:
    """Frames of a film that were not kept for one reason."""

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")

    reason: str
    frames: int


@dataclass(frozen=True, kw_only=True)
class FilmReading:
    """Frames of a film that were read and kept, and why the others were not."""

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
    film: FilmReading | None

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
class TrackedAnswer(_Document):
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
    view: ReadPhotograph
    model: Model
