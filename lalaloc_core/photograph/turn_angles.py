"""Angles of photographs of one spot by what they show twice: a bundle adjustment of rotations that tolerates parallax.

The unknowns are heading, pitch and roll of each photograph, and one factor of all focal lengths. Hands move a camera on
a circle of the arm's length, looking outwards, so near things move against far ones. With the rays a and b of a match,
the camera's centres c on a circle of radius 1, and the distance 1 / ρ of the thing::

    R_i^T a - R_j^T b = ρ (c_j - c_i) + noise,   ρ ~ N(ρ0, s²)

The unknown ρ adds a bias and a variance along the camera's displacement and none across it. A bundle adjustment without
it, such as OpenCV's, explains parallax by a focal length that is 10 to 20 % too long. Straight lines of the room give
each photograph a heading against the walls, which parallax does not touch, and its tilt (`levelling.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conventions import unit_rays, wrap_angle
from lalaloc_core.photograph.cameras import Camera, Perspective, level_axes
from lalaloc_core.photograph.levelling import Attitude, estimate_attitude, lines_of
from lalaloc_core.photograph.overlap import (
    Features,
    Link,
    Step,
    agreeing_links,
    find_links,
    grouped,
    headings_in_order,
    usual_steps,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Standard deviation (radians) of the ray of a match, and residual beyond which it counts less and less.
_RAY_SD, _OUTLIER = 0.006, 3.0
# Nearness ρ: spread among the matches of a turn; mean and spread of the mean over turns.
_NEARNESS_SD, _NEARNESS = 0.1, (0.12, 0.1)
# Least standard deviation (radians) of the heading by lines, and the largest that counts.
_LINES_SD, _MAX_LINES_SD = math.radians(0.5), math.radians(3.0)
# Standard deviation of angles: that of the fit times the factor, and at least so much (radians).
_SD_FACTOR, _SD_FLOOR = 1.5, math.radians(0.3)
# Links that the fit misses by more (radians) are wrong.
_MISSED = math.radians(12.0)
# Fits, each without the links that the one before misses.
_ROUNDS = 3
# Levenberg-Marquardt: steps, damping, fall of the cost that ends it, and steps of numeric derivatives.
_MAX_STEPS, _FIRST_DAMPING, _MAX_DAMPING, _LITTLE, _STEP = 30, 1e-3, 1e6, 1e-5, 1e-6
# Standard deviation of exact values.
_EXACT = 1e-4
_QUARTER = 0.5 * math.pi


@dataclass(frozen=True, eq=False)
class Overview:
    """Parts of a picture that tell its angles: its features and straight lines.

    Attributes:
        segments: (n, 4) ends of its straight lines, as shares of width and height.
        attitude: tilt by these lines, with the photograph's own camera; None to estimate it with another.
        picture: (h, w, 3) the upright picture, small, that patches are still to be cut from; None if they were cut.
    """

    features: Features
    segments: Float[np.ndarray, "n 4"]
    attitude: Attitude | None = None
    picture: UInt8[np.ndarray, "h w 3"] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class TurnView:
    """Photograph of a turn.

    Attributes:
        focal_sd: relative standard deviation of the camera's focal length; 0: it is kept.
        pitch, roll: stated tilt, radians; None if unknown.
    """

    overview: Overview
    camera: Camera
    focal_sd: float
    pitch: float | None = None
    roll: float | None = None


@dataclass(frozen=True, kw_only=True)
class TurnAngles:
    """Angles of a photograph of a turn, radians.

    Attributes:
        group: number of the group of photographs that overlap, directly or by others.
        heading: heading minus that of the first photograph of the group.
        focal_sd: relative standard deviation of the resulting focal length.
        is_assumed: the heading does not follow from overlap with the most photographs of the group, but from the order.
    """

    group: int
    heading: float
    heading_sd: float
    attitude: Attitude
    focal_factor: float = 1.0
    focal_sd: float = 0.0
    is_assumed: bool = False


def angles_of_turn(views: Sequence[TurnView], steps: Sequence[Step] | None = None) -> list[TurnAngles]:
    """Return the angles of photographs of one spot, in the order in which they were taken.

    Groups that do not overlap are joined by `steps` from each photograph to the next, by default by equal steps if the
    photographs go once around; see `usual_steps`.
    """
    attitudes = [_attitude_of(view) for view in views]
    cameras = [view.camera for view in views]
    links = find_links([view.overview.features for view in views], cameras, attitudes, np.random.default_rng(0))
    steps = steps or usual_steps(len(views), links)
    links = links if steps is None else agreeing_links(links, len(views), steps)
    found: list[TurnAngles] = []
    for _ in range(_ROUNDS):
        found = _fitted(views, attitudes, links)
        kept = [
            link
            for link in links
            if abs(wrap_angle(found[link.second].heading - found[link.first].heading - link.turn)) < _MISSED
        ]
        if len(kept) == len(links):
            break
        links = kept
    return found if steps is None else _joined(found, steps)


def _joined(found: list[TurnAngles], steps: Sequence[Step]) -> list[TurnAngles]:
    """Return the angles as one group."""
    group, heading = (np.array([getattr(angle, name) for angle in found]) for name in ("group", "heading"))
    if not group.any():
        return found
    turned, placed_sd = headings_in_order(group, heading, steps)
    return [
        replace(
            angle, group=0, heading=float(turn), heading_sd=math.hypot(angle.heading_sd, sd), is_assumed=bool(sd > 0.0)
        )
        for angle, turn, sd in zip(found, turned, placed_sd, strict=True)
    ]


def _fitted(views: Sequence[TurnView], attitudes: Sequence[Attitude], links: Sequence[Link]) -> list[TurnAngles]:
    """Return the angles by some links."""
    found: dict[int, TurnAngles] = {}
    for group, headings in enumerate(grouped(len(views), links)):
        members = sorted(headings)
        if len(members) == 1:
            found[members[0]] = TurnAngles(group=group, heading=0.0, heading_sd=0.0, attitude=attitudes[members[0]])
            continue
        number = {member: index for index, member in enumerate(members)}
        own = [
            replace(link, first=number[link.first], second=number[link.second])
            for link in links
            if link.first in headings
        ]
        fit = _Fit(own, [views[index] for index in members], [attitudes[index] for index in members])
        angles = fit.solve(np.array([headings[index] - headings[members[0]] for index in members]))
        found |= {index: replace(angle, group=group) for index, angle in zip(members, angles, strict=True)}
    return [found[index] for index in range(len(views))]


def _attitude_of(view: TurnView) -> Attitude:
    attitude, size = view.overview.attitude, (view.camera.width, view.camera.height)
    if attitude is None:
        attitude = estimate_attitude(lines_of(view.overview.segments * (*size, *size), view.camera))
    if view.pitch is not None:
        attitude = replace(attitude, pitch=view.pitch, pitch_sd=_LINES_SD)
    return attitude if view.roll is None else replace(attitude, roll=view.roll, roll_sd=_LINES_SD)


class _Fit:
    """Least squares for the angles of a group of photographs that overlap."""

    def __init__(self, links: Sequence[Link], views: Sequence[TurnView], attitudes: Sequence[Attitude]) -> None:
        self._count, self._attitudes = len(views), attitudes
        self._first, self._second = (
            np.repeat([getattr(link, name) for link in links], [link.rays.shape[1] for link in links])
            for name in ("first", "second")
        )
        self._rays = np.concatenate([link.rays for link in links], axis=1)
        self._tilt = np.array([[attitude.pitch, attitude.roll] for attitude in attitudes])
        self._tilt_sd = np.array([[attitude.pitch_sd, attitude.roll_sd] for attitude in attitudes])
        yaw_sd = np.maximum([attitude.yaw_sd for attitude in attitudes], _LINES_SD)
        self._lined = np.flatnonzero(yaw_sd < _MAX_LINES_SD)
        self._yaw, self._yaw_sd = np.array([attitude.yaw for attitude in attitudes]), yaw_sd
        stretches = all(isinstance(view.camera, Perspective) for view in views)
        # Photographs of one phone share the error of the field of view.
        self._focal_sd = max(float(np.median([view.focal_sd for view in views])) if stretches else 0.0, _EXACT)

    def solve(self, headings: Float[np.ndarray, "n"]) -> list[TurnAngles]:
        """Return the angles, from first headings."""
        values, information = self._minimised(self._start(headings))
        sd = _SD_FACTOR * np.sqrt(np.diag(np.linalg.inv(information)))
        angles, log_focal = self._angles(values), float(values[-3])
        angle_sd = np.maximum(sd[: 3 * self._count].reshape(-1, 3), _SD_FLOOR)
        # The headings of all change with that of the first, which is exact.
        return [
            TurnAngles(
                group=0,
                heading=float(wrap_angle(angles[index, 0])),
                heading_sd=float(angle_sd[index, 0]) if index else 0.0,
                attitude=Attitude(
                    pitch=float(angles[index, 1]),
                    roll=float(angles[index, 2]),
                    pitch_sd=float(angle_sd[index, 1]),
                    roll_sd=float(angle_sd[index, 2]),
                ),
                focal_factor=math.exp(log_focal),
                focal_sd=float(sd[-3]) if self._focal_sd > _EXACT else 0.0,
            )
            for index in range(self._count)
        ]

    def _start(self, headings: Float[np.ndarray, "n"]) -> Float[np.ndarray, "p"]:
        angles = np.column_stack([headings, self._tilt])
        walls = 0.0
        if len(self._lined):
            # Four times an angle, which repeats by a quarter turn, is an angle again.
            fold = np.exp(4j * (headings + self._yaw)[self._lined]) / self._yaw_sd[self._lined]
            walls = float(np.angle(fold.sum())) / 4.0
        return np.concatenate([angles.ravel(), [0.0, _NEARNESS[0], walls]])

    def _minimised(self, values: Float[np.ndarray, "p"]) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p p"]]:
        """Return the values of least cost near some values, and the information about them (Levenberg-Marquardt)."""
        # scipy's solvers of sparse problems stop far from the minimum here, and those of dense ones take minutes.
        damping, cost, information = _FIRST_DAMPING, self._cost(values), np.eye(len(values))
        for _ in range(_MAX_STEPS):
            residuals, slopes = self._residuals(values), self._jacobian(values)
            weight = _weights(residuals, 2 * len(self._first), len(self._lined))
            information = (slopes.T @ (slopes.multiply(weight[:, None]))).toarray()
            gradient = slopes.T @ (weight * residuals)
            step, better = np.zeros(0), math.inf
            while better >= cost and damping < _MAX_DAMPING:
                step = -np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
                better = self._cost(values + step)
                damping *= 0.1 if better < cost else 10.0
            if better >= cost:
                break
            values, fall, cost = values + step, cost - better, better
            if fall < _LITTLE * cost:
                break
        return values, information

    def _cost(self, values: Float[np.ndarray, "p"]) -> float:
        residuals, matches = self._residuals(values), 2 * len(self._first)
        square = np.square(residuals[:matches]).reshape(2, -1).sum(axis=0)
        lined = slice(-4 - len(self._lined), -4)
        return float(
            _OUTLIER**2
            * (np.log1p(square / _OUTLIER**2).sum() + np.log1p(np.square(residuals[lined]) / _OUTLIER**2).sum())
            + np.square(residuals[matches : lined.start]).sum()
            + np.square(residuals[-4:]).sum()
        )

    def _angles(self, values: Float[np.ndarray, "p"]) -> Float[np.ndarray, "n 3"]:
        return values[:-3].reshape(-1, 3)

    def _residuals(self, values: Float[np.ndarray, "p"]) -> Float[np.ndarray, "r"]:
        angles = self._angles(values)
        matches = self._match_residuals(angles[self._first], angles[self._second], values[-3], values[-2])
        return np.concatenate([matches, self._prior_residuals(values)])

    def _match_residuals(
        self, first: Float[np.ndarray, "m 3"], second: Float[np.ndarray, "m 3"], log_focal: float, nearness: float
    ) -> Float[np.ndarray, "r"]:
        """Return the residuals of all matches along the camera's displacement, then across it."""
        one, other = (
            np.einsum("mji,mj->mi", level_axes(angles), _stretched(rays, log_focal))
            for angles, rays in zip((first, second), self._rays, strict=True)
        )
        between = one + other
        between /= np.linalg.norm(between, axis=1, keepdims=True)
        # Cameras are on a circle of radius 1, and look outwards.
        start, end = (unit_rays(angles[:, 0], np.zeros(len(angles))) for angles in (first, second))
        moved = end - start
        moved -= (moved * between).sum(axis=1, keepdims=True) * between
        length = np.linalg.norm(moved, axis=1)
        along = moved / np.maximum(length, _STEP)[:, None]
        across = np.cross(between, along)
        missed = one - other
        beside = (missed * along).sum(axis=1) - nearness * length
        return np.concatenate(
            [beside / np.hypot(_RAY_SD, _NEARNESS_SD * length), (missed * across).sum(axis=1) / _RAY_SD]
        )

    def _prior_residuals(self, values: Float[np.ndarray, "p"]) -> Float[np.ndarray, "r"]:
        angles = self._angles(values)
        lined = (angles[:, 0] + self._yaw - values[-1])[self._lined]
        lined = (lined + 0.5 * _QUARTER) % _QUARTER - 0.5 * _QUARTER
        common = [angles[0, 0] / _EXACT, values[-3] / self._focal_sd, (values[-2] - _NEARNESS[0]) / _NEARNESS[1]]
        common.append(values[-1] / _QUARTER)
        return np.concatenate(
            [((angles[:, 1:] - self._tilt) / self._tilt_sd).ravel(), lined / self._yaw_sd[self._lined], common]
        )

    def _jacobian(self, values: Float[np.ndarray, "p"]) -> csr_array:
        """Return the derivatives; a match depends on the angles of two photographs only."""
        # It takes as long to import as all else that reads a photograph.
        from scipy.sparse import csr_array

        angles, log_focal, nearness = self._angles(values), float(values[-3]), float(values[-2])
        pair = angles[self._first], angles[self._second]
        base = self._match_residuals(*pair, log_focal, nearness)
        rows = np.arange(len(base))
        parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        columns = [3 * numbers + axis for numbers in (self._first, self._second) for axis in range(3)]
        columns += [np.full(len(self._first), len(values) + column) for column in (-3, -2)]
        for step, column in zip(_STEP * np.eye(8), columns, strict=True):
            one, other = pair[0] + step[:3], pair[1] + step[3:6]
            changed = self._match_residuals(one, other, log_focal + step[6], nearness + step[7])
            parts.append(((changed - base) / _STEP, rows, np.tile(column, 2)))
        slope, row, column = self._prior_slopes
        parts.append((slope, len(base) + row, column))
        value, row, column = (np.concatenate(part) for part in zip(*parts, strict=True))
        return csr_array((value, (row, column)), shape=(int(row.max()) + 1, len(values)))

    @cached_property
    def _prior_slopes(self) -> tuple[Float[np.ndarray, "s"], Int[np.ndarray, "s"], Int[np.ndarray, "s"]]:
        """Derivatives of the priors' residuals, with rows and columns: the same where no heading by lines wraps."""
        values = np.append(np.column_stack([-self._yaw, self._tilt]), np.zeros(3))
        changed = [self._prior_residuals(changed) for changed in values + _STEP * np.eye(len(values))]
        column, row = np.nonzero(slopes := np.array(changed) - self._prior_residuals(values))
        return slopes[column, row] / _STEP, row, column


def _stretched(rays: Float[np.ndarray, "m 3"], log_focal: float) -> Float[np.ndarray, "m 3"]:
    """Return the rays of the same pixels with another focal length."""
    rays = rays * np.array([math.exp(-log_focal), 1.0, math.exp(-log_focal)])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _weights(residuals: Float[np.ndarray, "r"], matches: int, lined: int) -> Float[np.ndarray, "r"]:
    """Return the weights of residuals: those of a match, and of a heading by lines, count less if they are large."""
    weight = np.ones(len(residuals))
    square = np.square(residuals[:matches]).reshape(2, -1).sum(axis=0)
    weight[:matches] = np.tile(1.0 / (1.0 + square / _OUTLIER**2), 2)
    rows = slice(len(residuals) - 4 - lined, len(residuals) - 4)
    weight[rows] = 1.0 / (1.0 + np.square(residuals[rows]) / _OUTLIER**2)
    return weight
