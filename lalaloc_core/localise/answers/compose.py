"""Composition of answers: of one search, and of a camera that moves."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lalaloc_core.bundle import Bundle, ConfidenceModel
from lalaloc_core.conventions import heading_to_degrees, wrap_angle
from lalaloc_core.localise.answers.documents import (
    Answer,
    Covariance,
    Evidence,
    Ground,
    ModelAnswer,
    Placed,
    Position,
    PossiblePose,
    Spot,
    TrackedAnswer,
)
from lalaloc_core.localise.answers.views import AssumedAngle, SeenObjectAnswer, ViewAnswer
from lalaloc_core.localise.belief import Confidence, photograph_heading, pose_uncertainty
from lalaloc_core.localise.belief.confidence import CONFIDENT, advice_for, information_bits, is_outside, reason_for
from lalaloc_core.localise.localisability.reports import known_of, step_after
from lalaloc_core.localise.query import Query
from lalaloc_core.localise.query.query import KnownHeading
from lalaloc_core.localise.search.pipeline import Localisation, StageClock
from lalaloc_core.localise.tracking import Odometry
from lalaloc_core.localise.tracking.tracking_filter import Tracked


def compose_answer(
    found: Localisation,
    ground: Ground,
    spot: Spot,
    known: KnownHeading,
    bundle: Bundle,
    *,
    warnings: Sequence[str] = (),
    with_step: bool = True,
    relative_heading: AssumedAngle | None = None,
    clock: StageClock | None = None,
) -> Answer:
    """Compose the answer of a search.

    `known` is the heading that was known before the search, and `warnings` are those besides warnings about it and the
    photograph. `with_step` computes the next step of an answer that is not sure, a stage of `clock`.
    `relative_heading` is the heading minus that of the first photograph of a turn.
    """
    model = bundle.manifest.confidence_for(view=found.query.is_view, turn=found.query.is_turn)
    confidence = found.confidence(model, ground.share(found))
    placed = [ground.place(candidate) for candidate in found.candidates]
    shares = len(placed) * [None] if confidence is None else confidence.candidates
    candidates = [_possible(place, found.query, share) for place, share in zip(placed, shares, strict=True)]
    covariance_m2, heading_std_deg = _uncertainty(placed[0], model)
    best, reason = candidates[0], None
    warnings = [*_heading_warnings(found, known), *warnings, *spot.photograph.warnings]
    warnings += found.query.warnings if confidence is not None and confidence.position < CONFIDENT else ()
    if confidence is not None:
        # The field of view of a turn, of which each is warned, is known well enough.
        is_warned = bool(warnings) and not found.query.is_turn
        reason = reason_for(confidence.position, confidence.elsewhere, found.query.objects, is_warned=is_warned)
    return Answer(
        position=best.position,
        heading_deg=best.heading_deg,
        heading_source="searched" if found.heading_contradicted else known.source,
        room=best.room,
        room_id=best.room_id,
        confidence=None if confidence is None else confidence.position,
        heading_confidence=None if confidence is None else confidence.heading,
        probability_elsewhere=None if confidence is None else confidence.elsewhere,
        warnings=warnings if reason is None else [*warnings, reason],
        covariance_m2=covariance_m2,
        heading_std_deg=heading_std_deg,
        stage=found.stage,
        cost=best.cost,
        latent_distance=best.latent_distance,
        camera_height_m=found.camera_height_m,
        candidates=candidates,
        view=_told(
            spot, ground, found, confidence, bundle if with_step else None, relative_heading, clock or StageClock()
        ),
        model=ModelAnswer.of(bundle),
        evidence=Evidence(ground, found, spot.photograph),
    )


def _possible(place: Placed, query: Query, probability: float | None) -> PossiblePose:
    candidate, room = place.candidate, place.plan.rooms[place.candidate.room_index]
    return PossiblePose(
        position=Position(x_m=candidate.x_m, y_m=candidate.y_m),
        heading_deg=heading_to_degrees(photograph_heading(query, candidate)),
        room=room.name,
        room_id=room.id,
        probability=None if probability is None else min(probability, 1.0),
        cost=candidate.cost,
        latent_distance=min(max(candidate.latent_distance, 0.0), 2.0),
    )


def _uncertainty(place: Placed, model: ConfidenceModel | None) -> tuple[Covariance | None, float | None]:
    """Return the covariance (m²) of the position and the standard deviation (degrees) of the heading, where known."""
    information = place.candidate.information
    if model is None or information is None:
        return None, None
    uncertainty = pose_uncertainty(information, place.plan.rooms[place.candidate.room_index], model)
    if uncertainty is None:
        return None, None
    position_m2, heading_std = uncertainty
    (xx, xy), (_, yy) = position_m2.tolist()
    return [[xx, xy], [xy, yy]], None if heading_std is None else math.degrees(heading_std)


def _heading_warnings(found: Localisation, known: KnownHeading) -> list[str]:
    """Return a warning if the known heading was not followed."""
    if not found.heading_contradicted:
        return []
    assert known.heading is not None
    origin = "heading_deg" if known.source == "given" else "the photograph's compass heading"
    degrees = heading_to_degrees(known.heading)
    return [f"{origin} is {degrees:.4g}, which the photograph contradicts: the heading was searched for instead"]


def compose_tracked(
    found: Tracked,
    ground: Ground,
    spot: Spot,
    bundle: Bundle,
    *,
    odometry: Odometry | None = None,
    warnings: Sequence[str] = (),
) -> TrackedAnswer:
    """Compose the answer of a camera that moves.

    `odometry` is the motion that was stated, and `warnings` are those besides warnings about it and the photograph.
    """
    pose, query, best = found.pose, found.query, found.candidates[0]
    room = ground.place(best).plan.rooms[pose.room_index]
    scale = np.array([1.0, 1.0, math.degrees(1.0)])
    stated = {} if odometry is None else odometry.components
    about_motion = [
        f"{name} is {stated[name]:g}, which the photographs contradict by more than 4 standard deviations"
        for name in found.contradicted
    ]
    about_motion += [
        f"{name} contradicts at least 3 of the last 8 photographs: check its sign, unit and standard deviation"
        for name in found.state.suspected
    ]
    return TrackedAnswer(
        number=pose.number,
        mode=pose.mode,
        position=Position(x_m=pose.x_m, y_m=pose.y_m),
        heading_deg=heading_to_degrees(pose.heading),
        room=room.name,
        room_id=room.id,
        covariance=(pose.covariance * np.outer(scale, scale)).tolist(),
        probability=min(pose.probability, 1.0),
        camera_height_m=query.camera_height.height_m * math.exp(best.height_offset),
        candidates=[
            _possible(ground.place(candidate), query, probability)
            for candidate, probability in zip(found.candidates, found.probability, strict=True)
        ],
        motion_contradicted=list(found.contradicted),
        warnings=[
            *about_motion,
            *warnings,
            *spot.photograph.warnings,
            *(query.warnings if pose.probability < CONFIDENT else ()),
        ],
        view=spot.view,
        model=ModelAnswer.of(bundle),
    )


def _told(
    spot: Spot,
    ground: Ground,
    found: Localisation,
    confidence: Confidence | None,
    bundle: Bundle | None,
    relative_heading: AssumedAngle | None,
    clock: StageClock,
) -> ViewAnswer:
    """Return the answer's part about its photograph; the next step follows from the model `bundle`, if any."""
    bits = information_bits(ground.plan, ground.grid.poses, found.posterior.pose)
    sure = found.posterior.position if confidence is None else confidence.position
    seen, step = found.query.objects, None
    can_turn = not is_outside(confidence, seen)
    if bundle is not None and confidence is not None and can_turn:
        field = spot.photograph.hfov.value
        known = known_of(found, confidence, arcs=spot.arcs, field=field, rooms_known=ground.rooms_known)
        with clock.stage("next_step"):
            step = step_after(ground.plan, bundle.manifest, known, step_m=ground.grid.step_m)
    objects = None
    if seen is not None:
        objects = [
            SeenObjectAnswer(
                name=shown.name,
                probability=shown.probability,
                azimuth_deg=math.degrees(float(wrap_angle(shown.azimuth))),
            )
            for shown in seen.objects
        ]
    return ViewAnswer(
        **vars(spot.view),
        information_bits=bits,
        ruled_out=1.0 - 2.0**-bits,
        relative_heading=relative_heading,
        advice=advice_for(spot.arcs, sure) if can_turn else None,
        next_step=step,
        room_types=None if seen is None else seen.room_type.shares(),
        objects=objects,
    )
