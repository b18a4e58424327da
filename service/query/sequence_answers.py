"""What is told of several panoramas of one visit."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lalaloc_core.localise.bundle import ConfidenceModel
from lalaloc_core.localise.sequence import Motion
from lalaloc_core.localise.sequence.search import SequenceLocalisation
from service.schemas import LocaliseAnswer, SequenceAnswer, SequencePoseAnswer


def sequence_answer(
    alone: Sequence[LocaliseAnswer],
    found: SequenceLocalisation,
    motions: Sequence[Motion],
    model: ConfidenceModel | None,
) -> SequenceAnswer:
    """The answer to a query of several panoramas.

    Args:
        alone: what is told of each of them.
    """
    first = alone[0]
    fits = [None if model is None else picture.fit_probability(model) for picture in found.pictures]
    known = [one for one in fits if one is not None]
    return SequenceAnswer(
        floorplan_id=first.floorplan_id,
        floorplan_revision=first.floorplan_revision,
        poses=[
            SequencePoseAnswer(**{name: getattr(one, name) for name in SequencePoseAnswer.model_fields})
            for one in alone
        ],
        confidence=min(known) * min(found.path_probability, 1.0) if len(known) == len(fits) else None,
        warnings=[_contradiction(index, motions[index]) for index in found.motions_contradicted],
        stage=found.stage,
        camera_height_m=found.camera_height_m,
        timings_ms=first.timings_ms,
        model=first.model,
    )


def _contradiction(index: int, motion: Motion) -> str:
    """Says that a motion was not followed."""
    measured = []
    if motion.distance_m is not None:
        measured.append(f"distance_m {motion.distance_m:g}")
    if motion.turn is not None:
        measured.append(f"turn_deg {math.degrees(motion.turn):.4g}")
    if motion.direction is not None:
        measured.append(f"direction_deg {math.degrees(motion.direction):.4g}")
    return f"motions[{index}] has {', '.join(measured)}, which the panoramas contradict: it was not followed"
