"""Answers of the API, composed of search results."""

from __future__ import annotations

import math
from typing import Any

from lalaloc_core.localise.answers.documents import Answer, TurnAnswer
from lalaloc_core.localise.belief import Posterior, probability_map
from lalaloc_core.localise.query import Query
from service.query.geopose import geopose_at
from service.query.ground import Ground, PlacedCandidate
from service.schemas import LocaliseAnswer, PosteriorAnswer, SequenceAnswer, SequencePoseAnswer, TimingsAnswer

# Smaller probabilities are rounded to 0 in the answer.
_MIN_PROBABILITY = 5e-7
# Fields of a pose that the answer to a query about its photograph alone has too.
_POSE_FIELDS = SequencePoseAnswer.model_fields.keys() & LocaliseAnswer.model_fields.keys()


def localise_answer(answer: Answer, ground: Ground, timings_ms: dict[str, float]) -> LocaliseAnswer:
    """Return the answer to a query about one photograph, with its places in stored plans and on Earth."""
    found, fields = answer.evidence.found, answer.document()
    places = [ground.place(candidate) for candidate in found.candidates]
    candidates = [
        pose | _located(place, pose, found.query) for place, pose in zip(places, fields["candidates"], strict=True)
    ]
    best = candidates[0]
    return LocaliseAnswer.model_validate(
        fields
        | {name: best[name] for name in ("floorplan_id", "level", "geopose")}
        | {
            "floorplan_revision": places[0].revision_id,
            "candidates": candidates,
            "timings_ms": {name: timings_ms.get(name, 0.0) for name in TimingsAnswer.model_fields},
        }
    )


def _located(place: PlacedCandidate, pose: dict[str, Any], query: Query) -> dict[str, Any]:
    candidate = place.candidate
    camera_height_m = query.camera_height.height_m * math.exp(candidate.height_offset)
    geopose = geopose_at(place.anchor, (candidate.x_m, candidate.y_m), pose["heading_deg"], camera_height_m)
    return {"floorplan_id": place.plan_id, "level": place.level, "geopose": geopose}


def posterior_answer(ground: Ground, posterior: Posterior) -> PosteriorAnswer:
    """Return the positions of the pose grid whose rounded probability is above zero."""
    places = probability_map(ground.plan, ground.grid.poses, posterior)
    kept = places.probability >= _MIN_PROBABILITY
    position_m = places.position_m[kept]
    return PosteriorAnswer(
        step_m=ground.grid.step_m,
        x_m=position_m[:, 0].tolist(),
        y_m=position_m[:, 1].tolist(),
        probability=places.probability[kept].tolist(),
    )


def sequence_answer(
    answer: TurnAnswer, ground: Ground, timings_ms: dict[str, float], venue_id: str | None
) -> SequenceAnswer:
    """Return the answer to a query about photographs of one spot, with its places in stored plans and on Earth."""
    poses = [localise_answer(pose, ground, timings_ms) for pose in answer.poses]
    first, times_s = poses[0], answer.times_s or [None] * len(poses)
    return SequenceAnswer(
        floorplan_id=first.floorplan_id,
        floorplan_revision=first.floorplan_revision,
        venue_id=venue_id,
        poses=[
            SequencePoseAnswer(**{name: getattr(pose, name) for name in _POSE_FIELDS}, time_s=time_s)
            for pose, time_s in zip(poses, times_s, strict=True)
        ],
        confidence=answer.confidence,
        warnings=answer.warnings,
        film=answer.film,
        stage="lpo" if answer.stage == "lpo" else "retrieval",
        camera_height_m=answer.camera_height_m,
        timings_ms=first.timings_ms,
        model=first.model,
    )
