"""Features of photographs, and the rotations between photographs of one spot that overlap.

Features are SIFT's, few for each photograph, so that comparing pairs is cheap. Two photographs overlap if a rotation of
the camera explains many of their matches. Hands move a phone on a circle, so near things shift against far ones:
matches may miss the rotation by more along the horizon than across it.

Photographs of a turn that overlap with no other are placed by their order. A turn goes one way: between two that do not
overlap it goes on by a step, that of a film's optical flow or, once around, about that of those that do overlap. The
headings are those of least squares over all steps, beside which overlap is exact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.photograph.cameras import HALF_PIXEL, Camera, camera_axes
from lalaloc_core.photograph.levelling import Attitude

# Features that are kept of a photograph, the strongest of each cell of a grid, and the side of the grid.
_MAX_FEATURES, _CELLS = 400, 8
# Contrast of the weakest features: rooms have plain walls.
_CONTRAST = 0.015
# Largest ratio of the distances of descriptors to the best and to the second best match.
_MAX_RATIO = 0.85
# Rotations that are tried for a pair, each by two matches.
_TRIES = 150
# Largest error (radians) of a match along and across the horizon. Parallax is along it: 0.2 m at 3 m are 4 degrees.
_ALONG, _ACROSS = math.radians(7.0), math.radians(1.5)
# Least number of matches that a rotation explains, and their least share; for photographs that are more steps apart in
# the order in which they were taken, as they rarely overlap and patterns repeat.
_MIN_MATCHES, _MIN_SHARE = 8, 0.25
_NEAR_STEPS, _FAR_MIN_MATCHES, _FAR_MIN_SHARE = 2, 16, 0.5
# Largest tilt (radians) of a rotation between levelled photographs, besides twice the deviation of their tilts.
_MAX_TILT = math.radians(8.0)
# Weight of the vertical beside two matches, while a rotation is tried.
_UPRIGHT = 0.2
# Bounds of work: pairs of photographs that are compared, and matches of a pair.
_MAX_PAIRS, _MAX_MATCHES = 200, 60
_UP = np.array([0.0, 0.0, 1.0])
_TINY = 1e-9
# Standard deviation (radians) of headings up to which a turn is read as one picture.
LIKELY_SD = math.radians(12.0)
# Standard deviation of a step that is assumed, as a share of it.
_STEP_SHARE = 0.2
# Least number of links, and their least share, that agree on the step of a turn once around; largest difference of
# their steps, as a share, and of the turn that the step makes of all photographs from a whole one.
_MIN_LINKS, _MIN_ALIKE, _MAX_UNLIKE, _MAX_OPEN = 2, 0.6, 0.4, 0.25
# Standard deviations beyond which a link contradicts the steps.
_CONTRADICTED = 4.0


@dataclass(frozen=True, eq=False)
class Features:
    """Features of a picture.

    Attributes:
        place: (n, 2) pixels from the top left corner, as shares of width and height.
        descriptor: (n, 128) SIFT descriptors.
    """

    place: Float[np.ndarray, "n 2"]
    descriptor: UInt8[np.ndarray, "n 128"]


@dataclass(frozen=True, eq=False)
class Link:
    """Matches of two photographs that a rotation explains.

    Attributes:
        rays: (2, m, 3) rays of the matches, in the frame of each camera.
        turn: heading of the second photograph minus that of the first, about, radians.
    """

    first: int
    second: int
    rays: Float[np.ndarray, "2 m 3"]
    turn: float


def shrunk(picture: UInt8[np.ndarray, "h w *c"], long_side: int) -> UInt8[np.ndarray, "k l *c"]:
    """Return a picture with a longer side of so many pixels, if it has more."""
    share = min(long_side / max(picture.shape), 1.0)
    return cv2.resize(picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA) if share < 1.0 else picture


def find_features(picture: UInt8[np.ndarray, "h w 3"], long_side: int) -> Features:
    """Return the features of a picture, spread over it, that are found at a longer side (pixels)."""
    grey = shrunk(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), long_side)
    found, descriptor = cv2.SIFT.create(nfeatures=4 * _MAX_FEATURES, contrastThreshold=_CONTRAST).detectAndCompute(
        grey, None
    )
    if not found:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    height, width = grey.shape
    place = (np.array([point.pt for point in found]) + HALF_PIXEL) / (width, height)
    response = np.array([point.response for point in found])
    kept = _spread(place, response)
    return Features(place[kept], np.clip(descriptor[kept], 0, 255).astype(np.uint8))


def _spread(place: Float[np.ndarray, "n 2"], response: Float[np.ndarray, "n"]) -> Int[np.ndarray, "k"]:
    """Return the numbers of the features to keep: by their rank within their cell."""
    cell = (np.clip(place, 0.0, 1.0 - 1e-9) * _CELLS).astype(int) @ np.array([1, _CELLS])
    order = np.lexsort((-response, cell))
    starts = np.searchsorted(cell[order], np.arange(_CELLS**2))
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order)) - starts[cell[order]]
    return np.lexsort((-response, rank))[:_MAX_FEATURES]


def best_matches(
    one: Float[np.ndarray, "n 128"], other: Float[np.ndarray, "k 128"], max_ratio: float = _MAX_RATIO
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
    """Return pairs of unit descriptors that are each other's best match, and clearly better than the second best."""
    if min(len(one), len(other)) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    alike, every = one @ other.T, np.arange(len(one))
    best = alike.argmax(axis=1)
    top = alike[every, best]
    alike[every, best] = -1.0
    distance, next_distance = (np.sqrt(np.maximum(2.0 - 2.0 * cosine, 0.0)) for cosine in (top, alike.max(axis=1)))
    alike[every, best] = top
    kept = np.flatnonzero(distance < max_ratio * next_distance)
    kept = kept[alike[:, best[kept]].argmax(axis=0) == kept]
    return kept, best[kept]


