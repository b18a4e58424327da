"""Fixtures: what stands fixed in a room and is drawn in plans, such as a bath or a stove."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Int

from lalaloc_core.conventions import FIXTURE_KINDS
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.limits import PlanLimits
from lalaloc_core.floorplan.rooms import frozen
from lalaloc_core.floorplan.values import check_keys, json_kind, read_choice, read_list, read_points

_KEYS = {"kind", "outline"}


@dataclass(frozen=True, eq=False)
class Fixture:
    """A fixture of the plan.

    Attributes:
        kind: one of `conventions.FIXTURE_KINDS`.
        outline_m: (n, 2) outline seen from above, not closed.
    """

    kind: str
    outline_m: Float[np.ndarray, "n 2"]


@dataclass(frozen=True, eq=False)
class FixturePlaces:
    """Places of f fixtures: centre and width (m), and the number of the room, -1 outside all."""

    centre_m: Float[np.ndarray, "f 2"]
    width_m: Float[np.ndarray, "f"]
    room_index: Int[np.ndarray, "f"]

    def __len__(self) -> int:
        return len(self.width_m)


def read_fixtures(raw: Any, limits: PlanLimits) -> tuple[Fixture, ...]:
    """Read the fixtures of a plan."""
    entries = read_list([] if raw is None else raw, "fixtures", limits.max_openings, "LALALOC_MAX_OPENINGS")
    vertices = 0
    fixtures = []
    for index, entry in enumerate(entries):
        fixtures.append(_read_fixture(entry, f"fixture {index}", limits))
        vertices += len(fixtures[-1].outline_m)
        if vertices > limits.max_plan_vertices:
            raise InvalidFloorPlanError(
                f"the fixtures have more than {limits.max_plan_vertices} vertices (LALALOC_MAX_PLAN_VERTICES); "
                "simplify their outlines"
            )
    return tuple(fixtures)


def _read_fixture(raw: Any, where: str, limits: PlanLimits) -> Fixture:
    if not isinstance(raw, Mapping):
        raise InvalidFloorPlanError(f"{where} must be an object, not {json_kind(raw)}")
    check_keys(raw, _KEYS, where=f"{where}: ")
    kind = read_choice(raw.get("kind"), FIXTURE_KINDS, f"{where}: the kind")
    outline = read_list(raw.get("outline"), f"{where}: outline", limits.max_vertices_per_room, "LALALOC_MAX_VERTICES")
    if len(outline) < 3:
        raise InvalidFloorPlanError(f"{where}: outline has {len(outline)} vertices; it must have at least 3")
    outline_m = read_points(outline, limits, None, f"{where}: vertex")
    if not shapely.Polygon(outline_m).is_valid:
        raise InvalidFloorPlanError(f"{where}: outline crosses itself or has no area")
    return Fixture(kind, frozen(outline_m))
