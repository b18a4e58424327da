"""Next step after an answer, as plain data and in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from lalaloc_core.bundle import Manifest
from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import Confidence
from lalaloc_core.localise.localisability.next_step import Known, NextStep, next_step
from lalaloc_core.localise.search.pipeline import Localisation


def step_after(
    plan: FloorPlan,
    manifest: Manifest,
    found: Localisation,
    confidence: Confidence | None,
    *,
    arcs: Sequence[tuple[float, float]],
    field: float,
    step_m: float,
    rooms_known: bool = False,
) -> dict[str, Any] | None:
    """Return the next step after an answer, with the field names of the API; None without a confidence, or a step.

    Args:
        plan: the plan that was searched.
        manifest: of the model.
        found: result of the search.
        confidence: its confidence; None for a model without.
        arcs: azimuths (radians) that were seen, relative to the photograph's centre.
        field: horizontal field of view (radians) of the photograph.
        step_m: step of the pose grid.
        rooms_known: whether rooms need not be asked for.
    """
    if confidence is None:
        return None
    known = known_of(found, confidence, arcs=arcs, field=field, rooms_known=rooms_known)
    step = next_step(plan, manifest, known, step_m=step_m)
    return None if step is None else _document(plan, step)


def known_of(
    found: Localisation,
    confidence: Confidence,
    *,
    arcs: Sequence[tuple[float, float]],
    field: float,
    rooms_known: bool = False,
) -> Known:
    """Return the facts about an answer that steps are computed from; see `step_after`."""
    is_view = found.query.is_view
    return Known(
        support=found.posterior.support,
        fit=confidence.fit,
        answer=found.posterior.position,
        arcs=arcs,
        field=field if is_view else TWO_PI,
        height_m=found.camera_height_m,
        is_view=is_view,
        heading=found.query.heading_known or found.query.searched is not None,
        rooms=rooms_known,
    )


def _document(plan: FloorPlan, step: NextStep) -> dict[str, Any]:
    return {
        "kind": step.kind,
        "text": words_of(plan, step),
        "turn_deg": math.degrees(step.turn) if step.kind in ("turn", "door") else None,
        "distance_m": step.distance_m if step.kind == "door" else None,
        "rooms": [plan.rooms[index].id for index in step.rooms] if step.kind == "rooms" else None,
        "expected_bits": step.bits,
        "expected_confidence": step.confidence,
    }


def words_of(plan: FloorPlan, step: NextStep) -> str:
    """Return a step in words, with the expected confidence."""
    side = "to the right" if step.turn >= 0.0 else "to the left"
    degrees = f"{abs(math.degrees(step.turn)):.0f}°"
    if step.kind == "turn":
        what = f"turn {degrees}{'' if degrees == '180°' else f' {side}'} on the spot and take another photograph"
    elif step.kind == "door":
        ahead = "ahead" if degrees == "0°" else f"{degrees} {side}"
        what = f"step through the door {ahead}, {step.distance_m:.1f} m away, and take another photograph behind it"
    elif step.kind == "heading":
        what = "state the heading, by a compass or the direction of a wall"
    else:
        names = list(dict.fromkeys(plan.rooms[index].name for index in step.rooms))
        what = f"choose the room: {', '.join(names[:-1])} or {names[-1]}"
    return f"{what}; the expected confidence is then {100 * step.confidence:.0f} %"
