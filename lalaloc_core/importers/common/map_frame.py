"""Frame of a map's grid of cells."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class MapFrame:
    """Grid of a map.

    Attributes:
        resolution_m: size of a cell.
        origin: place of the lower left corner (m) and the grid's counter-clockwise rotation in the map frame.
        size: rows and columns.
    """

    resolution_m: float
    origin: tuple[float, float, float]
    size: tuple[int, int]

    def to_map(self, points_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert points (m) from the lower left corner along the grid to the map frame."""
        x, y, yaw = self.origin
        c, s = math.cos(yaw), math.sin(yaw)
        return points_m @ np.array([[c, s], [-s, c]]) + np.array([x, y])

    def cells(self, row: int) -> Float[np.ndarray, "n 2"]:
        """Return the centres of a row's cells in the map frame; rows are from the top."""
        rows, columns = self.size
        x, y = np.arange(columns), np.full(columns, rows - 1 - row)
        return self.to_map((np.column_stack([x, y]) + 0.5) * self.resolution_m)
