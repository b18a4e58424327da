"""Tilt of a camera, and its field of view if unknown, estimated from straight lines.

Most lines of interiors are vertical or run along one of two horizontal directions at right angles (Manhattan world). A
line's image points to the vanishing point of its direction. The likelihood of an attitude is a mixture per segment: one
of the three directions, with a small angular error, or any direction. Sources: Coughlan and Yuille, "Manhattan World",
ICCV 1999; von Gioi et al., "LSD", PAMI 2010.

The bend of lines tells a wide lens's picture from one in perspective. Pieces of a bent line follow one another with
small turns. The bend of such a chain away from the picture's centre grows with its distance from it, as the radius of
the division model does (Fitzgibbon 2001): p / (1 + k p²).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lalaloc_core.photograph.cameras import HALF_PIXEL, Camera, Perspective, level_axes

# Longer side (pixels) at which segments are found, in pictures that are larger by more than the slack.
_LONG_SIDE, _SLACK = 480, 1.1
# Shorter segments, as a share of the picture's longer side, are mostly texture.
_MIN_LENGTH = 0.025
_MAX_SEGMENTS = 150
# Angular error of a segment: modelling, and of its ends in pixels.
_SIGMA = math.radians(0.6)
_SIGMA_PIXELS = 0.6
# Prior shares of vertical segments, of each horizontal direction, and of others.
_SHARES = np.array([0.3, 0.2, 0.2])
_OUTLIERS = 0.3 / math.pi
# Handheld cameras: standard deviations of pitch and roll.
_PRIOR = np.radians([12.0, 4.0])
# Tilts with a larger standard deviation (radians) are assumed rather than estimated.
MAX_ESTIMATED_SD = math.radians(4.0)
_PITCHES = np.radians(np.arange(-40.0, 40.1, 2.5))
_ROLLS = np.radians(np.arange(-17.5, 17.6, 2.5))
_YAWS = np.radians(np.arange(0.0, 90.0, 3.0))
# Angular error of the coarse search, which steps over narrow peaks.
_COARSE_SIGMA = math.radians(2.0)
_STARTS = 16
_REFINED = 3
_APART = math.radians(3.0)
_STEPS = 10
# Step (radians) of numeric derivatives.
_DELTA = 1e-5
# Likelihoods of segments are not independent: one edge gives several.
_TEMPERATURE = 0.15
# Errors that lines do not show: lenses, edges that are not quite upright. Fitted on views cut from spheres.
_FLOOR = np.radians([0.5, 0.4])
# Field of view of the longer side, if unknown: values to try, and the prior of log focal length of phones.
_LONG_FOVS = np.radians([44.0, 48.0, 52.0, 57.0, 62.0, 67.0, 73.0, 79.0, 86.0, 93.0, 100.0, 108.0, 116.0])
_USUAL_FOV, _FOV_SD = math.radians(72.0), 0.35
# Steps between values, lenses.
_FOCAL_FLOOR = 0.03
# Angles of an attitude (pitch, roll, yaw), its score and covariance.
_Mode = tuple[np.ndarray, float, np.ndarray]
# Largest gap between two pieces of a line and offset across it (shares of the longer side), and their largest turn.
_GAP, _OFFSET, _TURN = 0.03, 0.006, np.radians(9.0)
# Shortest chain, and its least distance from the centre (shares of half of the diagonal).
_SHORTEST, _OFF_CENTRE = 0.3, 0.25
# Fewest chains, and the share of their weight that must bend more than half as much. They lie on several sides of the
# centre, at least one by this cosine from another: an arch or a round table is on one side.
_FEWEST, _AGREEING, _BESIDE = 3, 0.75, 0.5
# Smallest bend that a lens is warned about. Of 456 views of real rooms in perspective none reached it; of fisheye
# pictures 100° to 150° wide, two of three do.
_BENT = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Lines:
    """Segments seen from the camera, in its frame (right, forward, up).

    Attributes:
        normal: (n, 3) unit normals of the planes through the camera and each segment.
        middle: (n, 3) unit rays to the middles.
        length: (n,) angles (radians) between the ends.
        pixel: angle (radians) of one pixel at the optical axis.
    """

    normal: Float[np.ndarray, "n 3"]
    middle: Float[np.ndarray, "n 3"]
    length: Float[np.ndarray, "n"]
    pixel: float


@dataclass(frozen=True, kw_only=True)
class Attitude:
    """Tilt of a camera.

    Attributes:
        pitch: elevation of the optical axis, radians.
        roll: clockwise rotation about it, radians.
        yaw: azimuth of one of the two horizontal directions relative to the optical axis, radians; repeats by 90°.
    """

    pitch: float
    roll: float
    pitch_sd: float
    roll_sd: float
    yaw: float = 0.0
    yaw_sd: float = math.inf


def find_segments(pixels: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "n 4"]:
    """Return the longest segments (x, y, x, y; pixels from the top left corner) found by OpenCV's LSD."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    share = 1.0
    if max(grey.shape) > _SLACK * _LONG_SIDE:
        share = _LONG_SIDE / max(grey.shape)
        grey = cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    if found is None:
        return np.zeros((0, 4))
    segments = found.reshape(-1, 4).astype(float) + HALF_PIXEL
    length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    order = np.argsort(-length, kind="stable")[:_MAX_SEGMENTS]
    return segments[order[length[order] > _MIN_LENGTH * max(grey.shape)]] / share


