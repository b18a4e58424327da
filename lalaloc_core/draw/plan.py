"""A floor plan as an SVG drawing, y up as in the plan frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lalaloc_core.draw.canvas import FONT_FAMILY, FOUND, INK, Box, xml_text
from lalaloc_core.floorplan import FloorPlan, OpeningFace, Room
from lalaloc_core.floorplan.inmost import inmost_place

_MARGIN_M = 0.5
_FILLS = ("#eef4fb", "#f7f1e6", "#eef7ee", "#f8eef4", "#f2f0fa", "#f4f6ea")
# Of the line on the wall, and of the gap through it.
_OPENING_COLOURS = {"door": "#b5651d", "window": "#2b7fc9", "passage": "#8c939c"}
_GAP_COLOURS = {"door": "#f6dfc6", "window": "#cde6fb", "passage": "#ffffff"}
# Walls are drawn this far outwards from the floors that they enclose: those between rooms meet.
_WALL_M = 0.12
# Where a heat map goes in what `draw_rooms` makes.
_HEAT_PLACE = "<!--heat-->"
# A scale bar of a round length, about this share of the drawing's width.
_BAR_SHARE = 0.2
# 95 % of a normal distribution in the plane lie within so many standard deviations: the root of -2 log 0.05.
ELLIPSE_STDS = 2.4477
# Of the drawing's size: room for the scale bar's label; the camera's radius; and how many radii its wedge reaches.
_LABEL_SHARE, _CAMERAS_PER_EXTENT, _CAMERA_REACH = 0.04, 70.0, 5.5


@dataclass(frozen=True, kw_only=True)
class Marker:
    """A camera to draw: position (m) and, when known, heading (degrees) and covariance (xx, xy, yy; m²)."""

    x_m: float
    y_m: float
    heading_deg: float | None = None
    covariance_m2: tuple[float, float, float] | None = None


def plan_svg(plan: FloorPlan, marker: Marker | None = None, *, rooms: str | None = None) -> str:
    """The plan with the names and areas of its rooms and a scale bar; one SVG unit is one metre.

    The view box is the plan's bounds with a margin, and the camera; its y axis points down: plan point (x, y) is drawn
    at (x, -y).

    Args:
        rooms: what `draw_rooms` made of it before.
    """
    left, top, width, height = _view_box(plan, [] if marker is None else [(marker.x_m, marker.y_m)])
    scale = 1000.0 / max(width, height)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width * scale:.0f}" height="{height * scale:.0f}" '
        f'viewBox="{left:.3f} {top:.3f} {width:.3f} {height:.3f}" font-family="{FONT_FAMILY}" text-anchor="middle">',
        f"<title>{xml_text(plan.name)}</title>",
        _rooms_and_scale(plan, rooms, ""),
    ]
    if marker is not None:
        lines.append(draw_camera(marker, max(_size_m(plan))))
    lines.append("</svg>\n")
    return "\n".join(lines)


def plan_part(
    plan: FloorPlan,
    box: Box,
    over: str,
    *,
    seen_m: Sequence[tuple[float, float]] = (),
    heat: str = "",
    rooms: str | None = None,
) -> str:
    """The plan as a part of a larger drawing, as large as fits into a box (x, y, width, height), in its middle.

    Args:
        over: what is drawn over it, in metres, y pointing down.
        seen_m: places that shall be seen even where they lie outside of the plan.
        heat: a heat map, drawn on the floors.
        rooms: what `draw_rooms` made of it before.
    """
    x, y, box_width, box_height = box
    left, top, width, height = _view_box(plan, seen_m)
    scale = min(box_width / width, box_height / height)
    x, y = x + 0.5 * (box_width - scale * width), y + 0.5 * (box_height - scale * height)
    return (
        f'<g class="plan" transform="translate({x:.2f} {y:.2f}) scale({scale:.5f}) translate({-left:.4f} {-top:.4f})" '
        f'text-anchor="middle">{_rooms_and_scale(plan, rooms, heat)}{over}</g>'
    )


def shape_of(plan: FloorPlan, seen_m: Sequence[tuple[float, float]] = ()) -> float:
    """How many times as wide as high a plan is drawn."""
    _, _, width, height = _view_box(plan, seen_m)
    return width / height


def extent_m(plan: FloorPlan) -> float:
    """The longer side of a plan's drawing, which marks are measured by."""
    return max(_size_m(plan))


def floor_path(plan: FloorPlan) -> str:
    """All rooms and their holes as the `d` of an SVG path, in metres, y pointing down."""
    rings = [ring for room in plan.rooms for ring in (room.polygon_m, *room.holes_m)]
    return "".join("M" + "L".join(f"{x:.3f} {-y:.3f}" for x, y in ring) + "Z" for ring in rings)


