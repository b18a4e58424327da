"""Answers of the API, composed of search results."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lalaloc_core.bundle import Bundle, ConfidenceModel, Manifest
from lalaloc_core.conventions import heading_to_degrees
from lalaloc_core.localise.belief import Posterior, photograph_heading, pose_uncertainty, probability_map, reason_for
from lalaloc_core.localise.query import KnownHeading, Query
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.localise.sequence import Motion
from lalaloc_core.localise.sequence.sequence_search import SequenceLocalisation
from lalaloc_core.photograph.film import Film
from service.query.geopose import geopose_at
from service.query.ground import Ground, PlacedCandidate
from service.query.spots import Spot, view_answer
from service.schemas import (
    CandidateAnswer,
    DroppedFrames,
    FilmAnswer,
    LocaliseAnswer,
    ModelAnswer,
    Position,
    PosteriorAnswer,
    SequenceAnswer,
    SequencePoseAnswer,
    TimingsAnswer,
)

# Smaller probabilities are rounded to 0 in the answer.
_MIN_PROBABILITY = 5e-7
# Fields of a pose that the answer to a query about its photograph alone has too.
_POSE_FIELDS = SequencePoseAnswer.model_fields.keys() & LocaliseAnswer.model_fields.keys()


def compose_answer(
    found: Localisation,
    ground: Ground,
    spot: Spot,
    known: KnownHeading,
    *,
    timings_ms: dict[str, float],
    bundle: Bundle,
    warnings: Sequence[str] = (),
    with_step: bool = True,
) -> LocaliseAnswer:
    """Compose the answer to a query about one photograph.

    Args:
        found: result of the search.
        ground: the searched places.
        spot: the photograph.
        known: the heading that was known before the search.
        timings_ms: durations (ms) by stage.
        bundle: the model.
        warnings: warnings besides those about the heading and the photograph.
        with_step: compute the next step of an answer that is not sure.
    """
    model = bundle.manifest.confidence_for(view=found.query.is_view, turn=found.query.is_turn)
    position_m2, heading_std_deg = _uncertainty(found, ground, model)
    confidence = found.confidence(model, ground.share(found))
    candidates = [
        _candidate(ground.place(candidate), found.query, None if confidence is None else confidence.candidates[index])
        for index, candidate in enumerate(found.candidates)
    ]
    best, place = candidates[0], ground.place(found.candidates[0])
    warnings = [*_heading_warnings(found, known), *warnings, *spot.photograph.warnings]
    if confidence is not None:
        objects, is_warned = found.query.objects, bool(warnings)
        reason = reason_for(confidence.position, confidence.elsewhere, objects, is_warned=is_warned)
        warnings += [] if reason is None else [reason]
    return LocaliseAnswer(
        floorplan_id=place.plan_id,
        floorplan_revision=place.revision_id,
        level=place.level,
        position=best.position,
        heading_deg=best.heading_deg,
        heading_source="searched" if found.heading_contradicted else known.source,
        room=best.room,
        room_id=best.room_id,
        confidence=None if confidence is None else confidence.position,
        heading_confidence=None if confidence is None else confidence.heading,
        probability_elsewhere=None if confidence is None else confidence.elsewhere,
        warnings=warnings,
        covariance_m2=position_m2,
        heading_std_deg=heading_std_deg,
        stage=found.stage,
        cost=best.cost,
        latent_distance=best.latent_distance,
        camera_height_m=found.camera_height_m,
        candidates=candidates,
        geopose=best.geopose,
        view=view_answer(spot, ground, found, confidence, bundle.manifest if with_step else None),
        timings_ms=TimingsAnswer(**{name: timings_ms.get(name, 0.0) for name in TimingsAnswer.model_fields}),
        model=ModelAnswer.of(bundle),
    )


def _uncertainty(
    found: Localisation, ground: Ground, model: ConfidenceModel | None
) -> tuple[list[list[float]] | None, float | None]:
    """Return the covariance (m²) of the position and the standard deviation (degrees) of the heading, where known."""
    final = found.best[found.stage]
    if model is None or final.information is None:
        return None, None
    placed = ground.place(final)
    uncertainty = pose_uncertainty(final.information, placed.plan.rooms[placed.candidate.room_index], model)
    if uncertainty is None:
        return None, None
    std = uncertainty.heading_std
    return uncertainty.position_m2.tolist(), None if std is None else math.degrees(std)


def _heading_warnings(found: Localisation, known: KnownHeading) -> list[str]:
    """Return a warning if the known heading was not followed."""
    if not found.heading_contradicted:
        return []
    assert known.heading is not None
    origin = "heading_deg" if known.source == "given" else "the photograph's compass heading"
    degrees = heading_to_degrees(known.heading)
    return [f"{origin} is {degrees:.4g}, which the photograph contradicts: the heading was searched for instead"]


def _candidate(place: PlacedCandidate, query: Query, probability: float | None) -> CandidateAnswer:
    candidate = place.candidate
    room = place.plan.rooms[candidate.room_index]
    heading_deg = heading_to_degrees(photograph_heading(query, candidate))
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
        geopose=geopose_at(place.anchor, (candidate.x_m, candidate.y_m), heading_deg, camera_height_m),
    )


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


def compose_sequence_answer(
    answers: Sequence[LocaliseAnswer],
    found: SequenceLocalisation,
    motions: Sequence[Motion],
    manifest: Manifest,
    share: float = 1.0,
) -> SequenceAnswer:
    """Compose the answer to a query about several photographs.

    Args:
        answers: the answer for each photograph.
        found: result of the joint search.
        motions: the stated motions between the photographs.
        manifest: of the model.
        share: lowest probability that a photograph is of a searched plan.
    """
    first = answers[0]
    return SequenceAnswer(
        floorplan_id=first.floorplan_id,
        floorplan_revision=first.floorplan_revision,
        poses=[SequencePoseAnswer(**{name: getattr(answer, name) for name in _POSE_FIELDS}) for answer in answers],
        confidence=found.confidence(manifest, share),
        warnings=[
            *(_motion_warning(index, motions[index]) for index in found.motions_contradicted),
            *(f"photo[{index}]: {text}" for index, answer in enumerate(answers) for text in _about_photograph(answer)),
        ],
        stage=found.stage,
        camera_height_m=found.camera_height_m,
        timings_ms=first.timings_ms,
        model=first.model,
    )


def _about_photograph(answer: LocaliseAnswer) -> list[str]:
    return [] if answer.view is None else answer.view.warnings


def _motion_warning(index: int, motion: Motion) -> str:
    measured = []
    if motion.distance_m is not None:
        measured.append(f"distance_m {motion.distance_m:g}")
    if motion.turn is not None:
        measured.append(f"turn_deg {math.degrees(motion.turn):.4g}")
    if motion.direction is not None:
        measured.append(f"direction_deg {math.degrees(motion.direction):.4g}")
    return f"motions[{index}] ({', '.join(measured)}) contradicts the photographs and was ignored"


def film_answer(film: Film) -> FilmAnswer:
    """Return the answer's part about its film."""
    return FilmAnswer(
        frames_read=film.frames,
        frames_kept=len(film.photographs),
        dropped=[DroppedFrames(reason=reason, frames=frames) for reason, frames in film.dropped.items()],
        duration_s=film.duration_s,
        turned_deg=math.degrees(film.turned),
        warnings=list(film.warnings),
    )


def timed_poses(poses: Sequence[SequencePoseAnswer], film: Film) -> list[SequencePoseAnswer]:
    """Return the poses of a film's frames with their times."""
    return [pose.model_copy(update={"time_s": time_s}) for pose, time_s in zip(poses, film.times_s, strict=True)]
