"""What a request about a venue says of where the camera stood: a prior over its plans, and over the places in them."""

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
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.hints import HintName, Hints, NearInEach, log_factor, rooms_named
from lalaloc_core.localise.pipeline import Localisation
from lalaloc_core.localise.venue.merged_plans import MergedPlans
from service.query.geopose import anchor_of
from service.query.hints import contradiction, near_missed
from service.schemas.hint_fields import EarthPoint, HintFields
from service.storage.plan_places import distances_m

# Levels that an error about an unknown one names.
_LEVELS_TOLD = 20
_Rows = Sequence[Row[Any]]


@dataclass(frozen=True, kw_only=True)
class VenueHints:
    """The hints of a request about a venue.

    Rows are of plans, as `Venues.searched` tells them.

    Attributes:
        anchor: of the venue.
        place: where the camera is said to be near; None where nothing is said.
        rooms: ids or names.
    """

    anchor: Anchor | None
    place: EarthPoint | None = None
    radius_m: float = math.inf
    rooms: tuple[str, ...] = ()
    level: float | None = None
    strict: bool = False

    @classmethod
    def of(cls, form: HintFields, anchor: Anchor | None) -> Self:
        """What a form says.

        Raises:
            InvalidHintError: a point of a frame that the plans do not share.
        """
        return cls(
            anchor=anchor,
            place=_on_earth(form, anchor),
            radius_m=math.inf if form.radius_m is None else form.radius_m,
            rooms=tuple(form.rooms or ()),
            level=form.level,
            strict=form.strict,
        )

    def check(self, members: _Rows) -> None:
        """See that the hints can be meant for a venue with these plans, ready or not.

        Raises:
            InvalidHintError: a level that none is on, or a place that none is known to be near.
        """
        levels = sorted({row.level for row in members})
        if self.level is not None and self.level not in levels:
            told = ", ".join(f"{level:g}" for level in levels[:_LEVELS_TOLD])
            more = f" and {len(levels) - _LEVELS_TOLD} more" if len(levels) > _LEVELS_TOLD else ""
            raise InvalidHintError(
                "level", f"no floor plan of the venue is on level {self.level:g}, they are on {told}{more}"
            )
        if self.place is None:
            return
        away_m = self._away_m(members)
        if np.isnan(away_m).all():
            raise InvalidHintError(
                "near",
                f"neither the venue nor a floor plan of it has an anchor, so none is known to be at {self.place}",
            )
        if (nearest_m := float(np.nanmin(away_m))) > self.radius_m:
            raise InvalidHintError(
                "near",
                f"{self.place} is {nearest_m:.3g} m from the nearest floor plan of the venue, farther than radius_m, "
                f"{self.radius_m:g} m",
            )

    def shares(self, rows: _Rows) -> dict[HintName, float]:
        """How much of the area of plans the hints leave that do not depend on rooms."""
        area, found = np.array([row.area_m2 for row in rows]), dict[HintName, float]()
        if self.level is not None:
            found["level"] = float(area[self._on_level(rows)].sum() / area.sum())
        if self.place is not None:
            known = ~np.isnan(self._away_m(rows))
            found["near"] = float((area * self._within(rows))[known].sum() / max(area[known].sum(), 1e-9))
        return found

    def log_prior(self, rows: _Rows, shares: Mapping[HintName, float]) -> Float[np.ndarray, "p"]:
        """Log of what hints make of the prior of plans, before rooms are looked at; -inf for what strict ones exclude.

        Args:
            shares: see `shares`.
        """
        total = np.zeros(len(rows))
        if self.level is not None:
            total += log_factor(self._on_level(rows).astype(float), shares["level"], strict=self.strict)
        if self.place is not None:
            factor = log_factor(self._within(rows), shares["near"], strict=self.strict)
            nowhere = -np.inf if self.strict else 0.0
            total += np.where(np.isnan(self._away_m(rows)), nowhere, factor)
        return total

    def among(
        self,
        rows: _Rows,
        plans: Sequence[FloorPlan],
        laid: MergedPlans,
        shares: Mapping[HintName, float],
        *,
        partly: bool,
    ) -> Hints:
        """The hints about plans that are laid side by side.

        Args:
            partly: whether others were left out, which may have the rooms that none of these has.

        Raises:
            InvalidHintError: a room that none of the plans has.
        """
        counts, first = [len(plan.rooms) for plan in plans], laid.first_room
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
                    "rooms", f"none of the {len(plans)} floor plans that are searched has one of them"
                )
        near = None
        if self.place is not None:
            point = np.stack([self._in_plan(plan) for plan in plans]) + laid.shift_m
            near = NearInEach(np.repeat(point, counts, axis=0), self.radius_m, str(self.place))
        return Hints(near=near, rooms=rooms or None, level=level, strict=self.strict, shares=shares)

    def unplaced(self, rows: _Rows) -> list[str]:
        """Says of how many plans `near` says nothing."""
        if self.place is None or not (count := int(np.isnan(self._away_m(rows)).sum())):
            return []
        what = "were not searched, near being strict" if self.strict else "near says nothing of them"
        return [f"{count} of the venue's {len(rows)} floor plans have no anchor: {what}"]

    def warnings(self, hints: Hints, found: Localisation, rows: _Rows, laid: MergedPlans) -> list[str]:
        """Says which hints were not followed, or were although the panorama contradicts them."""
        answer = found.candidates[0]
        row = rows[laid.plan_of(answer.room_index)]
        room = laid.plan.rooms[answer.room_index]
        told = {
            "near": lambda: near_missed(hints, found),
            "rooms": lambda: (
                f"rooms is {', '.join(repr(name) for name in self.rooms)}",
                f"the answer lies in room '{room.id}' of floor plan '{row.plan_id}'",
            ),
            "level": lambda: (f"level is {self.level:g}", f"the answer is on level {row.level:g}"),
        }
        return [contradiction(*told[name](), self.strict) for name in found.hints_missed]

    def _on_level(self, rows: _Rows) -> np.ndarray:
        return np.array([row.level == self.level for row in rows], bool)

    def _away_m(self, rows: _Rows) -> Float[np.ndarray, "p"]:
        """How far plans are from the place; NaN where it is not known where they are."""
        assert self.place is not None
        return distances_m(rows, self.anchor, self.place.latitude, self.place.longitude)

    def _within(self, rows: _Rows) -> Float[np.ndarray, "p"]:
        """About how much of each plan's area is as near the place as is said; 0 where it is not known."""
        area = np.array([row.area_m2 for row in rows])
        return np.where(self._away_m(rows) <= self.radius_m, np.minimum(math.pi * self.radius_m**2 / area, 1.0), 0.0)

    def _in_plan(self, plan: FloorPlan) -> Float[np.ndarray, "2"]:
        """The place in the frame of a plan; NaN where it is not known where the plan lies."""
        anchor = anchor_of(plan, self.anchor)
        if anchor is None or self.place is None:
            return np.full(2, np.nan)
        return anchor.to_plan(np.array([[self.place.longitude, self.place.latitude]]))[0]


