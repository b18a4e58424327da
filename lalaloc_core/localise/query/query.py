"""Encoded photograph as searches compare it, with the predictions of the networks, and the poses that are found for it.

All are values in plain numpy, so that they can cross process borders.

A picture shows the layout in units of the camera's height. An error of the stated height scales all distances in the
picture: it is one offset δ of log distances, with true height = stated height · exp δ. The search solves for δ and the
pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M, ROOM_TYPES, TWO_PI, heading_from_degrees
from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan import FloorPlan

# Types of rooms that are less probable are not named.
_MIN_PROBABILITY = 0.05
HeadingSource = Literal["given", "photograph", "searched"]
T = TypeVar("T")
# Largest error (degrees) of the compass heading in a photograph's metadata.
_COMPASS_TOLERANCE_DEG = 20.0
# Range of unknown camera heights (m) over the floor, all equally likely.
UNKNOWN_RANGE_M = (0.8, 2.2)
DEFAULT_STD_M = 0.1
# Largest distance between the offsets that retrieval tries; half of it is small beside the error of a grid pose.
_SPACING = 0.1
# Range of these offsets, in standard deviations; refinement can exceed it.
_REACH_STDS = 1.5


@dataclass(frozen=True)
class CameraHeight:
    """A stated camera height (m), and the standard deviation (m) of its error.

    A deviation of 0 means that the height is exact, infinity that it is unknown: the height is then anywhere in
    `UNKNOWN_RANGE_M`, and predictions are made for `height_m`.
    """

    height_m: float
    std_m: float = DEFAULT_STD_M

    def __post_init__(self) -> None:
        if not self.height_m > 0.0 or not math.isfinite(self.height_m):
            raise InvalidPoseError(f"the camera height is {self.height_m:g} m; it must be positive and finite")
        if not self.std_m >= 0.0:
            raise InvalidPoseError(f"the camera height's deviation is {self.std_m:g} m; it must not be negative")

    def at(self, height_m: float) -> CameraHeight:
        """Return another stated height (m) with the same relative error; not for an unknown height."""
        return CameraHeight(height_m, self.std_m * height_m / self.height_m)

    @property
    def is_exact(self) -> bool:
        """True if the height is exact."""
        return self.std_m == 0.0

    @property
    def is_unknown(self) -> bool:
        """True if the height is unknown."""
        return math.isinf(self.std_m)

    @property
    def log_std(self) -> float:
        """Standard deviation of δ; infinite if the height is unknown."""
        # Rounded, so that heights with the same relative error have the same offsets.
        return round(self.std_m / self.height_m, 12)

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest possible δ."""
        if self.is_unknown:
            low, high = UNKNOWN_RANGE_M
            return math.log(low / self.height_m), math.log(high / self.height_m)
        return -4.0 * self.log_std, 4.0 * self.log_std

    @cached_property
    def offsets(self) -> Float[np.ndarray, "j"]:
        """The δ that retrieval tries."""
        if self.is_unknown:
            low, high = self.bounds
            return np.linspace(low, high, math.ceil((high - low) / _SPACING) + 1)
        reach = _REACH_STDS * self.log_std
        each_side = math.ceil(reach / _SPACING)
        return np.linspace(-reach, reach, 2 * each_side + 1) if each_side else np.zeros(1)

    def penalty(self, offset: Float[np.ndarray, "*j"]) -> Float[np.ndarray, "*j"]:
        """Return the negative log prior of δ, 0 at best."""
        if self.is_unknown or self.is_exact:
            return np.zeros_like(offset)
        return 0.5 * np.square(offset / self.log_std)


@dataclass(frozen=True)
class KnownHeading:
    """Known heading: radians, or None if all are searched; its largest error (radians); and its source."""

    heading: float | None
    tolerance: float
    source: HeadingSource


UNKNOWN_HEADING = KnownHeading(None, 0.0, "searched")


