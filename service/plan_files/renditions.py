"""Files made from a stored plan: description, layout, drawing, mesh, exports, localisability. Pure functions."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Literal, cast

from lalaloc_core.conditions import CONDITIONS
from lalaloc_core.draw.plan import bounds_with, draw_rooms
from lalaloc_core.floorplan import FloorPlan, OpeningFace
from lalaloc_core.importers import ExportFormat, export_plan
from lalaloc_core.localise.answers.documents import ModelAnswer
from lalaloc_core.render.sampling import grid_size
from service.errors import DamagedDataError
from service.plan_documents import PlanHead, Rendition, RenditionJob
from service.schemas.localisability import LocalisabilityAnswer
from service.schemas.plan_import import ImportReport
from service.schemas.stored_plans import (
    BoundsAnswer,
    GridAnswer,
    LayoutAnswer,
    OpeningFaceAnswer,
    PlanContentAnswer,
    PlanHeadAnswer,
    PlanStateAnswer,
    PlanStatus,
    RoomAnswer,
    RoomLayoutAnswer,
)


def make_rendition(job: RenditionJob) -> Rendition:
    """Make a file from a stored plan."""
    stored = job.stored
    plan = stored.document.plan()
    if plan is None:
        raise DamagedDataError(
            f"the document of floor plan '{stored.id}' at revision '{stored.revision_id}' is damaged"
        )
    if job.kind == "description":
        return describe(plan, stored, job.step_m)
    if job.kind == "preview":
        # Areas that became no room; reports of earlier versions have none.
        no_room = [] if stored.report is None else json.loads(stored.report).get("no_room", [])
        return Rendition(draw_rooms(plan, no_room).encode(), bounds_with(plan.bounds_m, no_room))
    return Rendition(_content(plan, job), plan.bounds_m)


def _content(plan: FloorPlan, job: RenditionJob) -> bytes:
    match job.kind:
        case "localisability" | "coarse localisability":
            return plan_localisability(plan, job, coarse=job.kind != "localisability")
        case "layout":
            return plan_layout(plan, job.stored.id, job.stored.revision_id)
        case "drawing":
            return draw_rooms(plan).encode()
        case "mesh":
            # Imported late: its library takes a third of the time in which the service starts.
            from service.plan_files.plan_mesh import plan_glb

            return plan_glb(plan)
        case kind if kind in CONDITIONS:
            # Imported late: other files do not need its libraries.
            from lalaloc_core.draw.heat import localisability_svg

            return localisability_svg(plan, json.loads(job.report), kind).encode()
        case kind:
            return export_plan(plan, cast(ExportFormat, kind))


def plan_layout(plan: FloorPlan, plan_id: str, revision_id: str) -> bytes:
    """Return the `LayoutAnswer` of a plan as JSON, in time linear in its walls and openings."""
    rooms = [
        RoomLayoutAnswer(
            id=room.id,
            name=room.name,
            ceiling_height_m=room.ceiling_height_m,
            polygon=room.polygon_m.tolist(),
            holes=[hole.tolist() for hole in room.holes_m],
            walls_m=room.walls_m.tolist(),
            openings=[_opening(plan, face) for face in faces],
        )
        for room, faces in zip(plan.rooms, plan.room_faces, strict=True)
    ]
    return LayoutAnswer(floorplan_id=plan_id, revision=revision_id, rooms=rooms).model_dump_json().encode()


def _opening(plan: FloorPlan, face: OpeningFace) -> OpeningFaceAnswer:
    opening = plan.openings[face.opening]
    return OpeningFaceAnswer(
        kind=opening.kind, wall=face.wall, start=face.start, end=face.end, sill_m=opening.sill_m, head_m=opening.head_m
    )


def plan_localisability(plan: FloorPlan, job: RenditionJob, *, coarse: bool = False) -> bytes:
    """Return the `LocalisabilityAnswer` of a plan as JSON."""
    # Imported late: the search needs libraries that other files do not.
    from lalaloc_core.localise.localisability.predicted_localisability import localisability
    from lalaloc_core.localise.localisability.reports import report_of

    assert job.bundle is not None, "the prediction needs the model"
    answer = LocalisabilityAnswer(
        floorplan_id=job.stored.id,
        revision=job.stored.revision_id,
        model=ModelAnswer.of(job.bundle),
        **report_of(plan, localisability(plan, job.bundle.manifest, coarse=coarse), coarse=coarse),
    )
    return answer.model_dump_json().encode()


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
                types=list(room.types),
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
