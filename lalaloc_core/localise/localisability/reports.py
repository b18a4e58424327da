"""Localisability of a plan, and the next step after an answer, as plain data and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from pydantic import ConfigDict, Field

from lalaloc_core.answer_numbers import Score, Share, SignedDegrees
from lalaloc_core.bundle import Manifest
from lalaloc_core.conditions import CONDITIONS, HARDEST, Condition, HeadingState, Photograph, condition_of, parts_of
from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import Confidence
from lalaloc_core.localise.localisability.next_step import Known, NextStep, StepKind, next_step
from lalaloc_core.localise.localisability.predicted_localisability import STEP_M, Localisability
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.shown_text import probability_text

_TITLES: dict[Photograph, str] = {
    "sphere": "a sphere",
    "phone": "a phone photograph (80°)",
    "three_phone": "three of one spot",
}
_REMEDIES = {
    "heading": "Set the heading of a phone photograph",
    "three_photographs": "Take three phone photographs from one spot, a third of a turn apart, as one query",
    "sphere": "Take a 360° photograph instead of a phone photograph",
    "room_hint": "Choose the room of a phone photograph as a hint",
    "doors": "draw doors and windows",
}
# Smallest gain that is advised.
_WORTH = 0.02
_PAIRS = 3


def report_of(plan: FloorPlan, found: Localisability, *, coarse: bool = False) -> dict[str, Any]:
    """Return plain data: probabilities by condition for the plan, its rooms and places, confusions and remedies.

    A coarse prediction has too few draws for advice.
    """
    rooms = [
        {"id": room.id, "name": room.name, "probability": row}
        for room, row in zip(plan.rooms, _rows(found.rooms), strict=True)
    ]
    places = [
        {"x_m": round(float(x), 3), "y_m": round(float(y), 3), "room": plan.rooms[room].id, "probability": row}
        for (x, y), room, row in zip(found.places.position_m, found.places.room_index, _rows(found.found), strict=True)
    ]
    confused = [
        {
            "rooms": [plan.rooms[index].id for index in pair.rooms],
            "condition": pair.condition,
            "share": round(pair.share, 3),
        }
        for pair in found.confused
    ]
    gains = {name: None if gain is None else round(gain, 3) for name, gain in found.gains.items()}
    return {
        "coarse": coarse,
        "spacing_m": round(found.spacing_m, 3),
        "probability": {name: round(found.plan[name], 3) for name in CONDITIONS},
        "rooms": rooms,
        "places": places,
        "confused": confused,
        "measured_on": HARDEST,
        "gains": gains,
        "advice": [] if coarse else _advice_of(plan, found),
    }


def summary_of(plan: FloorPlan, found: Localisability) -> list[str]:
    """Return the report in words, one line each."""
    lines = ["Predicted share of photographs found within 1 m, heading unknown (stated):"]
    headings: tuple[HeadingState, HeadingState] = ("unknown", "known")
    for name, title in _TITLES.items():
        unknown, known = (probability_text(found.plan[condition_of(name, heading)], 0) for heading in headings)
        lines.append(f"- {title}: {unknown} ({known})")
    return lines + _advice_of(plan, found)


def _advice_of(plan: FloorPlan, found: Localisability) -> list[str]:
    """Return sentences about confused rooms and what helps most."""
    lines = []
    if found.spacing_m > STEP_M:
        lines.append(
            f"The plan is large: its poses are compared {found.spacing_m:g} m apart, not {STEP_M:g} m, and answers "
            f"within {max(found.spacing_m, 1.0):g} m count as found"
        )
    for pair in found.confused[:_PAIRS]:
        first, second = (f"'{plan.rooms[index].name}'" for index in pair.rooms)
        photograph, heading = parts_of(pair.condition)
        condition = f"{_TITLES[photograph]}, heading {heading}"
        lines.append(f"{first} and {second} are confused: {probability_text(pair.share, 0)} ({condition})")
    gains = [(gain, name) for name, gain in found.gains.items() if gain is not None and name != "doors"]
    for gain, name in sorted(gains, reverse=True):
        if gain >= _WORTH:
            before, after = (probability_text(found.plan[HARDEST] + more, 0) for more in (0.0, gain))
            lines.append(f"{_REMEDIES[name]}: {after} are found instead of {before}")
    doors = found.gains["doors"]
    if doors is None:
        lines.append(f"The plan shows no openings: {_REMEDIES['doors']}")
    else:
        lines.append(f"Doors and windows of the plan contribute {100 * doors:+.0f} points")
    return lines


def _rows(values: Mapping[Condition, Any]) -> list[dict[str, float] | None]:
    """Return the values by condition of each place or room; None where they are unknown."""
    columns = zip(*(values[name].tolist() for name in CONDITIONS), strict=True)
    return [
        None
        if any(value != value for value in row)
        else {name: round(value, 3) for name, value in zip(CONDITIONS, row, strict=True)}
        for row in columns
    ]


@dataclass(frozen=True, kw_only=True)
class NextStepAnswer:
    """Step after an answer that is not sure, and what it is expected to tell."""

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")

    kind: Annotated[
        StepKind,
        Field(
            description="`turn`: take another photograph from the same spot; `door`: take one from behind a door; "
            "`heading`: state the heading, within 10°; `rooms`: choose one of `rooms` as a hint."
        ),
    ]
    text: Annotated[str, Field(description="The step in words.")]
    turn_deg: Annotated[
        SignedDegrees | None,
        Field(description="Of `turn` and `door`: direction relative to the photograph's centre, clockwise; else null."),
    ]
    distance_m: Annotated[Score | None, Field(description="Of `door`: distance to the door; else null.")]
    rooms: Annotated[
        list[str] | None,
        Field(description="Of `rooms`: `id` of each probable room, the most probable first; else null."),
    ]
    expected_bits: Annotated[Score, Field(description="Expected increase of `information_bits`.")]
    expected_confidence: Annotated[Share, Field(description="Expected `confidence` after the step.")]


def step_after(plan: FloorPlan, manifest: Manifest, known: Known, *, step_m: float) -> NextStepAnswer | None:
    """Return the next step after an answer, by the facts about it; None without a step."""
    step = next_step(plan, manifest, known, step_m=step_m)
    if step is None:
        return None
    return NextStepAnswer(
        kind=step.kind,
        text=words_of(plan, step),
        turn_deg=math.degrees(step.turn) if step.kind in ("turn", "door") else None,
        distance_m=step.distance_m if step.kind == "door" else None,
        rooms=[plan.rooms[index].id for index in step.rooms] if step.kind == "rooms" else None,
        expected_bits=step.bits,
        expected_confidence=step.confidence,
    )


def known_of(
    found: Localisation,
    confidence: Confidence,
    *,
    arcs: Sequence[tuple[float, float]],
    field: float,
    rooms_known: bool = False,
) -> Known:
    """Return the facts about an answer that steps are computed from.

    `arcs` are azimuths (radians) that were seen, relative to the photograph's centre; `field` is its horizontal field
    of view (radians).
    """
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
    return f"{what}; the expected confidence is then {probability_text(step.confidence, 0)}"
