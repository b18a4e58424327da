"""Drawings of generated homes in five styles, with the rooms and openings that they show."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import cv2
import numpy as np
import shapely
from jaxtyping import Float, UInt8
from PIL import Image
from shapely.geometry.base import BaseGeometry

from benchmarks.plan_symbols import Symbol, place_symbols
from lalaloc_core.learn.synth.homes.plans import Home, HomeConfig, generate_home

Style = Literal["thin", "thick", "hatched", "coloured", "scanned"]
STYLES: tuple[Style, ...] = get_args(Style)
# Rooms joined by a wider opening without a symbol look like one room.
WIDEST_BARE_OPENING_M = 1.9
_MARGIN_M = 1.5
# Walls between slanted rooms are wedges; openings lead through wedges up to this depth.
_MAX_WALL_DEPTH_M = 0.8
_PIXELS_PER_M = {"thin": 80.0, "thick": 80.0, "hatched": 80.0, "coloured": 80.0, "scanned": 60.0}
HOME = HomeConfig(rotated_share=0.0, sheared_share=0.0, rooms=(3, 9), area_m2=(30.0, 140.0))
_PALE = ((250, 240, 220), (226, 240, 250), (232, 246, 228), (250, 232, 238), (246, 246, 236))
_SHIFT = 4


@dataclass(frozen=True)
class OpeningSymbol:
    """Opening of a drawing: its quadrilateral in the wall, its middle line, and the area cut out of walls."""

    kind: Literal["door", "window", "passage"]
    shape: shapely.Polygon
    start: tuple[float, float]
    end: tuple[float, float]
    cut: BaseGeometry


def encoded(picture: UInt8[np.ndarray, "h w 3"], format: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, format, **options)
    return stream.getvalue()


@dataclass(frozen=True, eq=False)
class DrawnPlan:
    """Picture with its rooms, openings and symbols, in metres from its lower left corner."""

    picture: UInt8[np.ndarray, "h w 3"]
    metres_per_pixel: float
    rooms: list[shapely.Polygon]
    openings: list[OpeningSymbol]
    symbols: list[Symbol] = field(default_factory=list)

    def noisy(self, sigma: float, seed: int) -> DrawnPlan:
        """Return the picture with noise of a standard deviation (of 255)."""
        noise = np.random.default_rng(seed).normal(0.0, sigma, self.picture.shape[:2])
        return self._with(self.picture + noise[..., None])

    def shaded(self, darkest: float) -> DrawnPlan:
        """Return the picture with a shadow from its upper left to its lower right corner, as a share of the light."""
        rows, columns = self.picture.shape[:2]
        across = 0.5 * (np.linspace(0.0, 1.0, rows)[:, None] + np.linspace(0.0, 1.0, columns))
        return self._with(self.picture * (1.0 - (1.0 - darkest) * across)[..., None])

    def _with(self, picture: Float[np.ndarray, "h w 3"]) -> DrawnPlan:
        return replace(self, picture=np.clip(np.round(picture), 0, 255).astype(np.uint8))

    def png(self) -> bytes:
        return encoded(self.picture, "PNG")

    def jpeg(self) -> bytes:
        return encoded(self.picture, "JPEG", quality=60)


@dataclass(frozen=True, eq=False)
class Model:
    """Home to draw, in metres from the lower left corner of the sheet."""

    rooms: list[shapely.Polygon]
    names: list[str]
    openings: list[OpeningSymbol]
    walls: BaseGeometry
    size_m: tuple[float, float]


def draw_plan(
    style: Style,
    seed: int,
    *,
    has_texts: bool = True,
    is_furnished: bool = False,
    has_symbols: bool = False,
    pixels_per_m: float | None = None,
) -> DrawnPlan:
    """Draw a generated home in one of the styles; the same for the same seed.

    `has_texts` writes names and dimensions in the styles that have them. `is_furnished` draws furniture
    in every style, and `has_symbols` symbols of fixtures and furniture instead of boxes and circles.
    """
    rng = np.random.default_rng([seed, STYLES.index(style)])
    thickness = float(rng.uniform(0.1, 0.25))
    model = model_of(generate_home(rng, replace(HOME, wall_thickness_m=(thickness, thickness))), thickness)
    sheet = _Sheet(model, pixels_per_m or _PIXELS_PER_M[style])
    if style == "coloured":
        sheet.colour(rng)
    symbols = sheet.furnish_with_symbols(rng) if has_symbols else []
    if not has_symbols and (is_furnished or style in ("coloured", "scanned")):
        sheet.furnish(rng)
    has_names = has_texts and style in ("coloured", "scanned")
    if has_names:
        sheet.letter()
        sheet.dimension()
    sheet.draw_walls(style, rng)
    sheet.draw_openings()
    picture = sheet.picture
    rooms, openings = (model.rooms, model.openings) if has_names else _as_seen(model)
    if style == "scanned":
        degrees = float(rng.uniform(1.0, 4.0) * rng.choice([-1.0, 1.0]))
        picture = scan(picture, degrees, rng)
        # The importer turns a skewed drawing back about its centre, so the truth stays as drawn.
    return DrawnPlan(picture, 1.0 / sheet.pixels_per_m, rooms, openings, symbols)


def model_of(home: Home, thickness: float) -> Model:
    """Return the walls and openings of a home whose walls are `thickness` metres thick."""
    corners = np.concatenate([room.polygon_m for room in home.plan.rooms])
    origin = corners.min(axis=0) - _MARGIN_M - thickness
    size = corners.max(axis=0) + _MARGIN_M + thickness - origin
    rooms = [shapely.transform(room.shape, lambda points: points - origin) for room in home.plan.rooms]
    inside = shapely.unary_union(rooms)
    openings = _openings(home, origin, thickness, inside)
    walls = shapely.unary_union([room.buffer(thickness, join_style="mitre") for room in rooms]).difference(inside)
    walls = walls.difference(shapely.unary_union([o.cut.buffer(1e-4, join_style="mitre") for o in openings]))
    names, width, height = [room.name for room in home.plan.rooms], *map(float, size)
    return Model(rooms, names, openings, walls, (width, height))


def _openings(home: Home, origin: np.ndarray, thickness: float, inside: BaseGeometry) -> list[OpeningSymbol]:
    found: list[OpeningSymbol] = []
    for opening in home.openings:
        x0, y0, x1, y1 = home.plan.rooms[opening.room].walls_m[opening.wall]
        along = np.array([x1 - x0, y1 - y0]) / math.hypot(x1 - x0, y1 - y0)
        outward = np.array([along[1], -along[0]])
        start = np.array([x0, y0]) + along * opening.start_m - origin
        end = np.array([x0, y0]) + along * opening.end_m - origin
        shape = shapely.Polygon([start, end, end + thickness * outward, start + thickness * outward])
        kind = {"door_shut": "door", "door_open": "door", "window": "window", "opening": "passage"}[opening.kind]
        # A door between two rooms is listed by both, and an opening into a third room is not drawn.
        is_drawn = any(shapely.intersection(shape, drawn.shape).area > 0.1 * shape.area for drawn in found)
        if is_drawn or shapely.intersection(shape, inside).area > 0.02 * shape.area:
            continue
        middle = 0.5 * thickness * outward
        a, b = start + middle, end + middle
        cut = _cut_through(start, end, outward, shape, inside)
        found.append(OpeningSymbol(kind, shape, (float(a[0]), float(a[1])), (float(b[0]), float(b[1])), cut))  # type: ignore[arg-type]
    return found


def _cut_through(
    start: Float[np.ndarray, "2"],
    end: Float[np.ndarray, "2"],
    outward: Float[np.ndarray, "2"],
    shape: shapely.Polygon,
    inside: BaseGeometry,
) -> BaseGeometry:
    """Return the area that an opening cuts out of walls, up to a room behind it that may be slanted against it."""
    deep = []
    for corner in (start, 0.5 * (start + end), end):
        ray = shapely.LineString([corner + 0.01 * outward, corner + _MAX_WALL_DEPTH_M * outward])
        behind = shapely.intersection(ray, inside)
        if behind.is_empty:
            return shape
        deep.append(shapely.distance(shapely.Point(corner), behind))
    far = max(deep) * outward
    return shapely.union(shape, shapely.difference(shapely.Polygon([start, end, end + far, start + far]), inside))


def _as_seen(model: Model) -> tuple[list[shapely.Polygon], list[OpeningSymbol]]:
    """Return rooms and openings as a drawing without names shows them: wide openings without a symbol join rooms."""
    wide = [o for o in model.openings if o.kind == "passage" and math.dist(o.start, o.end) > WIDEST_BARE_OPENING_M]
    joined = shapely.unary_union([*model.rooms, *(o.shape.buffer(1e-3, join_style="mitre") for o in wide)])
    parts = [part for part in shapely.get_parts(joined) if isinstance(part, shapely.Polygon)]
    return parts, [opening for opening in model.openings if opening not in wide]


class _Sheet:
    """Drawing in progress."""

    def __init__(self, model: Model, pixels_per_m: float) -> None:
        self._model, self.pixels_per_m = model, pixels_per_m
        columns, rows = (math.ceil(size * pixels_per_m) for size in model.size_m)
        # The sheet is a whole number of pixels high; its lower edge is the truth's origin.
        self._rows = rows
        self.picture = np.full((rows, columns, 3), 255, np.uint8)

    def colour(self, rng: np.random.Generator) -> None:
        for room in self._model.rooms:
            self._fill(room, _PALE[int(rng.integers(len(_PALE)))])

    def _swings(self) -> list[BaseGeometry]:
        return [o.shape.buffer(math.dist(o.start, o.end)) for o in self._model.openings if o.kind == "door"]

    def furnish_with_symbols(self, rng: np.random.Generator) -> list[Symbol]:
        """Draw symbols of fixtures and furniture, none of them where a door swings, and return them."""
        symbols = []
        for room in self._model.rooms:
            middle = shapely.maximum_inscribed_circle(room, 0.05).coords[0]
            name = shapely.Point(middle).buffer(0.5)
            symbols += place_symbols(room, [*self._swings(), name], rng)
        tone, pen = int(rng.integers(0, 120)), int(rng.integers(1, 3))
        for symbol in symbols:
            for line in symbol.lines:
                self._strokes(line, (tone, tone, tone), pen, closed=False)
        return symbols

    def furnish(self, rng: np.random.Generator) -> None:
        """Draw furniture, none of it where a door swings."""
        swings = self._swings()
        for room in self._model.rooms:
            taken: list[BaseGeometry] = list(swings)
            x0, y0, x1, y1 = room.bounds
            for _ in range(12):
                width, depth = rng.uniform(0.4, 2.0), rng.uniform(0.35, 0.95)
                if rng.random() < 0.5:
                    width, depth = depth, width
                x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
                if rng.random() < 0.7:  # Against a wall.
                    x = x0 + 0.06 if rng.random() < 0.5 else x1 - 0.06 - width
                piece = shapely.box(x, y, x + width, y + depth)
                if room.buffer(-0.05).contains(piece) and not any(piece.intersects(area) for area in taken):
                    taken.append(piece.buffer(0.15))
                    self._piece(piece, rng)

    def _piece(self, piece: shapely.Polygon, rng: np.random.Generator) -> None:
        x0, y0, x1, y1 = piece.bounds
        kind = rng.integers(3)
        if kind == 0:
            radius = round(0.45 * min(x1 - x0, y1 - y0) * self.pixels_per_m)
            middle = self._pixel((0.5 * (x0 + x1), 0.5 * (y0 + y1)))
            cv2.circle(self.picture, middle, radius, (90, 90, 90), 1, cv2.LINE_AA)
        else:
            self._outline(piece, (90, 90, 90), 1)
        if kind == 2:
            self._outline(shapely.box(x0 + 0.08, y0 + 0.08, 0.5 * (x0 + x1), y1 - 0.08), (90, 90, 90), 1)

    def letter(self) -> None:
        for room, name in zip(self._model.rooms, self._model.names, strict=True):
            centre = shapely.maximum_inscribed_circle(room, 0.05).coords[0]
            size = 0.006 * self.pixels_per_m
            (width, height), _ = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
            x, y = self._pixel((centre[0], centre[1]))
            self._write(name, (x - width // 2, y + height // 2), size, 40)
            self._write(f"{room.area:.1f} m2", (x - width // 2, y + 2 * height), 0.8 * size, 40)

    def dimension(self) -> None:
        """Draw dimension lines below and to the left, with ticks and numbers."""
        x0, y0, x1, y1 = shapely.unary_union(self._model.rooms).bounds
        for (ax, ay), (bx, by), length in (
            ((x0, y0 - 0.9), (x1, y0 - 0.9), x1 - x0),
            ((x0 - 0.9, y0), (x0 - 0.9, y1), y1 - y0),
        ):
            self._line((ax, ay), (bx, by), (60, 60, 60), 1)
            for x, y in ((ax, ay), (bx, by)):
                self._line((x - 0.1, y - 0.1), (x + 0.1, y + 0.1), (60, 60, 60), 1)
            self._write(f"{length:.2f}", self._pixel((0.5 * (ax + bx) + 0.05, 0.5 * (ay + by) + 0.08)), 0.5, 60)

    def _write(self, text: str, left: tuple[int, int], scale: float, tone: int) -> None:
        cv2.putText(self.picture, text, left, cv2.FONT_HERSHEY_SIMPLEX, scale, (tone, tone, tone), 1, cv2.LINE_AA)

    def draw_walls(self, style: Style, rng: np.random.Generator) -> None:
        parts = [part for part in shapely.get_parts(self._model.walls) if part.area > 1e-4]
        if style in ("thick", "scanned", "coloured"):
            tone = int(rng.integers(45, 95)) if style == "coloured" else 0
            for part in parts:
                self._fill(part, (tone, tone, tone))
            return
        if style == "hatched":
            for line in hatch_lines(shapely.unary_union(parts), self._model.size_m, 0.09):
                self._line(line.coords[0], line.coords[-1], (0, 0, 0), 1)
        for part in parts:
            self._outline(part, (0, 0, 0), 2)

    def draw_openings(self) -> None:
        for opening in self._model.openings:
            if opening.kind == "window":
                self._outline(opening.shape, (0, 0, 0), 1)
                self._line(opening.start, opening.end, (0, 0, 0), 1)
            elif opening.kind == "door":
                self._door(opening)

    def _door(self, opening: OpeningSymbol) -> None:
        for hinge, direction, inward, radius in door_leaves(opening):
            self._line(hinge, hinge + radius * inward, (0, 0, 0), 1)
            angles = np.linspace(0.0, 0.5 * np.pi, 25)[:, None]
            arc = hinge + radius * (np.cos(angles) * direction + np.sin(angles) * inward)
            self._strokes(arc, (0, 0, 0), 1, closed=False)

    def _fill(self, shape: BaseGeometry, colour: tuple[int, int, int]) -> None:
        for part in shapely.get_parts(shape):
            rings = [self._fixed(np.asarray(ring.coords)) for ring in (part.exterior, *part.interiors)]
            cv2.fillPoly(self.picture, rings, colour, cv2.LINE_AA, _SHIFT)

    def _outline(self, shape: BaseGeometry, colour: tuple[int, int, int], width: int) -> None:
        for part in shapely.get_parts(shape):
            for ring in (part.exterior, *part.interiors):
                self._strokes(np.asarray(ring.coords), colour, width, closed=True)

    def _line(self, start: object, end: object, colour: tuple[int, int, int], width: int) -> None:
        self._strokes(np.array([start, end], dtype=float), colour, width, closed=False)

    def _strokes(
        self, points: Float[np.ndarray, "n 2"], colour: tuple[int, int, int], width: int, *, closed: bool
    ) -> None:
        cv2.polylines(self.picture, [self._fixed(points)], closed, colour, width, cv2.LINE_AA, _SHIFT)

    def _fixed(self, points: Float[np.ndarray, "n 2"]) -> np.ndarray:
        """Return OpenCV's fixed-point coordinates, with pixel centres at integers and `_SHIFT` fractional bits."""
        from_top = np.column_stack([points[:, 0], self._rows / self.pixels_per_m - points[:, 1]])
        pixels = from_top * self.pixels_per_m - 0.5
        return np.round(pixels * 2**_SHIFT).astype(np.int32)

    def _pixel(self, point: tuple[float, float]) -> tuple[int, int]:
        x, y = self._fixed(np.array([point]))[0] / 2**_SHIFT
        return round(x), round(y)


