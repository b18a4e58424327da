"""Pins of an album as files that people take away: GeoJSON, CSV, and SVG over the drawing of a plan."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Any

from lalaloc_core.draw.canvas import INK, PAPER, xml_text
from lalaloc_core.draw.plan import Bounds, svg_around
from service.schemas.albums import AlbumPhotographAnswer, PinAnswer

# Colours of pins by state, from Okabe and Ito's palette; uncertain ones have a dashed edge as well.
COLOURS = {"sure": "#007a5a", "corrected": "#0067a5", "uncertain": "#c84f00"}
_COLUMNS: tuple[str, ...] = (
    "number",
    "name",
    "taken_at",
    "state",
    "confidence",
    "floorplan_id",
    "level",
    "room_id",
    "room",
    "x_m",
    "y_m",
    "heading_deg",
    "latitude",
    "longitude",
    "reason",
)
# Spreadsheets take texts that begin so for formulas.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
# Radius of a pin, and length of its arrow, as shares of the drawing's size.
_RADIUS, _ARROW = 0.016, 2.6


def pins_csv(photographs: Sequence[AlbumPhotographAnswer]) -> bytes:
    """Return photographs as CSV in UTF-8 (RFC 4180), a line each; texts that look like formulas begin with `'`."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, _COLUMNS)
    writer.writeheader()
    for photograph in photographs:
        row = {name: "" if value is None else value for name, value in _row(photograph).items()}
        writer.writerow({name: _plain(value) for name, value in row.items()})
    return buffer.getvalue().encode(errors="replace")


def pins_geojson(photographs: Sequence[AlbumPhotographAnswer]) -> dict[str, Any] | None:
    """Return pins as a FeatureCollection (RFC 7946); None if no photograph with a pin has a place on Earth.

    Photographs without a place have a null geometry.
    """
    features, placed, located = [], 0, 0
    for photograph in photographs:
        pin = photograph.pin
        geometry = None
        if pin is not None and pin.place is not None:
            placed += 1
            if pin.geopose is not None:
                located += 1
                place = pin.geopose.position
                geometry = {"type": "Point", "coordinates": [place.lon, place.lat, place.h]}
        properties = photograph.model_dump(mode="json")
        features.append({"type": "Feature", "id": photograph.id, "geometry": geometry, "properties": properties})
    if placed and not located:
        return None
    return {"type": "FeatureCollection", "features": features}


def pins_svg(name: str, bounds_m: Bounds, photographs: Sequence[AlbumPhotographAnswer]) -> tuple[str, str]:
    """Return the parts of a drawing before and after its rooms: a pin with its number and arrow for each photograph."""
    head, tail = svg_around(name, bounds_m)
    size_m = _RADIUS * max(bounds_m[2] - bounds_m[0], bounds_m[3] - bounds_m[1], 1.0)
    marks = [_mark(photograph, photograph.pin, size_m) for photograph in photographs if photograph.pin is not None]
    end = tail.rindex("</svg>")
    return head, tail[:end] + "".join(marks) + tail[end:]


def _row(photograph: AlbumPhotographAnswer) -> dict[str, Any]:
    pin = photograph.pin
    row = {"number": photograph.number, "name": photograph.name, "taken_at": photograph.view.taken_at}
    if pin is None:
        return row
    row |= {"state": pin.state, "confidence": pin.confidence, "reason": pin.reason}
    if (place := pin.place) is not None:
        row |= {key: getattr(place, key) for key in ("floorplan_id", "level", "room_id", "room", "heading_deg")}
        row |= {"x_m": place.position.x_m, "y_m": place.position.y_m}
    if pin.geopose is not None:
        row |= {"latitude": pin.geopose.position.lat, "longitude": pin.geopose.position.lon}
    return row


def _plain(value: Any) -> Any:
    """Return a value that spreadsheets do not take for a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def _mark(photograph: AlbumPhotographAnswer, pin: PinAnswer, radius_m: float) -> str:
    if (place := pin.place) is None:
        return ""
    x, y, colour = place.position.x_m, -place.position.y_m, COLOURS[pin.state]
    dashes = f' stroke-dasharray="{0.5 * radius_m:.3f}"' if pin.state == "uncertain" else ""
    arrow = ""
    if place.heading_deg is not None:
        turn = math.radians(place.heading_deg)
        reach = _ARROW * radius_m
        tip = x + reach * math.sin(turn), y - reach * math.cos(turn)
        sides = ((x + radius_m * math.sin(turn + side), y - radius_m * math.cos(turn + side)) for side in (-0.7, 0.7))
        points = " ".join(f"{a:.3f},{b:.3f}" for a, b in (tip, *sides))
        arrow = f'<polygon points="{points}" fill="{colour}"/>'
    title = f"{photograph.number} {photograph.name or ''} {place.room}".strip()
    return (
        f'<g class="pin"><title>{xml_text(title)}</title>{arrow}'
        f'<circle cx="{x:.3f}" cy="{y:.3f}" r="{radius_m:.3f}" fill="{PAPER}" stroke="{colour}" '
        f'stroke-width="{0.3 * radius_m:.3f}"{dashes}/>'
        f'<text x="{x:.3f}" y="{y + 0.36 * radius_m:.3f}" font-size="{radius_m:.3f}" fill="{INK}" '
        f'text-anchor="middle">{photograph.number}</text></g>\n'
    )
