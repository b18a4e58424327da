"""Sorting answers into located and failed, by the paper's two kinds of failure (figure of failure cases).

The paper names the kinds, not where they begin: "an incorrect room is retrieved", or "the correct room is retrieved but
the alignment is incorrect". Here an alignment is incorrect beyond `ALIGNMENT_LIMIT_M`.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import shapely

from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.evaluate.runs.score import position_errors_m
from lalaloc_core.floorplan import FloorPlan

# One step of the paper's grid: whoever is farther off has not even kept to the poses around the true one.
ALIGNMENT_LIMIT_M = 0.5


class Outcome(StrEnum):
    """What became of a query; every query has exactly one."""

    LOCATED = "located"
    WRONG_ALIGNMENT = "wrong alignment"
    WRONG_ROOM = "wrong room"
    NO_ANSWER = "no answer"


def outcomes(predictions: Sequence[Prediction], stage: str | None = None) -> list[Outcome]:
    """What became of each query.

    Args:
        stage: judge the pose after this stage; None judges the answer.
    """
    errors_m = position_errors_m(predictions, stage)
    return [_outcome(one, stage, float(error_m)) for one, error_m in zip(predictions, errors_m, strict=True)]


def count_outcomes(predictions: Sequence[Prediction], stage: str | None = None) -> dict[Outcome, int]:
    """How many queries had each outcome, those with none included; the counts sum to the number of queries."""
    found = outcomes(predictions, stage)
    return {outcome: found.count(outcome) for outcome in Outcome}


def symmetric_positions(room: shapely.Polygon, x_m: float, y_m: float) -> list[tuple[float, float]]:
    """Where a position comes to lie when its room is mirrored along either axis of its bounding box or turned round."""
    left, bottom, right, top = room.bounds
    across, along = left + right - x_m, bottom + top - y_m
    return [(across, y_m), (x_m, along), (across, along)]


def is_symmetric(plan: FloorPlan, prediction: Prediction) -> bool:
    """Whether an answer in the right room, but wrongly aligned there, took the room for its mirror image.

    That is: it lies within `ALIGNMENT_LIMIT_M` of one of the true position's `symmetric_positions`.
    """
    found = prediction.final_pose
    if found is None or outcomes([prediction]) != [Outcome.WRONG_ALIGNMENT]:
        return False
    return shapely.Point(found.x_m, found.y_m).within(_symmetric_area(plan, prediction))


def symmetric_by_chance(plan: FloorPlan, prediction: Prediction) -> float:
    """Share of the wrong positions in the true room that `is_symmetric` would hold for."""
    truth = prediction.truth
    room = plan.rooms[truth.room_index].shape
    wrong = room.difference(shapely.Point(truth.x_m, truth.y_m).buffer(ALIGNMENT_LIMIT_M))
    return wrong.intersection(_symmetric_area(plan, prediction)).area / wrong.area if wrong.area > 0.0 else 0.0


def _symmetric_area(plan: FloorPlan, prediction: Prediction) -> shapely.Geometry:
    truth = prediction.truth
    places = symmetric_positions(plan.rooms[truth.room_index].shape, truth.x_m, truth.y_m)
    return shapely.union_all(shapely.points(places)).buffer(ALIGNMENT_LIMIT_M)


def _outcome(prediction: Prediction, stage: str | None, error_m: float) -> Outcome:
    found = prediction.final_pose if stage is None else prediction.stages.get(stage)
    if found is None:
        return Outcome.NO_ANSWER
    if found.room_index != prediction.truth.room_index:
        return Outcome.WRONG_ROOM
    return Outcome.LOCATED if error_m <= ALIGNMENT_LIMIT_M else Outcome.WRONG_ALIGNMENT
