"""What methods cache of the plans they were last asked about, with `cachetools.cachedmethod`."""

from __future__ import annotations

from lalaloc_core.evaluate.methods.method import Question
from lalaloc_core.floorplan import FloorPlan

# Queries come scene by scene, and cameras of a scene often share a height: a few are enough.
GRIDS_CACHED = 4


def grid_key(_: object, question: Question) -> tuple[FloorPlan, float, float]:
    """Key of what is made of a question's grid; plans are compared by identity, and kept alive by the key."""
    return question.plan, question.camera.camera_height_m, question.grid_step_m


def plan_key(_: object, question: Question) -> FloorPlan:
    """Key of what is made of a question's plan."""
    return question.plan
