"""Similarity of layouts: the four metrics of the paper's table "Layout-similarity metric", and retrieval by them.

Each grid class holds the layouts of one plan, one set of poses and one camera height at heading 0, and compares a query
with every pose. `SimilarityRetrieval` and `PoseOracle` use the true layout or pose: they bound every retrieval.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Literal

import numpy as np
from cachetools import LRUCache, cachedmethod
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.evaluate.methods.method import GRIDS_CACHED, Answer, Question, grid_key
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.search.pipeline import StageClock
from lalaloc_core.render.profile import back_project, layout_depth
from lalaloc_core.render.sampling import PoseSet
from lalaloc_core.render.sweep import profiles_at

LayoutMetric = Literal["edges", "depth", "relative-depth", "chamfer"]

# Deviation of a profile from a straight wall (radians) that counts as a corner; less is rounding.
_CORNER_BEND = 0.1
# Parts of a cloud that `ChamferGrid.nearest` adds one by one; most poses are excluded after the first.
_PARTS = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class Layout:
    """Layout seen from one place at heading 0, with its wall profile `profile_m`."""

    profile_m: Float[np.ndarray, "w"]
    camera_height_m: float
    ceiling_height_m: float

    def depth_m(self, rows: int) -> Float[np.ndarray, "{rows} w"]:
        """Return the layout depth (m), one column per entry of the profile."""
        heights = np.array([self.camera_height_m]), np.array([self.ceiling_height_m])
        return layout_depth(self.profile_m[None], *heights, rows)[0]


def true_layout(question: Question, columns: int) -> Layout:
    """Return the layout at the true pose, for layout queries and oracles."""
    return Layout(
        profile_m=question.true_profile(columns),
        camera_height_m=question.camera.camera_height_m,
        ceiling_height_m=question.ceiling_height_m,
    )


def layouts_at(
    plan: FloorPlan, poses: PoseSet, camera_height_m: float, columns: int, heading: float = 0.0
) -> tuple[Float[np.ndarray, "n {columns}"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return wall profiles, camera and ceiling heights (m) of poses with one heading."""
    rooms = poses.room_index
    profile = profiles_at(plan, poses.position_m, rooms, np.full(len(poses), heading), columns)
    return profile, np.full(len(poses), camera_height_m), plan.ceiling_heights_m[rooms]


class LayoutGrid(ABC):
    """Layouts of poses, compared with a query whose wall profile has `columns` columns."""

    columns: int

    @abstractmethod
    def distances(self, query: Layout) -> Float[np.ndarray, "n"]:
        """Return the distance of the query to every pose."""

    def nearest(self, query: Layout) -> int:
        """Return the index of the pose nearest to the query."""
        return int(self.distances(query).argmin())


class ChamferGrid(LayoutGrid):
    """Symmetric Chamfer distance (m) between back-projected point clouds, see `learn.metrics.chamfer_distance`."""

    def __init__(
        self, plan: FloorPlan, poses: PoseSet, camera_height_m: float, *, rows: int = 16, columns: int = 32
    ) -> None:
        self.columns = columns
        self._depth_m = layout_depth(*layouts_at(plan, poses, camera_height_m, columns), rows)
        self._clouds_m = back_project(self._depth_m)

    def distances(self, query: Layout) -> Float[np.ndarray, "n"]:
        """Return the distance of the query to every pose."""
        pair = _Comparison(self._depth_m, self._clouds_m, query)
        poses = np.arange(len(self._clouds_m))
        return pair.to_query(poses, slice(None)) + np.array([pair.from_query(int(index)) for index in poses])

    def nearest(self, query: Layout) -> int:
        """Return the index of the pose nearest to the query, without computing most of the distances.

        All terms of a Chamfer distance are non-negative, so a partial sum is a lower bound, and poses with a bound
        above the best distance are skipped. Cheap terms come first: distances to the query need one search tree,
        distances from it one for every pose.
        """
        pair = _Comparison(self._depth_m, self._clouds_m, query)
        bound = np.zeros(len(self._clouds_m))
        remaining = np.arange(len(bound))
        best, best_index = math.inf, -1
        for part in range(_PARTS):
            bound[remaining] += pair.to_query(remaining, slice(part, None, _PARTS))
            if part == 0:
                # The likely nearest pose gives a low first distance to compare with.
                best_index = int(remaining[bound[remaining].argmin()])
                best = pair.distance(best_index)
            remaining = remaining[bound[remaining] <= best]
        for index in remaining[np.argsort(bound[remaining], kind="stable")]:
            if bound[index] > best:
                break
            distance = bound[index] + pair.from_query(int(index))
            if distance < best:
                best, best_index = float(distance), int(index)
        return best_index