def find_links(
    features: Sequence[Features], cameras: Sequence[Camera], attitudes: Sequence[Attitude], rng: np.random.Generator
) -> list[Link]:
    """Return the links between photographs of one spot, in the order in which they were taken.

    The last photograph is compared with the first ones too, as turns close.
    """
    count = len(features)
    apart = max(min(_MAX_PAIRS // count, count // 2), 1)
    # Steps between photographs, the shorter way around.
    steps = {
        (first, second): step
        for first, second in combinations(range(count), 2)
        if (step := min(second - first, count - second + first)) <= apart
    }
    rays = [
        camera.rays(found.place * (camera.width, camera.height))
        for found, camera in zip(features, cameras, strict=True)
    ]
    # RootSIFT: square roots of the shares (Arandjelović and Zisserman, CVPR 2012).
    values = (found.descriptor.astype(np.float32) for found in features)
    rooted = [np.sqrt(value / np.maximum(value.sum(axis=1, keepdims=True), 1.0)) for value in values]
    axes = [camera_axes(pitch=attitude.pitch, roll=attitude.roll) for attitude in attitudes]

    def link(pair: tuple[int, int], min_matches: int, min_share: float) -> Link | None:
        first, second = pair
        one, other = best_matches(rooted[first], rooted[second])
        matched = np.stack([rays[first][one], rays[second][other]])
        # In frames that are about level, with the headings of the cameras.
        level = matched[0] @ axes[first], matched[1] @ axes[second]
        tilt_sd = math.hypot(attitudes[first].pitch_sd, attitudes[second].pitch_sd)
        turned = turn_between(*level, min_matches, min_share, _MAX_TILT + 2.0 * tilt_sd, rng)
        if turned is None or not overlap(first, second, turned[0]):
            return None
        return Link(first, second, matched[:, np.flatnonzero(turned[1])[:_MAX_MATCHES]], turned[0])

    def overlap(first: int, second: int, turn: float) -> bool:
        return abs(turn) < 0.5 * (cameras[first].hfov + cameras[second].hfov)

    near = [link(pair, _MIN_MATCHES, _MIN_SHARE) for pair, step in steps.items() if step <= _NEAR_STEPS]
    links = [found for found in near if found is not None]
    placed = {member: headings for headings in grouped(count, links) for member in headings}
    for (first, second), step in steps.items():
        headings = placed[first]
        # Most pairs do not overlap, and comparing one takes milliseconds.
        if step > _NEAR_STEPS and (
            second not in headings or overlap(first, second, wrap_angle(headings[second] - headings[first]))
        ):
            found = link((first, second), _FAR_MIN_MATCHES, _FAR_MIN_SHARE)
            links += [] if found is None else [found]
    return links


def grouped(count: int, links: Sequence[Link]) -> list[dict[int, float]]:
    """Return groups of photographs that links connect, each with headings along the links with most matches."""
    group = {index: {index: 0.0} for index in range(count)}
    for link in sorted(links, key=lambda link: -link.rays.shape[1]):
        one, other = group[link.first], group[link.second]
        if one is not other:
            # The second group's headings in the frame of the first one.
            offset = one[link.first] + link.turn - other[link.second]
            one |= {index: heading + offset for index, heading in other.items()}
            group |= dict.fromkeys(other, one)
    return list({min(members): members for members in group.values()}.values())


def turn_between(
    one: Float[np.ndarray, "m 3"],
    other: Float[np.ndarray, "m 3"],
    min_matches: int,
    min_share: float,
    max_tilt: float,
    rng: np.random.Generator,
) -> tuple[float, Bool[np.ndarray, "m"]] | None:
    """Return the turn that explains most of some matches of about level rays, and which agree; None if too few do."""
    count = len(one)
    least = max(min_matches, min_share * count)
    if count < least:
        return None
    pairs = rng.integers(count, size=(_TRIES, 2))
    # The verticals count as a third match, a weak one.
    upright = np.broadcast_to(_UPRIGHT * _UP, (_TRIES, 1, 3))
    tried = _rotations(*(np.concatenate([rays[pairs], upright], axis=1) for rays in (one, other)))
    error = _errors(tried, one, other)
    agreed = error[int(np.maximum(1.0 - error, 0.0).sum(axis=1).argmax())] < 1.0
    if agreed.sum() < least:
        return None
    rotation = _rotations(one[agreed][None], other[agreed][None])
    agreed = _errors(rotation, one, other)[0] < 1.0
    if agreed.sum() < least or rotation[0, 2, 2] < math.cos(max_tilt):
        return None
    # The rotation takes rays ahead to the left if the camera turned to the right.
    return math.atan2(rotation[0, 1, 0], rotation[0, 0, 0]), agreed


def _rotations(one: Float[np.ndarray, "k m 3"], other: Float[np.ndarray, "k m 3"]) -> Float[np.ndarray, "k 3 3"]:
    """Return the rotations that turn rays best into others (Kabsch 1976)."""
    u, _, v = np.linalg.svd(np.einsum("kmi,kmj->kij", other, one))
    sign = np.sign(np.linalg.det(u @ v))
    u[:, :, 2] *= sign[:, None]
    return u @ v


def _errors(
    rotations: Float[np.ndarray, "k 3 3"], one: Float[np.ndarray, "m 3"], other: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "k m"]:
    """Return squared errors of matches, in units of what is tolerated along and across the horizon."""
    missed = rotations @ one.T - other.T
    along = np.cross(other, _UP)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), _TINY)
    beside = (missed * along.T).sum(axis=1)
    rest = np.maximum(np.square(missed).sum(axis=1) - np.square(beside), 0.0)
    return np.square(beside / _ALONG) + rest / _ACROSS**2


