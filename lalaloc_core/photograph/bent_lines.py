"""Bend of straight lines in a photograph, which tells a wide lens's picture from one in perspective.

Pieces of a line that a lens bends follow one another with small turns. The bend of such a chain away from the picture's
centre grows with its distance from it, as the radius of the division model does (Fitzgibbon 2001): p / (1 + k p²).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lalaloc_core.photograph.cameras import Camera, Perspective

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


def bend_warnings(segments: Float[np.ndarray, "n 4"], camera: Camera) -> tuple[str, ...]:
    """Return a warning if the straight lines of a picture bend that is read in perspective, without a distortion."""
    if not isinstance(camera, Perspective) or any(camera.radial):
        return ()
    bend = measure_bend(segments, width=camera.width, height=camera.height)
    if bend is None or bend < _BENT:
        return ()
    return (
        f"straight lines are bent by {bend:.0%} of the picture's longer side, as a fisheye lens bends them, but the "
        "photograph is read in perspective: send projection=fisheye with hfov_deg, or intrinsics with the distortion, "
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
    """Return the coefficient -k of the division model that straightens each chain, its weight, and its side (x, y).

    Lengths are in halves of the picture's diagonal, from its centre; the side is the direction from there.
    """
    chains = [pieces[chain] for chain in _joined(pieces, side)]
    # Most chains are a piece or two, and too short in any direction.
    long = [chain for chain in chains if np.hypot(*np.ptp(chain.reshape(-1, 2), axis=0)) >= _SHORTEST]
    found = [_coefficient(_sampled(chain)) for chain in long]
    return [chain for chain in found if chain is not None]


def _joined(pieces: Float[np.ndarray, "n 2 2"], side: float) -> list[list[int]]:
    """Return groups of pieces that continue each other."""
    steps = pieces[:, 1] - pieces[:, 0]
    direction = steps / np.maximum(np.linalg.norm(steps, axis=1), 1e-9)[:, None]
    root = list(range(len(pieces)))

    def find(index: int) -> int:
        while root[index] != index:
            root[index] = root[root[index]]
            index = root[index]
        return index

    ends = pieces.reshape(-1, 2)
    apart = np.linalg.norm(ends[:, None] - ends[None], axis=2)
    first, second = np.nonzero(apart < _GAP * side)
    for a, b in zip(first.tolist(), second.tolist(), strict=True):
        i, j = a // 2, b // 2
        if i >= j:
            continue
        cosine = abs(float(direction[i] @ direction[j]))
        # The far ends are on different sides, so that the pieces follow each other.
        outward = (pieces[i, 1 - a % 2] - ends[a]) @ (pieces[j, 1 - b % 2] - ends[b])
        gap = ends[b] - ends[a]
        offset = min(abs(float(direction[k, 0] * gap[1] - direction[k, 1] * gap[0])) for k in (i, j))
        if cosine > np.cos(_TURN) and outward < 0.0 and offset < _OFFSET * side:
            root[find(i)] = find(j)
    groups: dict[int, list[int]] = {}
    for index in range(len(pieces)):
        groups.setdefault(find(index), []).append(index)
    return list(groups.values())


def _sampled(pieces: Float[np.ndarray, "k 2 2"]) -> Float[np.ndarray, "m 2"]:
    """Return points on pieces, as many per length."""
    found = []
    for start, end in pieces:
        count = max(2, int(np.linalg.norm(end - start) / 0.01))
        found.append(start + np.linspace(0.0, 1.0, count)[:, None] * (end - start))
    return np.concatenate(found)


def _coefficient(points: Float[np.ndarray, "m 2"]) -> tuple[float, float, float, float] | None:
    """Return -k of a chain, its weight and its side; None for a short chain, or one through the centre."""
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    along, across = ((points - middle) @ axis for axis in axes)
    length, distance = float(np.ptp(along)), float(middle @ axes[1])
    if length < _SHORTEST or abs(distance) < _OFF_CENTRE:
        return None
    # A parabola across the chain: its bend is away from the centre if it has the sign of `distance`.
    curve = np.polyfit(along, across, 2)[0]
    x, y = (float(value) for value in np.sign(distance) * axes[1])
    return float(-curve / distance), abs(distance) * length**2, x, y
