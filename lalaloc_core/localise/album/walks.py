"""Walks through a plan: the probability of the next photograph's room, and how many photographs rooms have."""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Bool, Float

from lalaloc_core.localise.album.ground import AlbumGround

# Probability that the next photograph is of the same room, that it is of any room at all, and the weight of rooms that
# are a further door away over that of nearer ones; walks are followed through so many doors.
_STAY, _ANYWHERE, _FURTHER, _DOORS = 0.5, 0.05, 0.5, 4
# Rooms nearer than this (m) are joined if the plan draws no doors.
_JOINED_M = 0.4
# Probability of a photograph of none of the rooms, after one of a room and after another of none.
_LEAVE, _STAY_AWAY = 0.05, 0.5
# Rooms smaller than this (m²) are often left out.
_SMALL_M2, _SMALL_SHARE = 3.0, 0.5


def walk_of(ground: AlbumGround) -> Float[np.ndarray, "s s"]:
    """Return log probabilities of the next photograph's room (columns) by that of a photograph; the last is none."""
    near = _joined(ground)
    rooms = len(near)
    step = near / np.maximum(near.sum(axis=1, keepdims=True), 1)
    reached, total = np.eye(rooms), np.zeros((rooms, rooms))
    for door in range(_DOORS):
        reached = reached @ step
        total += _FURTHER**door * reached
    total[np.arange(rooms), np.arange(rooms)] = 0.0
    mass = total.sum(axis=1, keepdims=True)
    # A room without doors leads anywhere.
    total = np.where(mass > 0.0, total / np.maximum(mass, 1e-9), 1.0 / rooms)
    inside = _STAY * np.eye(rooms) + (1.0 - _STAY) * ((1.0 - _ANYWHERE) * total + _ANYWHERE / rooms)
    walk = np.empty((rooms + 1, rooms + 1))
    walk[:rooms, :rooms] = (1.0 - _LEAVE) * inside
    walk[:rooms, rooms] = _LEAVE
    walk[rooms, :rooms] = (1.0 - _STAY_AWAY) / rooms
    walk[rooms, rooms] = _STAY_AWAY
    return np.log(walk)


def expected_photographs(ground: AlbumGround, count: int) -> Float[np.ndarray, "s"]:
    """Return the number of photographs that each room has a priori; NaN for none of the rooms.

    Large rooms have more, and plans with far more rooms than photographs have no expectation.
    """
    area = np.array([room.area_m2 for room in ground.plan.rooms])
    share = np.sqrt(area) * np.where(area < _SMALL_M2, _SMALL_SHARE, 1.0)
    expected = count * share / share.sum()
    if count < len(area):
        expected = np.full(len(area), np.nan)
    return np.append(expected, np.nan)


def _joined(ground: AlbumGround) -> Bool[np.ndarray, "r r"]:
    """Return which rooms are joined by doors or passages; without any, which are beside each other."""
    plan = ground.plan
    joined = np.zeros((len(plan.rooms), len(plan.rooms)), bool)
    for face in plan.opening_faces:
        if face.behind >= 0 and plan.openings[face.opening].kind != "window":
            joined[face.room, face.behind] = joined[face.behind, face.room] = True
    if not joined.any():
        shapes = [room.shape for room in plan.rooms]
        first, second = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=_JOINED_M)
        joined[first, second] = True
    np.fill_diagonal(joined, False)
    return joined
