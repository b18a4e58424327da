"""Floor plans as SVG drawings, y up as in the plan frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.draw.canvas import FONT_FAMILY, FOUND, INK, ON_PAPER, PAPER, Box, xml_text
from lalaloc_core.floorplan import FloorPlan, OpeningFace, Room
from lalaloc_core.floorplan.rooms import interior_point

# (x_min, y_min, x_max, y_max) of a plan.
Bounds = tuple[float, float, float, float]

_MARGIN_M = 0.5
_FILLS = ("#eef4fb", "#f7f1e6", "#eef7ee", "#f8eef4", "#f2f0fa", "#f4f6ea")
# Colours of the gap through the wall.
_GAP_COLOURS = {"door": "#f6dfc6", "window": "#cde6fb", "passage": "#ffffff"}
# Areas inside walls that became no room: reddish purple of Okabe and Ito's palette.
_NO_ROOM = "#cc79a7"
# Thickness of drawn walls outside each floor; walls between rooms meet.
_WALL_M = 0.12
# Placeholder for a heat map in the result of `draw_rooms`.
HEAT_PLACE = "<!--heat-->"
# Largest length of the scale bar, as a share of the drawing's width.
_BAR_SHARE = 0.2
# Largest width of the legend of openings, as a share of the drawing's.
_KEY_SHARE = 0.6
# Radius, in standard deviations, that holds 95 % of a 2-D normal distribution: sqrt(-2 log 0.05).
ELLIPSE_STDS = 2.4477
# Share of the drawing for the scale bar's label, drawing size per camera radius, and reach of the wedge in radii.
_LABEL_SHARE, _CAMERAS_PER_EXTENT, _CAMERA_REACH = 0.04, 70.0, 5.5


@dataclass(frozen=True, kw_only=True)
class Marker:
    """A camera to draw: position (m) and, when known, heading (degrees) and covariance (xx, xy, yy; m²)."""

    x_m: float
    y_m: float
    heading_deg: float | None = None
    covariance_m2: tuple[float, float, float] | None = None


def plan_svg(
    plan: FloorPlan, marker: Marker | None = None, *, no_room: Sequence[Sequence[Sequence[float]]] = (), over: str = ""
) -> str:
    """Draw the plan with names and areas of its rooms and a scale bar; one SVG unit is one metre.

    The view box is the plan's bounds with a margin, extended to the camera. Its y axis points down: plan point (x, y)
    is drawn at (x, -y), as in `over`, SVG that is drawn over the rooms. For `no_room` see `draw_rooms`.
    """
    head, tail = svg_around(plan.name, bounds_with(plan.bounds_m, no_room), marker)
    return head + draw_rooms(plan, no_room).replace(HEAT_PLACE, "") + over + tail


def bounds_with(bounds_m: Bounds, no_room: Sequence[Sequence[Sequence[float]]]) -> Bounds:
    """Return the bounds of a plan and of the areas that became no room."""
    x, y = zip(*(point for outline in no_room for point in outline), strict=True) if no_room else ((), ())
    x_min, y_min, x_max, y_max = bounds_m
    return min((x_min, *x)), min((y_min, *y)), max((x_max, *x)), max((y_max, *y))


def svg_around(name: str, bounds_m: Bounds, marker: Marker | None = None) -> tuple[str, str]:
    """Return the parts of `plan_svg` before and after the rooms, for the name and the bounds of a plan."""
    left, top, width, height = _view_box(bounds_m, [] if marker is None else [(marker.x_m, marker.y_m)])
    scale = 1000.0 / max(width, height)
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width * scale:.0f}" height="{height * scale:.0f}" '
        f'viewBox="{left:.3f} {top:.3f} {width:.3f} {height:.3f}" font-family="{FONT_FAMILY}" text-anchor="middle">\n'
        f"<title>{xml_text(name)}</title>\n"
        # Without soft edges, as the size in pixels is rounded.
        f'<rect x="{left:.3f}" y="{top:.3f}" width="{width:.3f}" height="{height:.3f}" fill="{PAPER}" '
        'shape-rendering="crispEdges"/>\n'
    )
    camera = "" if marker is None else f"\n{draw_camera(marker, max(_size_m(bounds_m)))}"
    return head, f"{_scale_bar(bounds_m)}{camera}\n</svg>\n"


def plan_part(
    plan: FloorPlan,
    box: Box,
    over: str,
    *,
    seen_m: Sequence[tuple[float, float]] = (),
    heat: str = "",
    rooms: str | None = None,
) -> str:
    """Draw the plan as a part of a larger drawing, fitted and centred in a box.

    `box` is x, y, width and height. `over` is SVG drawn over the plan, in metres, y pointing down; `heat` is drawn on
    the floors. Positions `seen_m` are included even outside the plan. `rooms` is a cached result of `draw_rooms` for
    the plan.
    """
    x, y, box_width, box_height = box
    left, top, width, height = _view_box(plan.bounds_m, seen_m)
    scale = min(box_width / width, box_height / height)
    drawn = (draw_rooms(plan) if rooms is None else rooms).replace(HEAT_PLACE, heat)
    x, y = x + 0.5 * (box_width - scale * width), y + 0.5 * (box_height - scale * height)
    return (
        f'<g class="plan" transform="translate({x:.2f} {y:.2f}) scale({scale:.5f}) translate({-left:.4f} {-top:.4f})" '
        f'text-anchor="middle">{drawn}{_scale_bar(plan.bounds_m)}{over}</g>'
    )


def shape_of(plan: FloorPlan, seen_m: Sequence[tuple[float, float]] = ()) -> float:
    """Return the aspect ratio (width / height) of a plan's drawing."""
    _, _, width, height = _view_box(plan.bounds_m, seen_m)
    return width / height