def hatch_lines(walls: BaseGeometry, size_m: tuple[float, float], spacing_m: float) -> list[shapely.LineString]:
    """Return lines at 45 degrees within walls on a sheet."""
    width, height = size_m
    offsets = np.arange(-height, width, spacing_m * math.sqrt(2.0))
    lines = shapely.multilinestrings([[(x, 0.0), (x + height, height)] for x in offsets])
    parts = shapely.get_parts(shapely.intersection(lines, walls))
    return [part for part in parts if isinstance(part, shapely.LineString)]


def door_leaves(opening: OpeningSymbol) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]:
    """Return the hinge, the direction when shut and when open, and the width of each leaf; wide doors have two."""
    start, end = np.asarray(opening.shape.exterior.coords)[:2]
    width = math.dist(start, end)
    along = (end - start) / width
    inward = np.array([-along[1], along[0]])
    if width <= 1.3:
        return [(start, along, inward, width)]
    return [(start, along, inward, 0.5 * width), (end, -along, inward, 0.5 * width)]


def scan(picture: UInt8[np.ndarray, "h w 3"], degrees: float, rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Return the picture skewed, blurred and unevenly lit, with noise, on grey paper."""
    rows, columns = picture.shape[:2]
    turn = cv2.getRotationMatrix2D((0.5 * columns - 0.5, 0.5 * rows - 0.5), degrees, 1.0)
    turned = cv2.warpAffine(picture, turn, (columns, rows), flags=cv2.INTER_AREA, borderValue=(255, 255, 255))
    soft = cv2.GaussianBlur(turned, (0, 0), float(rng.uniform(0.6, 1.0))).astype(np.float64)
    x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    tilt = rng.uniform(-0.12, 0.12, 2)
    light = 0.86 + tilt[0] * x + tilt[1] * y - 0.08 * (x**2 + y**2)
    noisy = (25.0 + 0.9 * soft) * light[..., None] + rng.normal(0.0, 6.0, soft.shape[:2])[..., None]
    speckles = rng.random((rows, columns)) < 2e-4
    noisy[speckles] = rng.uniform(0, 120, (int(speckles.sum()), 1))
    return np.clip(noisy, 0, 255).astype(np.uint8)