def draw_rooms(plan: FloorPlan) -> str:
    """Outlines, openings, names and areas of all rooms: what takes its time, the same wherever a camera stands."""
    extent = max(_size_m(plan))
    wall = 2.0 * max(_WALL_M, extent / 400.0)
    lines = [
        f'<path class="solid" d="{floor_path(plan)}" fill="none" stroke="{INK}" stroke-width="{wall:.4f}" '
        'stroke-linejoin="miter"/>',
        f'<g stroke="{INK}" stroke-linejoin="round">',
        *(_outline(room, _FILLS[index % len(_FILLS)], extent) for index, room in enumerate(plan.rooms)),
        "</g>",
        _HEAT_PLACE,
        '<g class="openings">',
        *(_opening(plan, face, extent) for face in plan.opening_faces),
        "</g>",
        f'<g fill="{INK}" stroke="#fff" stroke-linejoin="round" paint-order="stroke">',
        *(_label(room, extent) for room in plan.rooms),
        "</g>",
    ]
    return "\n".join(lines)


def draw_camera(marker: Marker, extent: float, colour: str = FOUND) -> str:
    """A dot, a wedge that opens towards the heading, and the ellipse that holds 95 % of its covariance."""
    radius = extent / _CAMERAS_PER_EXTENT
    wedge = ""
    if marker.heading_deg is not None:
        # SVG turns clockwise, as azimuths do; the wedge is drawn looking up, along the plan's +y.
        side, reach = 2.2 * radius, 4.6 * radius
        wedge = (
            f'<path d="M0 0L{-side:.4f} {-reach:.4f}Q0 {-1.17 * reach:.4f} {side:.4f} {-reach:.4f}Z" '
            f'transform="rotate({marker.heading_deg:.3f})" fill-opacity="0.6" stroke="#fff" '
            f'stroke-width="{0.1 * radius:.4f}"/>'
        )
    return (
        f'<g class="camera" transform="translate({marker.x_m:.4f} {-marker.y_m:.4f})" fill="{colour}">'
        f"{_ellipse(marker.covariance_m2, extent, colour)}{wedge}"
        f'<circle r="{radius:.4f}" stroke="#fff" stroke-width="{0.25 * radius:.4f}"/></g>'
    )


def _rooms_and_scale(plan: FloorPlan, rooms: str | None, heat: str) -> str:
    x_min, y_min, _, _ = plan.bounds_m
    plan_width, plan_height = _size_m(plan)
    drawn = (draw_rooms(plan) if rooms is None else rooms).replace(_HEAT_PLACE, heat)
    return drawn + _scale_bar(x_min, y_min, plan_width, max(plan_width, plan_height))


def _size_m(plan: FloorPlan) -> tuple[float, float]:
    """Width and height of the drawing, margins included."""
    x_min, y_min, x_max, y_max = plan.bounds_m
    width, height = x_max - x_min + 2 * _MARGIN_M, y_max - y_min + 2 * _MARGIN_M
    # Below the plan there is the scale bar with its label, which grows with the plan.
    return width, height + max(_MARGIN_M, _LABEL_SHARE * max(width, height))


def _view_box(plan: FloorPlan, seen_m: Sequence[tuple[float, float]]) -> tuple[float, float, float, float]:
    """Left, top, width and height of what is seen, y pointing down."""
    width, height = _size_m(plan)
    left, top = plan.bounds_m[0] - _MARGIN_M, -plan.bounds_m[3] - _MARGIN_M
    right, bottom = left + width, top + height
    reach = max(width, height) / _CAMERAS_PER_EXTENT * _CAMERA_REACH
    for x_m, y_m in seen_m:
        left, right = min(left, x_m - reach), max(right, x_m + reach)
        top, bottom = min(top, -y_m - reach), max(bottom, -y_m + reach)
    return left, top, right - left, bottom - top


def _outline(room: Room, fill: str, extent_m: float) -> str:
    """The floor, with holes left white, and free-standing walls."""
    # Half of an outline lies on the floor, which would look smaller by so much.
    width = f'stroke-width="{extent_m / 500:.4f}"'
    rings = [(room.polygon_m, fill), *((hole, "#fff") for hole in room.holes_m)]
    lines = [f'<polygon points="{_points(ring)}" fill="{colour}" {width}/>' for ring, colour in rings]
    if len(room.inner_walls_m):
        path = "".join(f"M{x0:.3f} {-y0:.3f}L{x1:.3f} {-y1:.3f}" for x0, y0, x1, y1 in room.inner_walls_m)
        lines.append(f'<path class="walls" d="{path}" stroke-width="{extent_m / 250:.4f}"/>')
    return "\n".join(lines)


