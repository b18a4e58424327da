"""Numbered pins of an album on a plan, and the pages of the report: the plans, and the photographs room by room.

Pages are drawings (A4, 150 pixels per inch), so that text looks the same on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from textwrap import wrap
from typing import Any, Final

from lalaloc_core.draw.canvas import INK, MUTED, RULE, document, image, shortened, words, xml_text
from lalaloc_core.draw.plan import extent_m, plan_part
from lalaloc_core.errors import InvalidPhotographError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.photograph.photograph import open_picture
from lalaloc_core.photograph.picture_files import jpeg
from lalaloc_core.shown_text import probability_text

# Blue, orange and green of Okabe and Ito's palette, distinct for colour-blind readers.
PIN_COLOURS: Final = {"sure": "#0072b2", "uncertain": "#e69f00", "corrected": "#009e73"}
_PINS_PER_EXTENT = 58.0
# Pins nearer than this many radii are moved apart, around their place.
_APART = 2.1
# Pages.
WIDTH, HEIGHT, DPI = 1240, 1754, 150
_MARGIN = 80
_INNER = WIDTH - 2 * _MARGIN
# Photographs of a page: columns, rows, the space between, the height of the caption, and of the plan above.
_COLUMNS, _ROWS, _GAP, _CAPTION, _PLAN = 2, 3, 36, 64, 380
_TOP = _MARGIN + 70
_LINES = 46
# Letters of a line under the plan.
_LINE = 105
THUMBNAIL = (800, 600)


@dataclass(frozen=True, kw_only=True)
class DrawnPin:
    """A pin to draw: its number, title, place (m), heading (degrees) and state."""

    number: int
    title: str
    x_m: float
    y_m: float
    heading_deg: float | None
    state: str


def draw_pins(size_m: float, pins: Sequence[DrawnPin]) -> str:
    """Draw pins in metres, y pointing down; the longer side of the plan's drawing scales the marks."""
    radius = size_m / _PINS_PER_EXTENT
    placed: list[tuple[float, float]] = []
    for pin in pins:
        placed.append(_free((pin.x_m, -pin.y_m), placed, radius))
    moved = [
        f"M{pin.x_m:.3f} {-pin.y_m:.3f}L{x:.3f} {y:.3f}"
        for pin, (x, y) in zip(pins, placed, strict=True)
        if math.hypot(x - pin.x_m, y + pin.y_m) > 0.01 * radius
    ]
    leaders = f'<path d="{"".join(moved)}" stroke="{INK}" stroke-width="{0.15 * radius:.4f}"/>' if moved else ""
    return leaders + "".join(pin_svg(pin, *place, radius) for pin, place in zip(pins, placed, strict=True))


def arrow_svg(heading_deg: float, radius: float) -> str:
    """Draw an arrowhead at the rim of a circle around the origin, along a heading."""
    side, base, tip = 0.55 * radius, 1.05 * radius, 1.95 * radius
    return (
        f'<path d="M{-side:.3f} {-base:.3f}L0 {-tip:.3f}L{side:.3f} {-base:.3f}Z" '
        f'transform="rotate({heading_deg:.1f})" stroke="#fff" stroke-width="{0.12 * radius:.4f}"/>'
    )


