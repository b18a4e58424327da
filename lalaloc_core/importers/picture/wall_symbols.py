"""Symbols in walls: the arc of a door or the lines of a window in a gap, and windows drawn into walls of two lines.

These are lines along the middle, closed at both ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.importers.common.sketch import SketchedOpening
from lalaloc_core.importers.drawing.enclosed_rooms import Gap
from lalaloc_core.importers.picture.ink import COLOURLESS, Ink
from lalaloc_core.importers.picture.wall_mask import WallMask

# Smallest inked shares of an arc, a leaf and the line of a pane; ink counts up to this distance (pixels).
_ARC, _ARC_WITH_LEAF, _LEAF, _LINE, _ONE_LINE = 0.8, 0.55, 0.8, 0.7, 0.9
_NEAR_PX = 2
_DOOR_M = (0.5, 2.4)
_ARC_POINTS = 28
# Contrast of 255: of a line's pixels, of a line's mean, and of the paper between two lines.
_FAINT, _DIP, _RISE = 22.0, 30.0, 12.0
# A pane is a white strip between two lines of a window: long (m), thinner than its wall (share), and rectangular.
_MIN_LENGTH_M, _OF_WALL = 0.4, (0.12, 0.72)
_FULL, _LONG = 0.8, 3.0
_SLANTED_DEG = 8.0


@dataclass(frozen=True)
class GapContent:
    """Content of a gap.

    Attributes:
        kind: "swing" for the arc of a door, "pane" for two or more lines along the wall, "line" for a single line.
        warmth: warmth of the lines, of 255: positive for red or brown, negative for blue.
        leaf_m: width of the leaf that swings, 0 without one.
    """

    kind: Literal["swing", "pane", "line", "nothing"]
    confidence: float
    warmth: float = 0.0
    leaf_m: float = 0.0


class GapReader:
    """Classifier of the gaps of one picture."""

    def __init__(self, ink: Ink, walls: WallMask) -> None:
        self._ink = ink
        reach = 2 * _NEAR_PX - 1
        # Exclude walls, because a hatch would match any arc.
        lines = ink.lines & ~walls.mask
        self._near = cv2.dilate(lines.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0

    def classify(self, gap: Gap) -> GapContent:
        """Return the most likely content of a gap."""
        arc, leaves = self._arc(gap) if _DOOR_M[0] <= gap.width <= _DOOR_M[1] else (0.0, 1)
        if arc >= _ARC:
            return GapContent("swing", arc, leaf_m=gap.width / leaves)
        lines, share, warmth = self._lines(gap)
        if lines >= 2:
            return GapContent("pane", share, warmth)
        if lines == 1 and share >= _ONE_LINE:
            return GapContent("line", share, warmth)
        return GapContent("nothing", 1.0 - max(arc, share if lines else 0.0))

    def _arc(self, gap: Gap) -> tuple[float, int]:
        """Return the inked share of the best quarter circle about an end of the gap, and the number of leaves."""
        start, end = np.array(gap.start), np.array(gap.end)
        along = (end - start) / gap.width
        across = np.array([-along[1], along[0]])
        half = 0.5 * gap.shape.area / gap.width
        best = 0.0, 1
        for leaves in (1, 2):
            for side in (1.0, -1.0):
                hinges = [self._best_swing(start, along, side * across, half, gap.width / leaves)]
                hinges.append(self._best_swing(end, -along, side * across, half, gap.width / leaves))
                # Both of two leaves must be visible.
                share = max(hinges) if leaves == 1 else min(hinges)
                if share > best[0]:
                    best = share, leaves
        return best

    def _best_swing(
        self,
        hinge: Float[np.ndarray, "2"],
        along: Float[np.ndarray, "2"],
        across: Float[np.ndarray, "2"],
        half_wall: float,
        width: float,
    ) -> float:
        angles = np.radians(np.linspace(12.0, 82.0, _ARC_POINTS))
        best = 0.0
        for offset in (half_wall, 0.0, -half_wall):
            centre = hinge + offset * across
            for radius in width * np.array([1.0, 0.96, 0.92, 1.04]):
                arc = centre + radius * (np.cos(angles)[:, None] * along + np.sin(angles)[:, None] * across)
                share = self._inked_share(arc)
                if _ARC_WITH_LEAF <= share < _ARC:
                    reach = np.linspace(0.15, 0.95, _ARC_POINTS)[:, None]
                    leaf = self._inked_share(centre + radius * reach * across)
                    share = max(share, _ARC if leaf >= _LEAF else 0.0)
                best = max(best, share)
        return best

    def _lines(self, gap: Gap) -> tuple[int, float, float]:
        """Return the number of lines from jamb to jamb, the inked share of the second best line, and their warmth.

        The mean of the pixels along a line reveals even thin and faint lines.
        """
        start, end = np.array(gap.start), np.array(gap.end)
        along = (end - start) / gap.width
        across = np.array([-along[1], along[0]])
        pixel = self._ink.metres_per_pixel
        half = 0.5 * gap.shape.area / gap.width + 2.0 * pixel
        offsets = np.arange(-half, half + 0.25 * pixel, 0.25 * pixel)
        reach = np.linspace(0.08, 0.92, max(8, math.ceil(gap.width / pixel)))
        points = start + (reach * gap.width)[None, :, None] * along + offsets[:, None, None] * across
        columns, rows = (self._ink.to_pixels(points.reshape(-1, 2)) - 0.5).astype(np.float32).T
        maps = columns.reshape(len(offsets), len(reach)), rows.reshape(len(offsets), len(reach))
        values = cv2.remap(self._ink.gray, *maps, cv2.INTER_LINEAR, borderValue=255)
        profile = values.mean(axis=1)
        shares = (values < 255.0 - _FAINT).mean(axis=1)
        found = [index for index in _dips(profile) if shares[index] >= _LINE]
        best = sorted((float(shares[index]) for index in found), reverse=True)
        warmth = 0.0
        if found and self._ink.warmth is not None:
            colours = cv2.remap(self._ink.warmth, *maps, cv2.INTER_LINEAR, borderValue=COLOURLESS)
            warmth = float(colours[found].mean()) - COLOURLESS
        return len(best), best[1] if len(best) > 1 else (best[0] if best else 0.0), warmth

    def _inked_share(self, points_m: Float[np.ndarray, "n 2"]) -> float:
        """Return the share of points near ink; there is none outside the picture."""
        columns, rows = np.floor(self._ink.to_pixels(points_m)).astype(int).T
        height, width = self._near.shape
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        return float(self._near[rows[inside], columns[inside]].sum() / len(rows))


def _dips(profile: Float[np.ndarray, "n"]) -> list[int]:
    """Return the indices of a profile's minima that are darker than paper and separated by a rise."""
    found: list[int] = []
    lowest = highest = 0
    falling = True
    for index, value in enumerate(profile):
        if falling:
            if value < profile[lowest]:
                lowest = index
            elif value > profile[lowest] + _RISE:
                if profile[lowest] < 255.0 - _DIP:
                    found.append(lowest)
                falling, highest = False, index
        elif value > profile[highest]:
            highest = index
        elif value < profile[highest] - _RISE:
            falling, lowest = True, index
    if falling and profile[lowest] < 255.0 - _DIP:
        found.append(lowest)
    return found