def _on_earth(form: HintFields, anchor: Anchor | None) -> EarthPoint | None:
    if form.near is None or isinstance(form.near, EarthPoint):
        return form.near
    if anchor is None:
        raise InvalidHintError(
            "near",
            "x_m and y_m are of one plan, and the venue has no anchor, which would say that its plans share a frame: "
            "give latitude and longitude, or floorplan_id",
        )
    ((longitude, latitude),) = anchor.to_earth(np.array([[form.near.x_m, form.near.y_m]]))
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        raise InvalidHintError("near", f"({form.near.x_m:g}, {form.near.y_m:g}) is nowhere on Earth")
    return EarthPoint(latitude=float(latitude), longitude=float(longitude))


def _rooms_called(name: str, plans: Sequence[FloorPlan], partly: bool) -> list[tuple[int, int]]:
    """Numbers of plans, and of rooms in them, that have an id or a name."""
    found: list[tuple[int, int]] = []
    for index, plan in enumerate(plans):
        try:
            found += [(index, room) for room in rooms_named(plan, [name])]
        except InvalidHintError:
            # Another plan may have it.
            continue
    if not found and not partly:
        raise InvalidHintError(
            "rooms", f"none of the {len(plans)} floor plans that are searched has a room '{name:.50}'"
        )
    return found
