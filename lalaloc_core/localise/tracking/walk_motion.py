"""Motion of a camera between two photographs: odometry, and the belief after it.

Nobody walks through walls, so a pose of the grid can move to those that are reachable by short links alone; after a way
of many links, to all poses of the plan. Two poses are linked if they are neighbours and see each other: the wall
profile of the first, or what it sees through a door or a passage, reaches as far as the second. Links join poses of one
plan; `tracked_plans.py` has the ways between plans.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import block_diag, coo_array, csr_array, eye_array

from lalaloc_core.conventions import PASSAGE_CODE, TWO_PI, WALL_CODE, WINDOW_CODE, wrap_angle
from lalaloc_core.errors import InvalidMotionError
from lalaloc_core.localise.match import Layouts
from lalaloc_core.render.sampling import PoseSet

MAX_STEP_M = 50.0
MAX_TURN = 2.0 * TWO_PI
_MAX_STD_M, _MAX_TURN_STD = 50.0, TWO_PI
# Smallest deviations: measurements are never exact.
_MIN_STD_M, _MIN_TURN_STD = 0.01, math.radians(0.5)
# Errors of odometry whose deviations are not stated: shares of the distance and radians per metre, and what is added.
_DRIFT, _LEAST_M, _TURN_PER_M, _LEAST_TURN = 0.05, 0.02, math.radians(2.0), math.radians(1.0)
# Rounding of correlations in requests.
_ROUNDING = 1e-6
# Longest link, in steps of the grid, and how much farther (m) than a wall two linked poses may be apart: walls are
# thick, and a profile is that of the nearest column.
_LINK_STEPS, _SLACK_M = 1.5, 0.15
# Two rooms on both sides of an open passage or door can be this far (m) apart.
_DOORWAY_M = 1.2
# Deviation of a grid pose from the camera along any direction, as a share of the grid's step.
_OFF_GRID = 0.4
# Residuals beyond which a pair of poses is left out.
_MAX_DEVIATIONS = 3.0
# A motion longer than this many links does not respect walls: the way is not known.
MAX_HOPS = 10
# Without odometry: distance (m) walked and deviation of the turn (radians) between two photographs.
STROLL_M, _STROLL_TURN = 2.0, math.radians(60.0)
# Probability that odometry is wrong about a motion.
_SLIP = 0.02
# Pairs of a state and a reachable pose that are weighed at once, and in all.
_PAIRS, _MAX_PAIRS = 1 << 20, 1 << 24


def usual_stds(length_m: float) -> tuple[float, float, float]:
    """Return the standard deviations (m, m, radians) of odometry over a distance, where none are stated."""
    std_m = _DRIFT * length_m + _LEAST_M
    return std_m, std_m, _TURN_PER_M * length_m + _LEAST_TURN


@dataclass(frozen=True, eq=False)
class Odometry:
    """Measured motion between two photographs, in the frame of the camera at the first one.

    Attributes:
        forward_m: displacement (m) along the first heading.
        right_m: displacement (m) to its right.
        turn: second heading minus the first (radians), clockwise.
        covariance: of (forward, right, turn), in m² and radians².
    """

    forward_m: float
    right_m: float
    turn: float
    covariance: Float[np.ndarray, "3 3"]

    def __post_init__(self) -> None:
        """Check the motion.

        Raises:
            InvalidMotionError: a value is not finite or beyond its limit, or the covariance is none.
        """
        values = {"forward_m": self.forward_m, "right_m": self.right_m, "turn": self.turn}
        for name, value in values.items():
            if not math.isfinite(value):
                raise InvalidMotionError(f"{name} is {value}; it must be a finite number")
        if math.hypot(self.forward_m, self.right_m) > MAX_STEP_M:
            raise InvalidMotionError(
                f"the motion is {math.hypot(self.forward_m, self.right_m):g} m long; the limit is {MAX_STEP_M:g} m "
                "between two photographs: check its unit, or omit the motion"
            )
        if abs(self.turn) > MAX_TURN:
            raise InvalidMotionError(
                f"the turn is {math.degrees(self.turn):g}°; the limit is {math.degrees(MAX_TURN):g}° either way: check "
                "its unit, or omit the motion"
            )
        least = np.diag(np.square([_MIN_STD_M, _MIN_STD_M, _MIN_TURN_STD]))
        covariance = _checked_covariance(np.asarray(self.covariance, dtype=np.float64))
        object.__setattr__(self, "covariance", 0.5 * (covariance + covariance.T) + least)

    @classmethod
    def of_stds(cls, forward_m: float, right_m: float, turn: float, stds: tuple[float, float, float]) -> Odometry:
        """Return a motion with independent errors, given the standard deviations (m, m, radians)."""
        for name, value in zip(("forward_std_m", "right_std_m", "turn_std"), stds, strict=True):
            if not value >= 0.0:
                raise InvalidMotionError(f"{name} is {value:g}; it must not be negative")
        return cls(forward_m, right_m, turn, np.diag(np.square(stds)))

    @property
    def components(self) -> dict[str, float]:
        """Values of the motion by name, the turn in degrees."""
        return {"forward_m": self.forward_m, "right_m": self.right_m, "turn_deg": math.degrees(self.turn)}

    @property
    def displacement_m(self) -> Float[np.ndarray, "2"]:
        """(forward, right) in metres."""
        return np.array([self.forward_m, self.right_m])

    @property
    def turn_std(self) -> float:
        """Standard deviation (radians) of the turn."""
        return math.sqrt(self.covariance[2, 2])


def _checked_covariance(covariance: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """Return the covariance of a motion (m², radians²)."""
    if covariance.shape != (3, 3) or not np.isfinite(covariance).all():
        raise InvalidMotionError("covariance must have 3 rows of 3 finite numbers")
    variance = np.diagonal(covariance)
    if (variance < 0.0).any():
        raise InvalidMotionError(
            f"covariance has the variances {', '.join(f'{value:g}' for value in variance)}; "
            "a variance must not be negative"
        )
    scale = np.sqrt(np.maximum(variance, 1e-12))
    normed = covariance / np.outer(scale, scale)
    if (apart := float(np.abs(normed - normed.T).max())) > _ROUNDING:
        raise InvalidMotionError(
            f"covariance is not symmetric: correlations differ from their mirror images by {apart:.3g}; send rows in "
            "the order forward_m, right_m, turn_deg"
        )
    if (lowest := float(np.linalg.eigvalsh(normed).min())) < -_ROUNDING:
        raise InvalidMotionError(
            f"covariance is not positive semidefinite: the smallest eigenvalue of its correlations is {lowest:.3g}, "
            "the limit is 0; check its units, or send standard deviations"
        )
    for name, std, limit, unit in zip(
        ("forward_m", "right_m", "turn_deg"),
        (*np.sqrt(variance[:2]), math.degrees(math.sqrt(variance[2]))),
        (_MAX_STD_M, _MAX_STD_M, math.degrees(_MAX_TURN_STD)),
        (" m", " m", "°"),
        strict=True,
    ):
        if std > limit:
            raise InvalidMotionError(
                f"the deviation of {name} is {std:g}{unit}; the limit is {limit:g}{unit}: omit the motion"
            )
    return covariance


def axes(heading: Float[np.ndarray, "*k"]) -> Float[np.ndarray, "*k 2 2"]:
    """Return the directions forward and right of headings in the plan frame, as columns."""
    sine, cosine = np.sin(heading), np.cos(heading)
    return np.stack([np.stack([sine, cosine], axis=-1), np.stack([cosine, -sine], axis=-1)], axis=-2)


@dataclass(frozen=True, eq=False)
class WalkGraph:
    """Poses of one grid, or of the grids of several plans in a row, and the short links that can be walked.

    Attributes:
        position_m: (n, 2) positions in the frames of their own plans.
        links: (n, n) ones between linked poses, and on the diagonal.
        first: (p + 1,) number of the first pose of each plan, and that of poses.
    """

    position_m: Float[np.ndarray, "n 2"]
    links: csr_array
    step_m: float
    first: Int[np.ndarray, "_"]

    @classmethod
    def of(cls, poses: PoseSet, layouts: Layouts, step_m: float) -> WalkGraph:
        """Link the poses of a plan's grid, given their layouts."""
        # Imported late: it takes as long as a query, and only tracking needs it.
        from scipy.spatial import KDTree

        count, position = len(poses), poses.position_m
        reach_m = max(_LINK_STEPS * step_m, _DOORWAY_M)
        pair = KDTree(position).query_pairs(reach_m, output_type="ndarray")
        both = np.concatenate([pair, pair[:, ::-1]])
        kept = _seen(position, poses.room_index, layouts, both[:, 0], both[:, 1], step_m)
        rows, columns = both[kept].T
        linked = coo_array((np.ones(len(rows), np.float32), (rows, columns)), shape=(count, count)).tocsr()
        # Who sees is seen.
        links = csr_array(linked + linked.T + eye_array(count, format="csr"))
        links.data = np.ones(links.nnz, np.float32)
        return cls(position, links, step_m, np.array([0, count]))

    @classmethod
    def joined(cls, graphs: Sequence[WalkGraph]) -> WalkGraph:
        """Return the graphs of several plans as one; no link leads from plan to plan."""
        first = np.cumsum([0, *(len(graph.position_m) for graph in graphs)])
        links = csr_array(block_diag([graph.links for graph in graphs], format="csr"))
        return cls(np.concatenate([graph.position_m for graph in graphs]), links, graphs[0].step_m, first)

    def plan_of(self, pose: Int[np.ndarray, "m"]) -> Int[np.ndarray, "m"]:
        """Return the number of each pose's plan."""
        return np.searchsorted(self.first, pose, side="right") - 1

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(part.nbytes for part in (self.position_m, self.links.data, self.links.indices, self.links.indptr))

    def reachable(self, pose: Int[np.ndarray, "a"], distance_m: float) -> csr_array:
        """Return ones (a, n) at the poses within a walk of about a distance (m) from some poses."""
        return self.spread(csr_array(self.links[pose]), max(math.ceil(distance_m / self.step_m), 1) - 1)

    def spread(self, reached: csr_array, hops: int) -> csr_array:
        """Return ones (a, n) at the poses within some links of those with ones."""
        for _ in range(hops):
            reached = csr_array(reached @ self.links)
            reached.data[:] = 1.0
        return reached


