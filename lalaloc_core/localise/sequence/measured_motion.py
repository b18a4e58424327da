"""Measured motions between two pictures, and the likelihood of pairs of poses.

With the displacement v from the first place to the second, the measured distance d, the turn τ (second heading minus
first, clockwise) and, if it was measured, the direction φ (of the displacement against the first heading)::

    r_turn = (heading' - heading - τ) / σ_τ
    r_dist = (‖v‖ - d) / σ_d                                      without a direction
    r_along = (v · u - d) / σ_d,  r_across = (v · u') / (d σ_φ)   with one, u along heading + φ and u' at right angles

and the likelihood is `exp(-½ Σ r²) + FLOOR`, as a measurement can be an outlier. Deviations are widened by the distance
of grid poses from the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import InvalidMotionError

# Likelihood of an outlier, in units of that of a perfect measurement.
FLOOR = 1e-4
# Residuals from here on are less likely than the floor.
_MAX_DEVIATIONS = math.sqrt(-2.0 * math.log(FLOOR))
MAX_DISTANCE_M = 1000.0
# Smallest deviations: exact measurements would leave no pair of grid poses.
MIN_DISTANCE_STD_M, MIN_ANGLE_STD = 1e-3, math.radians(0.01)
# Deviation of grid poses from the camera along any direction, as a share of the grid's step.
_OFF_GRID = 0.5
# Limits of pairs of places times headings that are compared for one motion, and of pairs of states that are kept. More
# take seconds and gigabytes, and come from very uncertain measurements.
_MAX_COMPARED, _MAX_KEPT = 64_000_000, 4_000_000
# Smallest sideways deviation, for short distances.
_MIN_ACROSS_STD_M = 0.05


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A measured motion; None stands for quantities that were not measured. Angles in radians.

    Attributes:
        distance_m: straight-line distance (m) between the two places.
        distance_std_m: its standard deviation (m).
        turn: heading of the second picture minus that of the first, clockwise.
        turn_std: its standard deviation.
        direction: azimuth of the displacement minus the heading of the first picture; requires the distance.
        direction_std: its standard deviation.
    """

    distance_m: float | None = None
    distance_std_m: float = 0.1
    turn: float | None = None
    turn_std: float = math.radians(5.0)
    direction: float | None = None
    direction_std: float = math.radians(5.0)

    def __post_init__(self) -> None:
        _check("distance_m", self.distance_m, 0.0, MAX_DISTANCE_M)
        _check("distance_std_m", self.distance_std_m, MIN_DISTANCE_STD_M, MAX_DISTANCE_M)
        for name in ("turn", "direction"):
            _check(name, getattr(self, name), -2.0 * math.tau, 2.0 * math.tau)
            _check(f"{name}_std", getattr(self, f"{name}_std"), MIN_ANGLE_STD, math.tau)
        if self.direction is not None and self.distance_m is None:
            raise InvalidMotionError("direction is given without distance_m: give both or neither")

    @property
    def is_unknown(self) -> bool:
        """True if nothing was measured."""
        return self.distance_m is None and self.turn is None

    @property
    def across_std_m(self) -> float:
        """Deviation (m) at right angles to the measured direction."""
        assert self.distance_m is not None
        return max(self.distance_m * self.direction_std, _MIN_ACROSS_STD_M)


def _check(name: str, value: float | None, least: float, most: float) -> None:
    if value is not None and not least <= value <= most:
        raise InvalidMotionError(f"{name} is {value:g}; it must be between {least:g} and {most:g}")


@dataclass(frozen=True, eq=False)
class States:
    """States of a picture: every pose under every hypothesis of the heading.

    `heading` is that of the photograph (radians); each stands for an angle of `sector`, 0 if the heading is known.
    """

    position_m: Float[np.ndarray, "n 2"]
    heading: Float[np.ndarray, "k"]
    sector: float


@dataclass(frozen=True, eq=False)
class Transition:
    """Likelihood of all pairs of states of two pictures.

    Attributes:
        places: (n', n) likelihoods of pairs of places without the floor; if directed, (n' k, n k) of pairs of states
            with the first heading, in row-major order. None: all equal.
        turns: (k, k') likelihoods of pairs of headings; None: all equal.
        sizes: n, k, n' and k'.
        floor: likelihood added to every pair.
        is_directed: whether pairs of places depend on the first heading.
    """

    places: csr_array | None
    turns: Float[np.ndarray, "k l"] | None
    sizes: tuple[int, int, int, int]
    floor: float
    is_directed: bool = False

    def likelihood(self, first: int, second: int) -> float:
        """Return the likelihood of a pair of states, by row-major numbers, without the floor."""
        _, k, _, after = self.sizes
        (i, a), (j, b) = divmod(first, k), divmod(second, after)
        turned = 1.0 if self.turns is None else float(self.turns[a, b])
        if self.places is None:
            return turned
        return turned * float(self.places[j * k + a, first] if self.is_directed else self.places[j, i])

    def among(self, first: np.ndarray, second: np.ndarray) -> Transition:
        """Return the transition between some of the poses, by their numbers."""
        _, k, _, after = self.sizes
        places = self.places
        if places is not None:
            rows, columns = second, first
            if self.is_directed:
                rows, columns = (_states(index, k) for index in (second, first))
            places = places[rows][:, columns]
        return Transition(places, self.turns, (len(first), k, len(second), after), self.floor, self.is_directed)


