"""Sorting answers into located and failed, by the paper's two kinds of failure (figure of failure cases).

The paper names the kinds, not where they begin: "an incorrect room is retrieved", or "the correct room is retrieved but
the alignment is incorrect". Here an alignment is incorrect beyond `ALIGNMENT_LIMIT_M`.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

from lalaloc_core.evaluation.predictions import Prediction
from lalaloc_core.evaluation.score import position_errors_m

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


def _outcome(prediction: Prediction, stage: str | None, error_m: float) -> Outcome:
    found = prediction.answer if stage is None else prediction.stages.get(stage)
    if found is None:
        return Outcome.NO_ANSWER
    if found.room_index != prediction.truth.room_index:
        return Outcome.WRONG_ROOM
    return Outcome.LOCATED if error_m <= ALIGNMENT_LIMIT_M else Outcome.WRONG_ALIGNMENT
