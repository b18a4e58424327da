"""Wall pixels of a picture: dark thick areas, or pairs of lines with the area between them."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass

import cv2
import numpy as np
import shapely
from jaxtyping import Bool, Float

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.geometry import cross, polygons_of
from lalaloc_core.importers.common.import_limits import CheckTime
from lalaloc_core.importers.picture.ink import Ink, Labels, Mask

_MIN_THICKNESS_M = 0.055
# Broadest strokes and leaves between two lines relative to walls, with the thinnest inner wall (m) beside them.
_STROKE, _LEAF = (0.4, 0.075), (0.55, 0.1)
# Largest white gap between the two lines of a wall; the sector of a door swing is wider.
_MAX_CAVITY_M = 0.42
_SMALL_M = 1.2
_STRAIGHT_M, _STRAIGHT_PX = 0.012, 1.3
# Thickness range of walls and diameter of discs, relative to the usual wall; share of its box that a disc fills.
_OUTLINED_RANGE, _FILLED_RANGE, _DISC_OF_WALL, _DISC = (0.6, 2.5), (0.6, 3.0), 1.25, 0.95
# Largest share of a cavity that can be wider than a wall, at the junctions of walls.
_WIDE_PART = 0.15
# White areas in walls: least length of sure ones (m), share of the walls that sets the thickest, tolerance of widths,
# least length of strips and thickness of piers relative to the usual, widths of panes around 0.4 of it, wide part of a
# strip, tolerance of its width, and largest share of its middle beyond that.
_LONG_M, _WIDEST_WALLS, _LIKE_USUAL, _OBLONG, _PIER = 1.5, 0.9, 0.25, 2.5, 1.5
_PANE, _THINNEST_PANE, _WIDE_IN_STRIP, _EVEN, _UNEVEN = 0.15, 0.28, 0.03, 0.35, 0.3
# Width of lines, and reach across them (pixels).
_PEN_PX, _LINES_PX = 2.0, 11
# Thickest strip of a wall with its lines (m), and share of a white area in such strips. Shortest stroke of a hatch (m),
# and share of such strokes around a white area of the hatch.
_THICKEST_M, _IN_WALL, _STROKE_OF_HATCH_M, _HATCHED = 0.46, 0.5, 0.12, 0.62
# Largest cut of a rounded corner (m), and smallest sine of the whole turn.
_CUT_CORNER_M, _SQUARE = 0.07, 0.8
# Strokes of panes are paler than walls (of 255), thinner than walls (share), and long (m).
_PALER, _THINNER, _STROKE_M = 45.0, 0.55, 0.3
# Widest notch (m) in a wall that is drawn with two lines.
_NOTCH_M = 0.15
# Outlines of walls in a picture, with those of the areas that they enclose.
_MAX_OUTLINES = 10_000
# Edges of a smaller angle with an axis, or displacement across it, are parallel to it.
_ALONG_AXIS_DEG, _ALONG_AXIS_M = 6.0, 0.06


@dataclass(frozen=True, eq=False)
class WallMask:
    """Wall pixels; `cavities` labels the white areas inside walls, 0 elsewhere, and is None for dark walls."""

    mask: Mask
    thickness_m: float
    cavities: Labels | None


def dark_walls(ink: Ink) -> WallMask | None:
    """Return filled walls: the ink without thin lines and without broad strokes of a paler tone."""
    walls = _walls(ink, ink.mask, None)
    if walls is None:
        return None
    strokes = _pale_strokes(ink, walls)
    return _walls(ink, ink.mask & ~strokes, None) if strokes.any() else walls


def _pale_strokes(ink: Ink, walls: WallMask) -> Mask:
    """Return strokes of doors and windows: as broad as thin walls, but paler and thinner than most walls."""
    tone = float(np.median(ink.gray[cv2.erode(walls.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0]))
    pale = (ink.mask & (ink.gray > tone + _PALER)).astype(np.uint8)
    # Opening removes the pale rims of dark walls, which are one or two pixels wide.
    _, found, stats, _ = cv2.connectedComponentsWithStats(
        cv2.morphologyEx(pale, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), connectivity=8
    )
    long = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    # Thickness of a strip of the same length and area.
    thick = stats[:, cv2.CC_STAT_AREA] / np.maximum(long, 1)
    pixel = ink.metres_per_pixel
    is_stroke = (long * pixel >= _STROKE_M) & (thick * pixel <= _THINNER * walls.thickness_m)
    is_stroke[0] = False
    strokes = is_stroke[np.asarray(found, dtype=np.int32)].astype(np.uint8)
    return (cv2.dilate(strokes, np.ones((5, 5), np.uint8)) > 0) & (pale > 0)


def outlined_walls(ink: Ink) -> WallMask | None:
    """Return walls drawn with two lines: the ink and the narrow white areas between its lines."""
    white = (~ink.mask).astype(np.uint8)
    count, found = cv2.connectedComponents(white, connectivity=4)
    labels = np.asarray(found, dtype=np.int32)
    depth = cv2.distanceTransform(white, cv2.DIST_L2, 5)
    half_cavity = 0.5 * _MAX_CAVITY_M / ink.metres_per_pixel
    is_cavity = ~_reaches(labels, depth > half_cavity, count) | _is_narrow(labels, depth, half_cavity, count)
    is_cavity[0] = False
    is_cavity &= _is_in_wall(labels, depth, is_cavity, ink)
    return _walls(ink, ink.mask | is_cavity[labels], np.where(is_cavity[labels], labels, 0))


def _is_narrow(labels: Labels, depth: Float[np.ndarray, "h w"], reach: float, count: int) -> Bool[np.ndarray, "n"]:
    """Return the white areas that are as narrow as a wall nearly everywhere, and only slightly wider elsewhere.

    `depth` is the distance from the ink, and `reach` half the width of the widest cavity, both in pixels.
    """
    area = np.bincount(labels.ravel(), minlength=count)
    # A wide part covers more pixels than the centres of its discs.
    wide = 3.0 * np.bincount(labels[depth > reach], minlength=count)
    return (wide <= _WIDE_PART * area) & ~_reaches(labels, depth > 1.5 * reach, count)


def _is_in_wall(
    labels: Labels, depth: Float[np.ndarray, "h w"], is_cavity: Bool[np.ndarray, "n"], ink: Ink
) -> Bool[np.ndarray, "n"]:
    """Return the white areas that lie in walls or between the strokes of a hatch, among those that are narrow enough.

    Furniture at a wall forms areas with the wall that are thick in both directions. Short areas at a wall must not be
    much thicker than the wall, and areas behind furniture must be strips of the usual width.
    """
    count, pixel = len(is_cavity), ink.metres_per_pixel
    area = np.maximum(np.bincount(labels.ravel(), minlength=count), 1)
    # The mean distance from the edges of a strip is a quarter of its width.
    width = np.maximum(4.0 * (np.bincount(labels.ravel(), depth.ravel(), minlength=count) / area - 0.5), 1.0)
    length = area / width
    filled = (ink.mask | is_cavity[labels]).astype(np.uint8)

    def is_thin(thickest: float) -> Bool[np.ndarray, "n"]:
        size = max(3, round(thickest))
        kernels = (np.ones((1, size), np.uint8), np.ones((size, 1), np.uint8))
        across, down = (cv2.morphologyEx(filled, cv2.MORPH_OPEN, kernel) > 0 for kernel in kernels)
        return np.bincount(labels[~(across & down)], minlength=count) >= _IN_WALL * area

    is_hatched = is_cavity & _is_hatched(labels, ink, count)
    thin = is_thin(_THICKEST_M / pixel)
    is_sure = is_hatched | (is_cavity & thin & (length * pixel >= _LONG_M))
    if not is_sure.any():
        return thin
    sure = is_sure[labels].astype(np.uint8)
    walls = cv2.morphologyEx(sure | ink.mask, cv2.MORPH_OPEN, np.ones((_min_thickness_px(ink),) * 2, np.uint8))
    usual, widest = (usual_thickness(walls, share) for share in (0.5, _WIDEST_WALLS))
    near = cv2.dilate(sure, np.ones((_LINES_PX,) * 2, np.uint8))
    is_beside = np.bincount(labels[near > 0], minlength=count) > 0
    inner = max(usual - 2.0 * _PEN_PX, 1.0)
    is_strip = (np.abs(width / inner - 1.0) <= _LIKE_USUAL) | (np.abs(width / inner - 0.4) <= _PANE)
    wide = np.bincount(labels[depth > 0.5 * (1.0 + _LIKE_USUAL) * inner + 1.0], minlength=count)
    is_strip &= (length >= _OBLONG * inner) & (wide <= _WIDE_IN_STRIP * area)
    # A strip has its width along all of its middle; the paper between fixtures and letters only has it on average.
    is_middle = (depth > 0.0) & (depth >= cv2.dilate(depth, np.ones((3, 3), np.uint8)) - 1e-3)
    is_off = is_middle & (np.abs(2.0 * depth - width[labels]) > _EVEN * width[labels])
    middle, off = (np.bincount(labels[where], minlength=count) for where in (is_middle, is_off))
    is_strip &= off <= _UNEVEN * middle
    is_like_wall = is_thin(min(_PIER * widest, _THICKEST_M / pixel)) & (width >= _THINNEST_PANE * inner)
    # Corners of a hatch are cut into small parts.
    is_corner = is_beside & (area <= np.median(area[is_hatched])) if is_hatched.any() else is_hatched
    return is_sure | (thin & (is_like_wall | ~is_beside)) | is_strip | is_corner


def _is_hatched(labels: Labels, ink: Ink, count: int) -> Bool[np.ndarray, "n"]:
    """Return the white areas that the parallel strokes of a hatch bound."""
    around = np.ones((3, 3), np.uint8)
    inked = ink.mask.astype(np.uint8)
    rims = np.bincount(labels[(cv2.dilate(inked, around) > 0) & ~ink.mask], minlength=count)
    found = np.zeros(count, bool)
    diagonal = np.eye(max(3, round(_STROKE_OF_HATCH_M / ink.metres_per_pixel / math.sqrt(2.0))), dtype=np.uint8)
    for kernel in (diagonal, diagonal[::-1].copy()):
        strokes = cv2.dilate(cv2.morphologyEx(inked, cv2.MORPH_OPEN, kernel), around)
        found |= np.bincount(labels[(strokes > 0) & ~ink.mask], minlength=count) > _HATCHED * rims
    return found


def _reaches(labels: Labels, where: Mask, count: int) -> Bool[np.ndarray, "n"]:
    """Return whether each labelled area has one of some pixels; a maximum per label takes ten times as long."""
    found = np.zeros(count, bool)
    found[labels[where]] = True
    return found


def _walls(ink: Ink, filled: Mask, cavities: Labels | None) -> WallMask | None:
    size = _min_thickness_px(ink)
    thick = cv2.morphologyEx(filled.astype(np.uint8), cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    # Strokes of furniture can be broad in scans, and leaves between two lines, but not as broad as walls.
    share, thinnest_m = _STROKE if cavities is None else _LEAF
    widest = round(min(share * usual_thickness(thick), thinnest_m / ink.metres_per_pixel))
    if widest > size:
        # The middles of even sizes would move walls off the panes between their lines.
        kernel, middle = np.ones((widest, widest), np.uint8), (widest - 1) // 2
        thick = cv2.dilate(cv2.erode(thick, kernel), kernel, anchor=(middle, middle))
    thickness = usual_thickness(thick) * ink.metres_per_pixel
    if thickness < _MIN_THICKNESS_M:
        return None  # Merged strokes of a hatch are not walls.
    thickness_range = _FILLED_RANGE if cavities is None else _OUTLINED_RANGE
    kept = _without_furniture(thick, thickness / ink.metres_per_pixel, ink.metres_per_pixel, thickness_range)
    if cavities is not None:
        # What is drawn across a wall of two lines cuts it into pieces; no opening is as narrow.
        notch = np.ones((round(_NOTCH_M / ink.metres_per_pixel) | 1,) * 2, np.uint8)
        closed = cv2.morphologyEx(kept.astype(np.uint8), cv2.MORPH_CLOSE, notch)
        # Without the rims along panes, which join notches.
        pair = np.ones((2, 2), np.uint8)
        filled = cv2.dilate(cv2.erode((closed & ~kept).astype(np.uint8), pair), pair, anchor=(0, 0))
        _, found, stats, _ = cv2.connectedComponentsWithStats(filled, connectivity=8)
        # Longer areas are panes of windows.
        kept |= (stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) <= 2 * len(notch))[np.asarray(found)]
    return WallMask(kept, thickness, cavities) if kept.any() else None


def _min_thickness_px(ink: Ink) -> int:
    return max(3, round(_MIN_THICKNESS_M / ink.metres_per_pixel))


def usual_thickness(mask: np.ndarray, share: float = 0.5) -> float:
    """Return the thickness of walls in pixels, a quantile by area; 0 without walls."""
    depth = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    ridge = (depth > 0.0) & (depth >= cv2.dilate(depth, np.ones((3, 3), np.uint8)) - 1e-3)
    values = np.sort(depth[ridge].astype(np.float64))
    if not len(values) or mask.all():
        return 0.0
    # By area: strokes of furniture can be longer than all walls.
    parts = np.cumsum(values)
    return 2.0 * float(values[np.searchsorted(parts, share * parts[-1])]) - 1.0


def _without_furniture(
    mask: np.ndarray, thickness: float, metres_per_pixel: float, thickness_range: tuple[float, float]
) -> Mask:
    """Drop small pieces that are not as thick as a wall, and discs. Corners between two windows are kept.

    `thickness` is the usual thickness of a wall (pixels); `thickness_range` is that of a kept piece, relative to it.
    """
    count, found, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    labels = np.asarray(found, dtype=np.int32)
    depth = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    sides = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    is_large = sides.max(axis=1) * metres_per_pixel >= _SMALL_M
    thinnest, thickest = (0.5 * (share * thickness + 1.0) for share in thickness_range)
    keep = is_large | (_reaches(labels, depth >= thinnest, count) & ~_reaches(labels, depth > thickest, count))
    # Circles are filled between two lines: outlets and lamps, drawn over openings.
    is_wide = (thickness_range == _FILLED_RANGE) | (sides.max(axis=1) > _DISC_OF_WALL * thickness)
    keep &= is_wide | (stats[:, cv2.CC_STAT_AREA] > _DISC * sides.prod(axis=1))
    keep[0] = False
    return keep[labels]


def wall_polygons(walls: WallMask, ink: Ink, check_time: CheckTime) -> list[shapely.Polygon]:
    """Return walls as straightened polygons in plan metres."""
    contours, hierarchy = cv2.findContours(walls.mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if hierarchy is None:
        return []
    straight = max(_STRAIGHT_PX * ink.metres_per_pixel, _STRAIGHT_M)
    if len(contours) > _MAX_OUTLINES:
        raise InvalidFloorPlanError(
            f"the dark areas as thick as walls in the picture have {len(contours)} outlines; the limit is "
            f"{_MAX_OUTLINES}; check the scale, and remove noise, hatches and patterns"
        )
    rings = [ink.to_plan(contour.reshape(-1, 2) + 0.5) for contour in contours]
    parents = hierarchy.reshape(-1, 4)[:, 3].tolist()
    holes: defaultdict[int, list[np.ndarray]] = defaultdict(list)
    for ring, parent in zip(rings, parents, strict=True):
        holes[parent] += [ring] if len(ring) >= 3 else []
    found: list[shapely.Polygon] = []
    for index, (ring, parent) in enumerate(zip(rings, parents, strict=True)):
        check_time()
        if parent >= 0 or len(ring) < 3:
            continue
        shell = shapely.Polygon(ring, holes[index])
        # Contours run through pixel centres, so the wall reaches half a pixel farther.
        grown = [part.buffer(0.5 * ink.metres_per_pixel, join_style="mitre") for part in polygons_of(shell)]
        found += [align_edges(part) for shape in grown for part in polygons_of(shape.simplify(straight))]
    return found


def align_edges(shape: shapely.Polygon) -> shapely.Polygon:
    """Align nearly axis-parallel edges with the axes; return the same polygon if that changes it too much."""
    rings = [_straight_ring(_sharp_ring(np.asarray(ring.coords)[:-1])) for ring in (shape.exterior, *shape.interiors)]
    straight = shapely.Polygon(rings[0], rings[1:])
    if not straight.is_valid or abs(straight.area - shape.area) > 0.05 * shape.area:
        return shape
    return straight


def _sharp_ring(points: np.ndarray) -> np.ndarray:
    """Sharpen corners that are rounded by pixels: short edges between two obtuse angles."""
    kept = list(points)
    index = 0
    while len(kept) > 4 and index < len(kept):
        before, a, b, after = (kept[(index + k) % len(kept)] for k in (-1, 0, 1, 2))
        first, edge, last = a - before, b - a, after - b
        lengths = [float(np.linalg.norm(step)) for step in (first, edge, last)]
        turns = cross(first, edge), cross(edge, last), cross(first, last)
        is_cut = 0.0 < lengths[1] < _CUT_CORNER_M and min(lengths[0], lengths[2]) > lengths[1]
        if is_cut and turns[0] * turns[1] > 0.0 and abs(turns[2]) > _SQUARE * lengths[0] * lengths[2]:
            kept[index] = a + first * (cross(edge, last) / turns[2])
            del kept[(index + 1) % len(kept)]
        index += 1
    return np.array(kept)


def _straight_ring(points: np.ndarray) -> np.ndarray:
    points = points.copy()
    steps = np.roll(points, -1, axis=0) - points
    slope = np.tan(np.radians(_ALONG_AXIS_DEG))
    for axis in (0, 1):
        along, across = np.abs(steps[:, 1 - axis]), np.abs(steps[:, axis])
        flat = (across <= slope * along) | ((across < _ALONG_AXIS_M) & (along > 2.0 * across))
        for index in np.flatnonzero(flat):
            following = (index + 1) % len(points)
            middle = 0.5 * (points[index, axis] + points[following, axis])
            points[[index, following], axis] = middle
    return points
