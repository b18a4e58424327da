"""Windows drawn into walls of two lines: lines along the middle, closed at both ends."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import shapely

from lalaloc_core.importers.common.sketch import SketchedOpening
from lalaloc_core.importers.picture.ink import Ink
from lalaloc_core.importers.picture.wall_mask import WallMask

# A pane is a white strip between two lines of a window: long (m), thinner than its wall (share), and rectangular.
_MIN_LENGTH_M, _OF_WALL = 0.4, (0.12, 0.72)
_FULL, _LONG = 0.8, 3.0
_SLANTED_DEG = 8.0


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
    labels = np.where(walls.mask, walls.cavities, 0).astype(np.int32)
    compact = np.unique(labels, return_inverse=True)
    names, index = compact[0], compact[1].reshape(labels.shape)
    thickness = walls.thickness_m / ink.metres_per_pixel
    found = []
    boxes = _boxes(index, len(names))
    for label, (x0, y0, x1, y1) in enumerate(boxes):
        if names[label] == 0 or max(x1 - x0, y1 - y0) * ink.metres_per_pixel < _MIN_LENGTH_M:
            continue
        check_time()
        part = (index[y0:y1, x0:x1] == label).astype(np.uint8)
        points = np.argwhere(part)[:, ::-1].astype(np.float32)
        (cx, cy), (width, height), angle = cv2.minAreaRect(points)
        width, height = width + 1.0, height + 1.0
        long, short = max(width, height), min(width, height)
        if long * ink.metres_per_pixel < _MIN_LENGTH_M or long < _LONG * short:
            continue
        if not _OF_WALL[0] * thickness <= short <= _OF_WALL[1] * thickness or part.sum() < _FULL * long * short:
            continue
        corners = cv2.boxPoints(((cx + x0 + 0.5, cy + y0 + 0.5), (width, height), angle))
        found.append((corners, angle if width >= height else angle + 90.0))
    return found


def _boxes(index: np.ndarray, count: int) -> list[tuple[int, int, int, int]]:
    """Return the bounding boxes of all labels."""
    rows, columns = index.shape
    low_x, low_y = np.full(count, columns), np.full(count, rows)
    high_x, high_y = np.zeros(count, int), np.zeros(count, int)
    ys, xs = np.nonzero(index)
    labels = index[ys, xs]
    np.minimum.at(low_x, labels, xs)
    np.minimum.at(low_y, labels, ys)
    np.maximum.at(high_x, labels, xs + 1)
    np.maximum.at(high_y, labels, ys + 1)
    return [(int(a), int(b), int(c), int(d)) for a, b, c, d in zip(low_x, low_y, high_x, high_y, strict=True)]


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