def windows_in_walls(walls: WallMask, ink: Ink, check_time: Callable[[], None]) -> list[SketchedOpening]:
    """Return the windows: groups of panes that lie side by side in a wall. `check_time` raises an exception to stop."""
    if walls.cavities is None:
        return []
    panes = _panes(walls, ink, check_time)
    found: list[SketchedOpening] = []
    used: set[int] = set()
    for i, (first, angle) in enumerate(panes):
        check_time()
        if i in used:
            continue
        group = [first]
        for j in range(i + 1, len(panes)):
            second, second_angle = panes[j]
            apart = abs((angle - second_angle + 90.0) % 180.0 - 90.0)
            if j not in used and apart < _SLANTED_DEG and _side_by_side(group[-1], second, ink, walls):
                group.append(second)
                used.add(j)
        if len(group) >= 2:
            found.append(_window(group, ink))
    return found


def _panes(walls: WallMask, ink: Ink, check_time: Callable[[], None]) -> list[tuple[np.ndarray, float]]:
    """Return the corners (pixels) and direction (degrees) of every strip that could be a pane."""
    assert walls.cavities is not None
    # Cavities outside the walls are furniture.
    rows, columns = np.nonzero(np.where(walls.mask, walls.cavities, 0))
    labels = walls.cavities[rows, columns]
    order = np.argsort(labels, kind="stable")
    points, begins = np.column_stack([columns, rows])[order], np.flatnonzero(np.diff(labels[order], prepend=0))
    sizes, pixel_m = np.diff(begins, append=len(points)), ink.metres_per_pixel
    thickness = walls.thickness_m / pixel_m
    found = []
    # Most cavities are tiny.
    large = sizes * pixel_m >= _FULL * _MIN_LENGTH_M
    for begin, size in zip(begins[large].tolist(), sizes[large].tolist(), strict=True):
        part = points[begin : begin + size]
        if (np.ptp(part, axis=0).max() + 1) * pixel_m < _MIN_LENGTH_M:
            continue
        check_time()
        x0, y0 = part.min(axis=0).tolist()
        (cx, cy), (width, height), angle = cv2.minAreaRect((part - [x0, y0]).astype(np.float32))
        width, height = width + 1.0, height + 1.0
        long, short = max(width, height), min(width, height)
        if long * pixel_m < _MIN_LENGTH_M or long < _LONG * short:
            continue
        if not _OF_WALL[0] * thickness <= short <= _OF_WALL[1] * thickness or size < _FULL * long * short:
            continue
        corners = cv2.boxPoints(((cx + x0 + 0.5, cy + y0 + 0.5), (width, height), angle))
        found.append((corners, angle if width >= height else angle + 90.0))
    return found


def _side_by_side(first: np.ndarray, second: np.ndarray, ink: Ink, walls: WallMask) -> bool:
    """Return whether two strips lie along each other, one line apart."""
    a, b = shapely.Polygon(first), shapely.Polygon(second)
    line = 0.5 * walls.thickness_m / ink.metres_per_pixel
    if shapely.distance(a, b) > line:
        return False
    lengths = sorted(max(_sides(corners)) for corners in (first, second))
    shared = a.buffer(line, cap_style="square", join_style="mitre").intersection(b)
    return lengths[0] > 0.8 * lengths[1] and shared.length > lengths[0]


def _sides(corners: np.ndarray) -> tuple[float, float]:
    return float(np.linalg.norm(corners[1] - corners[0])), float(np.linalg.norm(corners[2] - corners[1]))


def _window(group: list[np.ndarray], ink: Ink) -> SketchedOpening:
    corners = cv2.boxPoints(cv2.minAreaRect(np.concatenate(group).astype(np.float32)))
    if np.linalg.norm(corners[1] - corners[0]) < np.linalg.norm(corners[2] - corners[1]):
        corners = np.roll(corners, -1, axis=0)
    ends = ink.to_plan(np.array([0.5 * (corners[0] + corners[3]), 0.5 * (corners[1] + corners[2])]))
    (x0, y0), (x1, y1) = ends
    return SketchedOpening("window", (float(x0), float(y0)), (float(x1), float(y1)))
