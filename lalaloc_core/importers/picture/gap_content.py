"""Content of gaps in walls: the arc of a door, the lines of a window, or nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float

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
