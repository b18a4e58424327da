"""What was found, in the words of the API."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from lalaloc_core.conventions import heading_to_degrees
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.covariance import pose_uncertainty
from lalaloc_core.localise.pipeline import Localisation, panorama_heading
from lalaloc_core.localise.poses import Candidate, Query
from service.query.geopose import geopose_of
from service.query.heading import KnownHeading
from service.schemas import CandidateAnswer, LocaliseAnswer, ModelAnswer, Position, TimingsAnswer
from service.storage.records import PlanRecord


@dataclass(frozen=True)
class Place:
    """The plan that a candidate lies in, and the candidate in its frame.

    Attributes:
        anchor: where on Earth the plan lies; None where that is not known.
        level: of the plan in its venue.
    """

    plan_id: str
    revision_id: str
    plan: FloorPlan
    candidate: Candidate
    anchor: Anchor | None
    level: float | None = None


# Tells where a candidate is.
Locate = Callable[[Candidate], Place]


def locate_in(record: PlanRecord) -> Locate:
    """Where the candidates of a search in a single plan are."""
    return lambda candidate: Place(record.id, record.revision_id, record.plan, candidate, record.plan.anchor)


def compose(
    found: Localisation,
    *,
    locate: Locate,
    known: KnownHeading,
    warnings: list[str],
    timings_ms: dict[str, float],
    bundle: Bundle,
    share: float = 1.0,
) -> LocaliseAnswer:
    """An answer.

    Args:
        locate: tells where each candidate is.
        share: how probable it is that the place is among those that were searched.
    """
    model = bundle.manifest.confidence
    answer, spread = found.best[found.stage], None
    if model is not None and answer.information is not None:
        at = locate(answer)
        spread = pose_uncertainty(answer.information, at.plan.rooms[at.candidate.room_index], model)
    fits = None if model is None else found.fit_probability(model)
    fits = None if fits is None else fits * share
    candidates = [
        _candidate(locate(candidate), found.query, None if fits is None else fits * probability)
        for candidate, probability in zip(found.candidates, found.posterior.candidate, strict=True)
    ]
    best, place = candidates[0], locate(found.candidates[0])
    return LocaliseAnswer(
        floorplan_id=place.plan_id,
        floorplan_revision=place.revision_id,
        level=place.level,
        position=best.position,
        heading_deg=best.heading_deg,
        heading_source="searched" if found.heading_contradicted else known.source,
        room=best.room,
        room_id=best.room_id,
        confidence=None if fits is None else fits * found.posterior.position,
        heading_confidence=None if fits is None else fits * min(found.posterior.heading, 1.0),
        warnings=warnings,
        covariance_m2=None if spread is None else spread.position_m2.tolist(),
        heading_std_deg=None if spread is None or spread.heading_std is None else math.degrees(spread.heading_std),
        stage=found.stage,
        cost=best.cost,
        latent_distance=best.latent_distance,
        camera_height_m=found.camera_height_m,
        candidates=candidates,
        geopose=best.geopose,
        timings_ms=TimingsAnswer(**{name: timings_ms.get(name, 0.0) for name in TimingsAnswer.model_fields}),
        model=model_answer(bundle),
    )


def model_answer(bundle: Bundle) -> ModelAnswer:
    """Name, version and digest of a bundle."""
    return ModelAnswer(name=bundle.manifest.name, version=bundle.manifest.version, sha256=bundle.sha256)


def heading_warnings(found: Localisation, known: KnownHeading) -> list[str]:
    """Says that a heading was not followed, where it was not."""
    if not found.heading_contradicted:
        return []
    assert known.heading is not None
    origin = "heading_deg" if known.source == "given" else "the panorama's compass heading"
    degrees = heading_to_degrees(known.heading)
    return [f"{origin} is {degrees:.4g}, which the panorama contradicts: the heading was searched for instead"]


def _candidate(place: Place, query: Query, probability: float | None) -> CandidateAnswer:
    candidate = place.candidate
    room = place.plan.rooms[candidate.room_index]
    heading_deg = heading_to_degrees(panorama_heading(query, candidate))
    camera_height_m = query.camera_height.height_m * math.exp(candidate.height_offset)
    return CandidateAnswer(
        floorplan_id=place.plan_id,
        level=place.level,
        position=Position(x_m=candidate.x_m, y_m=candidate.y_m),
        heading_deg=heading_deg,
        room=room.name,
        room_id=room.id,
        probability=None if probability is None else min(probability, 1.0),
        cost=candidate.cost,
        latent_distance=min(max(candidate.latent_distance, 0.0), 2.0),
        geopose=geopose_of(place.anchor, (candidate.x_m, candidate.y_m), heading_deg, camera_height_m),
    )
