"""Answers to queries as frozen dataclasses, as in `model.py`; `_ms` are milliseconds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lalaloc_client.errors import problem_from
from lalaloc_client.model import Position


@dataclass(frozen=True)
class PlanProbability:
    """Probability that a photograph was taken in one plan of a venue."""

    floorplan_id: str
    level: float
    name: str
    probability: float | None


@dataclass(frozen=True)
class Candidate:
    """One possible pose; candidates are ranked by `cost`, lower is better.

    Attributes:
        probability: probability that the camera is within 1 m and 25° of this pose, and not at a better candidate; None
            if the model is not calibrated.
    """

    position: Position
    heading_deg: float
    room: str
    cost: float
    latent_distance: float
    probability: float | None = None
    room_id: str | None = None
    floorplan_id: str | None = None
    level: float | None = None
    geopose: GeoPose | None = None


@dataclass(frozen=True)
class Model:
    """The model that computed an answer."""

    name: str
    version: str
    sha256: str


@dataclass(frozen=True)
class GeoPosePosition:
    """A position in WGS84; `h` is metres over the ellipsoid."""

    lat: float
    lon: float
    h: float


@dataclass(frozen=True)
class GeoPoseAngles:
    """Rotations about up, north and east in degrees; all 0 for a level camera that looks north."""

    yaw: float
    pitch: float
    roll: float


@dataclass(frozen=True)
class GeoPose:
    """A pose on Earth: OGC GeoPose 1.0, Basic-YPR."""

    position: GeoPosePosition
    angles: GeoPoseAngles


@dataclass(frozen=True)
class Posterior:
    """Probability of each place, as lists of equal length; a place covers `step_m` of its room."""

    step_m: float
    x_m: tuple[float, ...]
    y_m: tuple[float, ...]
    probability: tuple[float, ...]


@dataclass(frozen=True)
class AssumedAngle:
    """Angle of a camera in degrees, with its standard deviation.

    Attributes:
        source: `given` (by the request), `gpano` or `exif` (metadata), `estimated` (from the picture) or `assumed`.
    """

    value_deg: float
    std_deg: float
    source: str


@dataclass(frozen=True)
class Camera:
    """Camera matrix and distortion of the upright photograph, pixels, in OpenCV's conventions."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]


@dataclass(frozen=True)
class SeenArc:
    """Azimuths that photographs show, relative to the centre of the first, clockwise."""

    from_deg: float
    to_deg: float


@dataclass(frozen=True)
class ReadView:
    """Assumptions about a photograph.

    Attributes:
        projection: `equirectangular`, `perspective`, `cylindrical` or `fisheye`.
        pitch: elevation of the photograph's centre above the horizon.
        roll: clockwise rotation of the camera about its optical axis.
        seen: azimuths that the photographs behind the answer show.
        warnings: metadata that were ignored, and estimates to check.
        wall_direction: azimuth of walls relative to the photograph's centre, up to quarter turns; None without lines,
            for full spheres, and for services without this field.
    """

    projection: str
    projection_source: str
    hfov: AssumedAngle
    pitch: AssumedAngle
    roll: AssumedAngle
    camera: Camera | None
    seen: tuple[SeenArc, ...]
    warnings: tuple[str, ...]
    wall_direction: AssumedAngle | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class SeenObject:
    """Object that a photograph shows; `azimuth_deg` is relative to the photograph's centre."""

    name: str
    probability: float
    azimuth_deg: float


@dataclass(frozen=True)
class NextStep:
    """Step after an answer that is not sure, and what it is expected to tell.

    Attributes:
        kind: `turn` (another photograph from the same spot), `door` (one from behind a door), `heading` (state it) or
            `rooms` (choose one of them as a hint).
        turn_deg: of `turn` and `door`: direction relative to the photograph's centre, clockwise.
        rooms: of `rooms`: ids of the probable rooms, the most probable first.
        expected_bits: expected increase of `View.information_bits`.
    """

    kind: str
    text: str
    turn_deg: float | None
    distance_m: float | None
    rooms: tuple[str, ...] | None
    expected_bits: float
    expected_confidence: float


@dataclass(frozen=True)
class View(ReadView):
    """Assumptions about a photograph, and how much it could tell. See `ReadView` as well.

    Attributes:
        ruled_out: share of the searched area that this rules out.
        advice: how to photograph the place for a sure answer; None where it is sure.
        room_types: probability of each type of room by recognised objects; None for full spheres, and for services and
            models without objects.
        objects: recognised objects that tell the type of room, the most probable first; None as `room_types`.
        relative_heading: heading minus that of the first photograph of a turn; None where it was searched.
        next_step: the single step with the highest expected confidence; None where the answer is sure, where no step
            helps, and for services without this field.
    """

    information_bits: float
    ruled_out: float
    advice: str | None
    room_types: Mapping[str, float] | None = None
    objects: tuple[SeenObject, ...] | None = None
    relative_heading: AssumedAngle | None = None
    next_step: NextStep | None = None