def pin_svg(pin: DrawnPin, x: float, y: float, radius: float) -> str:
    """Draw a pin at a point in metres, y pointing down."""
    arrow = "" if pin.heading_deg is None else arrow_svg(pin.heading_deg, radius)
    size = radius * (1.25 if pin.number < 100 else 0.95)
    return (
        f'<g class="pin {xml_text(pin.state)}" transform="translate({x:.3f} {y:.3f})" '
        f'fill="{PIN_COLOURS[pin.state]}"><title>{xml_text(pin.title)}</title>{arrow}'
        f'<circle r="{radius:.4f}" stroke="#fff" '
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


@dataclass(frozen=True, eq=False)
class ReportRow:
    """A photograph of the report: its entry in `pins.json`, and a function that returns its file."""

    entry: Mapping[str, Any]
    content: Callable[[], bytes]

    @property
    def pin(self) -> DrawnPin | None:
        """Its pin; None if it is set aside."""
        named = {name: self.entry[name] for name in ("number", "heading_deg", "state")}
        title = "{number} {photograph} {room}".format_map(self.entry)
        return None if self.entry["position"] is None else DrawnPin(title=title, **self.entry["position"], **named)


def report_notes(counts: Mapping[str, int], camera_height_m: float | None, warnings: Sequence[str]) -> list[str]:
    """Return the lines under the first plan: the number of photographs by state, camera height and warnings."""
    lines = [", ".join(f"{count} {state.replace('_', ' ')}" for state, count in counts.items() if count)]
    if camera_height_m is not None:
        lines.append(f"Cameras were {camera_height_m:.2f} m above the floor.")
    return lines + [line for warning in warnings for line in wrap(warning, _LINE)]


def report_pages(
    title: str, plans: Mapping[str, FloorPlan], rows: Sequence[ReportRow], notes: Sequence[str]
) -> Iterator[str]:
    """Yield the pages as SVG: each plan, then each room with photographs, then what was set aside."""
    for number, (plan_id, plan) in enumerate(plans.items()):
        own = [row for row in rows if row.entry["plan"] == plan_id]
        yield _plan_page(title, plan, own, len(rows), notes if number == 0 else ())
    by_room: dict[tuple[str, str], list[ReportRow]] = {}
    for row in rows:
        if row.pin is not None:
            by_room.setdefault((row.entry["plan"], row.entry["room_id"]), []).append(row)
    for (plan_id, _), members in by_room.items():
        for first in range(0, len(members), _COLUMNS * _ROWS):
            yield _room_page(plans[plan_id], members, members[first : first + _COLUMNS * _ROWS])
    aside = [row for row in rows if row.pin is None]
    for first in range(0, len(aside), _LINES // 2):
        yield _aside_page(aside[first : first + _LINES // 2])


def _plan_page(title: str, plan: FloorPlan, rows: Sequence[ReportRow], count: int, notes: Sequence[str]) -> str:
    pins = [row.pin for row in rows if row.pin is not None]
    parts = [_heading(title, f"{plan.name}: {len(rows)} of {count} photographs")]
    foot = 120 + 30 * len(notes)
    box = (_MARGIN, _TOP + 10, _INNER, HEIGHT - _TOP - _MARGIN - foot)
    parts.append(plan_part(plan, box, draw_pins(extent_m(plan), pins)))
    y = HEIGHT - _MARGIN - foot + 60
    x = float(_MARGIN)
    names = (("sure", "room is probably right"), ("uncertain", "to be checked"), ("corrected", "stated by a person"))
    for state, meaning in names:
        parts.append(f'<circle cx="{x + 10:.0f}" cy="{y - 8:.0f}" r="10" fill="{PIN_COLOURS[state]}"/>')
        parts.append(words(x + 30, y, f"{state}: {meaning}", 20, fill=INK))
        x += 360
    for line, note in enumerate(notes):
        parts.append(words(_MARGIN, y + 40 + 30 * line, shortened(note, _LINE), 18, fill=MUTED))
    return document(WIDTH, HEIGHT, title, parts)


def _room_page(plan: FloorPlan, members: Sequence[ReportRow], rows: Sequence[ReportRow]) -> str:
    room = members[0].entry["room"]
    numbers = f"{len(members)} photograph{'s' if len(members) > 1 else ''}"
    parts = [_heading(room, f"{plan.name}, {numbers}")]
    pins = [row.pin for row in members if row.pin is not None]
    parts.append(plan_part(plan, (_MARGIN, _TOP, _INNER, _PLAN), draw_pins(extent_m(plan), pins)))
    width = (_INNER - (_COLUMNS - 1) * _GAP) / _COLUMNS
    height = (HEIGHT - _TOP - _PLAN - _MARGIN - 30) / _ROWS
    for place, row in enumerate(rows):
        x = _MARGIN + (place % _COLUMNS) * (width + _GAP)
        y = _TOP + _PLAN + 30 + (place // _COLUMNS) * height
        parts.append(_photograph(row, (x, y, width, height - _CAPTION - 14)))
    return document(WIDTH, HEIGHT, room, parts)


def _photograph(row: ReportRow, box: tuple[float, float, float, float]) -> str:
    x, y, width, height = box
    parts, shown = list[str](), None
    with suppress(InvalidPhotographError, OSError):
        shown = open_picture(row.content(), max_size=THUMBNAIL)
    if shown is not None:
        scale = min(width / shown.shape[1], height / shown.shape[0])
        size = shown.shape[1] * scale, shown.shape[0] * scale
        parts.append(image(jpeg(shown), "jpeg", (x + 0.5 * (width - size[0]), y + 0.5 * (height - size[1]), *size)))
    else:
        parts.append(f'<rect x="{x:.0f}" y="{y:.0f}" width="{width:.0f}" height="{height:.0f}" fill="{RULE}"/>')
    pin = row.pin
    assert pin is not None
    middle = y + height + 40
    arrow = "" if pin.heading_deg is None else arrow_svg(pin.heading_deg, 15.0)
    parts.append(
        f'<g transform="translate({x + 34:.0f} {middle:.0f})" fill="{PIN_COLOURS[pin.state]}">{arrow}'
        f'<circle r="15" /><text y="6" font-size="17" fill="#fff" font-weight="bold" text-anchor="middle">'
        f"{pin.number}</text></g>"
    )
    parts.append(words(x + 76, middle - 4, shortened(row.entry["photograph"], 34), 20))
    room, place = (probability_text(row.entry[name], 0) for name in ("room_confidence", "within_1m"))
    facts = f"{row.entry['taken'] or ''}   room {room}, within 1 m {place}"
    parts.append(words(x + 76, middle + 20, shortened(facts.strip(), 52), 16, fill=MUTED))
    return "".join(parts)


def _aside_page(rows: Sequence[ReportRow]) -> str:
    parts = [_heading("Set aside", "photographs without a pin")]
    for line, row in enumerate(rows):
        y = _TOP + 40 + line * 66
        name = shortened(row.entry["photograph"], 70)
        parts.append(words(_MARGIN, y, f"{row.entry['number']}   {name}", 20))
        parts.append(words(_MARGIN + 40, y + 26, shortened(row.entry["reason"], 112), 16, fill=MUTED))
    return document(WIDTH, HEIGHT, "Set aside", parts)


def _heading(text: str, under: str) -> str:
    rule = f'<path d="M{_MARGIN} {_TOP - 14}H{WIDTH - _MARGIN}" stroke="{RULE}" stroke-width="2"/>'
    under = shortened(under, 50)
    # Letters are about half as wide as high, bold ones 0.6 times; what is left of the line is the title's.
    text = shortened(text, int((WIDTH - 2 * _MARGIN - 10 * len(under)) / 20) - 1)
    head = words(_MARGIN, _MARGIN + 24, text, 34, more='font-weight="bold"')
    return head + words(WIDTH - _MARGIN, _MARGIN + 24, under, 20, fill=MUTED, anchor="end") + rule
