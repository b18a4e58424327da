"""Assignment of all photographs to rooms at once, by Markov chain Monte Carlo.

The energy of an assignment is the sum of four parts: the evidence of each photograph for its room, the log probability
of the walk from each photograph to the next, the log odds of pairs that look as if they are of one room, and a prior of
how many photographs each room has. The last one makes the evidence exclusive: a bathroom that explains all photographs
of a home is unlikely, as people photograph every room. How many are of none of the rooms is learnt in the album: the
share of them has a beta distribution, so that the more there are, the more likely is another one.

People mostly walk from room to room through doors, and photograph large rooms more often (`walk_of`,
`expected_shares`).

Chains of several temperatures exchange their states (parallel tempering: Geyer, 1991); those of temperature 1 count.
Beside single photographs, chains move all photographs of a room, or a run of them, to another room, and exchange two
rooms, or two storeys: these moves leave the pairs alone, between whose optima single moves get stuck.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from lalaloc_core.localise.album.ground import AlbumGround

# Chains of each temperature, and temperatures from 1 to the hottest. Many short chains tell more within a time than few
# long ones, as some optima are far from each other.
_LADDERS, _LEVELS, _HOTTEST = 12, 4, 2.5
_CHAINS = _LADDERS * _LEVELS
# Sweeps over all photographs: those before counting, and those that are counted. Large albums have fewer, to bound the
# time.
_SETTLING, _COUNTED, _MAX_UPDATES = 40, 60, 2000
_FEWEST = 12
# Most successive photographs that move together.
_LONGEST = 6
# Storeys whose exchange is tried: the largest ones, of at least so many rooms.
_MOST_STOREYS, _STOREY_ROOMS = 4, 2
# Pairs of a room count like those of each photograph with so many others, as photographs of a room that look alike are
# no independent signs: their sum would draw all photographs of a home with white walls into one room.
PARTNERS = 3.0
# Probability that the next photograph is of the same room, that it is of any room at all, and the weight of rooms that
# are a further door away over that of nearer ones; walks are followed through so many doors.
_STAY, _ANYWHERE, _FURTHER, _DOORS = 0.5, 0.3, 0.5, 4
# Rooms nearer than this (m) are joined if the plan draws no doors.
_JOINED_M = 0.4
# Beta distribution of the share of photographs of none of the rooms: in most folders it is one in ten.
_AWAY = 1.0, 9.0
# Rooms smaller than this (m²) are often left out, and those of these types mostly.
_SMALL_M2, _SMALL_SHARE = 3.0, 0.5
_RARE, _RARE_SHARE = {"closet", "storage", "garage"}, 0.3


@dataclass(frozen=True, eq=False, kw_only=True)
class RoomEvidence:
    """Evidence for the rooms of n photographs, those of a walk in their order; the last room is "elsewhere".

    Attributes:
        alone: (n, r) log likelihood of each photograph in each room.
        walk: (r, r) log probability of the next photograph's room, by that of a photograph; None without an order.
        follows: (n,) whether a photograph follows the one before it on a walk; never the first.
        pairs: (n, n) log odds that two photographs are of one room, symmetric, zero on the diagonal; they do not count
            elsewhere, which is no room, and in rooms of many photographs less (`PARTNERS`).
        expected: (r - 1,) share that each room has a priori of the photographs that are of any; None for no prior.
        storeys: rooms of each storey; empty for no exchange of them.
    """

    alone: Float[np.ndarray, "n r"]
    walk: Float[np.ndarray, "r r"] | None
    follows: Bool[np.ndarray, "n"]
    pairs: Float[np.ndarray, "n n"]
    expected: Float[np.ndarray, "q"] | None
    crowding: float = 1.0
    storeys: tuple[Int[np.ndarray, "_"], ...] = ()


def assign_rooms(
    evidence: RoomEvidence, seed: int = 0, pause: Callable[[], object] = lambda: None
) -> Float[np.ndarray, "n r"]:
    """Return the probability of every room for every photograph; `pause` is called before each sweep."""
    count = len(evidence.alone)
    if count == 0:
        return np.zeros(evidence.alone.shape)
    chains = _Chains(evidence, np.random.default_rng(seed))
    share = min(1.0, _MAX_UPDATES / ((_SETTLING + _COUNTED) * count))
    settling, counted = (max(round(share * sweeps), _FEWEST) for sweeps in (_SETTLING, _COUNTED))
    for _ in range(settling):
        pause()
        chains.sweep()
    total = np.zeros(evidence.alone.shape)
    for _ in range(counted):
        pause()
        total += chains.sweep()
    return total / total.sum(axis=1, keepdims=True)


def _sampled_walks(
    evidence: RoomEvidence, heat: Float[np.ndarray, "c"], rng: np.random.Generator
) -> Int[np.ndarray, "c n"]:
    """Return rooms drawn by evidence and walk alone (forward filtering, backward sampling) at the highest heat."""
    hottest = float(heat.max())
    forward = evidence.alone / hottest
    walk = np.zeros((forward.shape[1],) * 2) if evidence.walk is None else evidence.walk / hottest
    for number in np.flatnonzero(evidence.follows).tolist():
        forward[number] += np.logaddexp.reduce(forward[number - 1][:, None] + walk, axis=0)
    room = np.empty((len(heat), len(forward)), int)
    for number in reversed(range(len(forward))):
        is_followed = number + 1 < len(forward) and evidence.follows[number + 1]
        after = walk[:, room[:, number + 1]].T if is_followed else 0.0
        room[:, number] = (forward[number] + after + rng.gumbel(size=(len(heat), forward.shape[1]))).argmax(axis=1)
    return room


class _Chains:
    """States of several chains: the room of every photograph in each."""

    def __init__(self, evidence: RoomEvidence, rng: np.random.Generator) -> None:
        self._alone, self._pairs, self._rng = evidence.alone, evidence.pairs, rng
        self._rooms = evidence.alone.shape[1]
        self._walk = np.zeros((self._rooms, self._rooms)) if evidence.walk is None else evidence.walk
        self._follows = evidence.follows
        self._expected = np.zeros(self._rooms - 1) if evidence.expected is None else evidence.expected
        self._crowding = 0.0 if evidence.expected is None else 0.5 * evidence.crowding
        # Log probability of the photographs that are of none of the rooms, by their number.
        count = len(evidence.alone)
        self._away = np.array(
            [math.lgamma(_AWAY[0] + away) + math.lgamma(_AWAY[1] + count - away) for away in range(count + 1)]
        )
        self._each = np.arange(_CHAINS)
        # Temperature of each chain, and the number of each chain by ladder and temperature.
        self._heat = np.tile(np.geomspace(1.0, _HOTTEST, _LEVELS), _LADDERS)
        self._ladder = np.arange(_CHAINS).reshape(_LADDERS, _LEVELS)
        self._room = _sampled_walks(evidence, self._heat, rng)
        one_hot = np.eye(self._rooms)[self._room]
        # Log odds of each photograph with all others of each room, and photographs by room.
        self._linked = np.einsum("tu,cur->ctr", self._pairs, one_hot)
        self._linked[:, :, -1] = 0.0
        self._counts = one_hot.sum(axis=1)
        # Sum of the log odds of the pairs within each room, and what it counts by the number of photographs.
        self._within = 0.5 * np.einsum("ctr,ctr->cr", self._linked, one_hot)
        self._share = np.minimum(PARTNERS / np.maximum(np.arange(count + 1) - 1.0, 1.0), 1.0)
        self._exchanges = _exchanges(evidence)

    def sweep(self) -> Float[np.ndarray, "n r"]:
        """Move everything once; return the conditional probabilities of each photograph's room at temperature 1."""
        count = self._room.shape[1]
        found = np.empty((count, self._rooms))
        for number in self._rng.permutation(count).tolist():
            found[number] = self._move_one(number)
        for number in range(max(count // 2, 4)):
            self._move_set(whole=number % 2 == 0)
            self._exchange_rooms(self._random_exchange())
        for rooms in self._exchanges:
            self._exchange_rooms(np.broadcast_to(rooms, (_CHAINS, self._rooms)))
        for first in (0, 1):
            self._exchange_heats(first)
        return found

    def _prior(self, counts: Float[np.ndarray, "c r"]) -> Float[np.ndarray, "c"]:
        """Return the log prior of numbers of photographs."""
        inside = counts[:, :-1]
        expected = inside.sum(axis=1, keepdims=True) * self._expected
        unusual = self._crowding * np.square(inside - expected) / (expected + 1.0)
        return self._away[counts[:, -1].astype(int)] - unusual.sum(axis=1)

    def _prior_with(self, counts: Float[np.ndarray, "c r"], more: Float[np.ndarray, "#c"]) -> Float[np.ndarray, "c r"]:
        """Return the log prior with more photographs in each of the rooms."""
        inside, away = counts[:, :-1], counts[:, -1].astype(int)
        expected = (inside.sum(axis=1) + more)[:, None] * self._expected
        weight, off = self._crowding / (expected + 1.0), inside - expected
        found = np.empty(counts.shape)
        found[:, :-1] = -weight * more[:, None] * (2.0 * off + more[:, None])
        found[:, :-1] += (self._away[away] - (weight * np.square(off)).sum(axis=1))[:, None]
        outside = counts.copy()
        outside[:, -1] += more
        found[:, -1] = self._prior(outside)
        return found

    def _move_one(self, number: int) -> Float[np.ndarray, "r"]:
        """Draw the room of one photograph; return its conditional probabilities, summed over chains that count."""
        room, before = self._room, self._room[:, number].copy()
        others = self._counts.copy()
        others[self._each, before] -= 1.0
        within = self._within.copy()
        within[self._each, before] -= self._linked[self._each, number, before]
        log = self._alone[number] + self._of_pairs(within + self._linked[:, number], others + 1.0)
        log += self._prior_with(others, np.ones(1)) - self._of_pairs(within, others)
        if self._follows[number]:
            log = log + self._walk[room[:, number - 1]]
        if number + 1 < room.shape[1] and self._follows[number + 1]:
            log = log + self._walk[:, room[:, number + 1]].T
        cold = log[self._heat == 1.0]
        share = np.exp(cold - cold.max(axis=1, keepdims=True))
        share /= share.sum(axis=1, keepdims=True)
        after = self._drawn(log)
        moved = np.flatnonzero(after != before)
        if len(moved):
            mask = np.zeros(room.shape, bool)
            mask[moved, number] = True
            self._relabel(mask, after)
        return share.sum(axis=0)

    def _move_set(self, *, whole: bool) -> None:
        """Draw another room for all photographs of one room, or for some successive ones of one room.

        Balance needs sets that the move back can choose as well: whole rooms move to empty ones only, and where
        successive photographs begin and end does not depend on their rooms.
        """
        room, count = self._room, self._room.shape[1]
        start = self._rng.integers(count, size=_CHAINS)
        present = room[self._each, start]
        mask = room == present[:, None]
        if not whole:
            length = self._rng.integers(2, _LONGEST + 1, size=_CHAINS)
            number = np.arange(count)
            inside = (number >= start[:, None]) & (number < (start + length)[:, None])
            mask = inside & (mask | ~inside).all(axis=1)[:, None]
        size = mask.sum(axis=1)
        others = self._counts.copy()
        others[self._each, present] -= size
        # Pairs within the set stay pairs in whichever room it goes to.
        own = 0.5 * ((mask @ self._pairs) * mask).sum(axis=1)[:, None]
        linked = (mask[:, None, :] @ self._linked)[:, 0]
        linked[:, :-1] += np.where(np.arange(self._rooms - 1) == present[:, None], -own, own)
        within = self._within.copy()
        within[self._each, present] -= linked[self._each, present]
        log = mask @ self._alone + self._of_pairs(within + linked, others + size[:, None])
        log += self._prior_with(others, size.astype(float)) - self._of_pairs(within, others)
        first, second = mask[:, :-1], mask[:, 1:]
        log += (first & second & self._follows[1:]).sum(axis=1)[:, None] * np.diag(self._walk)
        # The ends of the set, whose neighbours are of other rooms or not of the set.
        for ends, neighbours, walk in (
            (first & ~second, room[:, 1:], self._walk.T),
            (~first & second, room[:, :-1], self._walk),
        ):
            chain, number = np.nonzero(ends & self._follows[1:])
            np.add.at(log, chain, walk[neighbours[chain, number]])
        if whole:
            log[others > 0.0] = -np.inf
        self._relabel(mask, self._drawn(log))

    def _of_pairs(self, within: Float[np.ndarray, "c r"], counts: Float[np.ndarray, "c r"]) -> Float[np.ndarray, "c r"]:
        """Return the log odds of the pairs of each room, by their sum and the number of photographs."""
        return self._share[counts.astype(int)] * within

    def _random_exchange(self) -> Int[np.ndarray, "c r"]:
        """Return an exchange of a photograph's room with any other."""
        first_room = self._room[self._each, self._rng.integers(self._room.shape[1], size=_CHAINS)]
        second_room = self._rng.integers(self._rooms - 1, size=_CHAINS)
        # Elsewhere is no room: pairs do not count there.
        second_room = np.where(first_room == self._rooms - 1, first_room, second_room)
        rooms = np.tile(np.arange(self._rooms), (_CHAINS, 1))
        rooms[self._each, first_room], rooms[self._each, second_room] = second_room, first_room
        return rooms

    def _exchange_rooms(self, rooms: Int[np.ndarray, "c r"]) -> None:
        """Give the photographs of every room another one, where the chain accepts it; `rooms` is its own inverse."""
        room, counts = np.take_along_axis(rooms, self._room, axis=1), np.take_along_axis(self._counts, rooms, axis=1)
        gain = self._energy(room, counts) - self._energy(self._room, self._counts)
        for chain in np.flatnonzero(np.log(self._rng.random(_CHAINS)) < gain / self._heat).tolist():
            self._room[chain], self._counts[chain] = room[chain], counts[chain]
            self._within[chain] = self._within[chain][rooms[chain]]
            changed = np.flatnonzero(rooms[chain] != np.arange(self._rooms))
            self._linked[chain][:, changed] = self._linked[chain][:, rooms[chain, changed]]

    def _exchange_heats(self, first: int) -> None:
        """Exchange the states of neighbouring temperatures: 0 and 1, 2 and 3, ..., or from the second on."""
        energy = self._energy(self._room, self._counts)
        energy += self._of_pairs(self._within, self._counts).sum(axis=1)
        for colder, hotter in zip(self._ladder.T[first:-1:2], self._ladder.T[first + 1 :: 2], strict=True):
            gain = (1.0 / self._heat[colder] - 1.0 / self._heat[hotter]) * (energy[hotter] - energy[colder])
            accepted = np.log(self._rng.random(_LADDERS)) < gain
            one, other = colder[accepted], hotter[accepted]
            self._heat[one], self._heat[other] = self._heat[other], self._heat[one]
        self._ladder = np.take_along_axis(self._ladder, self._heat[self._ladder].argsort(axis=1), axis=1)

    def _energy(self, room: Int[np.ndarray, "c n"], counts: Float[np.ndarray, "c r"]) -> Float[np.ndarray, "c"]:
        """Return the log probability without the pairs; `counts` are the photographs by room."""
        total = self._alone[np.arange(room.shape[1]), room].sum(axis=1)
        total += (self._walk[room[:, :-1], room[:, 1:]] * self._follows[1:]).sum(axis=1)
        return total + self._prior(counts)

    def _drawn(self, log: Float[np.ndarray, "c r"]) -> Int[np.ndarray, "c"]:
        return (log / self._heat[:, None] + self._rng.gumbel(size=log.shape)).argmax(axis=1)

    def _relabel(self, mask: Bool[np.ndarray, "c n"], after: Int[np.ndarray, "c"]) -> None:
        """Give the photographs of a mask a room, the same in each chain."""
        chain, number = np.nonzero(mask & (self._room != after[:, None]))
        before, new = self._room[chain, number], after[chain]
        np.add.at(self._counts, (chain, before), -1.0)
        np.add.at(self._counts, (chain, new), 1.0)
        for c, t, a, b in zip(chain.tolist(), number.tolist(), before.tolist(), new.tolist(), strict=True):
            self._within[c, a] -= self._linked[c, t, a]
            self._linked[c, :, a] -= self._pairs[t]
            self._within[c, b] += self._linked[c, t, b]
            self._linked[c, :, b] += self._pairs[t]
        self._linked[:, :, -1] = self._within[:, -1] = 0.0
        self._room[chain, number] = new


def _exchanges(evidence: RoomEvidence) -> list[Int[np.ndarray, "r"]]:
    """Return exchanges of two storeys: each room with the one that fits the same photographs best, or with itself."""
    # Imported late: only albums of several storeys need it.
    from scipy.optimize import linear_sum_assignment

    share = evidence.alone - evidence.alone.max(axis=1, keepdims=True)
    alike = np.exp(share - np.logaddexp.reduce(share, axis=1)[:, None])
    found = []
    for one, other in combinations(evidence.storeys, 2):
        first, second = linear_sum_assignment(alike[:, one].T @ alike[:, other], maximize=True)
        rooms = np.arange(evidence.alone.shape[1])
        rooms[one[first]], rooms[other[second]] = other[second], one[first]
        found.append(rooms)
    return found


def walk_of(ground: AlbumGround) -> Float[np.ndarray, "s s"]:
    """Return log probabilities of the next photograph's room (columns) by that of a photograph.

    The last column is none of the rooms, which order does not change; after it, all rooms are as likely as those of a
    walk are on average, so that it costs nothing to leave a photograph out of the walk.
    """
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
    walk = np.zeros((rooms + 1, rooms + 1))
    walk[:rooms, :rooms] = np.log(inside)
    walk[rooms, :rooms] = (inside * walk[:rooms, :rooms]).sum(axis=1).mean()
    return walk


def storeys_of(ground: AlbumGround) -> tuple[Int[np.ndarray, "_"], ...]:
    """Return the rooms of the largest parts of a place whose rooms are joined by doors, such as storeys."""
    _, part = connected_components(csr_array(_joined(ground)), directed=False)
    size = np.bincount(part)
    largest = [number for number in np.argsort(-size, kind="stable")[:_MOST_STOREYS] if size[number] >= _STOREY_ROOMS]
    return tuple(np.flatnonzero(part == number) for number in largest)


def expected_shares(ground: AlbumGround) -> Float[np.ndarray, "r"]:
    """Return the share of the photographs that each room has a priori: large rooms have more, closets few."""
    rooms = ground.plan.rooms
    area = np.array([room.area_m2 for room in rooms])
    is_rare = np.array([bool(room.types) and _RARE.issuperset(room.types) for room in rooms])
    share = np.sqrt(area) * np.where(is_rare, _RARE_SHARE, np.where(area < _SMALL_M2, _SMALL_SHARE, 1.0))
    return share / share.sum()


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
