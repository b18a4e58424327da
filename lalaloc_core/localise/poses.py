"""What the stages of localisation hand to one another. Plain numpy, so that it crosses process borders."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.binned_layouts import BinnedLayouts
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.layouts import Layouts, layouts_at
from lalaloc_core.render.sampling import PoseSet


@dataclass(frozen=True, eq=False)
class PoseGrid:
    """Poses, latents and wall profiles of one plan for one model, one camera height and one grid step; heading 0.

    Only latents depend on the camera height: wall profiles serve queries of any. Where poses are compared by their wall
    profiles, nobody asks for latents of a whole grid, and `latents` is None.
    """

    poses: PoseSet
    latents: Float[np.ndarray, "n d"] | None
    profile_m: Float[np.ndarray, "n w"]
    step_m: float
    camera_height_m: float
    _layouts: list[Layouts] = field(default_factory=list, init=False, repr=False)
    _binned: list[BinnedLayouts] = field(default_factory=list, init=False, repr=False)

    @classmethod
    def with_layouts(
        cls,
        poses: PoseSet,
        latents: Float[np.ndarray, "n d"] | None,
        profile_m: Float[np.ndarray, "n w"],
        step_m: float,
        camera_height_m: float,
        layouts: Layouts,
    ) -> PoseGrid:
        """A grid whose layouts are rendered already."""
        grid = cls(poses, latents, profile_m, step_m, camera_height_m)
        grid._layouts.append(layouts)
        return grid

    @classmethod
    def without_latents(cls, poses: PoseSet, layouts: Layouts, step_m: float, camera_height_m: float) -> PoseGrid:
        """A grid of rendered layouts whose poses are compared by these alone; distances in half precision."""
        profile_m = np.exp(layouts.log_profile).astype(np.float16)
        # The logs of what is kept of the profile, so that a grid which is read again answers the same.
        kept = replace(layouts, log_profile=np.log(profile_m.astype(np.float32)).astype(np.float16))
        return cls.with_layouts(poses, None, profile_m, step_m, camera_height_m, kept)

    def layouts(self, plan: FloorPlan) -> Layouts:
        """What the plan shows at the poses; rendered at first use, since grids are stored without openings."""
        if not self._layouts:
            # Two threads that meet here do the same work twice, and no harm.
            self._layouts.append(self._rendered(plan))
        return self._layouts[0]

    def binned(self, plan: FloorPlan) -> BinnedLayouts:
        """The poses as the first look of a search sees them; made at first use."""
        if not self._binned:
            self._binned.append(BinnedLayouts.of(self.layouts(plan)))
        return self._binned[0]

    @property
    def known_latents(self) -> Float[np.ndarray, "n d"]:
        """The latents.

        Raises:
            InvalidInputError: the grid was made without.
        """
        if self.latents is None:
            raise InvalidInputError("the grid was made without latents, which poses are to be compared by")
        return self.latents

    def latent_distance(self, pose: int, target: Float[np.ndarray, "d"]) -> float:
        """Distance of a pose's latent to another; NaN where there are none."""
        return math.nan if self.latents is None else float(np.linalg.norm(self.latents[pose] - target))

    @property
    def nbytes(self) -> int:
        """Memory that it takes, with what was made of it at first use."""
        arrays = [self.poses.position_m, self.poses.room_index, self.profile_m]
        arrays += [] if self.latents is None else [self.latents]
        return sum(part.nbytes for part in (*arrays, *self._layouts, *self._binned))

    def _rendered(self, plan: FloorPlan) -> Layouts:
        precision = self.profile_m.dtype if self.latents is None else np.float32
        log_profile = np.log(self.profile_m.astype(np.float32)).astype(precision)
        if not plan.opening_faces:
            return Layouts(log_profile, self.poses.room_index)
        layouts = layouts_at(plan, self.poses, np.zeros(len(self.poses)), self.profile_m.shape[1])
        return replace(layouts, log_profile=log_profile)