def lines_of(segments: Float[np.ndarray, "n 4"], camera: Camera) -> Lines:
    """Return the segments as a camera sees them."""
    rays = camera.rays(segments.reshape(-1, 2, 2))
    cross = np.cross(rays[:, 0], rays[:, 1])
    sine = np.linalg.norm(cross, axis=-1)
    middle = rays.sum(axis=1)
    middle_norm = np.linalg.norm(middle, axis=-1)
    usable = (sine > 1e-4) & (middle_norm > 1e-4)
    return Lines(
        normal=cross[usable] / sine[usable, None],
        middle=middle[usable] / middle_norm[usable, None],
        length=np.arctan2(sine, (rays[:, 0] * rays[:, 1]).sum(axis=-1))[usable],
        pixel=1.0 / camera.resolution,
    )


def estimate_attitude(lines: Lines) -> Attitude:
    """Return the most probable tilt of a camera that sees `lines`; with few lines, the prior of handheld cameras."""
    return _attitude(_modes(lines, _REFINED))


def estimate_calibration(
    segments: Float[np.ndarray, "n 4"], *, width: int, height: int
) -> tuple[float, float, Attitude]:
    """Return what is most probable for a perspective camera without distortion about which nothing is known.

    These are its horizontal field of view (radians), the relative deviation of its focal length, and its tilt.
    """
    focals = 0.5 * max(width, height) / np.tan(0.5 * _LONG_FOVS)
    modes: list[_Mode] = []
    for focal in focals:
        camera = Perspective(width=width, height=height, fx=focal, fy=focal, cx=0.5 * width, cy=0.5 * height)
        modes += _modes(lines_of(segments, camera), 1)
    log_focal = np.log(focals)
    usual = math.log(0.5 * max(width, height) / math.tan(0.5 * _USUAL_FOV))
    scores = np.array([score for _, score, _ in modes]) - 0.5 * ((log_focal - usual) / _FOV_SD) ** 2
    weights = np.exp(scores - scores.max())
    weights /= weights.sum()
    mean = float(weights @ log_focal)
    attitude = _attitude([(angles, score, cov) for (angles, _, cov), score in zip(modes, scores, strict=True)])
    focal_sd = math.sqrt(float(weights @ (log_focal - mean) ** 2) + _FOCAL_FLOOR**2)
    return 2.0 * math.atan(0.5 * width / math.exp(mean)), focal_sd, attitude


def _modes(lines: Lines, most: int) -> list[_Mode]:
    """Return the most probable attitudes; without lines a level one, of which nothing is known."""
    if not len(lines.length):
        return [(np.zeros(3), 0.0, np.diag([1.0, 1.0, np.inf]))]
    return _refined(lines, _starts(lines)[:most])


