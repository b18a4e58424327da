"""Drawings beside that of an answer: cameras and paths on a plan, what an import read, and the room of features."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import OPENING_CLASSES, TWO_PI, column_azimuths
from lalaloc_core.draw.canvas import FOUND, INK, MUTED, ON_PAPER, document, path, words, xml_text
from lalaloc_core.draw.plan import Marker, draw_camera, extent_m, plan_svg
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.importers.common.import_report import Trace, TracePart
from lalaloc_core.localise.query import Query

_UNSURE = "#55606e"
# Drawing of a trace: size, and space for the legend and its lines (pixels).
_SIZE, _MARGIN, _LEGEND, _LINE = 1600.0, 20.0, 190.0, 22.0
# Colour of lines, fill, width (pixels) and meaning by part, in the order of drawing; Okabe and Ito's palette.
_STYLES: dict[TracePart, tuple[str, str, float, str]] = {
    "room": ("none", "#cfe8d5", 0.0, "room"),
    "no room": ("#cc79a7", "#f3d9e7", 1.0, "inside, but no room"),
    "wall": ("none", "#b9bfc7", 0.0, "wall"),
    "gap": ("none", "#f0e442", 0.0, "gap that was closed"),
    "other": ("#c3c8cf", "none", 0.8, "ignored"),
    "line": ("#8c939c", "none", 1.2, "line of no known kind"),
    "wall line": (INK, "none", 1.2, "line of a wall"),
    "door": ("#b5651d", "none", 1.6, "door"),
    "window": ("#2b7fc9", "none", 1.6, "window"),
    "passage": ("#009e73", "none", 1.6, "passage"),
}
# Drawing of a seen room: side, and space around and below it (pixels).
_SEEN_SIZE, _PAD, _FOOT = 800.0, 40.0, 150.0
# Runs of an opening that are narrower are noise.
_MIN_COLUMNS = 2


def draw_path(
    plan: FloorPlan, position_m: Float[np.ndarray, "n 2"], is_sure: Sequence[bool], heading_deg: float
) -> str:
    """Draw a path from its first position, a ring, to its last, the camera; positions that are not sure are grey."""
    extent = extent_m(plan)
    flipped = position_m * [1.0, -1.0]
    line = path([flipped], digits=3)
    dots = "".join(
        f'<circle cx="{x:.3f}" cy="{y:.3f}" r="{extent / 220:.4f}" fill="{FOUND if sure else _UNSURE}"/>'
        for (x, y), sure in zip(flipped.tolist(), is_sure, strict=True)
    )
    x, y = flipped[0]
    start = f'<circle cx="{x:.3f}" cy="{y:.3f}" r="{extent / 100:.4f}" fill="none" stroke="{INK}" '
    start += f'stroke-width="{extent / 500:.4f}"/>'
    over = f'<path d="{line}" fill="none" stroke="{FOUND}" stroke-width="{extent / 400:.4f}"/>{dots}{start}'
    last_x, last_y = position_m[-1]
    marker = Marker(x_m=float(last_x), y_m=float(last_y), heading_deg=heading_deg)
    return plan_svg(plan, marker, over=over)


def draw_places(plan: FloorPlan, places: Sequence[tuple[str, Marker]]) -> str:
    """Draw a plan with a camera, labelled with its text, for each place."""
    extent = extent_m(plan)
    size = extent / 60
    cameras = "".join(
        f"{draw_camera(marker, extent)}"
        f'<text x="{marker.x_m:.3f}" y="{size * 1.8 - marker.y_m:.3f}" font-size="{size:.3f}" fill="{INK}" '
        f'stroke="#fff" stroke-width="{size / 5:.4f}" paint-order="stroke">{xml_text(text)}</text>'
        for text, marker in places
    )
    return plan_svg(plan, over=cameras)


def trace_svg(trace: Trace, title: str) -> str:
    """Draw a trace with a legend of the parts that occur."""
    if not trace.shapes:
        return document(_SIZE, 100, title, [words(_MARGIN, 50, "Nothing was read from a drawing.", 18)])
    x0, y0, x1, y1 = shapely.total_bounds([shape for _, shape in trace.shapes])
    scale = (_SIZE - 2.0 * _MARGIN - _LEGEND) / max(x1 - x0, y1 - y0, 1e-3)
    height = max(scale * (y1 - y0), _LINE * len(_STYLES)) + 2.0 * _MARGIN
    origin = np.array([_MARGIN + _LEGEND - scale * x0, _MARGIN + scale * y1])
    parts, row = [], 0
    for part, (stroke, fill, width, meaning) in _STYLES.items():
        shapes = [shape for kind, shape in trace.shapes if kind == part]
        if not shapes:
            continue
        rings = [ring for shape in shapes for ring in _rings(shape)]
        d = path((ring * np.array([scale, -scale]) + origin for ring in rings), digits=1)
        style = f'stroke="{stroke}" fill="{fill}" stroke-width="{width:g}" fill-rule="evenodd"'
        parts.append(f'<path d="{d}" {style}/>')
        y = _MARGIN + _LINE * row
        parts.append(f'<rect x="{_MARGIN:g}" y="{y:g}" width="16" height="14" {style}/>')
        parts.append(words(_MARGIN + 24, y + 12, meaning, 13))
        row += 1
    return document(_SIZE, height, title, parts)


def _rings(shape: shapely.Geometry) -> list[np.ndarray]:
    """Return the lines of a geometry, and the outlines of its areas."""
    found = []
    for part in shapely.get_parts(shape):
        if isinstance(part, shapely.Polygon):
            found += [np.asarray(ring.coords) for ring in (part.exterior, *part.interiors)]
        elif isinstance(part, shapely.LineString):
            found.append(np.asarray(part.coords))
        elif isinstance(part, shapely.MultiPolygon | shapely.MultiLineString | shapely.GeometryCollection):
            found += _rings(part)
    return found


@dataclass(frozen=True, eq=False)
class SeenRoom:
    """Room around a camera, as predicted from one photograph; azimuths are relative to the photograph's centre.

    Attributes:
        azimuth: (w,) azimuths (radians).
        distance_m: (w,) most probable distance of the wall.
        seen: (w,) azimuths that the photograph shows.
        kind: (w,) most probable opening class, as in `conventions.OPENING_CLASSES`.
        types: probabilities of the room types, the most probable first.
    """

    azimuth: Float[np.ndarray, "w"]
    distance_m: Float[np.ndarray, "w"]
    seen: Bool[np.ndarray, "w"]
    kind: Int[np.ndarray, "w"]
    ceiling_m: float
    types: dict[str, float]

    def document(self) -> dict[str, Any]:
        """Return the room as JSON, angles in degrees."""
        return {
            "room_types": {name: round(share, 3) for name, share in self.types.items()},
            "ceiling_height_m": round(self.ceiling_m, 2),
            "walls": [
                {"azimuth_deg": round(math.degrees(azimuth), 2), "distance_m": round(distance_m, 2)}
                for azimuth, distance_m in zip(
                    self.azimuth[self.seen].tolist(), self.distance_m[self.seen].tolist(), strict=True
                )
            ],
            "openings": [
                {"kind": OPENING_CLASSES[self.kind[run[0]]], "from_deg": ends[0], "to_deg": ends[1]}
                for run in self.openings
                for ends in [np.degrees(self.azimuth[[run[0], run[-1]]]).round(2).tolist()]
            ],
        }

    @property
    def openings(self) -> list[Int[np.ndarray, "n"]]:
        """Columns of each opening, from left to right."""
        codes = np.where(self.seen, self.kind, 0)
        runs = np.split(np.arange(len(codes)), np.flatnonzero(np.diff(codes)) + 1)
        return [run for run in runs if codes[run[0]] and len(run) >= _MIN_COLUMNS]


def seen_room(query: Query) -> SeenRoom:
    """Return the room that was predicted from a photograph with an unknown heading."""
    profile, openings, ceiling, types = query.profile, query.openings, query.ceiling, query.room_type
    if query.objects is not None:
        types = query.objects.room_type
    assert profile is not None
    assert openings is not None
    assert ceiling is not None
    assert types is not None
    return SeenRoom(
        azimuth=column_azimuths(profile.log_m.shape[1]),
        distance_m=np.exp(profile.log_m[0]).astype(np.float64),
        seen=profile.seen[0],
        kind=openings.log_probability[0].argmax(axis=1),
        ceiling_m=query.camera_height.height_m + math.exp(ceiling.log_m),
        types=types.shares(),
    )


def draw_seen_room(room: SeenRoom) -> str:
    """Draw all that features reveal: the room from above, the photograph's centre at the top, as an SVG document."""
    scale = (0.5 * _SEEN_SIZE - _PAD) / float(np.quantile(room.distance_m[room.seen], 0.98))
    half_column, centre = 0.5 * TWO_PI / len(room.azimuth), 0.5 * _SEEN_SIZE
    parts = []
    for index in np.flatnonzero(room.seen):
        ends = room.azimuth[index] + np.array([-half_column, half_column])
        points = np.stack([np.sin(ends), -np.cos(ends)], axis=1) * room.distance_m[index] * scale + centre
        kind = OPENING_CLASSES[room.kind[index]]
        parts.append(f'<path d="{path([points])}" fill="none" stroke="{ON_PAPER[kind]}" stroke-width="6"/>')
    parts.append(f'<path d="M{centre} {centre - 16}l10 28h-20z" fill="{INK}"/>')
    types = ", ".join(f"{name} {100 * share:.0f} %" for name, share in room.types.items())
    parts.append(words(_PAD, _SEEN_SIZE + 20, f"Room: {types}", 20))
    parts.append(words(_PAD, _SEEN_SIZE + 52, f"Ceiling: {room.ceiling_m:.2f} m above the floor", 20))
    for number, kind in enumerate(OPENING_CLASSES):
        x = _PAD + 170 * number
        parts.append(f'<path d="M{x} {_SEEN_SIZE + 84}h30" stroke="{ON_PAPER[kind]}" stroke-width="6"/>')
        parts.append(words(x + 40, _SEEN_SIZE + 90, kind, 18, fill=MUTED))
    parts.append(f'<path d="M{_PAD} {_SEEN_SIZE + 122}h{scale:.1f}" stroke="{INK}" stroke-width="2"/>')
    parts.append(words(_PAD + scale + 10, _SEEN_SIZE + 128, "1 m", 16, fill=MUTED))
    return document(_SEEN_SIZE, _SEEN_SIZE + _FOOT, "Room by the features of a photograph", parts)
