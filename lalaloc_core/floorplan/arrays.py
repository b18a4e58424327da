"""What the modules of this package share about arrays."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def frozen(array: np.ndarray) -> np.ndarray:
    """The array itself, from now on read-only."""
    array.flags.writeable = False
    return array


def ring_edges(ring_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 4"]:
    """Edges (x0, y0, x1, y1) of a ring that is not closed: the last joins its end with its beginning."""
    return np.concatenate([ring_m, np.roll(ring_m, -1, axis=0)], axis=1)
