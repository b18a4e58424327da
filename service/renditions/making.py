"""Make a file from a stored plan."""

from __future__ import annotations

from lalaloc_core.draw.plan import draw_rooms
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
    return Rendition(_content(plan, stored, kind), plan.bounds_m)


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
