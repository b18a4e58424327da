"""Stored plans as answers of the API."""

from __future__ import annotations

from dataclasses import astuple

from service.grids import GridProvider, GridState
from service.http.conditional import revision_etag
from service.plan_files.plan_description import state_of_description
from service.schemas import FloorPlanSummary
from service.storage.records import PlanSummary
from service.stored_plan import Rendition


def description_etag(revision_id: str, state: GridState, step_m: float, *, superseded: bool = False) -> str:
    """Return the entity tag of a plan's description; `superseded` marks an old revision."""
    return revision_etag(revision_id, "description", superseded, astuple(state), step_m)


def description_parts(
    description: Rendition, state: GridState, step_m: float, *, superseded: bool = False
) -> tuple[bytes, bytes]:
    """Return a plan as JSON in two parts; `superseded` marks an old revision."""
    head = state_of_description(
        "superseded" if superseded else state.status,
        state.progress,
        state.reason,
        poses=description.poses if state.poses is None else state.poses,
        step_m=step_m,
    )
    return head, description.content


def list_entries(summaries: list[PlanSummary], grids: GridProvider) -> list[FloorPlanSummary]:
    """Return plans as items of a list."""
    return [
        FloorPlanSummary(
            id=summary.id,
            revision=summary.revision_id,
            name=summary.name,
            status=state.status,
            progress=state.progress,
            rooms=summary.room_count,
            area_m2=summary.area_m2,
            created_at=summary.created_at,
            updated_at=summary.updated_at,
        )
        for summary, state in zip(summaries, grids.states(summaries), strict=True)
    ]
