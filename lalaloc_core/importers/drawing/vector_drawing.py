"""Vector drawing: shapes with their layers, in units of the drawing.

The readers of SVG, PDF and DXF produce a `Drawing`; `sketch_drawing` finds rooms and openings in it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import ClassVar

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.plan_words import Role, room_types_from_reading
from lalaloc_core.floorplan.room_types import PLAN_WORDS, room_types_from_name, split_words
from lalaloc_core.importers.common.geometry import (
    distinct,
    even_odd_polygons,
    extent_of,
    lines_of,
    point_xy,
    polygons_of,
    segments_of,
    side_lengths,
)
from lalaloc_core.importers.common.import_limits import CheckTime
from lalaloc_core.importers.common.room_bounds import ROOM_BOUNDS
from lalaloc_core.importers.common.sketch import SketchedFixture

# Of 255: fills of lower luminance can be walls, channels of white are not lower, and glass is bluer than red by this.
_DARK, _WHITE, _BLUER = 110.0, 250.0, 20.0
# Least opacity (of 255) of what can be seen, and of fills that hide what is below them.
_VISIBLE, _HIDING = 60.0, 230.0
# Angles of a door swing, and the largest deviation of its radius (share).
_SWING_DEG = (55.0, 125.0)
_ROUND = 0.03
_MAX_SEGMENTS = 60_000
# Texts of title blocks. Frames are drawn along this share of a box, which is so much of the drawing; lines nearer than
# this (m) to a frame belong to it. Sides of sheets relative to each other, also within margins, and their accuracy.
_TITLES, _WRITTEN_SCALE = frozenset(PLAN_WORDS["sheets"]["title"].split()), re.compile(r"\b1 ?: ?\d{2,3}\b")
_DRAWN, _MOST, _BESIDE_FRAME_M, _ON_BOX_M, _MIDDLE, _LEAST = 0.98, 0.5, 0.6, 0.05, 0.4, 0.05
_LINES_AT_A_TIME = 100
_SHEETS, _SAME_SIDES = np.array([math.sqrt(2.0), 400 / 277, 277 / 180, 17 / 11, 11 / 8.5]), 0.004


@dataclass(frozen=True)
class Paint:
    """Colour of a fill or a pen: channels and opacity, 0 to 255."""

    red: float
    green: float
    blue: float
    opacity: float

    @property
    def is_visible(self) -> bool:
        """Whether it can be seen."""
        return self.opacity >= _VISIBLE

    @property
    def is_dark(self) -> bool:
        """Whether a fill can be a wall, by its luminance (ITU-R BT.601)."""
        return 0.299 * self.red + 0.587 * self.green + 0.114 * self.blue < _DARK

    @property
    def is_white(self) -> bool:
        """Whether a line cannot be seen on paper."""
        return min(self.red, self.green, self.blue) >= _WHITE


@dataclass(frozen=True, eq=False)
class Area:
    """Closed shape on a layer, or in a group or class, with the role by its name.

    `kind` are words about the use of a room, such as the class of an SVG element. What `is_dark` can be a wall; None if
    the drawing has no fills. `width` is that of the outline's pen, 0 if unknown. `order` is the place in painting.
    """

    shape: shapely.Polygon
    layer: str
    role: Role | None = None
    name: str | None = None
    kind: str | None = None
    is_dark: bool | None = None
    width: float = 0.0
    order: int = 0


@dataclass(frozen=True, eq=False)
class Stroke:
    """Polyline with the width of its pen, 0 if unknown, its place in the order of painting, and whether it is white."""

    line: shapely.LineString
    layer: str
    role: Role | None = None
    width: float = 0.0
    order: int = 0
    is_white: bool = False


@dataclass(frozen=True, eq=False)
class Patch:
    """Opaque light area, which hides the walls that were painted before it; glass is `bluish`."""

    shape: shapely.Polygon
    order: int
    is_bluish: bool = False
    layer: str = ""


@dataclass(frozen=True)
class Swing:
    """Door swing: the quarter circle of a leaf that turns about `hinge` from `first` to `last`."""

    hinge: tuple[float, float]
    first: tuple[float, float]
    last: tuple[float, float]
    layer: str = ""

    @property
    def radius(self) -> float:
        """Width of the leaf."""
        return math.dist(self.hinge, self.first)


@dataclass(frozen=True)
class Lettering:
    """Text, its position (its middle or its start), and its height if that is known.

    Letters of a text that `is_ocr` was read from pixels can be wrong.
    """

    text: str
    position: tuple[float, float]
    layer: str = ""
    height: float = 0.0
    is_ocr: bool = False

    @property
    def is_title(self) -> bool:
        """Whether title blocks have such a text: a scale, or a word such as "project"."""
        return bool(_WRITTEN_SCALE.search(self.text)) or not _TITLES.isdisjoint(split_words(self.text))

    @property
    def room_types(self) -> tuple[str, ...]:
        """Types of the room that the text names; empty if it names none."""
        return (room_types_from_reading if self.is_ocr else room_types_from_name)(self.text)


@dataclass
class Drawing:
    """Contents of one page."""

    areas: list[Area] = field(default_factory=list)
    strokes: list[Stroke] = field(default_factory=list)
    swings: list[Swing] = field(default_factory=list)
    letterings: list[Lettering] = field(default_factory=list)
    patches: list[Patch] = field(default_factory=list)
    fixtures: list[SketchedFixture] = field(default_factory=list)

    @property
    def next_order(self) -> int:
        """Place of the next shape in the order of painting."""
        return len(self.areas) + len(self.strokes) + len(self.patches)

    @property
    def lines(self) -> list[Area | Stroke]:
        """Areas and lines, whose outlines can be walls."""
        return [*self.areas, *self.strokes]

    @property
    def shapes(self) -> list[BaseGeometry]:
        """Areas and lines."""
        return [*(area.shape for area in self.areas), *(stroke.line for stroke in self.strokes)]

    @property
    def extent(self) -> float:
        """Longer side of the box around areas and lines; NaN without any."""
        return extent_of(self.shapes)

    def add_areas(
        self, shells: Sequence[shapely.Polygon], like: Area, fill: Paint | None, *, is_nonzero: bool, has_line: bool
    ) -> int:
        """Add areas between outlines, with the attributes of one, and return their number; a light fill hides others.

        Of outlines without a line only dark areas are kept: not a coloured floor or a white background.
        """
        order, parts = self.next_order, even_odd_polygons(shells, is_nonzero=is_nonzero)
        if fill is not None and like.role is None and not like.is_dark and fill.opacity >= _HIDING:
            self.patches += [Patch(part, order, fill.blue > fill.red + _BLUER) for part in parts]
        if like.is_dark or has_line:
            self.areas += [replace(like, shape=part, order=order) for part in parts]
        return len(parts)

    def on_paper(self) -> Drawing:
        """Return the drawing without white lines, which hide others, unless most is white, as on a dark ground."""
        seen = [stroke for stroke in self.strokes if not stroke.is_white or stroke.role is not None]
        return replace(self, strokes=seen) if 2 * len(seen) + len(self.areas) > len(self.strokes) else self

    def without_plot(self) -> tuple[Drawing, shapely.Polygon | None]:
        """Return a drawing in metres without the outline of the plot around its walls, and this outline, if any.

        It is one thin line around all others, away from them and from names of rooms; without names, walls have faces.
        """
        light = [item for item in self.lines if not getattr(item, "is_dark", False) and item.role in (None, "wall")]
        thin = [item for item in light if item.width < ROOM_BOUNDS.thick_m[0]]
        faces = polygons_of(shapely.polygonize(shapely.get_parts(list(map(line_of, thin))).tolist()))
        plot = shapely.Polygon(max(faces, key=lambda face: face.envelope.area, default=shapely.Polygon()).exterior)
        edge = plot.exterior.buffer(_ON_BOX_M)
        own = {id(item) for item in thin if edge.covers(line_of(item))}
        rest = [item for item in self.lines if id(item) not in own]
        walls = shapely.GeometryCollection(list(map(line_of, rest)))
        named = [shapely.Point(text.position) for text in self.letterings if set(text.room_types) - {"balcony"}]
        names = [place for place in named if plot.covers(place)]
        thickest_m = ROOM_BOUNDS.walls.thickest
        is_walled = len(light) < len(self.lines) or any(face.buffer(-0.5 * thickest_m).is_empty for face in faces)
        is_plot = all(map(walls.convex_hull.covers, names)) if names else is_walled
        if not is_plot or not rest or not plot.buffer(-_BESIDE_FRAME_M).covers(walls):
            return self, None
        areas, strokes = ([item for item in rest if isinstance(item, kind)] for kind in (Area, Stroke))
        return replace(self, areas=areas, strokes=strokes), plot

    def on_layers(self, is_wanted: Callable[[str], bool]) -> Drawing:
        """Return what is on some layers; patches, which have none, stay."""
        kept = {kind: [item for item in items if is_wanted(item.layer)] for kind, items in vars(self).items()}
        return replace(self, **kept | {"patches": self.patches})

    def cropped(self, box: tuple[float, float, float, float]) -> Drawing:
        """Return the part of the drawing in a box; lines are cut, other shapes belong to it by their middles."""
        frame = shapely.box(*box)
        cut = [(s, part) for s in self.strokes for part in shapely.get_parts(shapely.intersection(s.line, frame))]
        return Drawing(
            [area for area in self.areas if frame.covers(area.shape.centroid)],
            [replace(s, line=part) for s, part in cut if isinstance(part, shapely.LineString) and part.length > 0.0],
            [swing for swing in self.swings if frame.covers(shapely.Point(swing.hinge))],
            [lettering for lettering in self.letterings if frame.covers(shapely.Point(lettering.position))],
            [patch for patch in self.patches if frame.covers(patch.shape.centroid)],
            [fixture for fixture in self.fixtures if frame.covers(fixture.shape.centroid)],
        )

    def scaled(self, factor: float, *, flip_y: bool) -> Drawing:
        """Return the drawing in metres, with y up."""
        factors = np.array([factor, -factor if flip_y else factor])

        def point(xy: tuple[float, float]) -> tuple[float, float]:
            return point_xy(xy * factors)

        def shape(geometry: BaseGeometry) -> BaseGeometry:
            return shapely.transform(geometry, lambda points: points * factors)

        return Drawing(
            [replace(area, shape=shape(area.shape), width=area.width * factor) for area in self.areas],
            [replace(s, line=shape(s.line), width=s.width * factor) for s in self.strokes],
            [replace(s, hinge=point(s.hinge), first=point(s.first), last=point(s.last)) for s in self.swings],
            [replace(t, position=point(t.position), height=t.height * factor) for t in self.letterings],
            [replace(patch, shape=shape(patch.shape)) for patch in self.patches],
            [replace(fixture, shape=shape(fixture.shape)) for fixture in self.fixtures],
        )


def line_of(item: Area | Stroke) -> BaseGeometry:
    """Return a line, or the boundary of an area."""
    return item.line if isinstance(item, Stroke) else item.shape.boundary


def joined(drawings: Iterable[Drawing]) -> Drawing:
    """Return drawings as one."""
    kinds = zip(*(vars(drawing).values() for drawing in drawings), strict=True)
    return Drawing(*(list(chain.from_iterable(items)) for items in kinds))


def without_frames(drawing: Drawing, check_time: CheckTime, most: int = 4) -> tuple[Drawing, list[BaseGeometry]]:
    """Return a drawing in metres without the frames of its sheet and what they touch, such as a title block; and these.

    A frame is a rectangle around most lines, which are away from it, of a sheet's proportions or with a title. Up to
    `most` frames around each other are found. `check_time` raises an exception to stop.
    """
    items = drawing.lines
    lines = list(map(line_of, items))
    if not items or not most:
        return drawing, []
    tree, whole = shapely.STRtree(lines), shapely.box(*shapely.total_bounds(lines))
    outlines = [area.shape for area in drawing.areas if not area.is_dark]
    large = [box for box in shapely.envelope(outlines) if box.area >= _MOST * whole.area]
    for box in distinct([whole, *sorted(large, key=lambda box: -box.area)])[:most]:
        edge = box.boundary.buffer(_ON_BOX_M)
        along = shapely.intersection(tree.geometries[tree.query(edge, predicate="intersects")], edge)
        if shapely.union_all(along).length < _DRAWN * box.length:
            continue
        own = _beside(tree, box.boundary, check_time)
        rest = [line for index, line in enumerate(lines) if index not in own and box.covers(line)]
        body = _beside(tree, max(rest, key=shapely.length), check_time) if rest else ()
        inner = shapely.box(*shapely.total_bounds([lines[k] for k in body])) if rest else shapely.Polygon()
        inside = [text for text in drawing.letterings if box.covers(shapely.Point(text.position))]
        names = [inner.covers(shapely.Point(text.position)) for text in inside if text.room_types]
        short, long = side_lengths(box)
        is_sheet = bool(np.any(np.abs(long / short / _SHEETS - 1.0) < _SAME_SIDES)) and (
            any(names) or inner.area >= _LEAST * box.area
        )
        titles = sum(text.is_title for text in inside)
        is_frame = (is_sheet or titles) and (any(names) or not names) if rest else titles > bool(names)
        # Walls that touch those around a building run through its middle.
        middle = shapely.affinity.scale(box, _MIDDLE, _MIDDLE)
        if is_frame and all(items[k].role is None and not middle.intersects(lines[k]) for k in own):
            left = [item for index, item in enumerate(items) if index not in own]
            areas, strokes = ([item for item in left if isinstance(item, kind)] for kind in (Area, Stroke))
            found, frames = without_frames(replace(drawing, areas=areas, strokes=strokes), check_time, most - 1)
            return found, [box, *frames]
    return drawing, []


def _beside(tree: shapely.STRtree, frame: BaseGeometry, check_time: CheckTime) -> set[int]:
    """Return the numbers of the lines that are connected with a frame, or are beside it."""
    found, new = set[int](), [frame]
    while new:
        check_time()
        # A long line can be near all others.
        some, new = new[-_LINES_AT_A_TIME:], new[:-_LINES_AT_A_TIME]
        near = set(tree.query(some, predicate="dwithin", distance=_BESIDE_FRAME_M)[1].tolist()) - found
        found |= near
        new += tree.geometries[list(near)].tolist()
    return found


@dataclass
class Subpath:
    """Part of a path: its points, its curves (runs of curved pieces), and whether it is closed."""

    # Straight pieces per curve.
    STEPS: ClassVar[int] = 12
    points: list[tuple[float, float]] = field(default_factory=list)
    curves: list[list[tuple[float, float]]] = field(default_factory=list)
    is_closed: bool = False
    was_curved: bool = False

    def add(self, piece: Sequence[tuple[float, float]], *, is_curved: bool) -> None:
        """Add a piece, which begins at the last point."""
        if is_curved:
            self.curves += [] if self.was_curved else [list(piece[:1])]
            self.curves[-1] += piece[1:]
        self.points += piece[1:] if self.points else piece
        self.was_curved = is_curved


def leaves_of(curves: Sequence[Float[np.ndarray, "_ 2"]], layer: str = "") -> list[Swing]:
    """Return the swings among the curves of a line, which has no more than two if they are of a door."""
    swings = [fit_swing(curve, layer) for curve in curves] if len(curves) <= 2 else []
    return [swing for swing in swings if swing is not None]


def fit_swing(points: Float[np.ndarray, "n 2"], layer: str, turn_deg: tuple[float, float] = _SWING_DEG) -> Swing | None:
    """Return the arc that a curve follows, None if its angle is outside `turn_deg` or it is not round."""
    if len(points) < 4 or not np.isfinite(points).all():
        return None
    middle = points.mean(axis=0)
    local = points - middle
    # Least squares of x² + y² = 2 a x + 2 b y + c, which is linear in (a, b, c).
    matrix = np.column_stack([2.0 * local, np.ones(len(local))])
    solution, _, rank, _ = np.linalg.lstsq(matrix, np.sum(local**2, axis=1), rcond=None)
    if rank < 3:
        return None
    centre = solution[:2]
    radii = np.linalg.norm(local - centre, axis=1)
    radius = float(radii.mean())
    if radius <= 0.0 or float(np.abs(radii - radius).max()) > _ROUND * radius:
        return None
    angles = np.unwrap(np.arctan2(*(local - centre).T[::-1]))
    if not turn_deg[0] <= math.degrees(float(abs(angles[-1] - angles[0]))) <= turn_deg[1]:
        return None
    hinge, first, last = centre + middle, points[0], points[-1]
    return Swing(point_xy(hinge), point_xy(first), point_xy(last), layer)


def split_lines(lines: Iterable[BaseGeometry]) -> list[shapely.LineString]:
    """Return the straight pieces of lines."""
    pieces = segments_of(list(lines))
    if len(pieces) > _MAX_SEGMENTS:
        raise InvalidFloorPlanError(
            f"{len(pieces)} lines could be walls; the limit is {_MAX_SEGMENTS}; set layers to the layers of the walls"
        )
    return lines_of(pieces)