class Step(NamedTuple):
    """Turn (radians) from a photograph to the next one, and its standard deviation."""

    turn: float
    sd: float


def usual_steps(count: int, links: Sequence[Link]) -> list[Step] | None:
    """Return the steps of photographs that go once around, from each to the next and from the last to the first.

    None if links do not tell that the photographs go once around in about equal steps.
    """
    apart = np.array([link.second - link.first for link in links])
    # The shorter way around.
    apart = np.where(2 * apart <= count, apart, apart - count)
    turn = np.array([link.turn for link in links])
    near = np.abs(apart) <= 2
    if near.sum() < _MIN_LINKS:
        return None
    step = turn[near] / apart[near]
    usual = float(np.median(step))
    alike = np.abs(step - usual) < _MAX_UNLIKE * abs(usual)
    if alike.sum() < max(_MIN_LINKS, _MIN_ALIKE * len(step)):
        return None
    whole = math.copysign(TWO_PI, usual) / count
    if abs(usual / whole - 1.0) > _MAX_OPEN:
        return None
    return [Step(whole, _STEP_SHARE * abs(whole))] * count


def agreeing_links(links: Sequence[Link], count: int, steps: Sequence[Step]) -> list[Link]:
    """Return the links that do not contradict the steps of a turn: patterns repeat around a room."""
    turn, sd = np.array(steps).T
    reckoned, variance = (np.concatenate([[0.0], np.cumsum(values)]) for values in (turn, np.square(sd)))

    def agrees(link: Link) -> bool:
        between = abs(variance[link.second] - variance[link.first])
        if len(steps) == count:
            between = min(between, variance[-1] - between)
        missed = wrap_angle(link.turn - (reckoned[link.second] - reckoned[link.first]))
        return abs(float(missed)) < _CONTRADICTED * math.sqrt(between)

    return [link for link in links if agrees(link)]


def headings_in_order(
    group: Int[np.ndarray, "n"], heading: Float[np.ndarray, "n"], steps: Sequence[Step]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return headings of all photographs minus that of the first, and the deviations of the places of their groups.

    Headings (radians) are given within the groups of photographs that overlap, whose numbers count from 0. Steps are
    from each photograph to the next one, and for turns that close from the last to the first.
    """
    first = np.arange(len(steps))
    second = (first + 1) % len(group)
    turn, sd = np.array(steps).T
    placed = _placed(group, heading, np.concatenate([[0.0], np.cumsum(turn[: len(group) - 1])]))
    across = np.flatnonzero(group[first] != group[second])
    # Unknowns: what is to be added to the headings of each group but the largest.
    slope = np.zeros((len(across), int(group.max()) + 1))
    rows = np.arange(len(across))
    slope[rows, group[second[across]]] += 1.0 / sd[across]
    slope[rows, group[first[across]]] -= 1.0 / sd[across]
    missed = wrap_angle(turn - (placed[second] - placed[first]))[across] / sd[across]
    main = int(np.bincount(group).argmax())
    free = np.delete(slope, main, axis=1)
    covariance = np.linalg.inv(free.T @ free)
    added = np.insert(covariance @ (free.T @ missed), main, 0.0)
    group_sd = np.insert(np.sqrt(np.diag(covariance)), main, 0.0)
    placed = placed + added[group]
    return wrap_angle(placed - placed[0]), group_sd[group]


def _placed(
    group: Int[np.ndarray, "n"], heading: Float[np.ndarray, "n"], reckoned: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Return headings within groups, each group and each of its turns around where the steps alone lead."""
    placed = heading.copy()
    for number in range(int(group.max()) + 1):
        members = np.flatnonzero(group == number)
        offset = reckoned[members] - heading[members]
        placed[members] += offset - wrap_angle(offset - offset[0])
    return placed
