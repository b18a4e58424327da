"""2-D iterative closest point, the paper's baseline on depth (section A.3, "Iterative Closest Point Baseline").

A horizontal laser scan at the camera is aligned with points along the walls of the plan, from every pose of the grid at
once. The alignment with the lowest root mean square distance is the answer. The plan's cloud is merged by finer cells
than the paper's 5 cm (`IcpConfig.plan_cell_m`). Choices that the paper leaves open:

* The scan is the rows of the depth image nearest the horizon, above most furniture; projecting all rows between floor
  and ceiling would take furniture for walls.
* The plan's cloud has the walls of all rooms, for points seen through open doors.
* The heading must be known; the alignment refines it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
from cachetools import LRUCache, cachedmethod
from jaxtyping import Float
from scipy.spatial import KDTree

from lalaloc_core.conventions import column_azimuths, row_elevations, wrap_angle
from lalaloc_core.errors import InvalidInputError
from lalaloc_core.evaluate.methods.method import GRIDS_CACHED, Answer, Pose, Question
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.search.pipeline import StageClock


@dataclass(frozen=True, kw_only=True)
class IcpConfig:
    """Settings; the defaults are the paper's where it names them.

    Attributes:
        cell_m: side of the cells in which points of the scan are merged.
        plan_cell_m: the same for the plan's cloud. Cells as coarse as the scan's pull points along their own wall,
            which costs most of a centimetre.
        still_m, still_iterations: an alignment converges after this many successive updates of less than `still_m`.
        columns: rays of the scan of a layout query.
    """

    cell_m: float = 0.05
    plan_cell_m: float = 0.02
    max_iterations: int = 50
    still_m: float = 1e-5
    still_iterations: int = 3
    spacing_m: float = 0.002
    columns: int = 1024


@dataclass(frozen=True, eq=False)
class Alignment:
    """Alignments by start: `x_plan = R(turn) x_scan + shift`, turns counter-clockwise.

    `rms_m` is the root mean square distance of the scan's points to the plan's cloud.
    """

    turn: Float[np.ndarray, "k"]
    shift_m: Float[np.ndarray, "k 2"]
    rms_m: Float[np.ndarray, "k"]


class Icp:
    """Method that aligns the scan of a question: the true layout or the furnished room's depth."""

    def __init__(self) -> None:
        self.config = IcpConfig()
        self._trees: LRUCache[Any, KDTree] = LRUCache(GRIDS_CACHED)

    @cachedmethod(attrgetter("_trees"), key=lambda _, question: question.plan)
    def _tree(self, question: Question) -> KDTree:
        return KDTree(wall_cloud(question.plan, self.config))

    def locate(self, question: Question) -> Answer:
        """Align the scan from every pose of the grid.

        An alignment that ends outside all rooms belongs to the room of its start. A photograph without valid depth has
        no answer.
        """
        if not question.heading_known:
            raise InvalidInputError("method 'icp' needs the heading; run it with a known heading")
        plan, clock = question.plan, StageClock()
        tree = self._tree(question)
        points = self._scan(question)
        if len(points) == 0:
            return Answer()
        with clock.stage("icp"):
            scan = merge_cells(points, self.config.cell_m)
            aligned = align(scan, tree, question.grid.position_m, self.config)
            best = int(aligned.rms_m.argmin())
        position = aligned.shift_m[best]
        room = int(plan.room_index_at(position[None])[0])
        room = room if room >= 0 else int(question.grid.room_index[best])
        # Turns are counter-clockwise, azimuths clockwise.
        heading = float(wrap_angle(question.camera.heading - aligned.turn[best]))
        found = Pose.at(position, room, heading, float(aligned.rms_m[best]))
        return Answer(stages={"icp": found}, timings_ms=clock.timings_ms)

    def _scan(self, question: Question) -> Float[np.ndarray, "n 2"]:
        if question.kind == "layout":
            return scan_of(question.true_profile(self.config.columns)[None], 0.0)
        depth = question.require_photograph().depth_m()
        rows = len(depth)
        horizon = slice((rows - 1) // 2, rows // 2 + 1)
        return scan_of(depth[horizon] * np.cos(row_elevations(rows)[horizon, None]), question.camera.heading)


def scan_of(distance_m: Float[np.ndarray, "r w"], heading: float) -> Float[np.ndarray, "n 2"]:
    """Return points (m) at horizontal distances from the camera, one column per azimuth, without NaN."""
    azimuth = heading + column_azimuths(distance_m.shape[1])
    points = distance_m[..., None] * np.stack([np.sin(azimuth), np.cos(azimuth)], axis=-1)
    return points[np.isfinite(distance_m)]


def wall_cloud(plan: FloorPlan, config: IcpConfig) -> Float[np.ndarray, "n 2"]:
    """Return points (m) along the walls of all rooms, merged by cells."""
    walls = np.concatenate([room.walls_m for room in plan.rooms])
    lengths = np.linalg.norm(walls[:, 2:] - walls[:, :2], axis=1)
    parts = []
    for wall, length in zip(walls, lengths, strict=True):
        count = math.ceil(length / config.spacing_m)
        share = (np.arange(count) + 0.5)[:, None] / count
        parts.append(wall[:2] + share * (wall[2:] - wall[:2]))
    return merge_cells(np.concatenate(parts), config.plan_cell_m)


def merge_cells(points_m: Float[np.ndarray, "n 2"], cell_m: float) -> Float[np.ndarray, "m 2"]:
    """Return the mean of the points in each cell of a grid."""
    _, cell, count = np.unique(np.floor(points_m / cell_m), axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    sums = [np.bincount(cell, weights=points_m[:, axis], minlength=len(count)) for axis in (0, 1)]
    return np.stack(sums, axis=1) / count[:, None]


def align(
    scan_m: Float[np.ndarray, "n 2"], tree: KDTree, starts_m: Float[np.ndarray, "k 2"], config: IcpConfig
) -> Alignment:
    """Align a scan with a cloud from several starting positions, without an initial turn.

    Each update pairs every point of the scan with its nearest in the cloud and moves the scan to the minimum of the
    summed squared distances of the pairs.
    """
    turn, shift = np.zeros(len(starts_m)), starts_m.astype(float)
    still = np.zeros(len(starts_m), dtype=int)
    active = np.arange(len(starts_m))
    for _ in range(config.max_iterations):
        _, nearest = tree.query(_moved(scan_m, turn[active], shift[active]))
        turn[active], moved = best_motion(scan_m, tree.data[nearest])
        step = np.linalg.norm(moved - shift[active], axis=1)
        shift[active] = moved
        still[active] = np.where(step < config.still_m, still[active] + 1, 0)
        active = active[still[active] < config.still_iterations]
        if len(active) == 0:
            break
    distance, _ = tree.query(_moved(scan_m, turn, shift))
    return Alignment(turn, shift, np.sqrt(np.square(distance).mean(axis=1)))


def best_motion(
    scan_m: Float[np.ndarray, "n 2"], targets_m: Float[np.ndarray, "k n 2"]
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k 2"]]:
    """Return the turns and shifts that best align a scan with its targets (the Kabsch algorithm in 2-D)."""
    scan_mean, target_mean = scan_m.mean(axis=0), targets_m.mean(axis=1)
    centred = scan_m - scan_mean
    along = np.einsum("ni,kni->k", centred, targets_m)
    across = np.einsum("ni,kni->k", np.stack([-centred[:, 1], centred[:, 0]], axis=1), targets_m)
    turn = np.arctan2(across, along)
    return turn, target_mean - _rotated(scan_mean[None], turn)[:, 0]


def _moved(
    scan_m: Float[np.ndarray, "n 2"], turn: Float[np.ndarray, "k"], shift_m: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "k n 2"]:
    return _rotated(scan_m, turn) + shift_m[:, None, :]


def _rotated(points_m: Float[np.ndarray, "n 2"], turn: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k n 2"]:
    cosine, sine = np.cos(turn)[:, None], np.sin(turn)[:, None]
    x, y = points_m[:, 0], points_m[:, 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