def known_heading(
    north: float | None,
    heading_deg: float | None,
    tolerance_deg: float,
    compass_heading: float | None,
    compass_tolerance_deg: float = _COMPASS_TOLERANCE_DEG,
) -> KnownHeading:
    """Return the given heading, else the photograph's if north is known, else none.

    `heading_deg` is given with the largest error `tolerance_deg`. `compass_heading` is in the photograph's metadata,
    clockwise from true north (radians); `north` is the azimuth of true north in the plan (radians).
    """
    if heading_deg is not None:
        return KnownHeading(heading_from_degrees(heading_deg), math.radians(tolerance_deg), "given")
    if north is not None and compass_heading is not None:
        heading = (compass_heading + north) % TWO_PI
        return KnownHeading(heading, math.radians(compass_tolerance_deg), "photograph")
    return UNKNOWN_HEADING


def check_height_m(plan: FloorPlan, height_m: float) -> None:
    """Check that a camera can have a height (m) in a plan.

    Raises:
        InvalidPoseError: the height is not below the lowest ceiling, or too low for any camera.
    """
    lowest_m = float(plan.ceiling_heights_m.min())
    if height_m != plan.camera_height_m and not MIN_CAMERA_HEIGHT_M <= height_m < lowest_m:
        raise InvalidPoseError(
            f"camera_height_m is {height_m:g}; it must be at least {MIN_CAMERA_HEIGHT_M:g} and below the plan's lowest "
            f"ceiling ({lowest_m:g} m)"
        )


def stated_height(plan: FloorPlan, height_m: float | None, std_m: float | None = None) -> CameraHeight:
    """Return the given camera height, else the plan's, else an unknown one."""
    if height_m is not None:
        return CameraHeight(height_m, DEFAULT_STD_M if std_m is None else std_m)
    usual = DEFAULT_STD_M if plan.states_camera_height else math.inf
    stated = (value for value in (std_m, plan.camera_height_std_m, usual) if value is not None)
    return CameraHeight(plan.camera_height_m, next(stated))


@dataclass(frozen=True, eq=False)
class RivalWall:
    """Second mode of a predicted wall profile, such as the wall behind a passage, or at an edge that is hidden.

    Attributes:
        log_m: (k, w) centres.
        log_scale: (k, w) logs of the scales.
        odds: (k, w) height of this mode's density at its centre over that of the first mode.
    """

    log_m: Float[np.ndarray, "k w"]
    log_scale: Float[np.ndarray, "k w"]
    odds: Float[np.ndarray, "k w"]


@dataclass(frozen=True, eq=False)
class PredictedProfile:
    """Laplace distributions of the log wall profile (m), for every hypothesis of the heading.

    Attributes:
        log_m: (k, w) centres.
        log_scale: (k, w) logs of the scales; infinite at azimuths that the photograph does not show.
        rival: second modes; None if the model predicts one only.
    """

    log_m: Float[np.ndarray, "k w"]
    log_scale: Float[np.ndarray, "k w"]
    rival: RivalWall | None = None

    @classmethod
    def of_outputs(cls, outputs: Mapping[str, np.ndarray]) -> PredictedProfile:
        """Return the profile of one hypothesis by the outputs of an image encoder, the mode with most density first.

        `log_profile` and `log_scale` are (w,), or with `log_share` (w, 2).
        """
        log_m, log_scale = outputs["log_profile"], outputs["log_scale"]
        if log_m.ndim == 1:
            return cls(log_m[None], log_scale[None])
        density = outputs["log_share"] - log_scale
        order = np.argsort(-density, axis=1, kind="stable")
        log_m, log_scale, density = (np.take_along_axis(value, order, axis=1) for value in (log_m, log_scale, density))
        # Azimuths that the photograph does not show have infinite scales.
        with np.errstate(invalid="ignore"):
            odds = np.nan_to_num(np.exp(density[:, 1] - density[:, 0]))
        rival = RivalWall(log_m[None, :, 1], log_scale[None, :, 1], odds[None])
        return cls(log_m[None, :, 0], log_scale[None, :, 0], rival)

    def moved(self, shifts: Int[np.ndarray, "j"]) -> PredictedProfile:
        """Return a profile of one hypothesis, moved to the right by a number of columns for each of several."""
        rival = self.rival
        return PredictedProfile(
            rolled(self.log_m[0], shifts),
            rolled(self.log_scale[0], shifts),
            None if rival is None else RivalWall(*(rolled(values[0], shifts) for values in vars(rival).values())),
        )

    def scaled(self, offset: float) -> PredictedProfile:
        """Return the profile if the camera stood higher by the factor `exp(offset)`."""
        rival = None if self.rival is None else replace(self.rival, log_m=self.rival.log_m + offset)
        return replace(self, log_m=self.log_m + offset, rival=rival)

    @property
    def seen(self) -> Bool[np.ndarray, "k w"]:
        """Azimuths that the photograph shows."""
        return np.isfinite(self.log_scale)


