"""Hints: priors of the camera's place that the posterior is multiplied with.

Each hint h states that the camera stands in a region with the share s of the plan's area. It is right with the
probability 1 - ε; otherwise the camera can be anywhere:

    f_h(place) = (1 - ε) g_h(place) / s_h + ε

`g` is 1 inside the region and 0 outside. Around a point it falls off beyond the radius r, by
`exp(-½ ((d - r) / (r / 3))²)` at the distance d, as a stated radius is approximate. Because of ε a place outside wins
if the picture makes it likelier by the factor `1 + (1 - ε) / (ε s)`. `strict` hints exclude every place outside.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import shapely
from jaxtyping import Float, Int

from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan

HintName = Literal["near", "rooms", "level"]
RADIUS_RANGE_M = (0.1, 1000.0)
# ε, the probability that a hint is wrong.
_DOUBT = 0.02
# Smallest share of a region, so that very small regions can be doubted as well.
_MIN_SHARE = 1e-3
# Width of the fall-off around a point, in units of its radius; a place with g below `_MISSED` misses the hint.
_FALL_OFF, _MISSED = 1.0 / 3.0, 0.5
# Number of rooms that the error about an unknown room lists.
_ROOMS_LISTED = 20


@dataclass(frozen=True)
class Near:
    """A point of the plan, and a radius around it within which the camera stands.

    `label` is the point as it was given, if not by x and y.
    """

    x_m: float
    y_m: float
    radius_m: float
    label: str = ""

    def __str__(self) -> str:
        return self.label or f"({self.x_m:g}, {self.y_m:g})"

    def distance_m(
        self, position_m: Float[np.ndarray, "n 2"], room_index: Int[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n"]:
        """Return the distance (m) of places from the point."""
        return np.hypot(position_m[:, 0] - self.x_m, position_m[:, 1] - self.y_m)


@dataclass(frozen=True, eq=False)
class NearInEach:
    """One place in each of several plans that are searched as one, such as a GPS position in all storeys of a house.

    `point_m` is in the frame of each room's plan; NaN if the position of that plan is unknown, for which the hint does
    not apply. `label` is the place as it was given.
    """

    point_m: Float[np.ndarray, "r 2"]
    radius_m: float
    label: str

    def __str__(self) -> str:
        return self.label

    def distance_m(
        self, position_m: Float[np.ndarray, "n 2"], room_index: Int[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n"]:
        """Return the distance (m) of places in some rooms from it; NaN if that is unknown."""
        return np.linalg.norm(position_m - self.point_m[room_index], axis=1)


@dataclass(frozen=True)
class Hints:
    """Hints of one query; by default none.

    Attributes:
        near: a place that the camera is near to.
        rooms: numbers of the rooms that the camera can be in.
        level: numbers of the rooms on the camera's level, of plans that are searched as one.
        strict: exclude every place outside.
        shares: share of the area inside a hint's region, if it is not of this plan alone, but of all plans of a venue.
    """

    near: Near | NearInEach | None = None
    rooms: frozenset[int] | None = None
    level: frozenset[int] | None = None
    strict: bool = False
    shares: Mapping[HintName, float] = field(default_factory=dict)

    def check(self, plan: FloorPlan) -> None:
        """Check that the hints fit a plan.

        Raises:
            InvalidHintError: a radius is outside its limits, a point is farther than its radius from every room, or
                `rooms` is empty.
        """
        if self.rooms is not None and not self.rooms:
            raise InvalidHintError("rooms", "no room is named: name at least one, or omit the hint")
        if not isinstance(self.near, Near):
            return
        low, high = RADIUS_RANGE_M
        if not low <= self.near.radius_m <= high:
            raise InvalidHintError(
                "radius_m", f"it is {self.near.radius_m:g} m; it must be between {low:g} and {high:g} m"
            )
        if not (math.isfinite(self.near.x_m) and math.isfinite(self.near.y_m)):
            raise InvalidHintError(
                "near", f"{self.near} is not a point of the plan: give two finite coordinates in metres"
            )
        point = shapely.Point(self.near.x_m, self.near.y_m)
        away_m = min(shapely.distance(shapely.Polygon(room.polygon_m), point) for room in plan.rooms)
        if away_m > self.near.radius_m:
            raise InvalidHintError(
                "near",
                f"{self.near} is {away_m:.3g} m from the nearest room of the plan; "
                f"the limit is radius_m, {self.near.radius_m:g} m",
            )

    def penalty(
        self, plan: FloorPlan, position_m: Float[np.ndarray, "n 2"], room_index: Int[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n"]:
        """Return the negative log prior of places (nats): 0 if all hints hold, infinite if strict ones exclude it."""
        total = np.zeros(len(position_m))
        for name, inside in self._inside(position_m, room_index).items():
            if self.strict:
                total[~(inside >= 1.0)] = np.inf
                continue
            share = max(self._share(plan, name), _MIN_SHARE)
            odds = (1.0 - _DOUBT) / (_DOUBT * share)
            # f is 1 where the hint does not apply, as it is for g equal to the share.
            total += math.log1p(odds) - np.log1p(odds * np.where(np.isnan(inside), share, inside))
        return total

    def missed(self, position_m: Float[np.ndarray, "2"], room_index: int) -> tuple[HintName, ...]:
        """Return the hints that do not hold at a place."""
        inside = self._inside(np.asarray(position_m)[None], np.array([room_index]))
        return tuple(name for name, share in inside.items() if share[0] < _MISSED)

    @property
    def are_none(self) -> bool:
        """True if there are no hints."""
        return self.near is None and self.rooms is None and self.level is None

    @property
    def relaxed(self) -> Hints:
        """The same hints, not strict."""
        return replace(self, strict=False)

    def _inside(
        self, position_m: Float[np.ndarray, "n 2"], room_index: Int[np.ndarray, "n"]
    ) -> dict[HintName, Float[np.ndarray, "n"]]:
        """Return the g of every hint; NaN where the hint does not apply."""
        found: dict[HintName, Float[np.ndarray, "n"]] = {}
        if self.near is not None:
            beyond = np.maximum(self.near.distance_m(position_m, room_index) / self.near.radius_m - 1.0, 0.0)
            found["near"] = np.exp(-0.5 * np.square(beyond / _FALL_OFF))
        for name, rooms in self._room_hints().items():
            found[name] = np.isin(room_index, list(rooms)).astype(float)
        return found

    def _room_hints(self) -> dict[HintName, frozenset[int]]:
        given: dict[HintName, frozenset[int] | None] = {"rooms": self.rooms, "level": self.level}
        return {name: rooms for name, rooms in given.items() if rooms is not None}

    def _share(self, plan: FloorPlan, name: HintName) -> float:
        """Return the share of the plan's area inside a hint's region."""
        if name in self.shares:
            return self.shares[name]
        if name == "near":
            assert self.near is not None
            return min(math.pi * self.near.radius_m**2 / plan.area_m2, 1.0)
        return sum(plan.rooms[index].area_m2 for index in self._room_hints()[name]) / plan.area_m2


NO_HINTS = Hints()


def log_factor(inside: Float[np.ndarray, "n"], share: float, *, strict: bool) -> Float[np.ndarray, "n"]:
    """Return the log of f, the factor of the prior; 0 without a hint.

    `inside` is g of each place or region, and `share` the share of the whole area inside the hint's region; `strict`
    excludes every place outside.
    """
    share = max(share, _MIN_SHARE)
    doubt = 0.0 if strict else _DOUBT
    with np.errstate(divide="ignore"):
        return np.log((1.0 - doubt) * inside / share + doubt)


def rooms_named(plan: FloorPlan, names: list[str]) -> frozenset[int]:
    """Return the numbers of the rooms with some ids or, for what is no id, names.

    Raises:
        InvalidHintError: no room has one of them.
    """
    found: set[int] = set()
    for name in names:
        by_id = {index for index, room in enumerate(plan.rooms) if room.id == name}
        wanted = name.strip().casefold()
        called = by_id or {index for index, room in enumerate(plan.rooms) if room.name.casefold() == wanted}
        if not called:
            known = [f"'{room.id}'" for room in plan.rooms[:_ROOMS_LISTED]]
            more = len(plan.rooms) - len(known)
            listed = ", ".join(known) + (f" and {more} more" if more else "")
            raise InvalidHintError("rooms", f"the plan has no room '{name:.50}'; its rooms are {listed}")
        found |= called
    return frozenset(found)