def extent_m(plan: FloorPlan) -> float:
    """Return the longer side (m) of a plan's drawing, which scales marks."""
    return max(_size_m(plan.bounds_m))


def floor_path(plan: FloorPlan) -> str:
    """Return all rooms and their holes as the `d` of an SVG path, in metres, y pointing down."""
    rings = [ring for room in plan.rooms for ring in (room.polygon_m, *room.holes_m)]
    return "".join("M" + "L".join(f"{x:.3f} {-y:.3f}" for x, y in ring) + "Z" for ring in rings)


def draw_rooms(plan: FloorPlan, no_room: Sequence[Sequence[Sequence[float]]] = ()) -> str:
    """Draw outlines, openings, names, areas and the legend of openings: all that is slow and independent of cameras.

    `no_room` has outlines (m) of areas inside walls that became no room; they are marked.
    """
    bounds_m = bounds_with(plan.bounds_m, no_room)
    extent = max(_size_m(bounds_m))
    wall = 2.0 * max(_WALL_M, extent / 400.0)
    lines = [
        f'<path class="solid" d="{floor_path(plan)}" fill="none" stroke="{INK}" stroke-width="{wall:.4f}" '
        'stroke-linejoin="miter"/>',
        f'<g stroke="{INK}" stroke-linejoin="round">',
        *(_outline(room, _FILLS[index % len(_FILLS)], extent) for index, room in enumerate(plan.rooms)),
        "</g>",
        HEAT_PLACE,
        '<g class="openings">',
        *(_opening(plan, face, extent) for face in plan.opening_faces),
        "</g>",
        f'<g fill="{INK}" stroke="#fff" stroke-linejoin="round" paint-order="stroke">',
        *(_label(room, extent) for room in plan.rooms),
        "</g>",
        *(_mark_no_room(np.array(outline), extent) for outline in no_room),
        _key(plan, bounds_m),
    ]
    return "\n".join(lines)


