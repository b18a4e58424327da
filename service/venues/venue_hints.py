"""Hints of a request about a venue: a prior over the venue's plans, and over the places in them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from jaxtyping import Float
from sqlalchemy import Row

from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor, LocalFrame
from lalaloc_core.localise.query import HintName, Hints, rooms_named
from lalaloc_core.localise.query.hints import NearInEach, log_factor
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from service.schemas import SessionDocument
from service.schemas.query_fields import EarthPoint, HintFields

# Maximum number of levels that an error message lists.
_MAX_LEVELS_LISTED = 20
_Rows = Sequence[Row[Any]]


@dataclass(frozen=True, kw_only=True)
class VenueHints:
    """Hints of a request about a venue.

    Methods take rows of plans as returned by `Venues.searchable_plans`.

    Attributes:
        anchor: anchor of the venue.
        place: place that the camera is near, within `radius_m`; None without that hint.
        rooms: ids or names of rooms.
        level: level of the camera; None without that hint.
        strict: plans and places that contradict the hints are excluded.
    """

    anchor: Anchor | None
    place: EarthPoint | None = None
    radius_m: float = math.inf
    rooms: tuple[str, ...] = ()
    level: float | None = None
    strict: bool = False

    @classmethod
    def from_form(cls, form: HintFields | SessionDocument, anchor: Anchor | None) -> Self:
        """Return the hints of a request."""
        return cls(
            anchor=anchor,
            place=_on_earth(form, anchor),
            radius_m=math.inf if form.radius_m is None else form.radius_m,
            rooms=tuple(form.rooms or ()),
            level=form.level,
            strict=isinstance(form, HintFields) and form.strict,
        )

    def check(self, members: _Rows) -> None:
        """Check the hints against all plans of the venue, ready or not."""
        if self.level is not None and self.level not in (levels := sorted({row.level for row in members})):
            listed = ", ".join(f"{level:g}" for level in levels[:_MAX_LEVELS_LISTED])
            more = f" and {len(levels) - _MAX_LEVELS_LISTED} more" if len(levels) > _MAX_LEVELS_LISTED else ""
            raise InvalidHintError(
                "level", f"no floor plan of the venue is on level {self.level:g}; its levels are {listed}{more}"
            )
        if self.place is None:
            return
        distance_m = self._distances_m(members)
        if np.isnan(distance_m).all():
            raise InvalidHintError(
                "near",
                f"{self.place} cannot be placed: neither the venue nor any of its floor plans has an anchor; add one",
            )
        if (nearest_m := float(np.nanmin(distance_m))) > self.radius_m:
            raise InvalidHintError(
                "near",
                f"{self.place} is {nearest_m:.3g} m from the nearest floor plan of the venue; radius_m is "
                f"{self.radius_m:g} m: increase it",
            )

    def shares(self, rows: _Rows) -> dict[HintName, float]:
        """Return the share of the plans' area that the hints `level` and `near` leave."""
        found = dict[HintName, float]()
        if self.level is None and self.place is None:
            return found
        area = np.array([row.area_m2 for row in rows])
        if self.level is not None:
            found["level"] = float(area[self._on_level(rows)].sum() / area.sum())
        if self.place is not None:
            known = ~np.isnan(self._distances_m(rows))
            found["near"] = float((area * self._within(rows))[known].sum() / max(area[known].sum(), 1e-9))
        return found

    def log_prior(self, rows: _Rows, shares: Mapping[HintName, float]) -> Float[np.ndarray, "p"]:
        """Return the log prior factors of plans by `level` and `near`; -inf for plans that a strict hint excludes."""
        total = np.zeros(len(rows))
        if self.level is not None:
            total += log_factor(self._on_level(rows).astype(float), shares["level"], strict=self.strict)
        if self.place is not None:
            factor = log_factor(self._within(rows), shares["near"], strict=self.strict)
            nowhere = -np.inf if self.strict else 0.0
            total += np.where(np.isnan(self._distances_m(rows)), nowhere, factor)
        return total

    def in_merged_plans(
        self,
        rows: _Rows,
        plans: Sequence[FloorPlan],
        merged: MergedPlans,
        shares: Mapping[HintName, float],
        *,
        partly: bool,
    ) -> Hints:
        """Return the hints about plans that are merged side by side.

        With `partly`, other plans, which may have the rooms, are not searched.
        """
        counts, first = [len(plan.rooms) for plan in plans], merged.first_room
        level = None
        if self.level is not None:
            on_level = np.repeat(self._on_level(rows), counts)
            level = frozenset(np.flatnonzero(on_level).tolist())
        rooms = None
        if self.rooms:
            rooms = frozenset(
                int(first[index]) + room for name in self.rooms for index, room in _rooms_called(name, plans, partly)
            )
            if not rooms and self.strict:
                raise InvalidHintError(
                    "rooms", f"none of the {len(plans)} floor plans that are searched has any of the rooms"
                )
        near = None
        if self.place is not None:
            point = np.stack([self._in_plan(plan) for plan in plans]) + merged.shift_m
            near = NearInEach(np.repeat(point, counts, axis=0), self.radius_m, str(self.place))
        return Hints(near=near, rooms=rooms or None, level=level, strict=self.strict, shares=shares)

    def unplaced_warnings(self, rows: _Rows) -> list[str]:
        """Return a warning with the number of plans whose place on Earth is unknown, if `near` is given."""
        if self.place is None or not (count := int(np.isnan(self._distances_m(rows)).sum())):
            return []
        effect = "were not searched, because near is strict" if self.strict else "are not affected by near"
        return [f"{count} of the venue's {len(rows)} floor plans have no anchor and {effect}"]

    def _on_level(self, rows: _Rows) -> np.ndarray:
        return np.array([row.level == self.level for row in rows], bool)

    def _distances_m(self, rows: _Rows) -> Float[np.ndarray, "p"]:
        """Return the distances (m) of plans from the place; NaN where a plan's place is unknown."""
        assert self.place is not None
        return distances_m(rows, self.anchor, self.place.latitude, self.place.longitude)

    def _within(self, rows: _Rows) -> Float[np.ndarray, "p"]:
        """Return the approximate share of each plan's area within the radius; 0 where a plan's place is unknown."""
        area = np.array([row.area_m2 for row in rows])
        return np.where(
            self._distances_m(rows) <= self.radius_m, np.minimum(math.pi * self.radius_m**2 / area, 1.0), 0.0
        )

    def _in_plan(self, plan: FloorPlan) -> Float[np.ndarray, "2"]:
        """Return the place in the frame of a plan; NaN where the plan's place on Earth is unknown."""
        anchor = plan.anchor_within(self.anchor)
        if anchor is None or self.place is None:
            return np.full(2, np.nan)
        return anchor.to_plan(np.array([[self.place.longitude, self.place.latitude]]))[0]