def _attitude(modes: Sequence[_Mode]) -> Attitude:
    """Return the best of several modes, with the spread of all."""
    best, score, covariance = max(modes, key=lambda mode: mode[1])
    weights = np.array([math.exp(mode[1] - score) for mode in modes])
    offsets = np.array([mode[0][:2] - best[:2] for mode in modes])
    spread = (weights[:, None] * offsets**2).sum(axis=0) / weights.sum()
    sd = np.minimum(np.sqrt(np.diag(covariance)[:2] + _FLOOR**2 + spread), _PRIOR)
    apart = np.array([(mode[0][2] - best[2] + 0.25 * math.pi) % (0.5 * math.pi) - 0.25 * math.pi for mode in modes])
    yaw_sd = math.sqrt(covariance[2, 2] + _FLOOR[1] ** 2 + weights @ apart**2 / weights.sum())
    return Attitude(
        pitch=float(best[0]),
        roll=float(best[1]),
        pitch_sd=float(sd[0]),
        roll_sd=float(sd[1]),
        yaw=float(best[2]),
        yaw_sd=yaw_sd,
    )


def _directions(angles: Float[np.ndarray, "*a 3"]) -> Float[np.ndarray, "*a 3 3"]:
    """Return the vertical and the two horizontal directions in the camera's frame, one per row."""
    pitch, roll, yaw = np.moveaxis(angles, -1, 0)
    # Seen from the first horizontal direction, the camera looks along minus its azimuth.
    axes = level_axes(np.stack([-yaw, pitch, roll], axis=-1))
    return axes[..., ::-1].swapaxes(-1, -2)


def _errors(lines: Lines, directions: Float[np.ndarray, "*a d 3"]) -> Float[np.ndarray, "*a n d"]:
    """Return the sine of the angle between each segment and the great circle to each direction."""
    return (lines.normal @ directions.swapaxes(-1, -2)) / _distances(lines, directions)


def _distances(lines: Lines, directions: Float[np.ndarray, "*a d 3"]) -> Float[np.ndarray, "*a n d"]:
    """Return the sine of the angle between the middle of each segment and each direction."""
    along = lines.middle @ directions.swapaxes(-1, -2)
    return np.sqrt(np.maximum(1.0 - along * along, 1e-3))


def _sigmas(lines: Lines, least: float) -> np.ndarray:
    return np.hypot(least, _SIGMA_PIXELS * lines.pixel / lines.length)


def _weights(lines: Lines) -> np.ndarray:
    return _TEMPERATURE * np.sqrt(lines.length / np.median(lines.length))


def _densities(error: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * (error / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi))


def _starts(lines: Lines) -> Float[np.ndarray, "s 3"]:
    """Return the best attitudes (pitch, roll, yaw) of a coarse search, in single precision, which is faster."""
    sigma = _sigmas(lines, _COARSE_SIGMA)[:, None].astype(np.float32)
    weight = _weights(lines).astype(np.float32)
    lines = replace(lines, normal=lines.normal.astype(np.float32), middle=lines.middle.astype(np.float32))
    pitch, roll = (grid.ravel() for grid in np.meshgrid(_PITCHES, _ROLLS, indexing="ij"))
    vertical = np.stack([-np.sin(roll) * np.cos(pitch), np.sin(pitch), np.cos(roll) * np.cos(pitch)], axis=-1)
    upright = float(_SHARES[0]) * _densities(_errors(lines, vertical.astype(np.float32)), sigma)
    prior = -0.5 * ((pitch / _PRIOR[0]) ** 2 + (roll / _PRIOR[1]) ** 2)
    score = weight @ np.log(upright + _OUTLIERS + 0.4 / math.pi) + prior
    chosen = np.argsort(-score)[:_STARTS]
    tilt = np.repeat(np.column_stack([pitch, roll])[chosen], len(_YAWS), axis=0)
    angles = np.column_stack([tilt, np.tile(_YAWS, _STARTS)])
    directions = _directions(angles).astype(np.float32)
    first, second = (_densities(_errors(lines, directions[:, row]), sigma) for row in (1, 2))
    horizontal = float(_SHARES[1]) * first + float(_SHARES[2]) * second
    full = weight @ np.log(np.repeat(upright[:, chosen], len(_YAWS), axis=1) + horizontal + _OUTLIERS)
    full = full.reshape(_STARTS, -1)
    best = full.argmax(axis=1)
    order = np.argsort(-(full[np.arange(_STARTS), best] + prior[chosen]), kind="stable")
    starts: list[np.ndarray] = []
    for start in angles.reshape(_STARTS, -1, 3)[order, best[order]]:
        # Neighbours on the grid lead to the same attitude.
        if all(np.abs(start[:2] - kept[:2]).max() > _APART for kept in starts):
            starts.append(start)
    return np.stack(starts[:_REFINED])