def _seen(
    position_m: Float[np.ndarray, "n 2"],
    room_index: Int[np.ndarray, "n"],
    layouts: Layouts,
    first: Int[np.ndarray, "p"],
    second: Int[np.ndarray, "p"],
    step_m: float,
) -> np.ndarray:
    """Return whether each second pose can be seen from the first and is near enough for a link."""
    columns = layouts.log_profile.shape[1]
    apart = position_m[second] - position_m[first]
    distance = np.hypot(apart[:, 0], apart[:, 1])
    # The centre column of a layout at heading 0 looks along azimuth 0.
    azimuth = np.arctan2(apart[:, 0], apart[:, 1])
    column = np.minimum(((azimuth / TWO_PI + 0.5) * columns).astype(int), columns - 1)
    wall_m = np.exp(layouts.log_profile[first, column].astype(np.float32))
    same = room_index[first] == room_index[second]
    near = distance <= _LINK_STEPS * step_m + 1e-6
    inside = same & near & (distance <= wall_m + _SLACK_M)
    return inside | (~same & _through_opening(layouts, first, column, distance, wall_m))


def _through_opening(
    layouts: Layouts,
    first: Int[np.ndarray, "p"],
    column: Int[np.ndarray, "p"],
    distance: Float[np.ndarray, "p"],
    wall_m: Float[np.ndarray, "p"],
) -> np.ndarray:
    """Return whether the way to a pose of another room leads through a door or a passage."""
    if layouts.kind is None:
        # The plan shows no openings: rooms that touch are taken as open to each other.
        return distance <= wall_m + _DOORWAY_M / 2.0
    kind = layouts.kind[first, column]
    opened = (kind != WALL_CODE) & (kind != WINDOW_CODE)
    reach_m = wall_m + np.where(kind == PASSAGE_CODE, _DOORWAY_M, _DOORWAY_M / 1.5)
    return opened & (distance <= reach_m)


