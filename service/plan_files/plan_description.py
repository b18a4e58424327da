"""Description of a plan: the `FloorPlanAnswer` as JSON in two parts, the state of its pose grid and the rest.

The rest depends on the revision only and can have megabytes; the state is short and changes while the grid is computed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.sampling import grid_size
from service.plan_documents import PlanHead, Rendition
from service.schemas.plan_import import ImportReport
from service.schemas.stored_plans import (
    BoundsAnswer,
    GridAnswer,
    PlanContentAnswer,
    PlanHeadAnswer,
    PlanStateAnswer,
    PlanStatus,
    RoomAnswer,
)


def describe(plan: FloorPlan, head: PlanHead, step_m: float) -> Rendition:
    """Return a plan's description without its state and its first brace; see `state_of_description`."""
    return with_head(describe_content(plan, head.report, step_m), head)


def with_head(content: Rendition, head: PlanHead) -> Rendition:
    """Return the description of a plan from the result of `describe_content`."""
    answer = PlanHeadAnswer(
        id=head.id,
        revision=head.revision_id,
        revision_number=head.revision,
        created_at=head.created_at,
        updated_at=head.updated_at,
    )
    start = answer.model_dump_json().encode()[1:-1]
    return replace(content, content=b"%b,%b" % (start, content.content))


def describe_content(plan: FloorPlan, report_text: str | None, step_m: float) -> Rendition:
    """Return the part of a description that does not depend on how the plan is stored; `report_text` is JSON."""
    report = None if report_text is None else ImportReport.model_validate_json(report_text)
    x_min, y_min, x_max, y_max = plan.bounds_m
    poses = grid_size(plan, step_m)
    answer = PlanContentAnswer(
        name=plan.name,
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
        # Warnings of the import come first.
        warnings=list(dict.fromkeys([*(() if report is None else report.warnings), *plan.warnings])),
        import_report=report,
        plan=plan.to_dict(),
    )
    return Rendition(answer.model_dump_json().encode()[1:], plan.bounds_m, poses)


def state_of_description(
    status: PlanStatus | Literal["superseded"], progress: float, reason: str | None, *, poses: int, step_m: float
) -> bytes:
    """Return the part of a description that precedes the content of `describe`."""
    grid = GridAnswer(step_m=step_m, poses=poses)
    state = PlanStateAnswer(status=status, progress=progress, reason=reason, grid=grid)
    return state.model_dump_json().encode()[:-1] + b","
