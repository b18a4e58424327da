"""Pose grid of a plan: its poses with their wall profiles, and layouts that are rendered and binned at first use.

The layout of a pose is what the plan shows there, in the form that the matching cost compares.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.conventions import OPENING_CLASSES, WALL_CODE
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.geometry import WallTable
from lalaloc_core.localise.query import Candidate, Query
from lalaloc_core.render.sampling import PoseSet
from lalaloc_core.render.sweep import profiles_at, sweep_layouts

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
class SeenThrough:
    """Walls seen through openings.

    Attributes:
        row: (m,) numbers of the poses, rising.
        column: (m,) azimuth columns.
        kind: (m,) codes of the openings.
        log_behind: (m,) log distances (m) of the walls behind.
    """

    row: Int[np.ndarray, "m"]
    column: Int[np.ndarray, "m"]
    kind: UInt8[np.ndarray, "m"]
    log_behind: Float[np.ndarray, "m"]

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(array.nbytes for array in vars(self).values())

    def chosen(self, kept: Int[np.ndarray, "k"]) -> SeenThrough:
        """Return some of the entries."""
        return SeenThrough(*(array[kept] for array in vars(self).values()))

    def entries(self, pose: Int[np.ndarray, "k"]) -> tuple[Int[np.ndarray, "e"], Int[np.ndarray, "e"]]:
        """Return the entries of some poses: for each entry the place of its pose in `pose`, and its number."""
        begin = np.searchsorted(self.row, pose)
        count = np.searchsorted(self.row, pose, side="right") - begin
        place = np.repeat(np.arange(len(pose)), count)
        return place, np.arange(len(place)) - np.repeat(np.cumsum(count) - count - begin, count)


@dataclass(frozen=True, eq=False)
class Layouts:
    """Layouts of n poses, in single precision; in half precision for grids without latents.

    Attributes:
        log_profile: (n, w) log wall profiles (m).
        kind: (n, w) codes as in `conventions.OPENING_CLASSES`; None if the plan has no openings.
        seen: walls seen through openings; None without any.
    """

    log_profile: Float[np.ndarray, "n w"]
    room_index: Int[np.ndarray, "n"]
    kind: UInt8[np.ndarray, "n w"] | None = None
    seen: SeenThrough | None = None

    def __len__(self) -> int:
        return len(self.room_index)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        kind = 0 if self.kind is None else self.kind.nbytes
        return self.log_profile.nbytes + self.room_index.nbytes + kind + (0 if self.seen is None else self.seen.nbytes)

    def rows(self, index: Int[np.ndarray, "m"]) -> Layouts:
        """Return the layouts of some poses, by their numbers in rising order."""
        seen = self.seen
        if seen is not None:
            place = np.searchsorted(index, seen.row)
            kept = np.flatnonzero(index[np.minimum(place, len(index) - 1)] == seen.row)
            seen = replace(seen.chosen(kept), row=place[kept])
        kind = None if self.kind is None else self.kind[index]
        return Layouts(self.log_profile[index], self.room_index[index], kind, seen)

    def thinned(self, stride: int) -> Layouts:
        """Return the layouts at every azimuth whose column is a multiple of `stride`."""
        seen = self.seen
        if seen is not None:
            seen = seen.chosen(np.flatnonzero(seen.column % stride == 0))
            seen = replace(seen, column=seen.column // stride)
        kind = None if self.kind is None else self.kind[:, ::stride]
        return Layouts(np.ascontiguousarray(self.log_profile[:, ::stride]), self.room_index, kind, seen)


def layouts_at(plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "n"], columns: int) -> Layouts:
    """Render the layouts of poses at some headings (radians); openings are seen from the plan's camera height."""
    if not plan.opening_faces:
        profile_m = profiles_at(plan, poses.position_m, poses.room_index, heading, columns, np.float32)
        return Layouts(np.log(profile_m), poses.room_index)
    swept = sweep_layouts(poses.position_m, heading, poses.room_index, plan.wall_table, columns, plan.camera_height_m)
    behind = swept.row, swept.column, swept.kind[swept.row, swept.column], np.log(swept.behind_m)
    seen = SeenThrough(*behind) if len(swept.row) else None
    return Layouts(np.log(swept.distance_m), poses.room_index, swept.kind, seen)


def layouts_of_plans(plans: Sequence[FloorPlan], poses: Sequence[PoseSet], columns: int) -> list[Layouts]:
    """Render poses of several plans at heading 0 in one pass; the layouts of each plan are those of `layouts_at`.

    The cost of a pass hardly depends on the number of poses while they are few, as in small plans.
    """
    tables = [plan.wall_table for plan in plans]
    rooms = np.cumsum([0, *(len(plan.rooms) for plan in plans)])
    first = np.cumsum([0, *map(len, poses)])
    eye_m = np.repeat([plan.camera_height_m for plan in plans], [len(table.sill_m) for table in tables])
    position_m = np.concatenate([part.position_m for part in poses])
    room_index = np.concatenate([part.room_index + shift for part, shift in zip(poses, rooms, strict=False)])
    heading, walls = np.zeros(len(position_m)), WallTable.joined(tables)
    swept = sweep_layouts(position_m, heading, room_index, walls, columns, eye_m)
    log_profile, log_behind = np.log(swept.distance_m), np.log(swept.behind_m)
    kind, through = swept.kind[swept.row, swept.column], np.searchsorted(swept.row, first)
    layouts = []
    for number, (plan, part) in enumerate(zip(plans, poses, strict=True)):
        own, seen = slice(first[number], first[number + 1]), slice(through[number], through[number + 1])
        if not plan.opening_faces:
            layouts.append(Layouts(log_profile[own], part.room_index))
            continue
        behind = swept.row[seen] - own.start, swept.column[seen], kind[seen], log_behind[seen]
        ways = SeenThrough(*behind) if len(behind[0]) else None
        layouts.append(Layouts(log_profile[own], part.room_index, swept.kind[own], ways))
    return layouts


def joined_layouts(parts: Sequence[Layouts], room_index: Int[np.ndarray, "n"]) -> Layouts:
    """Concatenate layouts, with new room numbers."""
    log_profile = np.concatenate([part.log_profile for part in parts])
    if all(part.kind is None for part in parts):
        return Layouts(log_profile, room_index)
    kind = np.full(log_profile.shape, WALL_CODE, np.uint8)
    first, seen = 0, []
    for part in parts:
        if part.kind is not None:
            kind[first : first + len(part)] = part.kind
        if part.seen is not None:
            seen.append(replace(part.seen, row=part.seen.row + first))
        first += len(part)
    if not seen:
        return Layouts(log_profile, room_index, kind)
    through = zip(*(vars(part).values() for part in seen), strict=True)
    return Layouts(log_profile, room_index, kind, SeenThrough(*map(np.concatenate, through)))


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
