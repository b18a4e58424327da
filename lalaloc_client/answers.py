"""What the service answers to queries, as frozen dataclasses, as in `model.py`; `_ms` are milliseconds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from lalaloc_client.model import Position


@dataclass(frozen=True)
class PlanProbability:
    """How probable it is that a panorama was taken in one plan of a venue."""

    floorplan_id: str
    level: float
    name: str
    probability: float | None


@dataclass(frozen=True)
class Candidate:
    """One possible pose; candidates are ranked by `cost`, lower is better.

    Attributes:
        probability: that the camera is within 1 m, turned alike within 25°, and not at a better candidate; None for a
            model that does not tell.
        room_id: the room's id in the plan, which is unique as its name need not be.
        floorplan_id, level: the plan that it lies in, and its level in the venue that was asked about.
        geopose: the pose on Earth; None where neither plan nor venue have an anchor.
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
    """The model that answered."""

    name: str
    version: str
    sha256: str


@dataclass(frozen=True)
class GeoPosePosition:
    """A place, WGS84; `h` is metres over the ellipsoid."""

    lat: float
    lon: float
    h: float


@dataclass(frozen=True)
class GeoPoseAngles:
    """Rotations about up, north and east, degrees; a camera that looks north, level, has none."""

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
    """How probable places are, lists of one length; each stands for a part of its room that is `step_m` wide."""

    step_m: float
    x_m: tuple[float, ...]
    y_m: tuple[float, ...]
    probability: tuple[float, ...]


@dataclass(frozen=True)
class Localisation:
    """Where a panorama was taken.

    Attributes:
        heading_deg: azimuth of the panorama's centre column, clockwise from the plan's +y.
        heading_source: `given`, `panorama` (its metadata) or `searched`; None for a service that does not tell.
        confidence: probability that the position is right within 1 m, None for a model that does not tell.
        heading_confidence: probability that the heading is right within 5°.
        warnings: what was said and not followed, such as a heading that the panorama contradicts.
        camera_height_m: the camera height that fits best.
        geopose: the pose on Earth; None where neither plan nor venue have an anchor.
        room_id: the room's id in the plan.
        stage: the last stage that produced the position: `retrieval`, `vdr` or `lpo`.
        covariance_m2: of the position, given that it is right within 1 m; None unless `stage` is `lpo`.
        heading_std_deg: standard deviation of the heading where it was searched.
        candidates: best first; the first one is the answer.
        timings_ms: per stage of the service.
        floorplan_revision: the revision of the plan that was compared with.
        venue_id, level: the venue that was asked about, and the level of the plan in it.
        plans: of a venue, the most probable plans, the most probable first.
        answer_id: under which the service keeps the answer; None where it keeps none.
        posterior: how probable every place is, where that was asked for.
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


@dataclass(frozen=True)
class GeoPoseQuaternion:
    """A rotation from the camera (x right, y where the panorama's centre looks, z up) to east, north, up."""

    x: float
    y: float
    z: float
    w: float


@dataclass(frozen=True)
class QuaternionGeoPose:
    """A pose on Earth: OGC GeoPose 1.0, Basic-Quaternion."""

    position: GeoPosePosition
    quaternion: GeoPoseQuaternion


@dataclass(frozen=True)
class GeoPoseAccuracy:
    """How far off a pose may be: metres, and degrees about the vertical."""

    position: float
    orientation: float


@dataclass(frozen=True)
class PlaceInPlan:
    """Where a device is, by its floor plan; attributes as of `Localisation`."""

    floorplan_id: str
    level: float | None
    position: Position
    heading_deg: float
    room: str
    room_id: str
    confidence: float | None
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class GeoPoseAnswer:
    """An answer of the OSCP GeoPose protocol.

    Attributes:
        id, timestamp: of the request.
        lalaloc: what the protocol has no place for.
    """

    id: str
    timestamp: float
    type: str
    accuracy: GeoPoseAccuracy
    geopose: QuaternionGeoPose
    lalaloc: PlaceInPlan


@dataclass(frozen=True)
class SequencePose:
    """Where one panorama of a sequence was taken, by all of them together; attributes as of `Localisation`."""

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


@dataclass(frozen=True)
class SequenceLocalisation:
    """Where the panoramas of one visit were taken.

    Attributes:
        poses: one for each panorama.
        confidence: probability that all positions are right within 1 m.
        warnings: motions that were said and not followed.
        stage: `retrieval` or `lpo`.
        camera_height_m: the camera height that fits all panoramas best.
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


@dataclass(frozen=True)
class Pool:
    """The service's LPO workers: wanted, warm now, and whether each has been warm once."""

    workers: int
    ready: int
    warmed_up: bool
    fault: str | None = None


@dataclass(frozen=True)
class Readiness:
    """Whether the service can answer at full quality."""

    ready: bool
    model: Model
    lpo_pool: Pool
    plans_preparing: int = field(default=0)
