"""Pose grid of a plan: its poses with their wall profiles, and layouts that are rendered and binned at first use."""

from __future__ import annotations

import math
from dataclasses import InitVar, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import OPENING_CLASSES, WALL_CODE
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match.pose_layouts import Layouts, layouts_at
from lalaloc_core.localise.query import Candidate, Query
from lalaloc_core.render.sampling import PoseSet

# Azimuths that are compared: with spheres, and with views, which show a part of them.
SPHERE_AZIMUTHS, VIEW_AZIMUTHS = 16, 64
# Width of the bins of log distance: 5 cm at a distance of 1 m.
_BIN = 0.05
# Distances (m) are clipped to this range.
_MIN_DISTANCE_M, _MAX_DISTANCE_M = 0.1, 500.0
# Azimuths of a sector of views; a view shows some sectors only, a sphere all.
_SECTOR_AZIMUTHS = 8
# Poses of a part: the sums of their costs stay in the processor's cache.
_PART = 512
# Opening classes with a row at every azimuth: all but walls.
OPENING_ROWS = len(OPENING_CLASSES) - 1


@dataclass(frozen=True, eq=False)
class BinnedLayouts:
    """Binned layouts of n poses.

    Attributes:
        walls: sectors of azimuths, each with (n, a b) ones, for every azimuth at its bin.
        openings: (n, a k) ones, for every azimuth at its opening class if it is not a wall.
        columns: (a,) the azimuth columns that are compared.
        bins: (b,) log distances (m) at the centres of the bins.
    """

    walls: tuple[scipy.sparse.csr_array, ...]
    openings: scipy.sparse.csr_array
    columns: Int[np.ndarray, "a"]
    bins: Float[np.ndarray, "b"]

    @classmethod
    def of(cls, layouts: Layouts, azimuths: int = SPHERE_AZIMUTHS) -> BinnedLayouts:
        """Bin layouts at a number of azimuths."""
        width = layouts.log_profile.shape[1]
        count = min(azimuths, width)
        columns = np.arange(count) * width // count
        log_m = layouts.log_profile[:, columns].astype(np.float32)
        log_m = np.clip(log_m, math.log(_MIN_DISTANCE_M), math.log(_MAX_DISTANCE_M))
        number = np.floor(log_m / _BIN).astype(np.int32)
        low, bins = int(number.min()), int(np.ptp(number)) + 1
        sectors = tuple(_ones((number - low)[:, part], bins) for part in _sectors(count))
        kind = np.zeros(number.shape, np.int32)
        if layouts.kind is not None:
            kind = layouts.kind[:, columns].astype(np.int32)
        openings = _ones(kind - 1, OPENING_ROWS, kind != WALL_CODE)
        return cls(sectors, openings, columns, (_BIN * (low + 0.5 + np.arange(bins))).astype(np.float32))

    def __len__(self) -> int:
        return len(self.openings.indptr) - 1

    @property
    def sectors_of_azimuths(self) -> list[slice]:
        """Numbers of the azimuths of each sector."""
        return _sectors(len(self.columns))

    def part(self, pose: Any) -> BinnedLayouts:
        """Return the layouts of some poses: a slice or numbers."""
        return BinnedLayouts(tuple(rows[pose] for rows in self.walls), self.openings[pose], self.columns, self.bins)

    @cached_property
    def parts(self) -> list[BinnedLayouts]:
        """The layouts, a few hundred poses at a time; kept, because slices of a sparse matrix are slow."""
        return [self.part(slice(first, first + _PART)) for first in range(0, len(self), _PART)]

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays, without `parts`."""
        return sum(m.data.nbytes + m.indices.nbytes + m.indptr.nbytes for m in (*self.walls, self.openings))


def _sectors(azimuths: int) -> list[slice]:
    """Return the sectors of a number of azimuths."""
    size = azimuths if azimuths <= SPHERE_AZIMUTHS else _SECTOR_AZIMUTHS
    return [slice(first, min(first + size, azimuths)) for first in range(0, azimuths, size)]


def _ones(
    number: Int[np.ndarray, "n a"], values: int, present: Bool[np.ndarray, "n a"] | None = None
) -> scipy.sparse.csr_array:
    """Return (n, a values) ones, for every azimuth at its number, where one is present."""
    count, azimuths = number.shape
    place = number + np.arange(azimuths, dtype=np.int32) * values
    begin = np.arange(count + 1, dtype=np.int32) * azimuths
    if present is not None:
        place = place[present]
        begin[1:] = np.cumsum(present.sum(axis=1))
    # The narrowest type, so that products keep the type of the dense factor.
    ones = np.ones(place.size, np.int8)
    return scipy.sparse.csr_array((ones, place.ravel(), begin), shape=(count, azimuths * values))


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