def _on_earth(form: HintFields | SessionDocument, anchor: Anchor | None) -> EarthPoint | None:
    if form.near is None or isinstance(form.near, EarthPoint):
        return form.near
    if anchor is None:
        raise InvalidHintError(
            "near",
            "x_m and y_m need a frame that all plans share, and the venue has no anchor: give latitude and longitude, "
            "or floorplan_id",
        )
    ((longitude, latitude),) = anchor.to_earth(np.array([[form.near.x_m, form.near.y_m]]))
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        raise InvalidHintError("near", f"({form.near.x_m:g}, {form.near.y_m:g}) is not a place on Earth")
    return EarthPoint(latitude=float(latitude), longitude=float(longitude))


def _rooms_called(name: str, plans: Sequence[FloorPlan], partly: bool) -> list[tuple[int, int]]:
    """Return (number of the plan, number of the room) for every room with this id or name."""
    found: list[tuple[int, int]] = []
    for index, plan in enumerate(plans):
        try:
            found += [(index, room) for room in rooms_named(plan, [name])]
        except InvalidHintError:
            # Another plan can have it.
            continue
    if not found and not partly:
        raise InvalidHintError(
            "rooms", f"none of the {len(plans)} floor plans that are searched has a room '{name:.50}'"
        )
    return found


def distances_m(
    rows: Sequence[Any], venue_anchor: Anchor | None, latitude: float, longitude: float
) -> Float[np.ndarray, "n"]:
    """Return the distances (m) from a place to the circles around plans, 0 inside; NaN for plans with an unknown place.

    Plans without an anchor of their own have that of the venue.
    """
    lon_lat = np.array([[_number(row.longitude), _number(row.latitude)] for row in rows]).reshape(-1, 2)
    centre = np.array([[_number(row.centre_x_m), _number(row.centre_y_m)] for row in rows]).reshape(-1, 2)
    unknown = np.isnan(lon_lat[:, 0])
    if venue_anchor is not None and unknown.any():
        lon_lat[unknown] = venue_anchor.to_earth(centre[unknown])
    away = LocalFrame(longitude, latitude).to_local(lon_lat)
    reach = np.array([_number(row.reach_m) for row in rows])
    # The projection returns NaN beyond its range, which means infinitely far.
    distance = np.where(np.isnan(lon_lat[:, 0]), np.nan, np.hypot(away[:, 0], away[:, 1]))
    return np.maximum(distance - reach, 0.0)


def _number(value: float | None) -> float:
    return math.nan if value is None else value
