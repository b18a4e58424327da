"""Values that the stages of localisation exchange, in plain numpy so that they can cross process borders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.binned_layouts import SPHERE_AZIMUTHS, BinnedLayouts
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.layouts import Layouts, layouts_at
from lalaloc_core.render.sampling import PoseSet


@dataclass(frozen=True, eq=False)
class PoseGrid:
    """Grid of poses of one plan at heading 0, with wall profiles, and latents for one model and camera height.

    Attributes:
        latents: (n, d) latents of the layouts; None for models that compare wall profiles.
        profile_m: (n, w) wall profiles (m), which serve queries of any camera height.
        camera_height_m: camera height (m) of the latents.
    """

    poses: PoseSet
    latents: Float[np.ndarray, "n d"] | None
    profile_m: Float[np.ndarray, "n w"]
    step_m: float
    camera_height_m: float
    _layouts: list[Layouts] = field(default_factory=list, init=False, repr=False)
    _binned: dict[int, BinnedLayouts] = field(default_factory=dict, init=False, repr=False)

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
        """Return a grid with layouts that are rendered already."""
        grid = cls(poses, latents, profile_m, step_m, camera_height_m)
        grid._layouts.append(layouts)
        return grid

    @classmethod
    def without_latents(cls, poses: PoseSet, layouts: Layouts, step_m: float, camera_height_m: float) -> PoseGrid:
        """Return a grid of rendered layouts without latents, with distances in half precision."""
        profile_m = np.exp(layouts.log_profile).astype(np.float16)
        # Logs of the rounded profile, so that a grid read from storage gives the same answers.
        kept = replace(layouts, log_profile=np.log(profile_m.astype(np.float32)).astype(np.float16))
        return cls.with_layouts(poses, None, profile_m, step_m, camera_height_m, kept)

    @property
    def is_rendered(self) -> bool:
        """True if the layouts are in memory."""
        return bool(self._layouts)

    def layouts(self, plan: FloorPlan) -> Layouts:
        """Return the layouts of the poses; rendered at first use, since grids are stored without openings."""
        if not self._layouts:
            # Two threads can render at once; both results are the same.
            self._layouts.append(self._rendered(plan))
        return self._layouts[0]

    def binned(self, plan: FloorPlan, azimuths: int = SPHERE_AZIMUTHS) -> BinnedLayouts:
        """Return the layouts as the coarse pass compares them; made at first use."""
        if azimuths not in self._binned:
            self._binned[azimuths] = BinnedLayouts.of(self.layouts(plan), azimuths)
        return self._binned[azimuths]

    @property
    def known_latents(self) -> Float[np.ndarray, "n d"]:
        """Latents of the poses.

        Raises:
            InvalidInputError: the grid has none.
        """
        if self.latents is None:
            raise InvalidInputError("the pose grid has no latents, and the model compares latents: make the grid again")
        return self.latents

    def latent_distance(self, pose: int, target: Float[np.ndarray, "d"]) -> float:
        """Return the distance of a pose's latent to a target; NaN without latents."""
        return math.nan if self.latents is None else float(np.linalg.norm(self.latents[pose] - target))

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays, with those made at first use."""
        arrays = [self.poses.position_m, self.poses.room_index, self.profile_m]
        arrays += [] if self.latents is None else [self.latents]
        return sum(part.nbytes for part in (*arrays, *self._layouts, *self._binned.values()))

    def _rendered(self, plan: FloorPlan) -> Layouts:
        precision = self.profile_m.dtype if self.latents is None else np.float32
        log_profile = np.log(self.profile_m.astype(np.float32)).astype(precision)
        if not plan.opening_faces:
            return Layouts(log_profile, self.poses.room_index)
        layouts = layouts_at(plan, self.poses, np.zeros(len(self.poses)), self.profile_m.shape[1])
        return replace(layouts, log_profile=log_profile)


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


@dataclass(frozen=True, eq=False)
class Query:
    """An encoded panorama, with one latent per hypothesis of the heading.

    A panorama is compared in its *frame*: rolled by whole pixels or ring sectors so that its centre column looks
    (almost) along azimuth 0. Hypothesis k assumes a panorama heading of `roll[k] + frame_heading`, and its latent is
    compared with layouts rendered at `frame_heading`.

    Attributes:
        latents: (k, d), L2-normalised.
        roll: (k,) angle (radians) that was rolled away.
        frame_heading: rest (radians) that rolling by whole pixels leaves; 0 if the heading is unknown.
        heading_known: whether the heading was given exactly; otherwise it is searched and refined.
        camera_height: stated camera height, which predictions in metres refer to.
        profile: predicted wall profile; None if the image encoder predicts none.
        openings, ceiling, room_type: other predictions; None if the image encoder does not make them.
        searched: the same panorama with an unknown heading, to doubt a given one; None if the heading is unknown.
        is_view: whether the encoder of views read it, which has matching weights and confidence of its own.
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
    is_view: bool = False

    def scaled(self, offset: float) -> Query:
        """Return the query if the camera stood higher by the factor `exp(offset)`."""
        profile, ceiling = self.profile, self.ceiling
        return replace(
            self,
            profile=None if profile is None else profile.scaled(offset),
            ceiling=None if ceiling is None else replace(ceiling, log_m=ceiling.log_m + offset),
        )

    @property
    def sector(self) -> float:
        """Angle (radians) between neighbouring hypotheses; 0 for a single one."""
        return float(self.roll[1] - self.roll[0]) if len(self.roll) > 1 else 0.0