class _Comparison:
    """Comparison of one query with the clouds of a `ChamferGrid`.

    Pixels with equal depth in both are the same point of both clouds, with distance 0. At equal heights this holds for
    most of the floor and ceiling, which are skipped in the search.
    """

    def __init__(
        self, depth_m: Float[np.ndarray, "n h w"], clouds_m: Float[np.ndarray, "n h*w 3"], query: Layout
    ) -> None:
        query_depth_m = query.depth_m(depth_m.shape[1])
        self._clouds_m = clouds_m
        self._query_m = back_project(query_depth_m[None])[0]
        self._tree = KDTree(self._query_m)
        self._differs = (depth_m != query_depth_m).reshape(len(depth_m), -1)

    def distance(self, index: int) -> float:
        return float(self.to_query(np.array([index]), slice(None))[0]) + self.from_query(index)

    def to_query(self, poses: Int[np.ndarray, "k"], points: slice) -> Float[np.ndarray, "k"]:
        """Return the contribution of some points to the mean distance of poses' clouds to the query's."""
        differs = self._differs[poses, points]
        distance = np.zeros(differs.shape)
        distance[differs] = self._tree.query(self._clouds_m[poses, points][differs])[0]
        return distance.sum(axis=1) / self._differs.shape[1]

    def from_query(self, index: int) -> float:
        """Return the mean distance of the query's cloud to a pose's."""
        searched = self._query_m[self._differs[index]]
        return float(KDTree(self._clouds_m[index]).query(searched)[0].sum()) / len(self._query_m)


class DepthGrid(LayoutGrid):
    """Mean absolute difference of layout depth images, in metres or relative to each image's maximum."""

    def __init__(
        self,
        plan: FloorPlan,
        poses: PoseSet,
        camera_height_m: float,
        *,
        relative: bool = False,
        rows: int = 64,
        columns: int = 128,
    ) -> None:
        self.columns = columns
        self._relative = relative
        self._depth = self._scaled(layout_depth(*layouts_at(plan, poses, camera_height_m, columns), rows))

    def distances(self, query: Layout) -> Float[np.ndarray, "n"]:
        """Return the distance of the query to every pose."""
        depth = self._scaled(query.depth_m(self._depth.shape[1])[None])
        return np.abs(self._depth - depth).mean(axis=(1, 2), dtype=np.float64)

    def _scaled(self, depth_m: Float[np.ndarray, "n h w"]) -> Float[np.ndarray, "n h w"]:
        scale = depth_m.max(axis=(1, 2), keepdims=True) if self._relative else 1.0
        return (depth_m / scale).astype(np.float32)


class EdgeGrid(LayoutGrid):
    """2-D Chamfer distance (pixels) between the edges of layouts as spheres, which wrap around horizontally."""

    def __init__(
        self, plan: FloorPlan, poses: PoseSet, camera_height_m: float, *, rows: int = 64, columns: int = 128
    ) -> None:
        self.columns = columns
        self._rows = rows
        edges = edge_image(*layouts_at(plan, poses, camera_height_m, columns), rows).reshape(len(poses), -1)
        self._owner, self._pixel = np.nonzero(edges)
        self._count = edges.sum(axis=1)
        self._field = np.stack([distance_field(image.reshape(rows, columns)).ravel() for image in edges])

    def distances(self, query: Layout) -> Float[np.ndarray, "n"]:
        """Return the distance of the query to every pose."""
        heights = np.array([query.camera_height_m]), np.array([query.ceiling_height_m])
        edges = edge_image(query.profile_m[None], *heights, self._rows)[0]
        to_poses = self._field[:, edges.ravel()].mean(axis=1, dtype=np.float64)
        to_query = np.bincount(self._owner, weights=distance_field(edges).ravel()[self._pixel])
        return to_poses + to_query / self._count


