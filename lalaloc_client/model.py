"""What the service answers, as frozen dataclasses. Units stand in the names: `_m`, `_m2`, `_deg`, `_ms`.

Fields that this client does not know are left out, so that a newer service can be asked; those that it knows must be
there and of the right type.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass
from datetime import datetime
from functools import cache
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from lalaloc_client.errors import MalformedAnswerError

T = TypeVar("T")


@dataclass(frozen=True)
class Position:
    """A point of the plan frame: x to the right, y up on the drawing."""

    x_m: float
    y_m: float


@dataclass(frozen=True)
class Bounds:
    """Smallest axis-parallel box around a plan."""

    x_min_m: float
    y_min_m: float
    x_max_m: float
    y_max_m: float


@dataclass(frozen=True)
class Room:
    """One room of a stored plan; `id` tells rooms of one name apart."""

    name: str
    area_m2: float
    ceiling_height_m: float
    vertices: int
    id: str | None = None
    type: str | None = None


@dataclass(frozen=True)
class Grid:
    """A plan's latent grid; the number of poses is an estimate until the plan is ready."""

    step_m: float
    poses: int


@dataclass(frozen=True)
class FloorPlan:
    """A stored floor plan.

    Attributes:
        status: `preparing`, then `ready` or `failed`.
        progress: share of its latent grid that is computed, 0 to 1.
        reason: why it failed, None unless it did.
        warnings: what is odd about it but usable.
        revision: names what was uploaded, as `Localisation.floorplan_revision` does.
        revision_number: how often the plan was uploaded up to this revision.
        created_at: when it was first uploaded; `updated_at`: when this revision was.
        etag: names this revision, for `replace_floorplan(..., if_match=...)`.
        plan: the plan itself in the native format.
        import_report: how its file was read: what was used for what, what is likely wrong, what was guessed.
    """

    id: str
    name: str
    status: str
    progress: float
    rooms: tuple[Room, ...]
    area_m2: float
    bounds: Bounds
    camera_height_m: float
    grid: Grid
    created_at: datetime
    warnings: tuple[str, ...] = ()
    reason: str | None = None
    revision: str | None = None
    revision_number: int | None = None
    updated_at: datetime | None = None
    etag: str | None = None
    plan: Mapping[str, Any] | None = None
    import_report: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class FloorPlanSummary:
    """A stored floor plan in a listing; `rooms` is their number."""

    id: str
    name: str
    status: str
    progress: float
    rooms: int
    area_m2: float
    created_at: datetime
    revision: str | None = None
    updated_at: datetime | None = None


@dataclass(frozen=True)
class FloorPlanPage:
    """One page of a listing; `next_cursor` asks for the one after it, None ends the listing."""

    floorplans: tuple[FloorPlanSummary, ...]
    next_cursor: str | None = None


@dataclass(frozen=True)
class VenueAnchor:
    """Where on Earth the origin of a venue's plans lies, WGS84; `north_deg` is the azimuth of true north in them."""

    latitude: float
    longitude: float
    altitude_m: float | None = None
    north_deg: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """As it is sent."""
        return asdict(self)


@dataclass(frozen=True)
class VenuePlan:
    """A plan of a venue.

    Attributes:
        level: number of its level, 0 for the ground.
        name: what it is called in the venue; None, when it is sent: by its own name.
        status, progress, rooms, area_m2, revision: those of the plan, as the service tells them.
    """

    floorplan_id: str
    level: float = 0.0
    name: str | None = None
    status: str | None = None
    progress: float | None = None
    rooms: int | None = None
    area_m2: float | None = None
    revision: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """As it is sent."""
        return {"floorplan_id": self.floorplan_id, "level": self.level, "name": self.name}


@dataclass(frozen=True)
class Venue:
    """A stored venue.

    Attributes:
        plans: how many floor plans it has; of these `plans_ready` can be asked about, `plans_failed` never will be.
            Listings do not tell these two.
        revision: changes with the name, the anchor and the plans that belong to it.
        etag: names this revision, for `if_match`.
    """

    id: str
    revision: str
    name: str
    plans: int
    created_at: datetime
    updated_at: datetime
    anchor: VenueAnchor | None = None
    revision_number: int | None = None
    plans_ready: int | None = None
    plans_failed: int | None = None
    etag: str | None = None


