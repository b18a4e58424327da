"""Symbols in walls: the leaf of a door or the lines of a window in a gap, and windows drawn into walls of two lines.

These are lines along the middle, closed at both ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.importers.common.geometry import opening_line
from lalaloc_core.importers.common.import_limits import CheckTime
from lalaloc_core.importers.common.sketch import SketchedOpening
from lalaloc_core.importers.drawing.enclosed_rooms import Gap
from lalaloc_core.importers.picture.ink import COLOURLESS, Ink, Mask, faint_lines
from lalaloc_core.importers.picture.symbol_shapes import Shape, closed_shapes
from lalaloc_core.importers.picture.wall_mask import WallMask

# Smallest inked shares of an arc, a leaf and the line of a pane; ink counts up to this distance (m), at least a pixel.
_ARC, _ARC_WITH_LEAF, _LEAF, _LINE, _ONE_LINE = 0.8, 0.55, 0.8, 0.7, 0.9
_NEAR_M, _COARSE_M, _DOOR_M = 0.017, 0.02, (0.5, 2.4)
# Leaves that are no full arc's: smallest share of one without an arc, and largest inked share beside a symbol.
_LEAF_ALONE, _BESIDE = 0.95, 0.45
# Lines of panes that a scan broke: smallest inked shares, of the whole line and of each quarter.
_BROKEN, _BROKEN_QUARTER = 0.35, 0.15
# Widths of bow windows (m), and their smallest and largest depths relative to them.
_BOW_M, _BOW = (0.8, 4.0), (0.08, 0.5)
# Contrast of 255: of a line's pixels, of the mean of a line at an edge of its gap, and between a line and the paper
# beside it; the part of a line's contrast that its pixels have; and of arcs as thin as a hair.
_FAINT, _DIP, _RISE, _OF_DEPTH, _HAIRLINE = 22.0, 30.0, 12.0, 0.25, 12.0
# A pane is a white strip between two lines of a window: long (m), thinner than its wall (share), and rectangular. Panes
# of a window are parallel (cosine), and few: hatches have more strips.
_MIN_LENGTH_M, _OF_WALL, _FULL, _LONG, _PARALLEL, _PANES = 0.4, (0.12, 0.72), 0.8, 3.0, 0.99, (2, 5)


@dataclass(frozen=True)
class GapContent:
    """Content of a gap.

    Attributes:
        kind: "swing" for the leaf of a door, "pane" for two or more lines along the wall, "line" for a single
            line, "leaf" for leaves without an arc, which show no opening alone.
        warmth: warmth of the lines, of 255: positive for red or brown, negative for blue.
        lines: number of lines along the wall.
        leaf_m: width of the leaf that swings, 0 without one.
    """

    kind: Literal["swing", "pane", "line", "leaf", "nothing"]
    confidence: float
    warmth: float = 0.0
    lines: int = 0
    leaf_m: float = 0.0


class GapReader:
    """Classifier of the gaps of one picture."""

    def __init__(self, ink: Ink, walls: WallMask) -> None:
        self._ink = ink
        # Arcs of few pixels are compared on a finer picture: their lines would cover what is drawn beside them.
        self._finer = math.ceil(ink.metres_per_pixel / _COARSE_M)
        gray, inked, wall = (
            cv2.resize(part.astype(np.uint8), None, fx=self._finer, fy=self._finer, interpolation=cv2.INTER_CUBIC)
            for part in (ink.gray, ink.lines, walls.mask)
        )
        hairlines = faint_lines(gray, ink.metres_per_pixel / self._finer, _HAIRLINE)
        reach = np.ones((2 * max(1, round(_NEAR_M / ink.metres_per_pixel)) + 1,) * 2, np.uint8)
        # Exclude walls, because a hatch would match any arc.
        drawn = [np.where(wall, 0, lines) for lines in (inked, inked | hairlines)]
        # There is no ink outside the picture.
        self._near, self._near_hairlines = (np.pad(cv2.dilate(lines, reach) > 0, 1) for lines in drawn)

    def classify(self, gap: Gap) -> GapContent:
        """Return the most likely content of a gap."""
        swing, leaves, alone = 0.0, 1, 0
        if _DOOR_M[0] <= gap.width <= _DOOR_M[1]:
            swing, leaves, alone = self._swing(gap, self._near)
            if swing < _ARC:
                swing, leaves, _ = self._swing(gap, self._near_hairlines, is_pale=True)
        found = GapContent("swing", swing, leaf_m=gap.width / leaves)
        if swing > _ARC and leaves == 1:
            return found
        lines, share, warmth, halves = self._lines(gap)
        if lines < 2 and gap.is_sure and gap.is_between_ends and _BOW_M[0] <= gap.width <= _BOW_M[1]:
            depths = np.arange(*_BOW, 2.0 * self._ink.metres_per_pixel / gap.width)
            bows = [self._lines(gap, side * float(depth)) for depth in depths for side in (1.0, -1.0)]
            bow = max(bows, key=lambda found: found[:2])
            if bow[0] >= 2 and bow[1] >= _ARC:
                return GapContent("pane", bow[1], bow[2], bow[0])
        if lines < 2 and halves >= 2:
            return GapContent("swing", _ARC)
        if swing > _ARC or (swing >= _ARC and (lines < 2 or share < _LINE)):
            return found
        if lines >= 2:
            return GapContent("pane", share, warmth, lines)
        if lines == 1 and share >= _ONE_LINE:
            return GapContent("line", share, warmth, lines)
        if alone:
            return GapContent("leaf", _ARC, leaf_m=gap.width / alone)
        return GapContent("nothing", 1.0 - max(swing, share if lines else 0.0))

    def _swing(self, gap: Gap, near: Mask, *, is_pale: bool = False) -> tuple[float, int, int]:
        """Return the drawn share of the best symbol of a door in a gap, its leaves, and the leaves without an arc.

        The symbol is a quarter circle about an end of the gap, or a part of it up to a leaf that stands half open. A
        pale arc must stand out from what is drawn beside it, and a leaf without an arc touches nothing. What lies
        within the wall is not compared: the lines of a window would match any arc.
        """
        half, reach = 0.5 * gap.shape.area / gap.width**2, np.arange(0.16, 1.25, 0.04)
        # Number of leaves, side, hinge, its place across the wall, angle, and distance from the hinge.
        count, side, hinge, offset, angle, distance = np.meshgrid(
            [1.0, 2.0], [1.0, -1.0], [0.0, 1.0], [half, 0.0, -half], np.radians(np.arange(12.0, 103.0, 2.0)), reach,
            indexing="ij", sparse=True,
        )  # fmt: skip
        x = hinge + (1.0 - 2.0 * hinge) * distance / count * np.cos(angle)
        y = offset + side * distance / count * np.sin(angle)
        start, end = self._finer * self._ink.to_pixels(np.array([gap.start, gap.end]))
        columns, rows = (start[k] + 1.0 + x * (end - start)[k] + (2 * k - 1) * y * (end - start)[1 - k] for k in (0, 1))
        inside = (rows.clip(0, near.shape[0] - 1).astype(np.intp), columns.clip(0, near.shape[1] - 1).astype(np.intp))
        is_inked = near[inside] & (np.abs(y) > half)
        # Radii are 0.92, 0.96, 1 and 1.04 of the width, and angles of the arc are at most 82 degrees.
        arcs = is_inked[..., :36, 19:23]
        leaves = is_inked[..., :21].mean(axis=-1)
        shares = arcs.mean(axis=-2)
        if is_pale:
            beside = np.maximum(is_inked[..., :36, 15:19].mean(axis=-2), is_inked[..., :36, 23:27].mean(axis=-2))
            shares = np.where(beside <= _BESIDE, shares, 0.0)
        has_leaf = (shares >= _ARC_WITH_LEAF) & (leaves[..., 39:40] >= _LEAF)
        shares = np.where(has_leaf, np.maximum(shares, _ARC), shares)
        # Leaves at 24 to 90 degrees with nothing beside them, and the arc up to six degrees before those to 76 degrees.
        outer, tips = is_inked[..., 9:21].mean(axis=-1), is_inked[..., 19:23].mean(axis=-1)
        beside, at_tip = (np.maximum(part[..., :34], part[..., 12:]) for part in (outer, tips))
        is_free = np.maximum(beside, is_inked[..., 6:40, 25:].mean(axis=-1)) <= _BESIDE
        up_to = (np.cumsum(arcs, axis=-2) / np.arange(1, 37)[:, None])[..., 3:30, :].max(axis=-1)
        leaf = leaves[..., 6:33]
        slanted = np.where(is_free[..., :27] & (up_to >= _ARC) & (leaf >= _LEAF), 0.5 * (leaf + up_to), 0.0)
        best = np.maximum(shares.max(axis=(-2, -1)), slanted.max(axis=(-2, -1)))
        alone = (is_free & (at_tip <= _BESIDE) & (leaves[..., 6:40] >= _LEAF_ALONE)).any(axis=(-2, -1))
        # Both of two leaves must be visible.
        one, two = float(best[0].max()), float(best[1].min(axis=-1).max())
        without_arc = 1 if alone[0].any() else 2 * int(alone[1].all(axis=-1).any())
        return (two, 2, without_arc) if two > one else (one, 1, without_arc)

    def _lines(self, gap: Gap, bow: float = 0.0) -> tuple[int, float, float, int]:
        """Return the number of lines from jamb to jamb, the inked share of the second best line, and their warmth.

        The last is the number of lines at one of the jambs alone, as of sliding leaves. The mean of pixels along a line
        reveals even faint ones. `bow` is the depth of a curve that they follow, relative to the gap's width.
        """
        start, end = np.array(gap.start), np.array(gap.end)
        along = (end - start) / gap.width
        across = np.array([-along[1], along[0]])
        # Curves are many, and are sampled half as finely.
        pixel, step = self._ink.metres_per_pixel, (0.25 if bow == 0.0 else 0.5) * self._ink.metres_per_pixel
        half = 0.5 * gap.shape.area / gap.width + 2.0 * pixel
        offsets = np.arange(-half, half + step, step)
        reach = np.linspace(0.08, 0.92, max(8, math.ceil(0.25 * gap.width / step)))
        places = offsets[:, None] + 4.0 * bow * gap.width * (reach * (1.0 - reach))[None]
        points = start + (reach * gap.width)[None, :, None] * along + places[..., None] * across
        columns, rows = (self._ink.to_pixels(points.reshape(-1, 2)) - 0.5).astype(np.float32).T
        maps = columns.reshape(len(offsets), len(reach)), rows.reshape(len(offsets), len(reach))
        values = cv2.remap(self._ink.gray, *maps, cv2.INTER_LINEAR, borderValue=255)
        found, halves = dict[int, float](), 0
        for index, level in _dips(values.mean(axis=1)):
            depth = level - float(values[index].mean())
            inked = values[index] < level - min(_FAINT, _OF_DEPTH * depth)
            quarters = [float(part.mean()) for part in np.array_split(inked, 4)]
            halves += max(quarters[0], quarters[3]) >= _LEAF and min(quarters[0], quarters[3]) <= 1.0 - _LEAF
            is_broken = bow == 0.0 and inked.mean() >= _BROKEN and min(quarters) >= _BROKEN_QUARTER
            if is_broken or inked.mean() >= _LINE:
                found[index] = float(inked.mean())
        best = sorted(found.values(), reverse=True)
        warmth = 0.0
        if found and self._ink.warmth is not None:
            colours = cv2.remap(self._ink.warmth, *maps, cv2.INTER_LINEAR, borderValue=COLOURLESS)
            warmth = float(colours[list(found)].mean()) - COLOURLESS
        return len(best), best[1] if len(best) > 1 else (best[0] if best else 0.0), warmth, halves


def _dips(profile: Float[np.ndarray, "n"]) -> list[tuple[int, float]]:
    """Return the indices of a profile's minima that a rise separates, each with the level of the paper beside it."""
    # Extremes in turn, each found by the change that follows it: a low, a high, a low, and so on.
    extremes, extreme, sign = list[int](), 0, 1.0
    for index, value in enumerate(profile):
        change = sign * (value - profile[extreme])
        if change > _RISE:
            extremes.append(extreme)
            sign = -sign
        if change < 0.0 or change > _RISE:
            extreme = index
    lows = [*extremes, extreme][::2]
    found = []
    for before, low, after in zip([0, *lows], lows, [*lows[1:], len(profile)], strict=False):
        level = float(min(profile[before : low + 1].max(), profile[low:after].max()))
        if level - profile[low] > _RISE:
            found.append((low, level))
        elif profile[low] < 255.0 - _DIP:
            found.append((low, 255.0))
    return found