@dataclass(frozen=True, eq=False)
class States:
    """States of a belief: grid poses with sectors of the heading, and their probabilities."""

    pose: Int[np.ndarray, "m"]
    sector: Int[np.ndarray, "m"]
    weight: Float[np.ndarray, "m"]


def moved(graph: WalkGraph, states: States, sectors: int, odometry: Odometry | None) -> Float[np.ndarray, "n k"]:
    """Return the belief (n, k) over all poses and sectors of the heading after a motion.

    The sum is at most that of `states`: motions that lead into walls are improbable. Without odometry, a camera walks
    and turns by an unknown amount.
    """
    pose, place = np.unique(states.pose, return_inverse=True)
    belief = np.zeros((len(pose), sectors))
    np.add.at(belief, (place.ravel(), states.sector), states.weight)
    if odometry is None:
        return _strolled(graph, pose, belief) @ _turns(sectors, 0.0, _STROLL_TURN)
    turns = _turns(sectors, odometry.turn, odometry.turn_std)
    walked = _walked(graph, pose, belief, odometry) @ turns
    slipped = _strolled(graph, pose, belief.sum(axis=1, keepdims=True)) / sectors
    return (1.0 - _SLIP) * walked + _SLIP * slipped


def _turns(sectors: int, turn: float, std: float) -> Float[np.ndarray, "k l"]:
    """Return the probability of every sector after a turn, for every sector before."""
    spread = math.hypot(std, TWO_PI / sectors / math.sqrt(12.0))
    heading = np.arange(sectors) * (TWO_PI / sectors)
    off = wrap_angle(heading[None, :] - heading[:, None] - turn) / spread
    value = np.exp(-0.5 * np.square(off))
    return value / value.sum(axis=1, keepdims=True)


