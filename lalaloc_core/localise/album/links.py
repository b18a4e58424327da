"""Links between photographs of an album: which ones look as if they are of one room, and the turn between some.

Two signs count. Corners and blobs that agree (`entry.Descriptors`): a rotation explains those of photographs from one
spot, and tells the turn between them. Colours: pairs that are more alike than most pairs of their album are probably of
one room. They count by their rank, because all rooms of some homes have white walls.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from lalaloc_core.localise.album.entry import AlbumPhotograph, Descriptors
from lalaloc_core.localise.album.evidence import AlbumMemory
from lalaloc_core.photograph.cameras import camera_axes
from lalaloc_core.photograph.overlap import best_matches, turn_between

# Largest ratio of the distances of descriptors to the best and to the second best match.
_MAX_RATIO = 0.9
# Matches that a rotation explains: least number and share; and the largest tilt of it, radians.
_MIN_MATCHES, _MIN_SHARE, _MAX_TILT = 10, 0.35, math.radians(12.0)
# Photographs of which all pairs are compared; in larger albums, neighbours in the order, and the pairs most alike.
_ALL_PAIRS, _NEIGHBOURS, _MOST_PAIRS = 60, 4, 3000
# Log odds of one room by the number of matches, measured on generated homes, and of a turn.
_MATCHES, _MATCH_ODDS, _TURN_ODDS = (0.0, 6.0, 14.0, 18.0, 24.0, 32.0), (-0.3, -0.3, 0.0, 0.3, 2.0, 4.0), 5.0
_CERTAIN_MATCHES = 24
# Share of the pairs of one room that are among the most similar ones, and limits of similarity and log odds.
_FOUND, _ALIKE, _UNLIKE = 0.65, 0.4, 0.25
_COLOUR_ODDS = (-2.0, 3.0)
# Matches of a pair, and turn (radians; NaN if none was found).
Found = tuple[int, float]


def find_links(
    photographs: Sequence[AlbumPhotograph], memory: AlbumMemory, pause: Callable[[], object]
) -> dict[tuple[int, int], Found]:
    """Return matches and turns of pairs of photographs, in their order; known pairs are taken from the memory.

    `pause` is called before each pair that is compared.
    """
    found: dict[tuple[int, int], Found] = {}
    seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for first, second in _pairs(photographs):
        # The memory has pairs in the order of their ids.
        one, other = sorted((first, second), key=lambda number: photographs[number].id)
        key = photographs[one].id, photographs[other].id
        if key not in memory.links:
            pause()
            for number in (one, other):
                if number not in seen:
                    seen[number] = _signs(photographs[number].descriptors), _level_rays(photographs[number])
            memory.links[key] = _compared(*seen[one], *seen[other])
        known = memory.links[key]
        if known is not None:
            found[first, second] = known[0], known[1] if one == first else -known[1]
    return found


def pair_odds(photographs: Sequence[AlbumPhotograph], links: dict[tuple[int, int], Found]) -> Float[np.ndarray, "n n"]:
    """Return the log odds that two photographs are of one room, symmetric, with zeros on the diagonal."""
    count = len(photographs)
    total = _colour_odds(photographs)
    for (first, second), (matches, turn) in links.items():
        odds = float(np.interp(matches, _MATCHES, _MATCH_ODDS)) if math.isnan(turn) else _TURN_ODDS
        total[first, second] += odds
        total[second, first] += odds
    total[np.arange(count), np.arange(count)] = 0.0
    return total


def is_one_place(found: Found) -> bool:
    """Return whether a pair of photographs is certainly of one place."""
    matches, turn = found
    return matches >= _CERTAIN_MATCHES or not math.isnan(turn)


def _pairs(photographs: Sequence[AlbumPhotograph]) -> list[tuple[int, int]]:
    """Return the pairs to compare; photographs without descriptors are left out."""
    numbers = [number for number, photograph in enumerate(photographs) if len(photograph.descriptors)]
    if len(numbers) <= _ALL_PAIRS:
        return [(first, second) for place, first in enumerate(numbers) for second in numbers[place + 1 :]]
    near = {
        (first, second)
        for place, first in enumerate(numbers)
        for second in numbers[place + 1 : place + 1 + _NEIGHBOURS]
    }
    alike = similarity(photographs)[np.ix_(numbers, numbers)]
    first, second = np.triu_indices(len(numbers), 1)
    for place in np.argsort(-alike[first, second], kind="stable")[: _MOST_PAIRS - len(near)]:
        near.add((numbers[first[place]], numbers[second[place]]))
    return sorted(near)


def _signs(descriptors: Descriptors) -> Float[np.ndarray, "n 128"]:
    """Return descriptors of unit length, one half of whose squared distance is the share of different bits."""
    bits = np.unpackbits(descriptors.bits, axis=1).astype(np.float32)
    return (2.0 * bits - 1.0) / np.float32(math.sqrt(max(bits.shape[1], 1)))


def _level_rays(photograph: AlbumPhotograph) -> Float[np.ndarray, "n 3"]:
    own, places = photograph.photograph, photograph.descriptors.place
    if own.camera is None:
        return np.zeros((len(places), 3))
    axes = camera_axes(pitch=own.pitch.value, roll=own.roll.value)
    return own.camera.rays(places * (own.camera.width, own.camera.height)) @ axes


def _compared(
    one: Float[np.ndarray, "n 128"],
    rays: Float[np.ndarray, "n 3"],
    other: Float[np.ndarray, "m 128"],
    other_rays: Float[np.ndarray, "m 3"],
) -> Found | None:
    """Return the number of matches, and the turn if a rotation explains enough of them; None without matches."""
    kept, best = best_matches(one, other, _MAX_RATIO)
    if not len(kept):
        return None
    matched = rays[kept], other_rays[best]
    if not (matched[0].any() and matched[1].any()):
        return len(kept), math.nan
    found = turn_between(*matched, _MIN_MATCHES, _MIN_SHARE, _MAX_TILT, np.random.default_rng(0))
    return len(kept), math.nan if found is None else found[0]


def similarity(photographs: Sequence[AlbumPhotograph]) -> Float[np.ndarray, "n n"]:
    """Return how alike colours are, from 0 to 1 (Bhattacharyya)."""
    colours = np.stack([photograph.colours for photograph in photographs]).astype(float)
    length = np.linalg.norm(colours, axis=1, keepdims=True)
    colours = colours / np.maximum(length, 1.0)
    return colours @ colours.T


def _colour_odds(photographs: Sequence[AlbumPhotograph]) -> Float[np.ndarray, "n n"]:
    """Return the log odds of one room by colours alone; 0 for pairs with a photograph without colours."""
    count = len(photographs)
    known = np.array([bool(photograph.colours.any()) for photograph in photographs])
    odds = np.zeros((count, count))
    both = known[:, None] & known
    alike = similarity(photographs)
    upper = np.sort(alike[np.triu(both, 1)])
    if not len(upper):
        return odds
    rank = np.maximum(1.0 - np.searchsorted(upper, alike, side="left") / len(upper), 1.0 / len(upper))
    odds = np.clip(np.log(_FOUND / rank), *_COLOUR_ODDS)
    odds = np.where(alike > _ALIKE, odds, np.minimum(odds, 0.0))
    odds = np.where(alike < _UNLIKE, np.minimum(odds, _COLOUR_ODDS[0]), odds)
    return np.where(both, odds, 0.0)