def _refined(lines: Lines, angles: Float[np.ndarray, "s 3"]) -> list[_Mode]:
    """Refine attitudes by expectation maximisation; return them with their scores and covariances."""
    prior = np.array([*(1.0 / _PRIOR**2), 0.0])
    weight = _weights(lines)
    beside = np.vstack([np.zeros(3), _DELTA * np.eye(3)])
    for step in range(_STEPS):
        sigma = _sigmas(lines, max(_SIGMA, _COARSE_SIGMA * 0.7**step))[:, None]
        nearby = _directions(angles[:, None] + beside)
        directions = nearby[:, 0]
        distance = _distances(lines, directions)
        error = (lines.normal @ directions.swapaxes(1, 2)) / distance
        density = _SHARES * _densities(error, sigma)
        share = weight[:, None] * density / (density.sum(axis=2, keepdims=True) + _OUTLIERS) / sigma**2
        # The distance changes as well, but for small errors it does not matter.
        change = (nearby[:, 1:] - directions[:, None]) / _DELTA
        slopes = (lines.normal @ change.swapaxes(2, 3)) / distance[:, None]
        weighted = (share[:, None] * slopes).reshape(len(angles), 3, -1)
        information = weighted @ slopes.reshape(weighted.shape).swapaxes(1, 2) + np.diag(prior) + 1e-3 * np.eye(3)
        gradient = (weighted @ error.reshape(len(angles), -1, 1))[..., 0] + prior * angles
        angles = angles - np.linalg.solve(information, gradient[..., None])[..., 0]
    density = _SHARES * _densities(_errors(lines, _directions(angles)), sigma)
    score = np.log(density.sum(axis=2) + _OUTLIERS) @ weight - 0.5 * (prior * angles * angles).sum(axis=1)
    return list(zip(angles, score.tolist(), np.linalg.inv(information), strict=True))


def bend_warnings(segments: Float[np.ndarray, "n 4"], camera: Camera) -> tuple[str, ...]:
    """Return a warning if the straight lines of a picture bend that is read in perspective, without a distortion."""
    if not isinstance(camera, Perspective) or any(camera.radial):
        return ()
    bend = measure_bend(segments, width=camera.width, height=camera.height)
    if bend is None or bend < _BENT:
        return ()
    return (
        f"straight lines are bent by {bend:.0%} of the picture's longer side, as a fisheye lens bends them, but the "
        "photograph is read in perspective: state projection=fisheye with hfov_deg, or intrinsics with the distortion, "
        "or set the camera to its linear mode",
    )