@dataclass(frozen=True, eq=False)
class PredictedProfile:
    """Laplace distributions of the log wall profile (m), for every hypothesis of how the panorama is turned.

    Attributes:
        log_m: (k, w) their centres.
        log_scale: (k, w) logs of their scales.
    """

    log_m: Float[np.ndarray, "k w"]
    log_scale: Float[np.ndarray, "k w"]

    @classmethod
    def rolled(
        cls, log_m: Float[np.ndarray, "w"], log_scale: Float[np.ndarray, "w"], shifts: Int[np.ndarray, "k"]
    ) -> PredictedProfile:
        """One prediction, moved to the right by so many columns for each hypothesis."""
        return cls(rolled(log_m, shifts), rolled(log_scale, shifts))


def rolled(values: Float[np.ndarray, "w *c"], shifts: Int[np.ndarray, "k"]) -> Float[np.ndarray, "k w *c"]:
    """What was said of the azimuth columns, moved to the right by so many columns for each hypothesis."""
    columns = len(values)
    return values[(np.arange(columns)[None, :] - shifts[:, None]) % columns]


@dataclass(frozen=True, eq=False)
class PredictedOpenings:
    """What is met at each azimuth at eye height, for every hypothesis of how the panorama is turned.

    Attributes:
        log_probability: (k, w, c) by class, in the order of `conventions.OPENING_CLASSES`.
        prior: (c,) the shares of the classes that the probabilities presume; dividing by them leaves likelihoods but
            for a factor.
    """

    log_probability: Float[np.ndarray, "k w c"]
    prior: Float[np.ndarray, "c"]


@dataclass(frozen=True)
class PredictedCeiling:
    """Laplace distribution of the log of the ceiling's height above the camera (m): its centre and log scale."""

    log_m: float
    log_scale: float


@dataclass(frozen=True, eq=False)
class PredictedRoomType:
    """What the room is for.

    Attributes:
        log_probability: (t,) by type, in the order of `conventions.ROOM_TYPES`.
        prior: (t,) the shares of the types that the probabilities presume.
    """

    log_probability: Float[np.ndarray, "t"]
    prior: Float[np.ndarray, "t"]


