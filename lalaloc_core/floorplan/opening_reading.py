"""Openings from the plan's document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.arrays import frozen
from lalaloc_core.floorplan.limits import PlanLimits
from lalaloc_core.floorplan.openings import DEFAULT_OPENING_TOLERANCE_M, Opening, kinds_that_occur
from lalaloc_core.floorplan.rooms import Room
from lalaloc_core.floorplan.values import (
    check_keys,
    json_kind,
    read_choice,
    read_list,
    read_name,
    read_number_between,
    read_segment,
)

# Walls are none.
_KINDS = OPENING_CLASSES[1:]
_OPENING_KEYS = {"kind", "line", "sill_m", "head_m", "name", "rooms"}
# From the rounding of a drawing to the thickest walls.
_TOLERANCES_M = (0.01, 1.5)


def read_openings(raw: Any, rooms: Sequence[Room], limits: PlanLimits) -> tuple[Opening, ...]:
    """The openings of a plan with these rooms.

    Raises:
        InvalidFloorPlanError: names the opening and what is wrong.
    """
    entries = read_list([] if raw is None else raw, "openings", limits.max_openings, "max_openings")
    ids = {room.id for room in rooms}
    return tuple(_read_opening(entry, f"opening {index}", ids, limits) for index, entry in enumerate(entries))


def read_opening_kinds(raw: Any, openings: Sequence[Opening]) -> frozenset[str]:
    """The kinds that a plan shows completely: by default those that occur in it."""
    if raw is None:
        return kinds_that_occur(openings)
    kinds = read_list(raw, "opening_kinds", len(_KINDS), "one of each kind")
    return frozenset(read_choice(kind, _KINDS, "an entry of opening_kinds") for kind in kinds)


def read_tolerance(raw: Any) -> float:
    """How far from a wall openings may be drawn (m)."""
    if raw is None:
        return DEFAULT_OPENING_TOLERANCE_M
    return read_number_between(raw, "opening_tolerance_m", *_TOLERANCES_M, " m")


def _read_opening(raw: Any, where: str, room_ids: set[str], limits: PlanLimits) -> Opening:
    if not isinstance(raw, Mapping):
        raise InvalidFloorPlanError(f"{where} must be an object, not {json_kind(raw)}")
    check_keys(raw, _OPENING_KEYS, where=f"{where}: ")
    kind = read_choice(raw.get("kind"), _KINDS, f"{where}: the kind")
    line_m = read_segment(raw.get("line"), f"{where}: the line", limits, None)
    name = None if raw.get("name") is None else read_name(raw["name"], limits, f"{where}: the name")
    sill_m, head_m = (
        None if raw.get(key) is None else read_number_between(raw[key], f"{where}: {key}", 0.0, highest, " m")
        for key, highest in (("sill_m", limits.max_ceiling_height_m), ("head_m", limits.max_ceiling_height_m))
    )
    if sill_m is not None and head_m is not None and sill_m >= head_m:
        raise InvalidFloorPlanError(f"{where}: sill_m is {sill_m:g}, it must lie below head_m ({head_m:g})")
    rooms = None
    if raw.get("rooms") is not None:
        rooms = tuple(read_list(raw["rooms"], f"{where}: rooms", len(room_ids), "one entry for each room"))
        unknown = [room for room in rooms if not isinstance(room, str) or room not in room_ids]
        if unknown:
            shown = f"'{unknown[0][:50]}'" if isinstance(unknown[0], str) else json_kind(unknown[0])
            raise InvalidFloorPlanError(f"{where}: rooms has {shown}, which is no room's id")
    return Opening(kind, frozen(line_m), sill_m, head_m, name, rooms)
