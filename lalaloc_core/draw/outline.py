"""Outline of a layout in a photograph: floor and ceiling lines, corners, doors and windows, and its drawing.

It is computed in closed form from the pose, the camera height and the room's walls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import TWO_PI, column_azimuths, unit_rays, wrap_angle
from lalaloc_core.draw.canvas import INK, ON_PHOTOGRAPH, Box, Number, image, path, words
from lalaloc_core.floorplan import USUAL_HEIGHTS_M, FloorPlan, OpeningFace
from lalaloc_core.photograph import Photograph
from lalaloc_core.render.profile import nearest_walls

_COLUMNS = 1024
# Extra rays this far (radians) to either side of a corner meet its two walls.
_BESIDE = 1e-6
# Rooms with more walls get no extra rays: their corners are as sharp as the columns.
_SHARP_WALLS = 256
# Rays times walls intersected at once, to bound memory.
_CROSSINGS = 2**20
# Walls within this angle of each other have no corner between them.
_STRAIGHT = math.radians(8.0)
_POINTS_PER_OPENING = 33
# A point farther than the wall by this share is hidden.
_HIDDEN = 2e-3
# Largest angle (radians) between points of a line in a photograph.
_VIEW_STEP = math.radians(0.5)

Line = Float[np.ndarray, "_ 2"]
WALL_COLOUR = ON_PHOTOGRAPH["wall"]
# In the order of the legend.
_KINDS = ("door", "window", "passage")


@dataclass(frozen=True, eq=False)
class OpeningOutline:
    """A closed line around the visible part of an opening."""

    kind: str
    line: Line


@dataclass(frozen=True, eq=False)
class Outline:
    """Lines of a layout in a photograph, as shares (x, y) of its width and height, y pointing down.

    Attributes:
        edges: lines of the walls; in a sphere, the lower and the upper edge from left to right, then the edges between
            walls from the floor to the ceiling.
        openings: lines around openings, of which other photographs show parts that need not be closed.
    """

    edges: tuple[Line, ...]
    openings: tuple[OpeningOutline, ...]

    def seen_in(self, photograph: Photograph) -> Outline:
        """Return the parts of an outline in a sphere that a photograph with a camera shows."""
        return Outline(
            tuple(part for line in self.edges for part in _seen_parts(line, photograph)),
            tuple(
                OpeningOutline(opening.kind, part)
                for opening in self.openings
                for part in _seen_parts(opening.line, photograph)
            ),
        )


def _seen_parts(line: Line, photograph: Photograph) -> list[Line]:
    """Return the visible parts of a line in a sphere, as lines in a photograph."""
    direction = (line - 0.5) * (TWO_PI, -math.pi)
    steps = np.ceil(np.abs(np.diff(direction, axis=0)).max(axis=1) / _VIEW_STEP).clip(1).astype(int)
    place = np.append(np.concatenate([start + np.arange(n) / n for start, n in enumerate(steps)]), len(steps))
    whole = np.arange(len(direction))
    azimuth, elevation = (np.interp(place, whole, values) for values in direction.T)
    shares, seen = photograph.project(unit_rays(azimuth, elevation))
    runs = np.split(np.arange(len(seen)), np.flatnonzero(np.diff(seen)) + 1)
    return [shares[run] for run in runs if len(run) > 1 and seen[run[0]]]


def layout_outline(
    plan: FloorPlan, position_m: Float[np.ndarray, "2"], room_index: int, heading: float, camera_height_m: float
) -> Outline:
    """Return the outline of a room as seen by a sphere's camera in it.

    `heading` is the azimuth (radians) of the sphere's centre column. A camera above the ceiling is drawn just below
    it.
    """
    walls_m = plan.rooms[room_index].walls_m
    ends = np.concatenate([walls_m[:, :2], walls_m[:, 2:]]) - position_m
    corner = wrap_angle(np.arctan2(ends[:, 0], ends[:, 1]) - heading)
    edges = np.array([-math.pi, math.pi])
    beside = [corner - _BESIDE, corner + _BESIDE] if len(walls_m) <= _SHARP_WALLS else []
    azimuth = np.sort(np.concatenate([column_azimuths(_COLUMNS), edges, *beside]))
    azimuth = azimuth[(azimuth >= -math.pi) & (azimuth <= math.pi)]
    distance_m, wall = _met(position_m, azimuth + heading, walls_m)
    seen = np.isfinite(distance_m)
    azimuth, distance_m, wall = azimuth[seen], distance_m[seen], wall[seen]
    above_m = max(float(plan.ceiling_heights_m[room_index]) - camera_height_m, 0.01)
    turns = _turns(walls_m, wall, distance_m)
    near_m = np.minimum(distance_m[:-1], distance_m[1:])[turns]
    bends = azimuth[:-1][turns]
    low, high = (project_points(bends, near_m, rise_m) for rise_m in (-camera_height_m, above_m))
    openings = [
        drawn
        for face in plan.room_faces[room_index]
        for drawn in _opening(plan, face, position_m, heading, camera_height_m)
    ]
    borders = (project_points(azimuth, distance_m, rise_m) for rise_m in (-camera_height_m, above_m))
    return Outline((*borders, *np.stack([low, high], axis=1)), tuple(openings))


def project_points(
    azimuth: Float[np.ndarray, "n"], distance_m: Float[np.ndarray, "n"], rise_m: Float[np.ndarray, "n"] | float
) -> Line:
    """Project points into a sphere, as shares (x, y) of its width and height.

    Azimuths are radians relative to the heading, in [-π, π]; distances are horizontal, and `rise_m` is above the
    camera.
    """
    return np.stack([azimuth / TWO_PI + 0.5, 0.5 - np.arctan2(rise_m, distance_m) / math.pi], axis=-1)


def _met(
    position_m: Float[np.ndarray, "2"], azimuth: Float[np.ndarray, "n"], walls_m: Float[np.ndarray, "w 4"]
) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return distance and index of the wall that each ray meets, in parts to bound memory."""
    parts = np.array_split(azimuth, -(-len(azimuth) * len(walls_m) // _CROSSINGS))
    met = [nearest_walls(position_m[None], part[None], walls_m[None]) for part in parts]
    return np.concatenate([distance[0] for distance, _ in met]), np.concatenate([wall[0] for _, wall in met])


def _turns(
    walls_m: Float[np.ndarray, "w 4"], wall: Int[np.ndarray, "n"], distance_m: Float[np.ndarray, "n"]
) -> Bool[np.ndarray, "n-1"]:
    """Return True between neighbouring rays with a corner: another wall, at an angle or at another distance."""
    edge = walls_m[:, 2:] - walls_m[:, :2]
    along = np.arctan2(edge[:, 0], edge[:, 1])
    first, second = wall[:-1], wall[1:]
    bend = np.abs(wrap_angle(along[first] - along[second]))
    jump = np.abs(np.log(distance_m[:-1] / distance_m[1:])) > 0.02
    return (first != second) & ((np.minimum(bend, math.pi - bend) > _STRAIGHT) | jump)


def _opening(
    plan: FloorPlan, face: OpeningFace, position_m: Float[np.ndarray, "2"], heading: float, camera_height_m: float
) -> list[OpeningOutline]:
    opening, walls_m = plan.openings[face.opening], plan.rooms[face.room].walls_m
    usual_sill_m, usual_head_m = USUAL_HEIGHTS_M[opening.kind]
    low_m = usual_sill_m if opening.sill_m is None else opening.sill_m
    high_m = usual_head_m if opening.head_m is None else opening.head_m
    high_m = min(high_m, float(plan.ceiling_heights_m[face.room]))
    if not low_m < high_m:
        return []
    start, end = walls_m[face.wall].reshape(2, 2)
    share = np.linspace(face.start, face.end, _POINTS_PER_OPENING)[:, None]
    offset = start + share * (end - start) - position_m
    azimuth, distance_m = np.arctan2(offset[:, 0], offset[:, 1]), np.hypot(*offset.T)
    met_m, _ = _met(position_m, azimuth, walls_m)
    visible = (distance_m > 0.0) & (distance_m <= met_m * (1.0 + _HIDDEN) + 1e-3)
    relative = wrap_angle(azimuth - heading)
    # Split openings that cross the sphere's edge.
    parts = np.split(np.arange(len(relative)), np.flatnonzero(np.abs(np.diff(relative)) > math.pi) + 1)
    drawn = []
    for part in parts:
        for run in np.split(part, np.flatnonzero(~visible[part])):
            run = run[visible[run]]
            if len(run) > 1:
                lower = project_points(relative[run], distance_m[run], low_m - camera_height_m)
                upper = project_points(relative[run], distance_m[run], high_m - camera_height_m)
                drawn.append(OpeningOutline(opening.kind, np.concatenate([lower, upper[::-1], lower[:1]])))
    return drawn


def photograph_part(jpeg: bytes, outline: Outline, box: Box) -> str:
    """Draw a photograph with a layout over it as a part of a larger drawing.

    The picture has as many pixels as the box (x, y, width, height).
    """
    x, y, width, height = box
    size = np.array([width, height])
    # Proportional to the width, so that lines look alike at every size.
    line = width / 480.0
    # Unscaled pixels need no smoothing, which takes a second.
    parts = [image(jpeg, "jpeg", (0.0, 0.0, width, height), 'image-rendering="optimizeSpeed"')]
    for opening in outline.openings:
        d, colour = path([opening.line * size]), ON_PHOTOGRAPH[opening.kind]
        parts.append(
            f'<path class="{opening.kind}" d="{d}" fill="{colour}" fill-opacity="0.18" stroke="{INK}" '
            f'stroke-width="{1.6 * line:.2f}" stroke-linejoin="round"/>'
            f'<path d="{d}" fill="none" stroke="{colour}" stroke-width="{0.9 * line:.2f}" stroke-linejoin="round"/>'
        )
    edges = path([edge * (round(width), round(height)) for edge in outline.edges if len(edge) > 1], 2)
    parts += [
        f'<path class="layout" d="{edges}" fill="none" stroke="{colour}" stroke-width="{thickness:.2f}" '
        'stroke-linejoin="round" stroke-linecap="round"/>'
        for colour, thickness in ((INK, 1.8 * line), (WALL_COLOUR, line))
    ]
    return f'<g class="photograph" transform="translate({x:.1f} {y:.1f})">{"".join(parts)}</g>'


def photograph_key(outline: Outline, x: Number, y: Number) -> str:
    """Draw the legend of the lines in a photograph; `y` is the base line of its text."""
    kinds = sorted({opening.kind for opening in outline.openings}, key=_KINDS.index)
    parts = []
    for name, colour in (("walls of the plan", WALL_COLOUR), *((kind + "s", ON_PHOTOGRAPH[kind]) for kind in kinds)):
        parts.append(
            f'<rect x="{x:.1f}" y="{y - 13:.1f}" width="26" height="13" rx="3" fill="{colour}" stroke="{INK}"/>'
            + words(x + 36, y, name, 17)
        )
        x += 36 + 9.8 * len(name) + 34
    return "".join(parts)