def _states(poses: np.ndarray, headings: int) -> np.ndarray:
    return (poses[:, None] * headings + np.arange(headings)).ravel()


def transition(motion: Motion, first: States, second: States, step_m: float) -> Transition:
    """Return the transition of a motion between pictures whose states are grid poses.

    `step_m` is the step of the grid.
    """
    sizes = len(first.position_m), len(first.heading), len(second.position_m), len(second.heading)
    turns = None
    if motion.turn is not None:
        spread = math.sqrt(motion.turn_std**2 + (first.sector**2 + second.sector**2) / 12.0)
        off = wrap_angle(second.heading[None, :] - first.heading[:, None] - motion.turn)
        turns = np.exp(-0.5 * np.square(off / spread))
    floor = 0.0 if motion.is_unknown else FLOOR
    if motion.distance_m is None:
        return Transition(None, turns, sizes, floor)
    off_m = _OFF_GRID * step_m
    pairs = _pairs_at_distance(motion.distance_m, math.hypot(motion.distance_std_m, off_m), first, second)
    if motion.direction is not None:
        directed = _directed(motion, pairs, first, second, off_m)
        if directed is not None:
            return Transition(directed, turns, sizes, floor, is_directed=True)
    places = csr_array((np.exp(-0.5 * np.square(pairs.off)), (pairs.target, pairs.source)), shape=(sizes[2], sizes[0]))
    return Transition(places, turns, sizes, floor)


class _Pairs(NamedTuple):
    """Pairs of places: their numbers, the displacement (m), and the residual of its length."""

    source: Int[np.ndarray, "p"]
    target: Int[np.ndarray, "p"]
    moved_m: Float[np.ndarray, "p 2"]
    off: Float[np.ndarray, "p"]


def _pairs_at_distance(distance_m: float, std_m: float, first: States, second: States) -> _Pairs:
    """Return the pairs of places at about a distance (m)."""
    # Imported late: few programs that load this module need it, and it takes as long as a query.
    from scipy.spatial import KDTree

    near = KDTree(second.position_m).query_ball_point(first.position_m, distance_m + _MAX_DEVIATIONS * std_m)
    count = np.array([len(targets) for targets in near])
    source = np.repeat(np.arange(len(near)), count)
    target = np.concatenate([np.asarray(targets, dtype=int) for targets in near]) if count.any() else np.empty(0, int)
    moved_m = second.position_m[target] - first.position_m[source]
    off = (np.hypot(moved_m[:, 0], moved_m[:, 1]) - distance_m) / std_m
    kept = np.abs(off) < _MAX_DEVIATIONS
    return _Pairs(source[kept], target[kept], moved_m[kept], off[kept])


def _directed(motion: Motion, pairs: _Pairs, first: States, second: States, off_m: float) -> csr_array | None:
    """Return likelihoods of pairs of states with the first heading; None if there are too many.

    The chain then uses the distance alone; joint refinement still uses the direction.
    """
    headings = len(first.heading)
    if len(pairs.source) * headings > _MAX_COMPARED:
        return None
    assert motion.distance_m is not None
    assert motion.direction is not None
    along_std = math.hypot(motion.distance_std_m, off_m)
    across_std = math.sqrt(motion.across_std_m**2 + off_m**2 + (motion.distance_m * first.sector) ** 2 / 12.0)
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    found = 0
    for k, heading in enumerate(first.heading):
        ahead = np.array([math.sin(heading + motion.direction), math.cos(heading + motion.direction)])
        along = (pairs.moved_m @ ahead - motion.distance_m) / along_std
        across = (pairs.moved_m[:, 0] * ahead[1] - pairs.moved_m[:, 1] * ahead[0]) / across_std
        squared = np.square(along) + np.square(across)
        kept = squared < _MAX_DEVIATIONS**2
        found += int(kept.sum())
        if found > _MAX_KEPT:
            return None
        parts.append(
            (np.exp(-0.5 * squared[kept]), pairs.target[kept] * headings + k, pairs.source[kept] * headings + k)
        )
    value, row, column = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return csr_array(
        (value, (row, column)), shape=(len(second.position_m) * headings, len(first.position_m) * headings)
    )