def draw_camera(marker: Marker, extent: float) -> str:
    """Draw a dot, a wedge towards the heading, and the 95 % ellipse of the covariance."""
    radius = extent / _CAMERAS_PER_EXTENT
    wedge = ""
    if marker.heading_deg is not None:
        # SVG rotates clockwise, like azimuths; the unrotated wedge points up, along the plan's +y.
        side, reach = 2.2 * radius, 4.6 * radius
        wedge = (
            f'<path d="M0 0L{-side:.4f} {-reach:.4f}Q0 {-1.17 * reach:.4f} {side:.4f} {-reach:.4f}Z" '
            f'transform="rotate({marker.heading_deg:.3f})" fill-opacity="0.6" stroke="#fff" '
            f'stroke-width="{0.1 * radius:.4f}"/>'
        )
    return (
        f'<g class="camera" transform="translate({marker.x_m:.4f} {-marker.y_m:.4f})" fill="{FOUND}">'
        f"{_ellipse(marker.covariance_m2, extent)}{wedge}"
        f'<circle r="{radius:.4f}" stroke="#fff" stroke-width="{0.25 * radius:.4f}"/></g>'
    )


def _size_m(bounds_m: Bounds) -> tuple[float, float]:
    """Return width and height of the drawing, margins included."""
    x_min, y_min, x_max, y_max = bounds_m
    width, height = x_max - x_min + 2 * _MARGIN_M, y_max - y_min + 2 * _MARGIN_M
    # The scale bar with its label is below the plan and grows with it.
    return width, height + max(_MARGIN_M, _LABEL_SHARE * max(width, height))


def _view_box(bounds_m: Bounds, seen_m: Sequence[tuple[float, float]]) -> tuple[float, float, float, float]:
    """Return left, top, width and height of the view box, y pointing down."""
    width, height = _size_m(bounds_m)
    left, top = bounds_m[0] - _MARGIN_M, -bounds_m[3] - _MARGIN_M
    right, bottom = left + width, top + height
    reach = max(width, height) / _CAMERAS_PER_EXTENT * _CAMERA_REACH
    for x_m, y_m in seen_m:
        left, right = min(left, x_m - reach), max(right, x_m + reach)
        top, bottom = min(top, -y_m - reach), max(bottom, -y_m + reach)
    return left, top, right - left, bottom - top


def _outline(room: Room, fill: str, extent_m: float) -> str:
    """Draw the floor, with white holes, and free-standing walls."""
    # Thin: half of an outline covers the floor.
    width = f'stroke-width="{extent_m / 500:.4f}"'
    rings = [(room.polygon_m, fill), *((hole, "#fff") for hole in room.holes_m)]
    lines = [f'<polygon points="{_points(ring)}" fill="{colour}" {width}/>' for ring, colour in rings]
    if len(room.inner_walls_m):
        path = "".join(f"M{x0:.3f} {-y0:.3f}L{x1:.3f} {-y1:.3f}" for x0, y0, x1, y1 in room.inner_walls_m)
        lines.append(f'<path class="walls" d="{path}" stroke-width="{extent_m / 250:.4f}"/>')
    return "\n".join(lines)


def _opening(plan: FloorPlan, face: OpeningFace, extent_m: float) -> str:
    """Draw an opening on its wall and, once for both rooms, the gap through the wall's thickness."""
    own = plan.rooms[face.room].wall_part(face.wall, face.start, face.end)
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
        # A passage has no leaf: the gap shows between the dashes.
        parts.append(f'<path {stroke} stroke="{_GAP_COLOURS[kind]}"/>')
        dashes = f' stroke-dasharray="{extent_m / 75:.4f}"'
    parts.append(f'<path class="{kind}" {stroke} stroke="{ON_PAPER[kind]}"{dashes}/>')
    return "".join(parts)


