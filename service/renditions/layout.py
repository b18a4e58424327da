"""Walls and openings of a plan as JSON, for clients that draw layouts."""

from __future__ import annotations

from lalaloc_core.floorplan import FloorPlan, OpeningFace
from service.schemas import LayoutAnswer, OpeningFaceAnswer, RoomLayoutAnswer


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
        kind=opening.kind,
        wall=face.wall,
        start=face.start,
        end=face.end,
        sill_m=opening.sill_m,
        head_m=opening.head_m,
    )
