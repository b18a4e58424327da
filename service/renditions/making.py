"""Make a file from a stored plan."""

from __future__ import annotations

import json

from lalaloc_core.draw.plan import bounds_with, draw_rooms
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import export_plan
from service.errors import DamagedDataError
from service.renditions.description import describe
from service.renditions.layout import plan_layout
from service.renditions.mesh import plan_glb
from service.stored_plan import Rendition, RenditionKind, StoredPlan


def make_rendition(stored: StoredPlan, kind: RenditionKind, step_m: float) -> Rendition:
    """Make a file from a stored plan.

    Args:
        stored: the plan.
        kind: kind of the file.
        step_m: grid step, for the estimated size of the pose grid.

    Raises:
        DamagedDataError: the stored document is damaged.
        InvalidFloorPlanError: the plan lacks something that an export requires.
        MissingExtraError: a library of an export is not installed.
    """
    plan = stored.document.plan()
    if plan is None:
        raise DamagedDataError(
            f"the document of floor plan '{stored.id}' at revision '{stored.revision_id}' is damaged"
        )
    if kind == "description":
        return describe(plan, stored, step_m)
    if kind == "preview":
        no_room = no_room_of(stored.report)
        return Rendition(draw_rooms(plan, no_room).encode(), bounds_with(plan.bounds_m, no_room))
    return Rendition(_content(plan, stored, kind), plan.bounds_m)


def no_room_of(report: str | None) -> list[list[list[float]]]:
    """Return the areas that became no room from an import report; none from those of earlier versions."""
    return [] if report is None else json.loads(report).get("no_room", [])


def _content(plan: FloorPlan, stored: StoredPlan, kind: RenditionKind) -> bytes:
    match kind:
        case "layout":
            return plan_layout(plan, stored.id, stored.revision_id)
        case "drawing":
            return draw_rooms(plan).encode()
        case "mesh":
            return plan_glb(plan)
        case _:
            return export_plan(plan, kind)