def _beyond_m(plan: FloorPlan, face: OpeningFace, own_m: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
    """Return the opening on the other side of the wall: that of the room behind, or a wall's thickness outwards."""
    if face.behind >= 0:
        return plan.rooms[face.behind].wall_part(face.exit_wall, face.exit_start, face.exit_end)
    (along_x, along_y) = own_m[1] - own_m[0]
    outwards = np.array([along_y, -along_x]) / max(math.hypot(along_x, along_y), 1e-9)
    return own_m[::-1] + _WALL_M * outwards


def _mark_no_room(outline_m: Float[np.ndarray, "n 2"], extent_m: float) -> str:
    x, y = interior_point(shapely.Polygon(outline_m).buffer(0))[0]
    size = extent_m / 50.0
    return (
        f'<g class="no-room"><polygon points="{_points(outline_m)}" fill="{_NO_ROOM}" fill-opacity="0.25" '
        f'stroke="{_NO_ROOM}" stroke-width="{extent_m / 400:.4f}" stroke-dasharray="{extent_m / 100:.4f}"/>'
        f'<text x="{x:.3f}" y="{-y:.3f}" font-size="{size:.4f}" fill="{INK}">no room</text></g>'
    )


def _points(ring_m: Float[np.ndarray, "n 2"]) -> str:
    return " ".join(f"{x:.3f},{-y:.3f}" for x, y in ring_m)


def _label(room: Room, extent_m: float) -> str:
    """Draw name and area at the room's interior point, small enough to fit."""
    (x, y), radius_m = interior_point(room.shape)
    size = min(extent_m / 40.0, 2.6 * radius_m / max(len(room.name), 6))
    return (
        f'<text x="{x:.3f}" y="{-y:.3f}" font-size="{size:.4f}" stroke-width="{0.18 * size:.4f}">{xml_text(room.name)}'
        f'<tspan x="{x:.3f}" dy="1.2em" font-size="{0.8 * size:.4f}" fill="#444">{room.area_m2:.1f} m²</tspan></text>'
    )


def _scale_bar(bounds_m: Bounds) -> str:
    x_min, y_min = bounds_m[:2]
    width_m, height_m = _size_m(bounds_m)
    extent_m = max(width_m, height_m)
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


def _key(plan: FloorPlan, bounds_m: Bounds) -> str:
    """Draw the legend of the plan's openings below the right corner of all that is drawn."""
    kinds = [kind for kind in _GAP_COLOURS if any(opening.kind == kind for opening in plan.openings)]
    if not kinds:
        return ""
    width_m, height_m = _size_m(bounds_m)
    # Widths in font sizes: a line and its gap, and the letters.
    widths = [2.6 + 0.62 * len(kind) for kind in kinds]
    size = min(max(width_m, height_m) / 50.0, _KEY_SHARE * width_m / sum(widths))
    x, y = bounds_m[2] - size * sum(widths), -bounds_m[1] + _MARGIN_M
    parts = []
    for kind, width in zip(kinds, widths, strict=True):
        dashes = f' stroke-dasharray="{0.4 * size:.4f}"' if kind == "passage" else ""
        parts.append(
            f'<path d="M{x:.3f} {y:.3f}h{1.4 * size:.4f}" stroke="{ON_PAPER[kind]}" '
            f'stroke-width="{0.3 * size:.4f}"{dashes}/>'
            f'<text x="{x + 1.8 * size:.3f}" y="{y + 0.36 * size:.3f}" font-size="{size:.4f}">{kind}</text>'
        )
        x += size * width
    return f'<g class="key" fill="{INK}" text-anchor="start">{"".join(parts)}</g>'


def _ellipse(covariance_m2: tuple[float, float, float] | None, extent: float) -> str:
    if covariance_m2 is None:
        return ""
    xx, xy, yy = covariance_m2
    variance, axes = np.linalg.eigh([[xx, xy], [xy, yy]])
    minor_m, major_m = ELLIPSE_STDS * np.sqrt(np.maximum(variance, 0.0))
    # The y axis of the drawing points down, so angles from +x turn the other way.
    angle_deg = -math.degrees(math.atan2(axes[1, 1], axes[0, 1]))
    return (
        f'<ellipse rx="{major_m:.4f}" ry="{minor_m:.4f}" transform="rotate({angle_deg:.3f})" fill-opacity="0.2" '
        f'stroke="{FOUND}" stroke-width="{extent / 500:.4f}"/>'
    )
