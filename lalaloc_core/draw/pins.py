"""Numbered pins of an album on a plan, coloured by how sure they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from lalaloc_core.draw.canvas import INK, xml_text
from lalaloc_core.draw.plan import extent_m, plan_with
from lalaloc_core.floorplan import FloorPlan

# Blue, orange and green of Okabe and Ito's palette, distinct for colour-blind readers.
PIN_COLOURS: Final = {"sure": "#0072b2", "uncertain": "#e69f00", "corrected": "#009e73"}
_PINS_PER_EXTENT = 58.0
# Pins nearer than this many radii are moved apart, around their place.
_APART = 2.1


@dataclass(frozen=True, kw_only=True)
class DrawnPin:
    """A pin to draw: its number, place (m), heading (degrees) and state."""

    number: int
    x_m: float
    y_m: float
    heading_deg: float | None
    state: str


def draw_pins(plan: FloorPlan, pins: Sequence[DrawnPin]) -> str:
    """Draw a plan with numbered pins."""
    return plan_with(plan, pins_svg(plan, pins))


def pins_svg(plan: FloorPlan, pins: Sequence[DrawnPin], extent: float | None = None) -> str:
    """Draw pins in metres, y pointing down; `extent` (m) scales the marks (default: the plan's)."""
    radius = (extent_m(plan) if extent is None else extent) / _PINS_PER_EXTENT
    placed: list[tuple[float, float]] = []
    for pin in pins:
        placed.append(_free((pin.x_m, -pin.y_m), placed, radius))
    moved = [
        f"M{pin.x_m:.3f} {-pin.y_m:.3f}L{x:.3f} {y:.3f}"
        for pin, (x, y) in zip(pins, placed, strict=True)
        if math.hypot(x - pin.x_m, y + pin.y_m) > 0.01 * radius
    ]
    leaders = f'<path d="{"".join(moved)}" stroke="{INK}" stroke-width="{0.15 * radius:.4f}"/>' if moved else ""
    return leaders + "".join(_pin_svg(pin, *place, radius) for pin, place in zip(pins, placed, strict=True))


def arrow_svg(heading_deg: float, radius: float) -> str:
    """Draw an arrowhead at the rim of a circle around the origin, along a heading."""
    side, base, tip = 0.55 * radius, 1.05 * radius, 1.95 * radius
    return (
        f'<path d="M{-side:.3f} {-base:.3f}L0 {-tip:.3f}L{side:.3f} {-base:.3f}Z" '
        f'transform="rotate({heading_deg:.1f})" stroke="#fff" stroke-width="{0.12 * radius:.4f}"/>'
    )


def _pin_svg(pin: DrawnPin, x: float, y: float, radius: float) -> str:
    arrow = "" if pin.heading_deg is None else arrow_svg(pin.heading_deg, radius)
    size = radius * (1.25 if pin.number < 100 else 0.95)
    return (
        f'<g class="pin {xml_text(pin.state)}" transform="translate({x:.3f} {y:.3f})" '
        f'fill="{PIN_COLOURS[pin.state]}">{arrow}<circle r="{radius:.4f}" stroke="#fff" '
        f'stroke-width="{0.14 * radius:.4f}"/><text y="{0.36 * size:.4f}" font-size="{size:.4f}" fill="#fff" '
        f'font-weight="bold" text-anchor="middle">{pin.number}</text></g>'
    )


def _free(place: tuple[float, float], placed: Sequence[tuple[float, float]], radius: float) -> tuple[float, float]:
    """Return the nearest place, on rings around a place, that is apart from others."""
    for ring in range(6):
        for step in range(max(6 * ring, 1)):
            angle = math.tau * step / max(6 * ring, 1)
            x, y = place[0] + ring * radius * math.sin(angle), place[1] - ring * radius * math.cos(angle)
            if all(math.hypot(x - a, y - b) >= _APART * radius for a, b in placed):
                return x, y
    return place