def rolled(values: Float[np.ndarray, "w *c"], shifts: Int[np.ndarray, "k"]) -> Float[np.ndarray, "k w *c"]:
    """Return values by azimuth column, moved to the right by a number of columns for each hypothesis."""
    columns = len(values)
    return values[(np.arange(columns)[None, :] - shifts[:, None]) % columns]


@dataclass(frozen=True, eq=False)
class PredictedOpenings:
    """Opening class at each azimuth at eye height, for every hypothesis of the heading.

    Attributes:
        log_probability: (k, w, c) by class, in the order of `conventions.OPENING_CLASSES`.
        prior: (c,) frequencies of the classes that the probabilities presume; probabilities over these are likelihoods
            up to a factor.
    """

    log_probability: Float[np.ndarray, "k w c"]
    prior: Float[np.ndarray, "c"]


@dataclass(frozen=True)
class PredictedCeiling:
    """Laplace distribution of the log of the ceiling's height (m) above the camera: centre and log scale."""

    log_m: float
    log_scale: float


@dataclass(frozen=True, eq=False)
class PredictedRoomType:
    """Log probability by type, as in `conventions.ROOM_TYPES`, and the frequencies that it presumes."""

    log_probability: Float[np.ndarray, "t"]
    prior: Float[np.ndarray, "t"]

    def shares(self) -> dict[str, float]:
        """Return the probabilities of the types that are not negligible, the most probable first."""
        share = np.exp(self.log_probability)
        return {ROOM_TYPES[k]: float(share[k]) for k in np.argsort(-share) if share[k] >= _MIN_PROBABILITY}


@dataclass(frozen=True)
class SeenObject:
    """Object in a photograph: its name, probability, and azimuth (radians) relative to the photograph's centre."""

    name: str
    probability: float
    azimuth: float


@dataclass(frozen=True)
class WallDirection:
    """Azimuth of walls relative to the photograph's centre, known up to quarter turns, and its deviation (radians)."""

    azimuth: float
    sd: float


@dataclass(eq=False)
class Later(Generic[T]):
    """Value that is computed when it is read, or sent to another process: few answers need it."""

    compute: Callable[[], T]

    @cached_property
    def value(self) -> T:
        """The value."""
        return self.compute()

    def __reduce__(self) -> tuple[type[Later[T]], tuple[Any]]:
        return Later, (partial(copy, self.value),)


@dataclass(frozen=True, eq=False)
class SeenObjects:
    """Objects that a photograph, or several of one spot, show, and the type of room that they suggest.

    Attributes:
        room_type: its probabilities presume that all types are equally frequent.
        objects: the most probable first.
        outside: log likelihood ratio of a photograph taken outside to one of a room.
        lying: warnings that photographs lie on their side or upside down; None for features.
    """

    room_type: PredictedRoomType
    objects: tuple[SeenObject, ...]
    outside: float = 0.0
    lying: Later[tuple[str, ...]] | None = None


