"""Assignment of all photographs to rooms at once, by Markov chain Monte Carlo.

The energy of an assignment is the sum of four parts: the evidence of each photograph for its room, the log probability
of the walk from each photograph to the next, the log odds of pairs that look as if they are of one room, and a prior of
how many photographs each room has. The last one makes the evidence exclusive: a bathroom that explains all photographs
of a home is unlikely, as people photograph every room.

People mostly walk from room to room through doors, and photograph large rooms more often (`walk_of`,
`expected_photographs`).

Several chains are cooled together. Beside single photographs, chains move all photographs of a room, or a run of them,
to another room, and swap two rooms: these moves leave the pairs alone, between whose optima single moves get stuck.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from lalaloc_core.localise.album.ground import AlbumGround

_CHAINS, _HOTTEST = 12, 4.0
# Sweeps over all photographs: while cooling, and those that are counted. Large albums have fewer, to bound the time.
_COOLING, _COUNTED, _MAX_UPDATES = 40, 60, 3000
_FEWEST = 12
# Most successive photographs that move together.
_LONGEST = 6
# Probability that the next photograph is of the same room, that it is of any room at all, and the weight of rooms that
# are a further door away over that of nearer ones; walks are followed through so many doors.
_STAY, _ANYWHERE, _FURTHER, _DOORS = 0.5, 0.05, 0.5, 4
# Rooms nearer than this (m) are joined if the plan draws no doors.
_JOINED_M = 0.4
# Probability of a photograph of none of the rooms, after one of a room and after another of none.
_LEAVE, _STAY_AWAY = 0.05, 0.5
# Rooms smaller than this (m²) are often left out.
_SMALL_M2, _SMALL_SHARE = 3.0, 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class RoomEvidence:
    """Evidence for the rooms of n photographs in the order in which they were taken; the last room is "elsewhere".

    Attributes:
        alone: (n, r) log likelihood of each photograph in each room.
        walk: (r, r) log probability of the next photograph's room, by that of a photograph; None without an order.
        pairs: (n, n) log odds that two photographs are of one room, symmetric, zero on the diagonal.
        expected: (r,) number of photographs that each room has a priori; NaN for rooms that can have any number.
    """

    alone: Float[np.ndarray, "n r"]
    walk: Float[np.ndarray, "r r"] | None
    pairs: Float[np.ndarray, "n n"]
    expected: Float[np.ndarray, "r"]
    tightness: float = 1.0


def assign_rooms(
    evidence: RoomEvidence, seed: int = 0, pause: Callable[[], object] = lambda: None
) -> Float[np.ndarray, "n r"]:
    """Return the probability of every room for every photograph; `pause` is called before each sweep."""
    count = len(evidence.alone)
    if count == 0:
        return np.zeros(evidence.alone.shape)
    chains = _Chains(evidence, np.random.default_rng(seed))
    share = min(1.0, _MAX_UPDATES / ((_COOLING + _COUNTED) * count))
    cooling, counted = (max(round(share * sweeps), _FEWEST) for sweeps in (_COOLING, _COUNTED))
    for heat in np.geomspace(_HOTTEST, 1.0, cooling):
        pause()
        chains.sweep(float(heat))
    total = np.zeros(evidence.alone.shape)
    for _ in range(counted):
        pause()
        total += chains.sweep(1.0)
    return total / total.sum(axis=1, keepdims=True)


def _sampled_walks(
    alone: Float[np.ndarray, "n r"], walk: Float[np.ndarray, "r r"], rng: np.random.Generator
) -> Int[np.ndarray, "c n"]:
    """Return rooms drawn by evidence and walk alone (forward filtering, backward sampling)."""
    forward = alone.copy()
    for number in range(1, len(alone)):
        forward[number] += np.logaddexp.reduce(forward[number - 1][:, None] + walk, axis=0)
    room = np.empty((_CHAINS, len(alone)), int)
    after = np.zeros((_CHAINS, alone.shape[1]))
    for number in reversed(range(len(alone))):
        room[:, number] = (forward[number] + after + rng.gumbel(size=after.shape)).argmax(axis=1)
        after = walk[:, room[:, number]].T
    return room


class _Chains:
    """States of several chains: the room of every photograph in each."""

    def __init__(self, evidence: RoomEvidence, rng: np.random.Generator) -> None:
        self._alone, self._pairs, self._rng = evidence.alone, evidence.pairs, rng
        self._rooms = evidence.alone.shape[1]
        self._walk = np.zeros((self._rooms, self._rooms)) if evidence.walk is None else evidence.walk
        self._expected = np.nan_to_num(evidence.expected)
        self._stiffness = np.where(
            np.isnan(evidence.expected), 0.0, evidence.tightness / (2.0 * (self._expected + 1.0))
        )
        self._each = np.arange(_CHAINS)
        self._room = _sampled_walks(evidence.alone / _HOTTEST, self._walk / _HOTTEST, rng)
        one_hot = np.eye(self._rooms)[self._room]
        # Log odds of each photograph with all others of each room, and photographs by room.
        self._linked = np.einsum("tu,cur->ctr", self._pairs, one_hot)
        self._counts = one_hot.sum(axis=1)

    def sweep(self, heat: float) -> Float[np.ndarray, "n r"]:
        """Move everything once; return the summed conditional probabilities of each photograph's room."""
        count = self._room.shape[1]
        found = np.empty((count, self._rooms))
        for number in self._rng.permutation(count).tolist():
            found[number] = self._move_one(number, heat)
        for number in range(max(count // 2, 4)):
            self._move_set(heat, whole=number % 2 == 0)
            self._swap(heat)
        return found

    def _prior(self, counts: Float[np.ndarray, "c r"]) -> Float[np.ndarray, "c r"]:
        return -self._stiffness * np.square(counts - self._expected)

    def _prior_of_more(
        self, counts: Float[np.ndarray, "c r"], more: float | Int[np.ndarray, "c 1"]
    ) -> Float[np.ndarray, "c r"]:
        """Return how the log prior changes with more photographs in a room."""
        return -self._stiffness * more * (2.0 * (counts - self._expected) + more)

    def _move_one(self, number: int, heat: float) -> Float[np.ndarray, "r"]:
        """Draw the room of one photograph; return its conditional probabilities, summed over chains."""
        room, before = self._room, self._room[:, number].copy()
        others = self._counts.copy()
        others[self._each, before] -= 1.0
        log = self._alone[number] + self._linked[:, number] + self._prior_of_more(others, 1.0)
        if number > 0:
            log = log + self._walk[room[:, number - 1]]
        if number + 1 < room.shape[1]:
            log = log + self._walk[:, room[:, number + 1]].T
        share = np.exp(log - log.max(axis=1, keepdims=True))
        share /= share.sum(axis=1, keepdims=True)
        after = self._drawn(log, heat)
        moved = np.flatnonzero(after != before)
        if len(moved):
            mask = np.zeros(room.shape, bool)
            mask[moved, number] = True
            self._relabel(mask, after)
        return share.sum(axis=0)

    def _move_set(self, heat: float, *, whole: bool) -> None:
        """Draw another room for all photographs of one room, or for some successive ones of one room.

        Balance needs sets that the move back can choose as well: whole rooms move to empty ones only, and where
        successive photographs begin and end does not depend on their rooms.
        """
        room, count = self._room, self._room.shape[1]
        start = self._rng.integers(count, size=_CHAINS)
        own = room[self._each, start]
        mask = room == own[:, None]
        if not whole:
            length = self._rng.integers(2, _LONGEST + 1, size=_CHAINS)
            number = np.arange(count)
            inside = (number >= start[:, None]) & (number < (start + length)[:, None])
            mask = inside & (mask | ~inside).all(axis=1)[:, None]
        size = mask.sum(axis=1)
        others = self._counts.copy()
        others[self._each, own] -= size
        log = mask @ self._alone + (mask[:, None, :] @ self._linked)[:, 0]
        # Pairs within the set stay pairs wherever it goes.
        log[self._each, own] -= ((mask @ self._pairs) * mask).sum(axis=1)
        log += self._prior_of_more(others, size[:, None])
        first, second = mask[:, :-1], mask[:, 1:]
        log += (first & second).sum(axis=1)[:, None] * np.diag(self._walk)
        # The ends of the set, whose neighbours are of other rooms or not of the set.
        for ends, neighbours, walk in (
            (first & ~second, room[:, 1:], self._walk.T),
            (~first & second, room[:, :-1], self._walk),
        ):
            chain, number = np.nonzero(ends)
            np.add.at(log, chain, walk[neighbours[chain, number]])
        if whole:
            log[others > 0.0] = -np.inf
        self._relabel(mask, self._drawn(log, heat))

    def _swap(self, heat: float) -> None:
        """Exchange the photographs of two rooms."""
        room = self._room
        one = room[self._each, self._rng.integers(room.shape[1], size=_CHAINS)]
        other = self._rng.integers(self._rooms, size=_CHAINS)
        swapped = np.where(room == one[:, None], other[:, None], np.where(room == other[:, None], one[:, None], room))
        counts = self._counts.copy()
        counts[self._each, one] = self._counts[self._each, other]
        counts[self._each, other] = self._counts[self._each, one]
        gain = self._energy(swapped, counts) - self._energy(room, self._counts)
        accepted = np.log(self._rng.random(_CHAINS)) < gain / heat
        if not accepted.any():
            return
        mask = (room == one[:, None]) & accepted[:, None]
        back = (room == other[:, None]) & accepted[:, None]
        self._relabel(mask, other)
        self._relabel(back, one)

    def _energy(self, room: Int[np.ndarray, "c n"], counts: Float[np.ndarray, "c r"]) -> Float[np.ndarray, "c"]:
        """Return the log probability without the pairs; `counts` are the photographs by room."""
        total = self._alone[np.arange(room.shape[1]), room].sum(axis=1)
        total += self._walk[room[:, :-1], room[:, 1:]].sum(axis=1)
        return total + self._prior(counts).sum(axis=1)

    def _drawn(self, log: Float[np.ndarray, "c r"], heat: float) -> Int[np.ndarray, "c"]:
        return (log / heat + self._rng.gumbel(size=log.shape)).argmax(axis=1)

    def _relabel(self, mask: Bool[np.ndarray, "c n"], after: Int[np.ndarray, "c"]) -> None:
        """Give the photographs of a mask a room, the same in each chain."""
        chain, number = np.nonzero(mask & (self._room != after[:, None]))
        before, new = self._room[chain, number], after[chain]
        np.add.at(self._counts, (chain, before), -1.0)
        np.add.at(self._counts, (chain, new), 1.0)
        for c, t, a, b in zip(chain.tolist(), number.tolist(), before.tolist(), new.tolist(), strict=True):
            self._linked[c, :, a] -= self._pairs[t]
            self._linked[c, :, b] += self._pairs[t]
        self._room[chain, number] = new


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
