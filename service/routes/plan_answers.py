"""Stored plans as answers of the API."""

from __future__ import annotations

from lalaloc_core.render.sampling import grid_size
from service.grids import GridProvider, GridState
from service.http.conditional import plan_etag
from service.schemas import BoundsAnswer, FloorPlanAnswer, FloorPlanSummary, GridAnswer, ImportReport, RoomAnswer
from service.storage.records import PlanRecord, PlanSummary


def plan_state(record: PlanRecord, grids: GridProvider) -> GridState:
    """Return the current state of a plan's pose grid."""
    return grids.states([_summary(record)])[0]


def plan_representation(
    record: PlanRecord, state: GridState, step_m: float, *, superseded: bool = False
) -> tuple[bytes, str]:
    """Return a plan as JSON, and its entity tag; `superseded` marks an old revision."""
    content = _answer(record, state, step_m, superseded=superseded).model_dump_json().encode()
    return content, plan_etag(record.revision_id, content)


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


def _answer(record: PlanRecord, state: GridState, step_m: float, *, superseded: bool) -> FloorPlanAnswer:
    plan = record.plan
    report = None if record.report is None else ImportReport.model_validate_json(record.report)
    x_min, y_min, x_max, y_max = plan.bounds_m
    return FloorPlanAnswer(
        id=record.id,
        revision=record.revision_id,
        revision_number=record.revision,
        name=plan.name,
        status="superseded" if superseded else state.status,
        progress=state.progress,
        reason=state.reason,
        rooms=[
            RoomAnswer(
                id=room.id,
                name=room.name,
                type=room.type,
                area_m2=room.area_m2,
                ceiling_height_m=room.ceiling_height_m,
                vertices=len(room.polygon_m),
            )
            for room in plan.rooms
        ],
        area_m2=plan.area_m2,
        bounds=BoundsAnswer(x_min_m=x_min, y_min_m=y_min, x_max_m=x_max, y_max_m=y_max),
        camera_height_m=plan.camera_height_m,
        grid=GridAnswer(step_m=step_m, poses=grid_size(plan, step_m) if state.poses is None else state.poses),
        # Warnings of the import come first.
        warnings=list(dict.fromkeys([*(() if report is None else report.warnings), *plan.warnings])),
        import_report=report,
        plan=plan.to_dict(),
        created_at=record.created_at,
        updated_at=record.updated_at,
    )


def _summary(record: PlanRecord) -> PlanSummary:
    return PlanSummary(
        id=record.id,
        revision_id=record.revision_id,
        revision=record.revision,
        created_at=record.created_at,
        updated_at=record.updated_at,
        name=record.plan.name,
        room_count=len(record.plan.rooms),
        area_m2=record.plan.area_m2,
        camera_height_m=record.plan.camera_height_m,
        failure=record.failure,
    )