def measure_bend(segments: Float[np.ndarray, "n 4"], *, width: int, height: int) -> float | None:
    """Return the bend of lines as a share of the picture's longer side; None for too few or unlike ones.

    `segments` are straight pieces (x, y, x, y; pixels). The bend is that of a line along the whole longer border of the
    picture, positive if it bulges away from the centre, as fisheye lenses show it.
    """
    radius = 0.5 * float(np.hypot(width, height))
    points = (segments.reshape(-1, 2, 2) - (0.5 * width, 0.5 * height)) / radius
    chains = _chains(points, max(width, height) / radius)
    if len(chains) < _FEWEST:
        return None
    bends, weights, x, y = np.array(chains).T
    order = np.argsort(bends)
    share = np.cumsum(weights[order]) / weights.sum()
    middle = float(bends[order][np.searchsorted(share, 0.5)])
    agrees = bends * np.sign(middle) > 0.5 * abs(middle)
    cosines = (x[:, None] * x + y[:, None] * y)[np.ix_(agrees, agrees)]
    if weights[agrees].sum() < _AGREEING * weights.sum() or not (cosines < _BESIDE).any():
        return None
    long, short = max(width, height) / radius, min(width, height) / radius
    # The sagitta of a chord of half length `long / 2` at distance `short / 2` from the centre.
    return middle * (0.5 * short) * (0.5 * long) ** 2 / long


def _chains(pieces: Float[np.ndarray, "n 2 2"], side: float) -> list[tuple[float, float, float, float]]:
    """Return the coefficient -k of the division model that straightens each chain, its weight, and its side (x, y)."""
    # Lengths are in halves of the picture's diagonal, from its centre; the side is the direction from there.
    chains = [pieces[chain] for chain in _joined(pieces, side)]
    # Most chains are a piece or two, and too short in any direction.
    long = [chain for chain in chains if np.hypot(*np.ptp(chain.reshape(-1, 2), axis=0)) >= _SHORTEST]
    found = [_coefficient(chain) for chain in long]
    return [chain for chain in found if chain is not None]


def _joined(pieces: Float[np.ndarray, "n 2 2"], side: float) -> list[list[int]]:
    """Return groups of pieces that continue each other."""
    steps = pieces[:, 1] - pieces[:, 0]
    direction = steps / np.maximum(np.linalg.norm(steps, axis=1), 1e-9)[:, None]
    group = {index: [index] for index in range(len(pieces))}
    ends = pieces.reshape(-1, 2)
    apart = np.linalg.norm(ends[:, None] - ends[None], axis=2)
    a, b = np.nonzero(apart < _GAP * side)
    a, b = a[a // 2 < b // 2], b[a // 2 < b // 2]
    i, j = a // 2, b // 2
    cosine = np.abs((direction[i] * direction[j]).sum(axis=1))
    # The far ends are on different sides, so that the pieces follow each other.
    outward = ((ends[a ^ 1] - ends[a]) * (ends[b ^ 1] - ends[b])).sum(axis=1)
    gap = ends[b] - ends[a]
    offset = np.minimum(*(np.abs(direction[k, 0] * gap[:, 1] - direction[k, 1] * gap[:, 0]) for k in (i, j)))
    follows = (cosine > np.cos(_TURN)) & (outward < 0.0) & (offset < _OFFSET * side)
    for one, other in zip(i[follows].tolist(), j[follows].tolist(), strict=True):
        if group[one] is not group[other]:
            merged = sorted(group[one] + group[other])
            group |= dict.fromkeys(merged, merged)
    return list({members[0]: members for members in group.values()}.values())


def _coefficient(pieces: Float[np.ndarray, "k 2 2"]) -> tuple[float, float, float, float] | None:
    """Return -k of a chain, its weight and its side; None for a short chain, or one through the centre."""
    counts = np.maximum(np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1) / 0.01, 2).astype(int).tolist()
    points = np.concatenate(
        [np.linspace(start, end, count) for (start, end), count in zip(pieces, counts, strict=True)]
    )
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    along, across = ((points - middle) @ axis for axis in axes)
    length, distance = float(np.ptp(along)), float(middle @ axes[1])
    if length < _SHORTEST or abs(distance) < _OFF_CENTRE:
        return None
    # A parabola across the chain: its bend is away from the centre if it has the sign of `distance`. By regression on
    # what a line leaves of the squares, in a tenth of the time of `np.polyfit`.
    squares = along * along
    squares -= squares.mean() + (squares @ along) / (along @ along) * along
    curve = (squares @ across) / (squares @ squares)
    x, y = (float(value) for value in np.sign(distance) * axes[1])
    return float(-curve / distance), abs(distance) * length**2, x, y
