"""Large buildings: generated homes side by side in wings, corridors between wings, and halls with columns.

They test the search as hospitals, offices and malls do: hundreds of similar rooms, corridors with a door every few
metres, and single rooms with hundreds of walls.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lalaloc_core.floorplan import FloorPlan, PlanLimits
from lalaloc_core.learn.synth.homes.plans import home_of

# Between what stands side by side (m).
_GAP_M = 0.3
_CORRIDOR_M, _MAX_CORRIDOR_M, _DOOR_M, _DOORS_EVERY_M = 2.5, 60.0, 0.9, 6.0
# Halls: their area (m²), how far their columns are apart, and how thick they are.
_HALL_M2, _COLUMNS_EVERY_M, _COLUMN_M = 900.0, 5.0, 0.5
_CEILING_M = 3.0
# Floor by length of the wings (m); gaps and courtyards make buildings more than twice as deep.
_MAX_DEPTH_M = 350.0
# Buildings can exceed the upload limits.
_LIMITS = PlanLimits(max_rooms=10**6, max_plan_vertices=10**7, max_openings=10**6)


class Building:
    """A large building as one `plan`: wings, each a row of homes or halls with a corridor along it.

    The homes are those of a split; the floor has at least the given area, `hall_share` of it in halls.
    """

    def __init__(self, split: int, seed: int, area_m2: float, *, hall_share: float = 0.2) -> None:
        self._split, self._seed = split, seed
        self._area_m2, self._hall_share = area_m2, hall_share
        # Nearly square; large ones are wider, because a wing is as deep as its deepest home.
        self._length_m = max(1.1 * math.sqrt(area_m2), area_m2 / _MAX_DEPTH_M)
        self._rooms: list[dict[str, Any]] = []
        self._openings: list[dict[str, Any]] = []
        self._homes = 0
        self._floor_m2 = self._halls_m2 = y_m = 0.0
        while self._floor_m2 < self._area_m2:
            y_m = self._corridors(self._wing(y_m))
        self.plan = FloorPlan.from_dict(
            {
                "name": "synthetic building",
                "rooms": self._rooms,
                "openings": self._openings,
                "opening_kinds": ["door", "window", "passage"],
            },
            _LIMITS,
        )

    def _wing(self, y_m: float) -> float:
        """Place homes and halls from left to right; return the end of the wing."""
        x_m, depth_m = 0.0, 0.0
        while x_m < self._length_m and self._floor_m2 < self._area_m2:
            if self._halls_m2 + _HALL_M2 < self._hall_share * self._floor_m2:
                width, depth = self._hall(x_m, y_m)
            else:
                width, depth = self._home(x_m, y_m)
            x_m, depth_m = x_m + width + _GAP_M, max(depth_m, depth)
        return y_m + depth_m + _GAP_M

    def _home(self, x_m: float, y_m: float) -> tuple[float, float]:
        number = self._homes
        home, _ = home_of(self._split, self._seed, number)
        left, bottom, right, top = home.plan.bounds_m
        shift_m = np.array([x_m - left, y_m - bottom])
        document = home.plan.to_dict()
        self._homes += 1
        for room in document["rooms"]:
            moved = (np.array(room["polygon"]) + shift_m).tolist()
            self._rooms.append(room | {"id": f"{number}-{room['id']}", "polygon": moved})
        for opening in document.get("openings", []):
            moved = (np.array(opening["line"]) + shift_m).tolist()
            named = [f"{number}-{name}" for name in opening["rooms"]]
            self._openings.append(opening | {"line": moved, "rooms": named})
        self._floor_m2 += home.plan.area_m2
        return right - left, top - bottom

    def _hall(self, x_m: float, y_m: float) -> tuple[float, float]:
        rng = np.random.default_rng([self._split, self._seed, len(self._rooms), 7])
        width = math.sqrt(_HALL_M2 * float(rng.uniform(0.8, 1.6)))
        depth = _HALL_M2 * float(rng.uniform(0.8, 1.2)) / width
        columns: list[list[list[float]]] = []
        for column_x in np.arange(_COLUMNS_EVERY_M, width - 1.0, _COLUMNS_EVERY_M):
            for column_y in np.arange(_COLUMNS_EVERY_M, depth - 1.0, _COLUMNS_EVERY_M):
                corner = np.array([column_x, column_y]) + rng.uniform(-0.6, 0.6, 2)
                # Keep the column within the hall.
                corner = np.array([x_m, y_m]) + np.minimum(corner, np.array([width, depth]) - _COLUMN_M - 0.1)
                columns.append(_rectangle(float(corner[0]), float(corner[1]), _COLUMN_M, _COLUMN_M)[::-1])
        self._rooms.append(_room(f"hall-{len(self._rooms)}", _rectangle(x_m, y_m, width, depth), columns))
        self._floor_m2 += width * depth
        self._halls_m2 += width * depth
        return width, depth

    def _corridors(self, y_m: float) -> float:
        """Place corridors along a finished wing; return their end."""
        count = math.ceil(self._length_m / _MAX_CORRIDOR_M)
        length_m = self._length_m / count - _GAP_M
        for x_m in (np.arange(count) * (length_m + _GAP_M)).tolist():
            number = len(self._rooms)
            key, rng = f"corridor-{number}", np.random.default_rng([self._split, self._seed, number, 8])
            self._rooms.append(_room(key, _rectangle(x_m, y_m, length_m, _CORRIDOR_M)))
            for along_m in np.arange(0.0, length_m - _DOORS_EVERY_M, _DOORS_EVERY_M).tolist():
                for side_m in (y_m, y_m + _CORRIDOR_M):
                    begin = float(x_m + along_m + rng.uniform(0.1, _DOORS_EVERY_M - _DOOR_M - 0.1))
                    line = [[begin, side_m], [begin + _DOOR_M, side_m]]
                    self._openings.append({"kind": "door", "line": line, "rooms": [key]})
            self._floor_m2 += length_m * _CORRIDOR_M
        return y_m + _CORRIDOR_M + _GAP_M


def _rectangle(x_m: float, y_m: float, width_m: float, depth_m: float) -> list[list[float]]:
    right, top = x_m + width_m, y_m + depth_m
    return [[x_m, y_m], [right, y_m], [right, top], [x_m, top]]


def _room(key: str, polygon: list[list[float]], holes: list[list[list[float]]] | None = None) -> dict[str, Any]:
    room: dict[str, Any] = {"id": key, "name": key, "polygon": polygon, "ceiling_height_m": _CEILING_M}
    return room | {"holes": holes} if holes else room