@dataclass(frozen=True)
class Localisation:
    """Pose of a photograph.

    Attributes:
        heading_deg: azimuth of the photograph's centre, clockwise from the plan's +y.
        heading_source: `given`, `photograph` (its metadata; `panorama` before 0.12) or `searched`; None for services
            without this field.
        confidence: probability that the position error is below 1 m; None if the model is not calibrated.
        heading_confidence: probability that the heading error is below 5°.
        probability_elsewhere: probability that the photograph is of none of the plan's places.
        warnings: options that were not followed, such as a heading that the photograph contradicts.
        stage: the stage that produced the position: `retrieval`, `vdr` or `lpo`.
        covariance_m2: covariance of the position, given an error below 1 m; None unless `stage` is `lpo`.
        answer_id: id of the answer for `get_answer`; None if the service does not store it.
    """

    floorplan_id: str
    position: Position
    heading_deg: float
    room: str
    confidence: float | None
    stage: str
    covariance_m2: tuple[tuple[float, float], tuple[float, float]] | None
    heading_std_deg: float | None
    cost: float
    latent_distance: float
    camera_height_m: float
    candidates: tuple[Candidate, ...]
    timings_ms: Mapping[str, float]
    model: Model
    floorplan_revision: str | None = None
    heading_source: str | None = None
    heading_confidence: float | None = None
    warnings: tuple[str, ...] = ()
    room_id: str | None = None
    geopose: GeoPose | None = None
    venue_id: str | None = None
    level: float | None = None
    plans: tuple[PlanProbability, ...] | None = None
    answer_id: str | None = None
    posterior: Posterior | None = None
    view: View | None = None
    probability_elsewhere: float | None = None


@dataclass(frozen=True)
class BatchAnswer:
    """Answer to one photograph of a batch.

    Attributes:
        name: name of the photograph's file; `photo` for photographs without one.
        retry_after_s: seconds after which the photograph can be sent again; None if that does not help.
    """

    index: int
    status: int
    name: str | None = None
    answer: Localisation | None = None
    problem: Mapping[str, Any] | None = None
    retry_after_s: int | None = None

    def result(self) -> Localisation:
        """Return the answer.

        Raises:
            ProblemError: the photograph could not be localised.
        """
        if self.answer is None:
            raise problem_from(self.problem or {}, self.status)
        return self.answer


@dataclass(frozen=True)
class SequencePose:
    """Pose of one photograph of a sequence, from all of them jointly; attributes as in `Localisation`.

    Attributes:
        time_s: time of the frame in the film; None for photographs.
    """

    position: Position
    heading_deg: float
    heading_source: str
    room: str
    room_id: str
    confidence: float | None
    heading_confidence: float | None
    warnings: tuple[str, ...]
    covariance_m2: tuple[tuple[float, float], tuple[float, float]] | None
    heading_std_deg: float | None
    cost: float
    latent_distance: float
    candidates: tuple[Candidate, ...]
    geopose: GeoPose | None = None
    view: View | None = None
    probability_elsewhere: float | None = None
    camera_height_m: float | None = None
    floorplan_id: str | None = None
    level: float | None = None
    time_s: float | None = None


@dataclass(frozen=True)
class DroppedFrames:
    """Frames of a film that were not kept for one reason."""

    reason: str
    frames: int


@dataclass(frozen=True)
class FilmReading:
    """Reading of a film: frames that were decoded, and that became poses.

    Attributes:
        warnings: faults of the film: the camera walks, shakes or stands still, or nothing can be followed.
    """

    frames_read: int
    frames_kept: int
    dropped: tuple[DroppedFrames, ...]
    duration_s: float
    turned_deg: float
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class SequenceLocalisation:
    """Poses of the photographs of one visit.

    Attributes:
        warnings: motions that were not followed, and photographs of a turn that do not overlap.
    """

    floorplan_id: str
    floorplan_revision: str
    poses: tuple[SequencePose, ...]
    confidence: float | None
    warnings: tuple[str, ...]
    stage: str
    camera_height_m: float
    timings_ms: Mapping[str, float]
    model: Model
    venue_id: str | None = None
    film: FilmReading | None = None


@dataclass(frozen=True)
class Pool:
    """The service's LPO workers: configured, ready now, and whether all have been ready once."""

    workers: int
    ready: int
    warmed_up: bool
    fault: str | None = None


@dataclass(frozen=True)
class Readiness:
    """Readiness of the service to answer at full quality."""

    ready: bool
    model: Model
    lpo_pool: Pool
    plans_preparing: int = 0