@dataclass(frozen=True, eq=False)
class Query:
    """An encoded photograph, with one latent per hypothesis of the heading.

    A photograph is compared in its *frame*: rolled by whole pixels or ring sectors so that its centre column looks
    (almost) along azimuth 0. Hypothesis k assumes a photograph heading of `roll[k] + frame_heading`, and its latent is
    compared with layouts rendered at `frame_heading`.

    Attributes:
        latents: (k, d), L2-normalised.
        roll: (k,) angle (radians) that was rolled away.
        frame_heading: rest (radians) that rolling by whole pixels leaves; 0 if the heading is unknown.
        heading_known: whether the heading was given exactly; otherwise it is searched and refined.
        camera_height: stated camera height, which predictions in metres refer to.
        profile: predicted wall profile; None if the image encoder predicts none.
        openings, ceiling, room_type: other predictions; None if the image encoder does not make them.
        objects: recognised objects, whose room type replaces `room_type`; None if the model recognises none.
        wall_directions: directions of walls that the lines of each photograph tell.
        searched: the same photograph with an unknown heading, to doubt a given one; None if the heading is unknown.
        is_view: whether the encoder of views read it, which has matching weights and confidence of its own.
        is_turn: whether it is several views from one spot, which have a confidence of their own.
    """

    latents: Float[np.ndarray, "k d"]
    roll: Float[np.ndarray, "k"]
    frame_heading: float
    heading_known: bool
    camera_height: CameraHeight
    profile: PredictedProfile | None = None
    openings: PredictedOpenings | None = None
    ceiling: PredictedCeiling | None = None
    room_type: PredictedRoomType | None = None
    objects: SeenObjects | None = None
    wall_directions: tuple[WallDirection, ...] = ()
    searched: Later[Query] | None = None
    is_view: bool = False
    is_turn: bool = False

    def scaled(self, offset: float) -> Query:
        """Return the query if the camera stood higher by the factor `exp(offset)`."""
        profile, ceiling = self.profile, self.ceiling
        return replace(
            self,
            profile=None if profile is None else profile.scaled(offset),
            ceiling=None if ceiling is None else replace(ceiling, log_m=ceiling.log_m + offset),
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings by what the photograph shows."""
        return () if self.objects is None or self.objects.lying is None else self.objects.lying.value

    @property
    def sector(self) -> float:
        """Angle (radians) between neighbouring hypotheses; 0 for a single one."""
        return float(self.roll[1] - self.roll[0]) if len(self.roll) > 1 else 0.0


@dataclass(frozen=True)
class Candidate:
    """A pose and its cost.

    Attributes:
        frame_heading: heading (radians) of the layout in the frame of the hypothesis; the photograph's heading is
            `query.roll[hypothesis] + frame_heading`.
        cost: matching cost; the latent distance if the model predicts no wall profile.
        latent_distance: distance of the layout's latent to the query's; NaN until computed, as it is for answers.
        height_offset: log of true over stated camera height that fits best.
        place_cost: cost of hints, fixtures and directions of walls at the pose, in units of the cost; see
            `localise.match.place_cost`.
        terms: terms of the matching cost by name; empty if poses are compared by latents.
        information: (p, p) curvature of the cost by x, y (m) and, if it was searched, the heading (radians), from pose
            refinement. Its inverse is the covariance up to a factor.
    """

    x_m: float
    y_m: float
    room_index: int
    frame_heading: float
    hypothesis: int
    cost: float
    latent_distance: float
    height_offset: float = 0.0
    place_cost: float = 0.0
    terms: dict[str, float] = field(default_factory=dict, compare=False)
    information: Float[np.ndarray, "p p"] | None = field(default=None, compare=False)

    @property
    def position_m(self) -> Float[np.ndarray, "2"]:
        """(x, y) as an array."""
        return np.array([self.x_m, self.y_m])

    @property
    def total_cost(self) -> float:
        """Cost that candidates are ranked by: the matching cost plus that of the place."""
        return self.cost + self.place_cost