def windows_in_walls(walls: WallMask, ink: Ink, check_time: CheckTime) -> list[SketchedOpening]:
    """Return the windows: groups of panes that lie side by side in a wall. `check_time` raises an exception to stop."""
    if walls.cavities is None:
        return []
    # Cavities outside the walls are furniture.
    cavities = replace(ink, mask=~(walls.mask & (walls.cavities > 0)))
    thinnest_m, thickest_m = (share * walls.thickness_m for share in _OF_WALL)
    panes = [
        strip
        for strip in closed_shapes(cavities, (_FULL * _MIN_LENGTH_M * thinnest_m, math.inf))
        if strip.long_m >= max(_MIN_LENGTH_M, _LONG * strip.short_m)
        and thinnest_m <= strip.short_m - ink.metres_per_pixel <= thickest_m
        and strip.filled >= _FULL
    ]
    found: list[SketchedOpening] = []
    while panes:
        check_time()
        group = [panes[0]]
        for pane in panes[1:]:
            if _side_by_side(group[-1], pane, 0.5 * walls.thickness_m):
                group.append(pane)
        panes = [pane for pane in panes if pane not in group]
        if _PANES[0] <= len(group) <= _PANES[1]:
            ends = opening_line(shapely.Polygon(Shape.around(group).box))
            assert ends is not None
            found.append(SketchedOpening("window", *ends))
    return found


def _side_by_side(first: Shape, second: Shape, line_m: float) -> bool:
    """Return whether two strips lie along each other, at most a line apart."""
    shorter, longer = sorted((first.long_m, second.long_m))
    apart = abs(float((first.centre - second.centre) @ first.axis))
    is_alike = shorter > 0.8 * longer and apart < 0.2 * longer and abs(float(first.axis @ second.axis)) >= _PARALLEL
    return is_alike and bool(shapely.distance(first.outline, second.outline) <= line_m)
