"""A floor plan as an SVG drawing, y up as in the plan frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float

from lalaloc_core.floorplan import FloorPlan, OpeningFace, Room
from lalaloc_core.floorplan.inmost import inmost_place

_MARGIN_M = 0.5
_FILLS = ("#eef4fb", "#f7f1e6", "#eef7ee", "#f8eef4", "#f2f0fa", "#f4f6ea")
_OPENING_COLOURS = {"door": "#b5651d", "window": "#3d9be9", "passage": "#ffffff"}
# A scale bar of a round length, about this share of the drawing's width.
_BAR_SHARE = 0.2
# 95 % of a normal distribution in the plane lie within so many standard deviations: the root of -2 log 0.05.
_ELLIPSE_STDS = 2.4477
# Of the drawing's size: room for the scale bar's label; the camera's radius; and how many radii its wedge reaches.
_LABEL_SHARE, _CAMERAS_PER_EXTENT, _CAMERA_REACH = 0.04, 80.0, 5.0


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
    x_min, y_min, _, _ = plan.bounds_m
    plan_width, plan_height = _size_m(plan)
    extent = max(plan_width, plan_height)
    left, top, width, height = _view_box(plan, marker)
    scale = 1000.0 / max(width, height)
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width * scale:.0f}" height="{height * scale:.0f}" '
        f'viewBox="{left:.3f} {top:.3f} {width:.3f} {height:.3f}" '
        'font-family="sans-serif" text-anchor="middle">',
        f"<title>{_text(plan.name)}</title>",
        draw_rooms(plan) if rooms is None else rooms,
        _scale_bar(x_min, y_min, plan_width, extent),
    ]
    if marker is not None:
        lines.append(_camera(marker, extent))
    lines.append("</svg>\n")
    return "\n".join(lines)


def draw_rooms(plan: FloorPlan) -> str:
    """Outlines, openings, names and areas of all rooms: what takes its time, the same wherever a camera stands."""
    extent = max(_size_m(plan))
    lines = [
        '<g stroke="#333" stroke-linejoin="round">',
        *(_outline(room, _FILLS[index % len(_FILLS)], extent) for index, room in enumerate(plan.rooms)),
        "</g>",
        '<g class="openings">',
        *(_opening(plan, face, extent) for face in plan.opening_faces),
        "</g>",
        '<g fill="#222">',
        *(_label(room, extent) for room in plan.rooms),
        "</g>",
    ]
    return "\n".join(lines)


def _size_m(plan: FloorPlan) -> tuple[float, float]:
    """Width and height of the drawing, margins included."""
    x_min, y_min, x_max, y_max = plan.bounds_m
    width, height = x_max - x_min + 2 * _MARGIN_M, y_max - y_min + 2 * _MARGIN_M
    # Below the plan there is the scale bar with its label, which grows with the plan.
    return width, height + max(_MARGIN_M, _LABEL_SHARE * max(width, height))


def _view_box(plan: FloorPlan, marker: Marker | None) -> tuple[float, float, float, float]:
    """Left, top, width and height of what is seen, y pointing down."""
    width, height = _size_m(plan)
    left, top = plan.bounds_m[0] - _MARGIN_M, -plan.bounds_m[3] - _MARGIN_M
    right, bottom = left + width, top + height
    if marker is not None:
        reach = max(width, height) / _CAMERAS_PER_EXTENT * _CAMERA_REACH
        left, right = min(left, marker.x_m - reach), max(right, marker.x_m + reach)
        top, bottom = min(top, -marker.y_m - reach), max(bottom, -marker.y_m + reach)
    return left, top, right - left, bottom - top


def _outline(room: Room, fill: str, extent_m: float) -> str:
    """The floor, with holes left white, and free-standing walls."""
    width = f'stroke-width="{extent_m / 250:.4f}"'
    rings = [(room.polygon_m, fill), *((hole, "#fff") for hole in room.holes_m)]
    lines = [f'<polygon points="{_points(ring)}" fill="{colour}" {width}/>' for ring, colour in rings]
    if len(room.inner_walls_m):
        path = "".join(f"M{x0:.3f} {-y0:.3f}L{x1:.3f} {-y1:.3f}" for x0, y0, x1, y1 in room.inner_walls_m)
        lines.append(f'<path class="walls" d="{path}" {width}/>')
    return "\n".join(lines)


def _opening(plan: FloorPlan, face: OpeningFace, extent_m: float) -> str:
    """A piece of wall in the colour of what is in it, and once for both rooms the gap through the wall's thickness."""
    own = _piece_m(plan.rooms[face.room], face.wall, face.start, face.end)
    kind = plan.openings[face.opening].kind
    parts = []
    if face.behind > face.room:
        beyond = _piece_m(plan.rooms[face.behind], face.exit_wall, face.exit_start, face.exit_end)
        # Walls that face each other run in opposite directions.
        quad = np.concatenate([own, beyond])
        parts.append(f'<polygon points="{_points(quad)}" fill="{_OPENING_COLOURS[kind]}" fill-opacity="0.35"/>')
    (x0, y0), (x1, y1) = own.tolist()
    parts.append(
        f'<path class="{kind}" d="M{x0:.3f} {-y0:.3f}L{x1:.3f} {-y1:.3f}" stroke="{_OPENING_COLOURS[kind]}" '
        f'stroke-width="{extent_m / 160:.4f}"/>'
    )
    return "".join(parts)


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
        f'<text x="{x:.3f}" y="{-y:.3f}" font-size="{size:.4f}">{_text(room.name)}'
        f'<tspan x="{x:.3f}" dy="1.2em" font-size="{0.8 * size:.4f}" fill="#666">{room.area_m2:.1f} m²</tspan></text>'
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


def _text(name: str) -> str:
    """A name as XML text; the two characters that XML cannot hold, and plans may, are replaced."""
    return escape(name.replace("\ufffe", "\ufffd").replace("\uffff", "\ufffd"))


def _camera(marker: Marker, extent_m: float) -> str:
    """A dot, a wedge that opens towards the heading, and the ellipse that holds 95 % of its covariance."""
    radius = extent_m / _CAMERAS_PER_EXTENT
    wedge = ""
    if marker.heading_deg is not None:
        # SVG turns clockwise, as azimuths do; the wedge is drawn looking up, along the plan's +y.
        wedge = (
            f'<path d="M0 0L{-2 * radius:.4f} {-4 * radius:.4f}L{2 * radius:.4f} {-4 * radius:.4f}Z" '
            f'transform="rotate({marker.heading_deg:.3f})" fill-opacity="0.35"/>'
        )
    return (
        f'<g class="camera" transform="translate({marker.x_m:.4f} {-marker.y_m:.4f})" fill="#c0392b">'
        f'{_ellipse(marker.covariance_m2, extent_m)}{wedge}<circle r="{radius:.4f}"/></g>'
    )


def _ellipse(covariance_m2: tuple[float, float, float] | None, extent_m: float) -> str:
    if covariance_m2 is None:
        return ""
    xx, xy, yy = covariance_m2
    variance, axes = np.linalg.eigh([[xx, xy], [xy, yy]])
    minor_m, major_m = _ELLIPSE_STDS * np.sqrt(np.maximum(variance, 0.0))
    # The y axis of the drawing points down, so angles from +x turn the other way.
    angle_deg = -math.degrees(math.atan2(axes[1, 1], axes[0, 1]))
    return (
        f'<ellipse rx="{major_m:.4f}" ry="{minor_m:.4f}" transform="rotate({angle_deg:.3f})" fill-opacity="0.2" '
        f'stroke="#c0392b" stroke-width="{extent_m / 500:.4f}"/>'
    )