def _strolled(graph: WalkGraph, pose: Int[np.ndarray, "a"], belief: Float[np.ndarray, "a k"]) -> np.ndarray:
    """Return the belief if the camera walked a short way in any direction."""
    reach = graph.reachable(pose, STROLL_M)
    share = belief / np.maximum(np.diff(reach.indptr), 1)[:, None]
    return reach.T @ share


def _walked(
    graph: WalkGraph, pose: Int[np.ndarray, "a"], belief: Float[np.ndarray, "a k"], odometry: Odometry
) -> Float[np.ndarray, "n k"]:
    """Return the belief displaced by odometry, with the headings before the turn."""
    sectors, count = belief.shape[1], len(graph.position_m)
    heading = np.arange(sectors) * (TWO_PI / sectors)
    frame = axes(heading)
    target_m = frame @ odometry.displacement_m
    length_m = float(np.hypot(*odometry.displacement_m))
    # The heading is anywhere in its sector, which spreads places across the way.
    across = frame @ np.array([-odometry.right_m, odometry.forward_m])
    spread = np.einsum("ki,kj->kij", across, across) * (TWO_PI / sectors) ** 2 / 12.0
    off_grid = np.eye(2) * (_OFF_GRID * graph.step_m) ** 2
    covariance = frame @ odometry.covariance[:2, :2] @ frame.transpose(0, 2, 1) + spread + off_grid
    precision = np.linalg.inv(covariance)
    density = graph.step_m**2 / (TWO_PI * np.sqrt(np.linalg.det(covariance)))
    reach_m = length_m + _MAX_DEVIATIONS * math.sqrt(np.linalg.eigvalsh(covariance).max())
    row, sector = np.nonzero(belief)
    near = None
    if reach_m > MAX_HOPS * graph.step_m:
        # Anywhere in the plan.
        own = graph.plan_of(pose)
        begin, targets = graph.first[own][row], np.diff(graph.first)[own][row]
        # The least probable states are left out if there are too many pairs.
        kept = np.argsort(-belief[row, sector], kind="stable")
        kept = np.sort(kept[np.cumsum(targets[kept]) <= _MAX_PAIRS])
        row, sector, begin, targets = row[kept], sector[kept], begin[kept], targets[kept]
    else:
        near = graph.reachable(pose, reach_m)
        begin, targets = near.indptr[row], np.diff(near.indptr)[row]
    result = np.zeros(count * sectors)
    ends = np.cumsum(targets)
    first = 0
    while first < len(row):
        before = ends[first] - targets[first]
        last = max(int(np.searchsorted(ends, before + _PAIRS, side="right")), first + 1)
        part = slice(first, last)
        state = np.repeat(np.arange(first, last), targets[part])
        entry = np.arange(len(state)) - np.repeat(ends[part] - targets[part] - before, targets[part]) + begin[state]
        target = entry if near is None else near.indices[entry]
        k = sector[state]
        off = graph.position_m[target] - graph.position_m[pose[row[state]]] - target_m[k]
        form = precision[k]
        squared = (
            form[:, 0, 0] * off[:, 0] ** 2
            + 2.0 * form[:, 0, 1] * off[:, 0] * off[:, 1]
            + form[:, 1, 1] * off[:, 1] ** 2
        )
        kept = squared < _MAX_DEVIATIONS**2
        value = belief[row[state[kept]], k[kept]] * density[k[kept]] * np.exp(-0.5 * squared[kept])
        result += np.bincount(target[kept] * sectors + k[kept], value, minlength=len(result))
        first = last
    return result.reshape(count, sectors)
