"""Make a file from a stored plan."""

from __future__ import annotations

import json
from typing import cast

from lalaloc_core.conditions import CONDITIONS
from lalaloc_core.draw.plan import bounds_with, draw_rooms
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers import ExportFormat, export_plan
from service.errors import DamagedDataError
from service.renditions.description import describe
from service.renditions.layout import plan_layout
from service.renditions.mesh import plan_glb
from service.stored_plan import Rendition, RenditionJob


def make_rendition(job: RenditionJob) -> Rendition:
    """Make a file from a stored plan.

    Raises:
        DamagedDataError: the stored document is damaged.
        InvalidFloorPlanError: the plan lacks something that an export requires.
        InvalidInputError: localisability of a model without measured errors.
        MissingExtraError: a library of an export is not installed.
    """
    stored = job.stored
    plan = stored.document.plan()
    if plan is None:
        raise DamagedDataError(
            f"the document of floor plan '{stored.id}' at revision '{stored.revision_id}' is damaged"
        )
    if job.kind == "description":
        return describe(plan, stored, job.step_m)
    if job.kind == "preview":
        no_room = no_room_of(stored.report)
        return Rendition(draw_rooms(plan, no_room).encode(), bounds_with(plan.bounds_m, no_room))
    return Rendition(_content(plan, job), plan.bounds_m)


def no_room_of(report: str | None) -> list[list[list[float]]]:
    """Return the areas that became no room from an import report; none from those of earlier versions."""
    return [] if report is None else json.loads(report).get("no_room", [])


def _content(plan: FloorPlan, job: RenditionJob) -> bytes:
    match job.kind:
        case "localisability":
            # Imported late: the search needs libraries that other files do not.
            from service.renditions.localisability import plan_localisability

            return plan_localisability(plan, job)
        case "layout":
            return plan_layout(plan, job.stored.id, job.stored.revision_id)
        case "drawing":
            return draw_rooms(plan).encode()
        case "mesh":
            return plan_glb(plan)
        case kind if kind in CONDITIONS:
            # Imported late for the same reason.
            from service.renditions.localisability import localisability_map

            return localisability_map(plan, job.report, kind)
        case kind:
            return export_plan(plan, cast(ExportFormat, kind))
