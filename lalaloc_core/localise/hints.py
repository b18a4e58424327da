"""What is known of a camera's place beforehand: priors that the posterior is multiplied with.

Each hint h says that the camera stands in a region, of the share s of the plan's area. It is right with the probability
1 - ε; else the camera may be anywhere:

    f_h(place) = (1 - ε) g_h(place) / s_h + ε

`g` is 1 inside the region and 0 outside. Around a point it falls off beyond the radius r, by
`exp(-½ ((d - r) / (r / 3))²)` at the distance d, as nobody means a radius to the centimetre. Because of ε no hint is a
fence: another place wins where the picture makes it likelier by `1 + (1 - ε) / (ε s)`. Hints that are `strict` are
fences: nothing outside is looked at.
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
# ε, the probability that a hint is wrong altogether.
_DOUBT = 0.02
# Regions count as no smaller than this share of a plan, so that the smallest of hints is doubted as well.
_MIN_SHARE = 1e-3
# How fast a point's region ends, in units of its radius; an answer as unlikely as `_MISSED` misses it.
_FALL_OFF, _MISSED = 1.0 / 3.0, 0.5
# Rooms that an error about an unknown one names.
_ROOMS_TOLD = 20


@dataclass(frozen=True)
class Near:
    """A point of the plan (m), and how far from it the camera is said to be at most.

    Attributes:
        said: the point as it was given, where that was in other words.
    """

    x_m: float
    y_m: float
    radius_m: float
    said: str = ""

    def __str__(self) -> str:
        return self.said or f"({self.x_m:g}, {self.y_m:g})"

    def distance_m(
        self, position_m: Float[np.ndarray, "n 2"], room_index: Int[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n"]:
        """How far places are from the point, whatever their rooms."""
        return np.hypot(position_m[:, 0] - self.x_m, position_m[:, 1] - self.y_m)


@dataclass(frozen=True, eq=False)
class NearInEach:
    """One place in each of several plans that are searched as one, such as what GPS says in all storeys of a house.

    Attributes:
        point_m: (r, 2) where it is in the frame of each room's plan; NaN where it is not known where that plan lies,
            of whose places the hint says nothing.
        said: the place as it was given.
    """

    point_m: Float[np.ndarray, "r 2"]
    radius_m: float
    said: str

    def __str__(self) -> str:
        return self.said

    def distance_m(
        self, position_m: Float[np.ndarray, "n 2"], room_index: Int[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n"]:
        """How far places in these rooms are from it; NaN where that is not known."""
        return np.linalg.norm(position_m - self.point_m[room_index], axis=1)


@dataclass(frozen=True)
class Hints:
    """What is known beforehand; by default nothing.

    Attributes:
        rooms: numbers of the rooms of which the camera stands in one.
        level: numbers of the rooms on the level that the camera is on, of plans that are searched as one.
        strict: whether nothing else is possible.
        shares: how much of the area a hint leaves, where that is not of this plan alone, as where a plan is of the
            most probable ones of many.
    """

    near: Near | NearInEach | None = None
    rooms: frozenset[int] | None = None
    level: frozenset[int] | None = None
    strict: bool = False
    shares: Mapping[HintName, float] = field(default_factory=dict)

    def check(self, plan: FloorPlan) -> None:
        """See that the hints can be meant for a plan.

        Raises:
            InvalidHintError: a radius outside its limits, or a point that is farther from every room than that; or no
                room.
        """
        if self.rooms is not None and not self.rooms:
            raise InvalidHintError("rooms", "none is named: leave the hint out where nothing is known")
        if not isinstance(self.near, Near):
            return
        low, high = RADIUS_RANGE_M
        if not low <= self.near.radius_m <= high:
            raise InvalidHintError("radius_m", f"{self.near.radius_m:g} m, it must be between {low:g} and {high:g} m")
        if not (math.isfinite(self.near.x_m) and math.isfinite(self.near.y_m)):
            raise InvalidHintError("near", f"{self.near} is no point of the plan")
        point = shapely.Point(self.near.x_m, self.near.y_m)
        away_m = min(shapely.distance(shapely.Polygon(room.polygon_m), point) for room in plan.rooms)
        if away_m > self.near.radius_m:
            raise InvalidHintError(
                "near",
                f"{self.near} is {away_m:.3g} m from the nearest room of the plan, farther "
                f"than radius_m, {self.near.radius_m:g} m",
            )

    def penalty(
        self, plan: FloorPlan, position_m: Float[np.ndarray, "n 2"], room_index: Int[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n"]:
        """Negative log prior of places (nats), 0 where all hints hold; infinite for what `strict` ones exclude."""
        total = np.zeros(len(position_m))
        for name, inside in self._inside(position_m, room_index).items():
            if self.strict:
                total[~(inside >= 1.0)] = np.inf
                continue
            share = max(self._share(plan, name), _MIN_SHARE)
            odds = (1.0 - _DOUBT) / (_DOUBT * share)
            # Where nothing is said, f is 1, which it is also where g is the share.
            total += math.log1p(odds) - np.log1p(odds * np.where(np.isnan(inside), share, inside))
        return total

    def missed(self, position_m: Float[np.ndarray, "2"], room_index: int) -> tuple[HintName, ...]:
        """The hints that do not hold at a place."""
        inside = self._inside(np.asarray(position_m)[None], np.array([room_index]))
        return tuple(name for name, share in inside.items() if share[0] < _MISSED)

    @property
    def are_none(self) -> bool:
        """Whether nothing is known."""
        return self.near is None and self.rooms is None and self.level is None

    @property
    def relaxed(self) -> Hints:
        """The same hints, not strict."""
        return replace(self, strict=False)

    def _inside(
        self, position_m: Float[np.ndarray, "n 2"], room_index: Int[np.ndarray, "n"]
    ) -> dict[HintName, Float[np.ndarray, "n"]]:
        """G of every hint; NaN where it says nothing."""
        found: dict[HintName, Float[np.ndarray, "n"]] = {}
        if self.near is not None:
            beyond = np.maximum(self.near.distance_m(position_m, room_index) / self.near.radius_m - 1.0, 0.0)
            found["near"] = np.exp(-0.5 * np.square(beyond / _FALL_OFF))
        for name, rooms in self._of_rooms().items():
            found[name] = np.isin(room_index, list(rooms)).astype(float)
        return found

    def _of_rooms(self) -> dict[HintName, frozenset[int]]:
        """The hints that are of some rooms."""
        given: dict[HintName, frozenset[int] | None] = {"rooms": self.rooms, "level": self.level}
        return {name: rooms for name, rooms in given.items() if rooms is not None}

    def _share(self, plan: FloorPlan, name: HintName) -> float:
        """How much of the plan's area a hint leaves."""
        if name in self.shares:
            return self.shares[name]
        if name == "near":
            assert self.near is not None
            return min(math.pi * self.near.radius_m**2 / plan.area_m2, 1.0)
        return sum(plan.rooms[index].area_m2 for index in self._of_rooms()[name]) / plan.area_m2


