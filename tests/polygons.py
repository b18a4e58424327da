"""Comparing polygons."""

from __future__ import annotations

import numpy as np


def same_ring(one: np.ndarray, other: np.ndarray, tolerance_m: float) -> bool:
    """Whether two rings (n, 2) have the same vertices in the same order, whichever comes first."""
    if one.shape != other.shape:
        return False
    shifts = (np.roll(one, shift, axis=0) for shift in range(len(one)))
    return any(np.abs(shifted - other).max() <= tolerance_m for shifted in shifts)
