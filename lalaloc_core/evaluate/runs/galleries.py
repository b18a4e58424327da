"""Scores of answers in galleries: how often an annotated photograph's own room is found among others like it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lalaloc_core.evaluate.runs.predictions import Prediction
from lalaloc_core.evaluate.runs.score import expected_calibration_error, heading_errors_deg, position_errors_m
from lalaloc_core.learn.data.annotated import GalleryKey
from lalaloc_core.learn.data.annotations import AnnotatedPhotograph

# A position is right within this distance, or within this share of the room's size (the root of its area).
NEAR_M, NEAR_SHARE = 0.5, 0.1
# A room that is the same when it is turned round has two headings for one position.
_TURNED_DEG = 10.0
# Rank of a room that is not among the answer's candidates.
_NOT_RANKED = 1_000


@dataclass(frozen=True, kw_only=True)
class GalleryAnswer:
    """One photograph asked for in one gallery; of two outlines, the one that was answered better.

    Attributes:
        located: the right room and the right position in it.
        turned: located, but with a heading that is off by more than 10°.
        rank: of the best candidate in the right room, from 1; None where no candidate is in it.
        within_1m: what `confidence` is the probability of.
    """

    photograph: str
    gallery: int
    outline: int
    located: bool
    turned: bool
    right_room: bool
    rank: int | None
    error_m: float
    within_1m: bool
    confidence: float | None

    @property
    def merit(self) -> tuple[bool, bool, int, float]:
        """What the better of two answers has more of."""
        return self.located, self.right_room, -(self.rank or _NOT_RANKED), -self.error_m


@dataclass(frozen=True, kw_only=True)
class GalleryScores:
    """Shares over all galleries of all photographs.

    Attributes:
        turned: share in which the position is right, but the heading is not.
        among_3: share in which the right room is among the first three candidates.
        calibration_error: expected calibration error of "within 1 m"; None without confidences.
        by_photograph: share of its galleries in which each photograph was located.
    """

    photographs: int
    galleries: int
    located: float
    turned: float
    right_room: float
    among_3: float
    calibration_error: float | None
    by_photograph: Mapping[str, float]


def answers_in_galleries(
    predictions: Sequence[Prediction], photographs: Sequence[AnnotatedPhotograph]
) -> list[GalleryAnswer]:
    """One answer for every gallery of every photograph, in order."""
    known = {one.name: one for one in photographs}
    errors_m = np.nan_to_num(position_errors_m(predictions), nan=np.inf)
    turned_deg = heading_errors_deg(predictions)
    best: dict[tuple[str, int], GalleryAnswer] = {}
    for prediction, error_m, off_deg in zip(predictions, errors_m, turned_deg, strict=True):
        key = GalleryKey.of_scene(prediction.scene)
        assert key is not None, f"'{prediction.scene}' is no gallery"
        size_m = known[key.photograph].outlines[key.outline].size_m
        found = prediction.final_pose
        right_room = found is not None and found.room_index == prediction.truth.room_index
        located = right_room and bool(error_m < max(NEAR_M, NEAR_SHARE * size_m))
        answer = GalleryAnswer(
            photograph=key.photograph,
            gallery=key.gallery,
            outline=key.outline,
            located=located,
            turned=located and bool(off_deg > _TURNED_DEG),
            right_room=right_room,
            rank=prediction.room_rank,
            error_m=float(error_m),
            within_1m=bool(error_m < 1.0),
            confidence=prediction.confidence,
        )
        slot = key.photograph, key.gallery
        if slot not in best or answer.merit > best[slot].merit:
            best[slot] = answer
    return list(best.values())


def score_galleries(answers: Sequence[GalleryAnswer]) -> GalleryScores:
    """Scores of at least one answer."""
    confident = [one for one in answers if one.confidence is not None]
    error = None
    if confident:
        confidence = np.array([one.confidence for one in confident], dtype=float)
        error = expected_calibration_error(confidence, np.array([one.within_1m for one in confident]))
    names = list(dict.fromkeys(one.photograph for one in answers))
    return GalleryScores(
        photographs=len(names),
        galleries=len(answers),
        located=float(np.mean([one.located for one in answers])),
        turned=float(np.mean([one.turned for one in answers])),
        right_room=float(np.mean([one.right_room for one in answers])),
        among_3=float(np.mean([one.rank is not None and one.rank <= 3 for one in answers])),
        calibration_error=error,
        by_photograph={
            name: float(np.mean([one.located for one in answers if one.photograph == name])) for name in names
        },
    )


def describe_answers(answers: Sequence[GalleryAnswer], photograph: str) -> str:
    """How many of its galleries a photograph was located in, and the ranks of its room in the others."""
    own = [one for one in answers if one.photograph == photograph]
    if not own:
        return "not asked"
    missed = [f"{one.rank or 'none'}" for one in own if not one.located]
    return f"{len(own) - len(missed)} of {len(own)}" + (f" (ranks {', '.join(missed)})" if missed else "")
