"""Pose grid of a plan: its poses with their wall profiles, and layouts that are rendered at first use."""

from __future__ import annotations

import math
from dataclasses import InitVar, dataclass, field, replace

import numpy as np
from jaxtyping import Float

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match.binned_layouts import SPHERE_AZIMUTHS, BinnedLayouts
from lalaloc_core.localise.match.layouts import Layouts, layouts_at
from lalaloc_core.localise.query import Candidate, Query
from lalaloc_core.render.sampling import PoseSet


@dataclass(frozen=True, eq=False)
class PoseGrid:
    """Grid of poses of one plan at heading 0, with wall profiles, and latents for one model and camera height.

    Attributes:
        latents: (n, d) latents of the layouts; None for models that compare wall profiles.
        profile_m: (n, w) wall profiles (m), which serve queries of any camera height.
        camera_height_m: camera height (m) of the latents.
        rendered: layouts of the poses; None renders them at first use.
    """

    poses: PoseSet
    latents: Float[np.ndarray, "n d"] | None
    profile_m: Float[np.ndarray, "n w"]
    step_m: float
    camera_height_m: float
    rendered: InitVar[Layouts | None] = None
    _layouts: list[Layouts] = field(default_factory=list, init=False, repr=False)
    _binned: dict[int, BinnedLayouts] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self, rendered: Layouts | None) -> None:
        self._layouts.extend([] if rendered is None else [rendered])

    @classmethod
    def without_latents(cls, poses: PoseSet, layouts: Layouts, step_m: float, camera_height_m: float) -> PoseGrid:
        """Return a grid of rendered layouts without latents, with distances in half precision."""
        profile_m = np.exp(layouts.log_profile).astype(np.float16)
        # Logs of the rounded profile, so that a grid read from storage gives the same answers.
        kept = replace(layouts, log_profile=np.log(profile_m.astype(np.float32)).astype(np.float16))
        return cls(poses, None, profile_m, step_m, camera_height_m, kept)

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
        """Latents of the poses."""
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


def grid_candidate(
    grid: PoseGrid,
    pose: int,
    query: Query,
    hypothesis: int,
    *,
    cost: float,
    height_offset: float = 0.0,
    place_cost: float = 0.0,
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
        place_cost=place_cost,
    )
