"""Trust in the openings of a plan: the probability, by kind, that an opening that exists is drawn.

Every room has an entry, and most rooms on an outer wall have a window. So rooms that no drawn opening reaches show how
many are missing. The trust is the posterior mean of the share t of openings that are drawn:

    P(a room is reached | t) = q (1 - (1 - t)^n)

with the probability q that a room has an opening, and the usual number n of these. A priori, a plan shows a kind as far
as the reader finds it, t ~ Beta(c r, c (1 - r)) with the reader's recall r; or a part of it, t ~ U(0, 1); or none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from lalaloc_core.conventions import OPENING_CLASSES

# Largest distance of two rooms that share a wall, reach of an opening to either side, and shortest outer wall (m).
_WALL_M, _REACH_M, _OUTER_M = 0.6, 0.65, 1.5
# q and n of entries and windows, as in generated homes; prior probabilities of a part and of none; c.
_HAS_ENTRY, _ENTRIES, _HAS_WINDOW, _WINDOWS = 0.99, 1.8, 0.9, 1.6
_IN_PART, _NOT_DRAWN, _STRENGTH = 0.2, 0.25, 20.0
# Probability that passages are drawn where they occur, in a plan with doors and without passages.
_ABSENT_PASSAGES = 0.7
# Trust in passages of a plan without doors, relative to others: they can be doors whose leaves are not drawn.
_LEAFLESS = 0.6
# Smaller rooms (m²) can be ducts without an entry, or lack a window.
_MIN_ENTERED_M2, _MIN_LIT_M2 = 1.5, 6.0
_UNLIT_TYPES = {
    "bathroom", "corridor", "entrance", "closet", "storage", "laundry", "garage", "stairs", "balcony",
}  # fmt: skip
# Rooms that are examined, evenly chosen among more.
_MAX_ROOMS = 400
_SHARES = (np.arange(200) + 0.5) / 200


@dataclass(frozen=True)
class OpeningTrust:
    """Trust in the openings of one kind, with its reason."""

    kind: str
    trust: float
    reason: str


def estimate_trust(
    document: Mapping[str, Any], recall: float, kinds: Sequence[str] = OPENING_CLASSES[1:]
) -> tuple[OpeningTrust, ...]:
    """Return the trust in the kinds of openings of a plan in the native format.

    `recall` is the share of drawn openings that the reader finds, and `kinds` are those that its format can hold.
    """
    shapes = [shapely.Polygon(room["polygon"]) for room in document["rooms"]]
    lines = {kind: opening_lines(document, kind) for kind in OPENING_CLASSES[1:]}
    chosen = np.unique(np.linspace(0, len(shapes) - 1, min(len(shapes), _MAX_ROOMS)).round().astype(int)).tolist()
    entered = [shapes[index] for index in chosen if shapes[index].area >= _MIN_ENTERED_M2]
    reached = len(reached_rooms(entered, lines["door"] + lines["passage"]))
    entries = _share_drawn(reached, len(entered), (_HAS_ENTRY, _ENTRIES), recall)
    by_entries = f"{reached} of {len(entered)} rooms are reached by a door or passage"
    lit = _lit_rooms(document, shapes, chosen)
    with_window = len(reached_rooms(lit, lines["window"]))
    windows = _share_drawn(with_window, len(lit), (_HAS_WINDOW, _WINDOWS), recall)
    has_doors, has_passages = bool(lines["door"]), bool(lines["passage"])
    passages, by_passages = entries, by_entries
    if has_doors and not has_passages:
        passages, by_passages = _ABSENT_PASSAGES * entries, f"{by_entries}; no passage is drawn"
    elif has_passages and not has_doors:
        passages, by_passages = _LEAFLESS * entries, f"{by_entries}; without doors, passages can be doors"
    found = (
        ("door", entries if has_doors else 0.0, by_entries if has_doors else "no door is drawn"),
        ("window", windows, f"{with_window} of {len(lit)} rooms on outer walls have a window"),
        ("passage", passages if has_doors or has_passages else 0.0, by_passages),
    )
    # A certain kind would count as proven.
    return tuple(OpeningTrust(kind, round(min(trust, 0.99), 2), why) for kind, trust, why in found if kind in kinds)


def _share_drawn(reached: int, rooms: int, having: tuple[float, float], recall: float) -> float:
    """Return the posterior mean of the share of openings that are drawn."""
    has, count = having
    if rooms == 0:
        return 0.0
    whole = _SHARES ** (_STRENGTH * recall - 1.0) * (1.0 - _SHARES) ** (_STRENGTH * (1.0 - recall) - 1.0)
    prior = (1.0 - _IN_PART - _NOT_DRAWN) * whole / whole.sum() + _IN_PART / len(_SHARES)
    reach = has * (1.0 - (1.0 - _SHARES) ** count)
    # In logs, as plans can have hundreds of rooms.
    log_weight = np.log(prior) + reached * np.log(reach) + (rooms - reached) * np.log1p(-reach)
    log_none = np.log(_NOT_DRAWN) if reached == 0 else -np.inf
    highest = max(float(log_weight.max()), log_none)
    weight = np.exp(log_weight - highest)
    return float(weight @ _SHARES / (weight.sum() + np.exp(log_none - highest)))


def opening_lines(document: Mapping[str, Any], kind: str) -> list[shapely.LineString]:
    """Return the lines of a plan's openings of a kind."""
    return [shapely.LineString(opening["line"]) for opening in document.get("openings", ()) if opening["kind"] == kind]


def reached_rooms(rooms: Sequence[shapely.Polygon], lines: Sequence[shapely.LineString]) -> list[int]:
    """Return the numbers of the rooms that openings lead to, straight across their middle; not those beside them."""
    if not rooms or not lines:
        return []
    start, end = (np.array([line.coords[side] for line in lines]) for side in (0, -1))
    along = (end - start) / np.maximum(np.linalg.norm(end - start, axis=1, keepdims=True), 1e-9)
    middle, across = 0.5 * (start + end), _REACH_M * along[:, ::-1] * (-1.0, 1.0)
    ways = [shapely.LineString(ends) for ends in np.stack([middle - across, middle + across], axis=1)]
    room, _ = shapely.STRtree(ways).query(rooms, predicate="intersects")
    return np.unique(room).tolist()


def _lit_rooms(
    document: Mapping[str, Any], shapes: Sequence[shapely.Polygon], chosen: Sequence[int]
) -> list[shapely.Polygon]:
    """Return the rooms that usually have a window: large ones with an outer wall."""
    tree = shapely.STRtree(shapes)
    found = []
    for index in chosen:
        shape, kind = shapes[index], document["rooms"][index].get("type")
        if shape.area < _MIN_LIT_M2 or kind in _UNLIT_TYPES:
            continue
        near = tree.query(shape, predicate="dwithin", distance=_WALL_M)
        around = shapely.union_all(tree.geometries[near[near != index]]).buffer(_WALL_M)
        if shape.exterior.difference(around).length >= _OUTER_M:
            found.append(shape)
    return found
