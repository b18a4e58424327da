"""Features of photographs, and the rotations between photographs of one spot that overlap.

Features are SIFT's, few for each photograph, so that comparing pairs is cheap. Two photographs overlap if a rotation of
the camera explains many of their matches. Hands move a phone on a circle, so near things shift against far ones:
matches may miss the rotation by more along the horizon than across it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.photograph.cameras import Camera, camera_axes
from lalaloc_core.photograph.levelling import Attitude

# Features that are kept of a photograph, the strongest of each cell of a grid, and the side of the grid.
_MAX_FEATURES, _CELLS = 400, 8
# Longer side (pixels) at which features are found: those of photographs from one spot differ little in scale.
TURN_SIDE, ALBUM_SIDE = 420, 640
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
_HALF_PIXEL = 0.5


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
        first, second: numbers of the photographs.
        rays: (2, m, 3) rays of the matches, in the frame of each camera.
        turn: heading of the second photograph minus that of the first, about, radians.
    """

    first: int
    second: int
    rays: Float[np.ndarray, "2 m 3"]
    turn: float


def find_features(picture: UInt8[np.ndarray, "h w 3"], long_side: int) -> Features:
    """Return the features of a picture, spread over it, that are found at a longer side (pixels)."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    share = long_side / max(grey.shape)
    if share < 1.0:
        grey = cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    found, descriptor = cv2.SIFT.create(nfeatures=4 * _MAX_FEATURES, contrastThreshold=_CONTRAST).detectAndCompute(
        grey, None
    )
    if not found:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    height, width = grey.shape
    place = (np.array([point.pt for point in found]) + _HALF_PIXEL) / (width, height)
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


def _alike(
    one: Float[np.ndarray, "n 128"], other: Float[np.ndarray, "k 128"]
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
    """Return pairs of descriptors that are each other's best match, and clearly better than the second best."""
    if min(len(one), len(other)) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    alike, every = one @ other.T, np.arange(len(one))
    best = alike.argmax(axis=1)
    top = alike[every, best]
    alike[every, best] = -1.0
    distance, next_distance = (np.sqrt(np.maximum(2.0 - 2.0 * cosine, 0.0)) for cosine in (top, alike.max(axis=1)))
    alike[every, best] = top
    kept = np.flatnonzero(distance < _MAX_RATIO * next_distance)
    kept = kept[alike[:, best[kept]].argmax(axis=0) == kept]
    return kept, best[kept]


def _rooted(descriptor: UInt8[np.ndarray, "n 128"]) -> Float[np.ndarray, "n 128"]:
    """Return RootSIFT: square roots of the shares (Arandjelović and Zisserman, CVPR 2012)."""
    values = descriptor.astype(np.float32)
    return np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1.0))


def find_links(
    features: Sequence[Features], cameras: Sequence[Camera], attitudes: Sequence[Attitude], rng: np.random.Generator
) -> list[Link]:
    """Return the links between photographs of one spot, in the order in which they were taken.

    The last photograph is compared with the first ones too, as turns close.
    """
    count = len(features)
    apart = max(min(_MAX_PAIRS // count, count // 2), 1)
    pairs = {
        (min(first, (first + step) % count), max(first, (first + step) % count))
        for first in range(count)
        for step in range(1, apart + 1)
    }
    rays = [_rays_of(*view) for view in zip(features, cameras, strict=True)]
    rooted = [_rooted(view.descriptor) for view in features]
    axes = [camera_axes(pitch=attitude.pitch, roll=attitude.roll) for attitude in attitudes]

    def link(pair: tuple[int, int], min_matches: int, min_share: float) -> Link | None:
        first, second = pair
        one, other = _alike(rooted[first], rooted[second])
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

    steps = {pair: min(pair[1] - pair[0], count - pair[1] + pair[0]) for pair in sorted(pairs) if pair[0] != pair[1]}
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


def _rays_of(features: Features, camera: Camera) -> Float[np.ndarray, "n 3"]:
    return camera.rays(features.place * (camera.width, camera.height))


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