NO_HINTS = Hints()


def log_factor(inside: Float[np.ndarray, "n"], share: float, *, strict: bool) -> Float[np.ndarray, "n"]:
    """Log of f, the factor of the prior, of regions that are inside to some share; that of no hint is 0.

    Args:
        share: of all that is possible, how much is inside.
    """
    share = max(share, _MIN_SHARE)
    doubt = 0.0 if strict else _DOUBT
    with np.errstate(divide="ignore"):
        return np.log((1.0 - doubt) * inside / share + doubt)


def rooms_named(plan: FloorPlan, names: list[str]) -> frozenset[int]:
    """Numbers of the rooms with these ids, or where no room has one as its id, with these names.

    Raises:
        InvalidHintError: no room has one of them; says which there are.
    """
    found: set[int] = set()
    for name in names:
        by_id = {index for index, room in enumerate(plan.rooms) if room.id == name}
        wanted = name.strip().casefold()
        called = by_id or {index for index, room in enumerate(plan.rooms) if room.name.casefold() == wanted}
        if not called:
            known = [f"'{room.id}'" for room in plan.rooms[:_ROOMS_TOLD]]
            more = len(plan.rooms) - len(known)
            told = ", ".join(known) + (f" and {more} more" if more else "")
            raise InvalidHintError("rooms", f"the plan has no room '{name:.50}', it has {told}")
        found |= called
    return frozenset(found)
