"""Cost of a pose by evidence that is not about the room's outline: hints, drawn fixtures, and directions of walls.

**Fixtures.** An object of the kind of a fixture, present with the probability p and seen at the azimuth α, agrees with
a pose from which the plan shows such a fixture there, at the azimuth φ:

    f(pose) = 1 - p + p ((1 - m) g(pose) + m),    g = mean over the fixtures of the room of F N(α - φ; σ)

The classifier shares the probability q among all objects of the photograph, so p = q / (q + 0.15), which is not fitted.
The fixture is not drawn, or stands in another room, with the probability m. N is the normal distribution with the
deviation σ, of the object's azimuth and the fixture's width, and F the usual field of view, within which an object of
unknown place would be anywhere. In rooms without such a fixture g is 0; rooms with many tell no direction, g is 1.
Kinds that the plan draws nowhere are left out.

**Directions.** Lines of a photograph tell the directions of the walls relative to its centre, up to quarter turns
(`photograph.levelling`). Under a hypothesis of the heading they have the azimuth α in the plan, whose density is

    f(α) = (1 - o) sum_i l_i N(α - φ_i; σ) + o / 90°

with the shares l of the walls' length in the room by their direction φ, modulo 90°. o is the probability that the lines
are of something else, and σ has the deviation of the estimate, of walls that are not quite straight, and of headings
between two hypotheses. Photographs of one spot see the same walls, so the mean of their costs counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FixturePlaces, FloorPlan
from lalaloc_core.localise.query import Hints, Query, SeenObject, WallDirection

# Names of recognised objects that are fixtures; the others tell the type of the room alone.
_FIXTURES = {
    "stove": "stove", "oven": "stove", "refrigerator": "fridge", "bathtub": "bath", "tub": "bath", "toilet seat":
    "toilet", "toilet": "toilet", "washbasin": "basin", "shower curtain": "shower", "washing machine": "washer",
    "four-poster bed": "bed", "quilt": "bed", "bed": "bed", "couch": "sofa", "banister": "stairs",
}  # fmt: skip
# m, and the q at which an object is as likely present as not.
_ELSEWHERE, _EVEN = 0.5, 0.15
# F and the deviation of an object's azimuth (radians), and the largest deviation by a fixture's width.
_FIELD, _AZIMUTH_SD, _MAX_SD = math.radians(70.0), math.radians(12.0), math.radians(45.0)
# Rooms with more fixtures of a kind, such as the washrooms of a stadium, tell no direction.
_MAX_FIXTURES = 12
# More fixtures of the kinds that are seen, or rooms with them of a larger area (m²), tell nothing, which bounds work
# and memory of a query.
_MAX_SEEN, _MAX_AREA_M2 = 500, 5000.0
# o, and the deviation (degrees) of directions beside that of the estimate; estimates with a larger one tell nothing.
OTHER_LINES = 0.2
_DIRECTION_SD, _MAX_DIRECTION_SD = 1.5, 15.0
_QUARTER = 90.0


@dataclass(frozen=True, eq=False)
class PlaceCost:
    """Cost of n poses by the hypothesis of the heading, in units of the matching cost.

    Attributes:
        hint: (n,) cost of the hints; infinite where strict ones exclude a pose.
        parts: costs of the fixtures and of the directions of the walls that tell anything, (r, k) or, where they do not
            depend on the heading, (r, 1), each with the (n,) numbers of the poses' rows in it.
    """

    hint: Float[np.ndarray, "n"]
    parts: Sequence[tuple[Float[np.ndarray, "_ #k"], Int[np.ndarray, "n"]]]

    @classmethod
    def of(
        cls,
        plan: FloorPlan,
        query: Query,
        hints: Hints,
        temperature: float,
        position_m: Float[np.ndarray, "n 2"],
        room_index: Int[np.ndarray, "n"],
    ) -> PlaceCost | None:
        """Return the cost of some poses; None if none of the evidence tells anything."""
        seen = [] if query.objects is None else _seen_fixtures(plan, query.objects.objects)
        told = [each for each in query.wall_directions if math.degrees(each.sd) < _MAX_DIRECTION_SD]
        if hints.are_none and not seen and not told:
            return None
        hint, parts = np.zeros(len(position_m)), []
        if not hints.are_none:
            hint = hints.penalty(plan, position_m, room_index) / temperature
        if seen:
            parts.append(_fixture_costs(plan, query, seen, position_m, room_index))
        if told:
            # Candidates are in few rooms of a plan that can have thousands.
            rooms, room = np.unique(room_index, return_inverse=True)
            parts.append((_direction_costs(plan.wall_directions[rooms], query, told), room))
        return cls(hint, [(cost / temperature, row) for cost, row in parts])

    def lowest(self, pose: Int[np.ndarray, "m"], neighbours: int) -> Float[np.ndarray, "m #l"]:
        """Return lower bounds of the cost of some poses under each so many neighbouring hypotheses."""
        lowest = self.hint[pose, None]
        for cost, row in self.parts:
            part = np.minimum.reduceat(cost, np.arange(0, cost.shape[1], neighbours), axis=1)
            lowest = lowest + part[row[pose]]
        return lowest

    def of_poses(self, pose: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m #k"]:
        """Return the cost of some poses under every hypothesis, (m, 1) where it does not depend on that."""
        return sum((cost[row[pose]] for cost, row in self.parts), self.hint[pose, None])

    def of_pairs(self, pose: Int[np.ndarray, "m"], hypothesis: Int[np.ndarray, "#m"]) -> Float[np.ndarray, "m"]:
        """Return the cost of some pairs of a pose and a hypothesis."""
        return self.hint[pose] + sum(
            cost[row[pose], hypothesis if cost.shape[1] > 1 else np.zeros_like(hypothesis)] for cost, row in self.parts
        )


def _seen_fixtures(plan: FloorPlan, objects: tuple[SeenObject, ...]) -> list[SeenObject]:
    """Return the most probable object of each kind of fixture that the plan draws, with the kind as its name."""
    best = dict[str, SeenObject]()
    for each in objects:
        kind = _FIXTURES.get(each.name)
        if kind is None or kind not in plan.fixtures_by_kind:
            continue
        if kind not in best or best[kind].probability < each.probability:
            best[kind] = SeenObject(kind, each.probability, each.azimuth)
    rooms = np.concatenate([np.empty(0, np.intp), *(plan.fixtures_by_kind[kind].room_index for kind in best)])
    if len(rooms) > _MAX_SEEN or plan.areas_m2[np.unique(rooms[rooms >= 0])].sum() > _MAX_AREA_M2:
        return []
    return list(best.values())


def _fixture_costs(
    plan: FloorPlan,
    query: Query,
    seen: list[SeenObject],
    position_m: Float[np.ndarray, "n 2"],
    room_index: Int[np.ndarray, "n"],
) -> tuple[Float[np.ndarray, "f k"], Int[np.ndarray, "n"]]:
    """Return the negative log likelihood (nats, at least 0) of rows, and the number of each pose's row.

    Poses in rooms without any of the fixtures share row 0.
    """
    row = np.zeros(len(position_m), np.intp)
    rooms = np.concatenate([plan.fixtures_by_kind[each.name].room_index for each in seen])
    beside = np.flatnonzero(np.isin(room_index, rooms))
    row[beside] = 1 + np.arange(len(beside))
    cost = np.zeros((1 + len(beside), len(query.roll)), np.float32)
    for each in seen:
        share = each.probability / (each.probability + _EVEN)
        agreement, places = np.zeros(cost.shape, np.float32), plan.fixtures_by_kind[each.name]
        agreement[1:] = _agreement(places, query, each, position_m[beside], room_index[beside])
        # At least 0, by the highest density there is, so that costs of poses that are compared later are comparable.
        cost += _log_factor(share, _FIELD / (math.sqrt(2.0 * math.pi) * _AZIMUTH_SD)) - _log_factor(share, agreement)
    return cost, row


def _log_factor(share: float, agreement: float | Float[np.ndarray, "f k"]) -> float | Float[np.ndarray, "f k"]:
    """Return log f of an object that is present with a probability."""
    return np.log(1.0 - share + share * ((1.0 - _ELSEWHERE) * agreement + _ELSEWHERE))


def _agreement(
    places: FixturePlaces,
    query: Query,
    each: SeenObject,
    position_m: Float[np.ndarray, "m 2"],
    room_index: Int[np.ndarray, "m"],
) -> Float[np.ndarray, "m k"]:
    """Return g of every pose under every hypothesis."""
    found = np.zeros((len(position_m), len(query.roll)), np.float32)
    azimuth = query.roll + query.frame_heading + each.azimuth
    order = np.argsort(room_index, kind="stable")
    begin, end = (np.searchsorted(room_index[order], places.room_index, side) for side in ("left", "right"))
    for number, room in enumerate(places.room_index):
        rows, count = order[begin[number] : end[number]], int((places.room_index == room).sum())
        if count > _MAX_FIXTURES:
            found[rows] = 1.0
            continue
        away_m = places.centre_m[number] - position_m[rows]
        distance_m = np.maximum(np.hypot(*away_m.T), 0.1)
        deviation = np.hypot(_AZIMUTH_SD, np.minimum(0.5 * places.width_m[number] / distance_m, _MAX_SD))[:, None]
        off = wrap_angle(azimuth - np.arctan2(away_m[:, 0], away_m[:, 1])[:, None]) / deviation
        found[rows] += _FIELD / count * np.exp(-0.5 * np.square(off)) / (math.sqrt(2.0 * math.pi) * deviation)
    return found


def _direction_costs(
    walls: Float[np.ndarray, "r 90"], query: Query, told: list[WallDirection]
) -> Float[np.ndarray, "r k"]:
    """Return the negative log likelihood (nats, at least 0) of directions in rooms, by their `wall_directions`."""
    cost = np.zeros((len(walls), len(query.roll)), np.float32)
    between = math.degrees(query.sector) / math.sqrt(12.0)
    for each in told:
        deviation = math.hypot(math.degrees(each.sd), _DIRECTION_SD, between)
        azimuth = np.degrees(query.roll + query.frame_heading + each.azimuth)
        off = (azimuth[:, None] - np.arange(_QUARTER) + 0.5 * _QUARTER) % _QUARTER - 0.5 * _QUARTER
        peak = (1.0 - OTHER_LINES) / (math.sqrt(2.0 * math.pi) * deviation)
        kernel = (peak * np.exp(-0.5 * np.square(off / deviation))).astype(np.float32)
        # At least 0, by the highest density there is, as for fixtures.
        other = OTHER_LINES / _QUARTER
        cost += math.log(peak + other) - np.log(walls @ kernel.T + other)
    return cost / len(told)
