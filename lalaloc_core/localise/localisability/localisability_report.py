"""Report of a plan's localisability: plain data, and its summary in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lalaloc_core.conditions import CONDITIONS, HARDEST, Condition, HeadingState, Photograph, condition_of, parts_of
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.localisability.predicted_localisability import STEP_M, Localisability

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
        unknown, known = (_percent(found.plan[condition_of(name, heading)]) for heading in headings)
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
        lines.append(f"{first} and {second} are confused: {_percent(pair.share)} ({_words(pair.condition)})")
    gains = [(gain, name) for name, gain in found.gains.items() if gain is not None and name != "doors"]
    for gain, name in sorted(gains, reverse=True):
        if gain >= _WORTH:
            before, after = found.plan[HARDEST], found.plan[HARDEST] + gain
            lines.append(f"{_REMEDIES[name]}: {_percent(after)} are found instead of {_percent(before)}")
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


def _words(condition: Condition) -> str:
    photograph, heading = parts_of(condition)
    return f"{_TITLES[photograph]}, heading {heading}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
