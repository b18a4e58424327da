"""Classification of predictions into located and the paper's two kinds of failure (figure of failure cases).

The paper names "an incorrect room is retrieved" and "the correct room is retrieved but the alignment is incorrect"
without a threshold. Here an alignment is incorrect beyond `ALIGNMENT_LIMIT_M`.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import shapely

from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.evaluate.runs.score import position_errors_m
from lalaloc_core.floorplan import FloorPlan

# One step of the paper's grid: a larger error is beyond the grid poses around the true one.
ALIGNMENT_LIMIT_M = 0.5


class Outcome(StrEnum):
    """Outcome of a query; every query has exactly one."""

    LOCATED = "located"
    WRONG_ALIGNMENT = "wrong alignment"
    WRONG_ROOM = "wrong room"
    NO_ANSWER = "no answer"


def outcomes(predictions: Sequence[Prediction], stage: str | None = None) -> list[Outcome]:
    """Return the outcome of each query, for the final pose or the pose after a stage."""
    errors_m = position_errors_m(predictions, stage)
    pairs = zip(predictions, errors_m, strict=True)
    return [_outcome(prediction, stage, float(error_m)) for prediction, error_m in pairs]


def count_outcomes(predictions: Sequence[Prediction], stage: str | None = None) -> dict[Outcome, int]:
    """Return the number of queries by outcome, for all outcomes."""
    found = outcomes(predictions, stage)
    return {outcome: found.count(outcome) for outcome in Outcome}


def symmetric_positions(room: shapely.Polygon, x_m: float, y_m: float) -> list[tuple[float, float]]:
    """Return a position mirrored along either axis of its room's bounding box, and turned by 180°."""
    left, bottom, right, top = room.bounds
    across, along = left + right - x_m, bottom + top - y_m
    return [(across, y_m), (x_m, along), (across, along)]


def is_symmetric(plan: FloorPlan, prediction: Prediction) -> bool:
    """Return whether a misaligned pose in the right room fits the mirrored room.

    It then lies within `ALIGNMENT_LIMIT_M` of one of the true position's `symmetric_positions`.
    """
    pose = prediction.final_pose
    if pose is None or outcomes([prediction]) != [Outcome.WRONG_ALIGNMENT]:
        return False
    return shapely.Point(pose.x_m, pose.y_m).within(_symmetric_area(plan, prediction))


def symmetric_by_chance(plan: FloorPlan, prediction: Prediction) -> float:
    """Return the share of the wrong positions in the true room for which `is_symmetric` holds."""
    truth = prediction.truth
    room = plan.rooms[truth.room_index].shape
    wrong = room.difference(shapely.Point(truth.x_m, truth.y_m).buffer(ALIGNMENT_LIMIT_M))
    return wrong.intersection(_symmetric_area(plan, prediction)).area / wrong.area if wrong.area > 0.0 else 0.0


def _symmetric_area(plan: FloorPlan, prediction: Prediction) -> shapely.Geometry:
    truth = prediction.truth
    places = symmetric_positions(plan.rooms[truth.room_index].shape, truth.x_m, truth.y_m)
    return shapely.union_all(shapely.points(places)).buffer(ALIGNMENT_LIMIT_M)


def _outcome(prediction: Prediction, stage: str | None, error_m: float) -> Outcome:
    pose = prediction.pose_after(stage)
    if pose is None:
        return Outcome.NO_ANSWER
    if pose.room_index != prediction.truth.room_index:
        return Outcome.WRONG_ROOM
    return Outcome.LOCATED if error_m <= ALIGNMENT_LIMIT_M else Outcome.WRONG_ALIGNMENT
