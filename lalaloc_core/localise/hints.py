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
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
from jaxtyping import Float, Int

from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan

HintName = Literal["near", "rooms"]
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
    """A point of the plan (m), and how far from it the camera is said to be at most."""

    x_m: float
    y_m: float
    radius_m: float

    def distance_m(self, position_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """How far places are from the point."""
        return np.hypot(position_m[:, 0] - self.x_m, position_m[:, 1] - self.y_m)


@dataclass(frozen=True)
class Hints:
    """What is known beforehand; by default nothing.

    Attributes:
        rooms: numbers of the rooms of which the camera stands in one.
        strict: whether nothing else is possible.
    """

    near: Near | None = None
    rooms: frozenset[int] | None = None
    strict: bool = False

    def check(self, plan: FloorPlan) -> None:
        """See that the hints can be meant for a plan.

        Raises:
            InvalidHintError: a radius outside its limits, or a point that is farther from every room than that; or no
                room.
        """
        if self.rooms is not None and not self.rooms:
            raise InvalidHintError("rooms", "none is named: leave the hint out where nothing is known")
        if self.near is None:
            return
        low, high = RADIUS_RANGE_M
        if not low <= self.near.radius_m <= high:
            raise InvalidHintError("radius_m", f"{self.near.radius_m:g} m, it must be between {low:g} and {high:g} m")
        if not (math.isfinite(self.near.x_m) and math.isfinite(self.near.y_m)):
            raise InvalidHintError("near", f"({self.near.x_m:g}, {self.near.y_m:g}) is no point of the plan")
        point = shapely.Point(self.near.x_m, self.near.y_m)
        away_m = min(shapely.distance(shapely.Polygon(room.polygon_m), point) for room in plan.rooms)
        if away_m > self.near.radius_m:
            raise InvalidHintError(
                "near",
                f"({self.near.x_m:g}, {self.near.y_m:g}) is {away_m:.3g} m from the nearest room of the plan, farther "
                f"than radius_m, {self.near.radius_m:g} m",
            )

    def penalty(
        self, plan: FloorPlan, position_m: Float[np.ndarray, "n 2"], room_index: Int[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n"]:
        """Negative log prior of places (nats), 0 where all hints hold; infinite for what `strict` ones exclude."""
        total = np.zeros(len(position_m))
        for name, inside in self._inside(position_m, room_index).items():
            if self.strict:
                total[inside < 1.0] = np.inf
                continue
            odds = (1.0 - _DOUBT) / (_DOUBT * max(self._share(plan, name), _MIN_SHARE))
            total += math.log1p(odds) - np.log1p(odds * inside)
        return total

    def missed(self, position_m: Float[np.ndarray, "2"], room_index: int) -> tuple[HintName, ...]:
        """The hints that do not hold at a place."""
        inside = self._inside(np.asarray(position_m)[None], np.array([room_index]))
        return tuple(name for name, share in inside.items() if share[0] < _MISSED)

    @property
    def are_none(self) -> bool:
        """Whether nothing is known."""
        return self.near is None and self.rooms is None

    @property
    def doubted(self) -> Hints:
        """The same hints, if they were no fences."""
        return replace(self, strict=False)

    def _inside(
        self, position_m: Float[np.ndarray, "n 2"], room_index: Int[np.ndarray, "n"]
    ) -> dict[HintName, Float[np.ndarray, "n"]]:
        """g of every hint."""
        found: dict[HintName, Float[np.ndarray, "n"]] = {}
        if self.near is not None:
            beyond = np.maximum(self.near.distance_m(position_m) / self.near.radius_m - 1.0, 0.0)
            found["near"] = np.exp(-0.5 * np.square(beyond / _FALL_OFF))
        if self.rooms is not None:
            found["rooms"] = np.isin(room_index, list(self.rooms)).astype(float)
        return found

    def _share(self, plan: FloorPlan, name: HintName) -> float:
        """How much of the plan's area a hint leaves."""
        if name == "near":
            assert self.near is not None
            return min(math.pi * self.near.radius_m**2 / plan.area_m2, 1.0)
        assert self.rooms is not None
        return sum(plan.rooms[index].area_m2 for index in self.rooms) / plan.area_m2


NO_HINTS = Hints()


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