@dataclass(frozen=True)
class VenuePage:
    """One page of a listing of venues; `next_cursor` asks for the one after it, None ends the listing."""

    venues: tuple[Venue, ...]
    next_cursor: str | None = None


@dataclass(frozen=True)
class VenuePlanPage:
    """One page of the plans of a venue."""

    plans: tuple[VenuePlan, ...]
    next_cursor: str | None = None


@dataclass(frozen=True)
class PlanProbability:
    """How probable it is that a panorama was taken in one plan of a venue."""

    floorplan_id: str
    level: float
    name: str
    probability: float | None


@dataclass(frozen=True)
class PlanEvent:
    """How far a plan is at some moment.

    Attributes:
        status: `preparing`, then `ready`, `failed` or `deleted`, after which nothing comes.
        progress: share of its latent grid that is computed, 0 to 1; None of a plan that is deleted.
        revision: the current one; a plan may get another meanwhile.
        reason: why it failed.
    """

    status: str
    progress: float | None = None
    revision: str | None = None
    reason: str | None = None

    @property
    def final(self) -> bool:
        """Whether it is the last one."""
        return self.status in ("ready", "failed", "deleted")


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
    """How probable places are, lists of one length; each stands for a square `step_m` wide."""

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


def parse(wanted: type[T], data: object, where: str = "answer") -> T:
    """JSON values as a dataclass of this module.

    Raises:
        MalformedAnswerError: names the field that is missing or of another type.
    """
    return _value(wanted, data, where)


@cache
def _types_of(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def _value(wanted: Any, data: object, where: str) -> Any:
    if wanted is Any:
        return data
    origin, arguments = get_origin(wanted), get_args(wanted)
    if origin in (Union, types.UnionType):
        if data is None:
            return None
        return _value(next(one for one in arguments if one is not type(None)), data, where)
    if is_dataclass(wanted):
        return _record(wanted, data, where)
    if origin is tuple:
        return _sequence(arguments, data, where)
    if wanted is datetime:
        return _moment(data, where)
    if origin is not None:
        # Mappings are the only other kind of container here.
        return {str(key): _value(arguments[1], one, f"{where}.{key}") for key, one in _object(data, where).items()}
    if wanted is float and type(data) is int:
        return float(data)
    # By type and not isinstance: true is no number.
    if type(data) is not wanted:
        raise MalformedAnswerError(f"{where} is {data!r:.100}, not of type {wanted.__name__}")
    return data


def _record(cls: Any, data: object, where: str) -> Any:
    given, hints = _object(data, where), _types_of(cls)
    values = {}
    for one in fields(cls):
        if one.name in given:
            values[one.name] = _value(hints[one.name], given[one.name], f"{where}.{one.name}")
        elif one.default is MISSING:
            raise MalformedAnswerError(f"{where}.{one.name} is missing")
    return cls(**values)


def _sequence(arguments: tuple[Any, ...], data: object, where: str) -> tuple[Any, ...]:
    if not isinstance(data, list):
        raise MalformedAnswerError(f"{where} is {data!r:.100}, not a list")
    if arguments[-1] is Ellipsis:
        arguments = (arguments[0],) * len(data)
    if len(arguments) != len(data):
        raise MalformedAnswerError(f"{where} has {len(data)} items, not {len(arguments)}")
    return tuple(
        _value(one, item, f"{where}[{index}]") for index, (one, item) in enumerate(zip(arguments, data, strict=True))
    )


def _moment(data: object, where: str) -> datetime:
    try:
        return datetime.fromisoformat(str(data))
    except ValueError as error:
        raise MalformedAnswerError(f"{where} is {data!r:.100}, not a time") from error


def _object(data: object, where: str) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise MalformedAnswerError(f"{where} is {data!r:.100}, not an object")
    return data