@dataclass(frozen=True, eq=False)
class Query:
    """An encoded panorama: one latent per hypothesis of how it is turned.

    The layout encoder sees a panorama in its *frame*: rolled by whole pixels or ring sectors so that its centre
    column looks (almost) along azimuth 0. A hypothesis k assumes a panorama heading of
    `roll[k] + frame_heading`, and its latent is to be compared with layouts rendered at `frame_heading`.

    Attributes:
        latents: (k, d), L2-normalised.
        roll: (k,) radians, what was rolled away.
        frame_heading: radians; what whole-pixel rolling could not remove, 0 when the heading is unknown.
        heading_known: whether the heading was given exactly; if not, it is searched over and refined.
        camera_height: what was stated of it; predictions are in metres for just that height.
        profile: what the image encoder says of the walls; None where it predicts no wall profile.
        openings, ceiling, room_type: what it says of those, None where it does not.
        searched: where the heading is known, the same panorama as if it were not, to doubt what was said.
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
    searched: Query | None = None

    def scaled(self, offset: float) -> Query:
        """What the panorama says if the camera stood higher by the factor `exp(offset)`."""
        profile, ceiling = self.profile, self.ceiling
        return replace(
            self,
            profile=None if profile is None else replace(profile, log_m=profile.log_m + offset),
            ceiling=None if ceiling is None else replace(ceiling, log_m=ceiling.log_m + offset),
        )

    @property
    def sector(self) -> float:
        """Angle (radians) between neighbouring hypotheses; 0 where there is one."""
        return float(self.roll[1] - self.roll[0]) if len(self.roll) > 1 else 0.0


@dataclass(frozen=True)
class Candidate:
    """One answer: a pose and how badly its layout fits the query.

    Attributes:
        frame_heading: heading (radians) of the layout in the frame of `Query` hypothesis number `hypothesis`;
            the panorama's heading is `query.roll[hypothesis] + frame_heading`.
        cost: how badly the layout fits, see `localise.matching_cost`; the latent distance where the model predicts no wall
            profile.
        latent_distance: from the latent of its layout to the query's; NaN where nobody has looked, which of answers is
            done in the end.
        height_offset: log of true over stated camera height that fits best.
        hint_cost: what hints have against the place, in units of the cost; see `localise.hints`.
        terms: what each term of the evidence says of it, by name; empty where poses are compared by latents.
        information: (p, p) curvature of the cost by x, y (m) and, where it was searched, the heading (radians); set by
            the optimiser. Its inverse is the covariance but for a factor.
    """

    x_m: float
    y_m: float
    room_index: int
    frame_heading: float
    hypothesis: int
    cost: float
    latent_distance: float
    height_offset: float = 0.0
    hint_cost: float = 0.0
    terms: dict[str, float] = field(default_factory=dict, compare=False)
    information: Float[np.ndarray, "p p"] | None = field(default=None, compare=False)

    @property
    def position_m(self) -> Float[np.ndarray, "2"]:
        """(x, y) as an array."""
        return np.array([self.x_m, self.y_m])

    @property
    def total_cost(self) -> float:
        """What candidates are ranked by: the cost, and what hints have against the place."""
        return self.cost + self.hint_cost


def grid_candidate(
    grid: PoseGrid,
    pose: int,
    query: Query,
    hypothesis: int,
    *,
    cost: float,
    height_offset: float = 0.0,
    hint_cost: float = 0.0,
) -> Candidate:
    """A pose of a grid under one of the hypotheses of a query, by their numbers."""
    return Candidate(
        x_m=float(grid.poses.position_m[pose, 0]),
        y_m=float(grid.poses.position_m[pose, 1]),
        room_index=int(grid.poses.room_index[pose]),
        frame_heading=query.frame_heading,
        hypothesis=hypothesis,
        cost=cost,
        latent_distance=grid.latent_distance(pose, query.latents[hypothesis]),
        height_offset=height_offset,
        hint_cost=hint_cost,
    )


@dataclass(frozen=True, eq=False)
class RefinementJob:
    """Starting poses for pose optimisation, each with its own targets and room.

    Attributes:
        targets: (k, d) what the layouts' embeddings, or latents, are compared with.
        log_profile: (k, w) centres of the predicted log wall profiles (m); None compares latents alone.
        precision: (k, w) factors that turn differences of log distance into residuals.
        latent_weight: weight of the latent distance in the cost of what was optimised by its profile.
        height_offset: (k,) where to begin with the log of true over stated camera height; None leaves it at 0.
        height_stiffness: factor that turns that log into a residual, among those of the profile's columns.
        height_bounds: the least and largest log there is.
    """

    targets: Float[np.ndarray, "k d"]
    position_m: Float[np.ndarray, "k 2"]
    heading: Float[np.ndarray, "k"]
    walls_m: Float[np.ndarray, "k n 4"]
    camera_height_m: Float[np.ndarray, "k"]
    ceiling_height_m: Float[np.ndarray, "k"]
    optimise_heading: bool
    log_profile: Float[np.ndarray, "k w"] | None = None
    precision: Float[np.ndarray, "k w"] | None = None
    latent_weight: float = 0.0
    height_offset: Float[np.ndarray, "k"] | None = None
    height_stiffness: float = 0.0
    height_bounds: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class RefinementResult:
    """Where the optimisation ended: poses inside the same rooms, how well they fit, and what it took.

    Attributes:
        cost: (k,) what was minimised: of profiles as in `localise.matching_cost`, else the distance of the embeddings.
        latent_distance: (k,) distance of the embeddings; None where it is no part of the cost.
        information: (k, p, p) curvature of the cost by position and heading, the camera height integrated out.
        height_offset: (k,) log of true over stated camera height; None where it was not solved for.
    """

    position_m: Float[np.ndarray, "k 2"]
    heading: Float[np.ndarray, "k"]
    cost: Float[np.ndarray, "k"]
    latent_distance: Float[np.ndarray, "k"] | None
    information: Float[np.ndarray, "k p p"]
    converged: Bool[np.ndarray, "k"]
    evaluations: Int[np.ndarray, "k"]
    height_offset: Float[np.ndarray, "k"] | None = None