def _opening(plan: FloorPlan, face: OpeningFace, extent_m: float) -> str:
    """A piece of wall in the colour of what is in it, and once for both rooms the gap through the wall's thickness."""
    own = _piece_m(plan.rooms[face.room], face.wall, face.start, face.end)
    kind = plan.openings[face.opening].kind
    parts = []
    sides = [own]
    if face.behind < 0 or face.behind > face.room:
        # Walls that face each other run in opposite directions.
        beyond = _beyond_m(plan, face, own)
        parts.append(f'<polygon points="{_points(np.concatenate([own, beyond]))}" fill="{_GAP_COLOURS[kind]}"/>')
        # The room behind draws its own side.
        sides += [beyond] if face.behind < 0 else []
    ends = (side.ravel().tolist() for side in sides)
    path = "".join(f"M{x0:.3f} {-y0:.3f}L{x1:.3f} {-y1:.3f}" for x0, y0, x1, y1 in ends)
    stroke = f'd="{path}" stroke-width="{extent_m / 220:.4f}"'
    dashes = ""
    if kind == "passage":
        # Nothing stands there: between the dashes there is no wall either.
        parts.append(f'<path {stroke} stroke="{_GAP_COLOURS[kind]}"/>')
        dashes = f' stroke-dasharray="{extent_m / 75:.4f}"'
    parts.append(f'<path class="{kind}" {stroke} stroke="{_OPENING_COLOURS[kind]}"{dashes}/>')
    return "".join(parts)


def _beyond_m(plan: FloorPlan, face: OpeningFace, own_m: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
    """The other side of the wall: where the room behind has its own, else a wall's thickness outwards."""
    if face.behind >= 0:
        return _piece_m(plan.rooms[face.behind], face.exit_wall, face.exit_start, face.exit_end)
    (along_x, along_y) = own_m[1] - own_m[0]
    outwards = np.array([along_y, -along_x]) / max(math.hypot(along_x, along_y), 1e-9)
    return own_m[::-1] + _WALL_M * outwards


def _piece_m(room: Room, wall: int, start: float, end: float) -> Float[np.ndarray, "2 2"]:
    ends = room.walls_m[wall].reshape(2, 2)
    return ends[0] + np.array([[start], [end]]) * (ends[1] - ends[0])


def _points(ring_m: Float[np.ndarray, "n 2"]) -> str:
    return " ".join(f"{x:.3f},{-y:.3f}" for x, y in ring_m)


def _label(room: Room, extent_m: float) -> str:
    """Name and area at the middle of a large circle in the room, small enough to fit."""
    (x, y), radius_m = inmost_place(room.shape)
    size = min(extent_m / 40.0, 2.6 * radius_m / max(len(room.name), 6))
    return (
        f'<text x="{x:.3f}" y="{-y:.3f}" font-size="{size:.4f}" stroke-width="{0.18 * size:.4f}">{xml_text(room.name)}'
        f'<tspan x="{x:.3f}" dy="1.2em" font-size="{0.8 * size:.4f}" fill="#444">{room.area_m2:.1f} m²</tspan></text>'
    )


def _scale_bar(x_min: float, y_min: float, width_m: float, extent_m: float) -> str:
    length = 10.0 ** math.floor(math.log10(_BAR_SHARE * width_m))
    length *= max(factor for factor in (1, 2, 5) if factor == 1 or factor * length <= _BAR_SHARE * width_m)
    y = -y_min + _MARGIN_M
    size = min(extent_m / 50.0, width_m / 8.0)
    return (
        f'<g class="scale"><path d="M{x_min:.3f} {y:.3f}h{length:g}" stroke="#333" '
        f'stroke-width="{extent_m / 200:.4f}"/>'
        f'<text x="{x_min:.3f}" y="{y + extent_m / 40:.3f}" font-size="{size:.4f}" text-anchor="start">{length:g} m'
        "</text></g>"
    )


def _ellipse(covariance_m2: tuple[float, float, float] | None, extent: float, colour: str) -> str:
    if covariance_m2 is None:
        return ""
    xx, xy, yy = covariance_m2
    variance, axes = np.linalg.eigh([[xx, xy], [xy, yy]])
    minor_m, major_m = ELLIPSE_STDS * np.sqrt(np.maximum(variance, 0.0))
    # The y axis of the drawing points down, so angles from +x turn the other way.
    angle_deg = -math.degrees(math.atan2(axes[1, 1], axes[0, 1]))
    return (
        f'<ellipse rx="{major_m:.4f}" ry="{minor_m:.4f}" transform="rotate({angle_deg:.3f})" fill-opacity="0.2" '
        f'stroke="{colour}" stroke-width="{extent / 500:.4f}"/>'
    )
