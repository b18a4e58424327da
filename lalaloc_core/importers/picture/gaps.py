"""What stands in a gap of a wall: the arc of a door, the lines of a window, or nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float

from lalaloc_core.importers.drawing.walls import Gap
from lalaloc_core.importers.picture.ink import COLOURLESS, Ink
from lalaloc_core.importers.picture.masks import WallMask

# Shares of an arc, of a leaf, of a pane's line that must be inked; ink this near counts (pixels).
_ARC, _ARC_WITH_LEAF, _LEAF, _LINE, _ONE_LINE = 0.8, 0.55, 0.8, 0.7, 0.9
_NEAR_PX = 2
_DOOR_M = (0.5, 2.4)
_ARC_POINTS = 28
# Of 255: how much darker than paper a line's pixels are, its mean is, and how far the paper rises between two lines.
_FAINT, _DIP, _RISE = 22.0, 30.0, 12.0


@dataclass(frozen=True)
class GapContent:
    """What was seen in a gap, and how sure that is (0 to 1).

    `swing`: the arc of a door; `pane`: two or more lines along the wall; `line`: a single one. `warmth` is that of
    these lines, of 255: above 0 they are red or brown, below blue.
    """

    kind: Literal["swing", "pane", "line", "nothing"]
    confidence: float
    warmth: float = 0.0


class GapReader:
    """Looks into gaps of one picture."""

    def __init__(self, ink: Ink, walls: WallMask) -> None:
        self._ink = ink
        reach = 2 * _NEAR_PX - 1
        # Lines of a hatch would make an arc of any.
        lines = ink.lines & ~walls.mask
        self._near = cv2.dilate(lines.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0

    def look(self, gap: Gap) -> GapContent:
        """The most likely content of a gap."""
        arc = self._arc(gap) if _DOOR_M[0] <= gap.width <= _DOOR_M[1] else 0.0
        if arc >= _ARC:
            return GapContent("swing", arc)
        lines, share, warmth = self._lines(gap)
        if lines >= 2:
            return GapContent("pane", share, warmth)
        if lines == 1 and share >= _ONE_LINE:
            return GapContent("line", share, warmth)
        return GapContent("nothing", 1.0 - max(arc, share if lines else 0.0))

    def _arc(self, gap: Gap) -> float:
        """How much of the best quarter circle about an end of the gap is inked, one leaf or two."""
        start, end = np.array(gap.start), np.array(gap.end)
        along = (end - start) / gap.width
        across = np.array([-along[1], along[0]])
        half = 0.5 * gap.shape.area / gap.width
        best = 0.0
        for leaves in (1, 2):
            for side in (1.0, -1.0):
                hinges = [self._best_swing(start, along, side * across, half, gap.width / leaves)]
                hinges.append(self._best_swing(end, -along, side * across, half, gap.width / leaves))
                # Of two leaves, both must be seen.
                best = max(best, max(hinges) if leaves == 1 else min(hinges))
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
                share = self._inked(arc)
                if _ARC_WITH_LEAF <= share < _ARC:
                    reach = np.linspace(0.15, 0.95, _ARC_POINTS)[:, None]
                    leaf = self._inked(centre + radius * reach * across)
                    share = max(share, _ARC if leaf >= _LEAF else 0.0)
                best = max(best, share)
        return best

    def _lines(self, gap: Gap) -> tuple[int, float, float]:
        """(lines that run from jamb to jamb within the wall, how much of the second best is inked, their warmth).

        Along a pane's line the mean of many pixels stands out of the paper, be it as thin and faint as it may.
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
        place = columns.reshape(len(offsets), len(reach)), rows.reshape(len(offsets), len(reach))
        values = cv2.remap(self._ink.gray, *place, cv2.INTER_LINEAR, borderValue=255)
        profile = values.mean(axis=1)
        shares = (values < 255.0 - _FAINT).mean(axis=1)
        found = [index for index in _dips(profile) if shares[index] >= _LINE]
        best = sorted((float(shares[index]) for index in found), reverse=True)
        warmth = 0.0
        if found and self._ink.warmth is not None:
            colours = cv2.remap(self._ink.warmth, *place, cv2.INTER_LINEAR, borderValue=COLOURLESS)
            warmth = float(colours[found].mean()) - COLOURLESS
        return len(best), best[1] if len(best) > 1 else (best[0] if best else 0.0), warmth

    def _inked(self, points_m: Float[np.ndarray, "n 2"]) -> float:
        return float(self._values(points_m, self._near).mean())

    def _values(self, points_m: Float[np.ndarray, "n 2"], mask: np.ndarray) -> np.ndarray:
        pixels = self._ink.to_pixels(points_m)
        columns, rows = np.floor(pixels).astype(int).T
        inside = (rows >= 0) & (rows < mask.shape[0]) & (columns >= 0) & (columns < mask.shape[1])
        values = np.zeros(len(pixels), dtype=bool)
        values[inside] = mask[rows[inside], columns[inside]]
        return values


def _dips(profile: Float[np.ndarray, "n"]) -> list[int]:
    """Where a profile has its minima: each below the paper, and apart from the next by a rise."""
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
