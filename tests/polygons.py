"""Comparison of polygons."""

from __future__ import annotations

import numpy as np


def same_ring(first: np.ndarray, second: np.ndarray, tolerance_m: float) -> bool:
    """Return True if two rings (n, 2) have the same vertices in the same cyclic order."""
    if first.shape != second.shape:
        return False
    shifts = (np.roll(first, shift, axis=0) for shift in range(len(first)))
    return any(np.abs(shifted - second).max() <= tolerance_m for shifted in shifts)