def layout_grid(metric: LayoutMetric, plan: FloorPlan, poses: PoseSet, camera_height_m: float) -> LayoutGrid:
    """Return the grid that compares the poses of a plan with queries by a metric."""
    if metric in ("depth", "relative-depth"):
        return DepthGrid(plan, poses, camera_height_m, relative=metric == "relative-depth")
    return (ChamferGrid if metric == "chamfer" else EdgeGrid)(plan, poses, camera_height_m)


def edge_image(
    profile_m: Float[np.ndarray, "n w"],
    camera_height_m: Float[np.ndarray, "n"],
    ceiling_height_m: Float[np.ndarray, "n"],
    rows: int,
) -> Bool[np.ndarray, "n {rows} w"]:
    """Draw the edges of layouts: between walls, floor and ceiling, at corners and at occlusions."""

    def row_of(elevation: Float[np.ndarray, "n w"]) -> Int[np.ndarray, "n 1 w"]:
        return np.floor((0.5 - elevation / math.pi) * rows).astype(int)[:, None, :]

    top = row_of(np.arctan((ceiling_height_m - camera_height_m)[:, None] / profile_m))
    foot = row_of(-np.arctan(camera_height_m[:, None] / profile_m))
    row = np.arange(rows)[None, :, None]
    along = (row == top) | (row == foot)
    return along | (_corners(profile_m)[:, None, :] & (row >= top) & (row <= foot))


def distance_field(edges: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return the distance (pixels) of every pixel to the nearest edge, wrapping around; every column has an edge."""
    rows, columns = edges.shape
    # The edge in a pixel's own column is at most `rows` away, so the margin need not be wider.
    margin = min(rows, columns)
    around = np.pad(edges, ((0, 0), (margin, margin)), mode="wrap")
    distance = distance_transform_edt(~around)
    assert isinstance(distance, np.ndarray)
    return distance[:, margin : margin + columns].astype(np.float32)


def _corners(profile_m: Float[np.ndarray, "n w"]) -> Bool[np.ndarray, "n w"]:
    """Return the columns next to a corner or an occlusion.

    Along a straight wall the inverse distance is a cosine of azimuth, u(a + δ) + u(a - δ) = 2 cos δ u(a), which fails
    at corners and occlusions.
    """
    step = TWO_PI / profile_m.shape[1]
    inverse = 1.0 / profile_m
    neighbours = np.roll(inverse, 1, axis=1) + np.roll(inverse, -1, axis=1)
    return np.abs(neighbours - 2.0 * math.cos(step) * inverse) > _CORNER_BEND * step * inverse


class SimilarityRetrieval:
    """Retrieval of the grid pose whose layout is nearest the true layout (table "Layout-similarity metric").

    With Chamfer distance it is the paper's oracle: Layout R@1 counts its choice as right.
    """

    def __init__(self, metric: LayoutMetric = "chamfer") -> None:
        self.metric: LayoutMetric = metric
        self._grids: LRUCache[Any, LayoutGrid] = LRUCache(GRIDS_CACHED)

    def locate(self, question: Question) -> Answer:
        """Return the grid pose with the nearest layout."""
        grid = self._grid(question)
        clock = StageClock()
        with clock.stage("retrieve"):
            index = grid.nearest(true_layout(question, grid.columns))
        return _retrieved(question, index, clock)

    @cachedmethod(attrgetter("_grids"), key=grid_key)
    def _grid(self, question: Question) -> LayoutGrid:
        return layout_grid(self.metric, question.plan, question.grid, question.camera.camera_height_m)


class PoseOracle:
    """Retrieval of the grid pose nearest the true position: row "Pose" of the same table."""

    def locate(self, question: Question) -> Answer:
        """Return the nearest grid pose."""
        clock = StageClock()
        with clock.stage("retrieve"):
            index = int(np.linalg.norm(question.grid.position_m - question.camera.position_m, axis=1).argmin())
        return _retrieved(question, index, clock)


def _retrieved(question: Question, index: int, clock: StageClock) -> Answer:
    found = question.pose_of(question.grid, index)
    return Answer(stages={"retrieval": found}, retrieved=index, timings_ms=clock.timings_ms)