@dataclass(frozen=True)
class Candidate:
    """A pose and its cost.

    Attributes:
        frame_heading: heading (radians) of the layout in the frame of the hypothesis; the panorama's heading is
            `query.roll[hypothesis] + frame_heading`.
        cost: matching cost; the latent distance if the model predicts no wall profile.
        latent_distance: distance of the layout's latent to the query's; NaN until computed, as it is for answers.
        height_offset: log of true over stated camera height that fits best.
        hint_cost: cost of the hints at the place, in units of the cost; see `localise.hints`.
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
    hint_cost: float = 0.0
    terms: dict[str, float] = field(default_factory=dict, compare=False)
    information: Float[np.ndarray, "p p"] | None = field(default=None, compare=False)

    @property
    def position_m(self) -> Float[np.ndarray, "2"]:
        """(x, y) as an array."""
        return np.array([self.x_m, self.y_m])

    @property
    def total_cost(self) -> float:
        """Cost that candidates are ranked by: the matching cost plus that of hints."""
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
    """Return a grid pose under a hypothesis of a query, by their numbers, as a candidate."""
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
    """Starting poses for pose refinement, each with its own targets and room.

    `PoseOptimiser` compares embedded layouts with `targets`, by differences times `precision` if that is not None.
    `PoseRefiner` reads a job with `log_profile` differently: it passes the optimiser a copy with `log_profile` as the
    targets, and uses the job's own `targets`, which are latents, for the latent distance alone. Without `log_profile`
    it compares latents and ignores `precision`.

    Attributes:
        targets: (k, d) latents, or other embeddings for an optimiser with another embedding.
        heading: (k,) headings (radians) in the frame.
        walls_m: (k, n, 4) walls of each pose's room (m), padded.
        optimise_heading: whether the heading is refined as well.
        log_profile: (k, w) centres of the predicted log wall profiles (m); None compares latents alone.
        precision: (k, w) factors that turn differences of log distance into residuals.
        latent_weight: weight of the latent distance in the cost of poses that were refined by their profiles.
        height_offset: (k,) start of the log of true over stated camera height; None keeps it at 0.
        height_stiffness: factor that turns that log into a residual among those of the profile's columns.
        height_bounds: smallest and largest log.
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
    """Refined poses, inside the rooms of their starts.

    Attributes:
        heading: (k,) headings (radians) in the frame.
        cost: (k,) minimised cost: the walls' term of the matching cost, or the distance of the embeddings.
        latent_distance: (k,) distance of the embeddings; None if it is no part of the cost.
        information: (k, p, p) curvature of the cost by position and heading, the camera height integrated out.
        height_offset: (k,) log of true over stated camera height; None if it was not solved for.
    """

    position_m: Float[np.ndarray, "k 2"]
    heading: Float[np.ndarray, "k"]
    cost: Float[np.ndarray, "k"]
    latent_distance: Float[np.ndarray, "k"] | None
    information: Float[np.ndarray, "k p p"]
    converged: Bool[np.ndarray, "k"]
    evaluations: Int[np.ndarray, "k"]
    height_offset: Float[np.ndarray, "k"] | None = None
