"""The poses of a grid as the first look of a search (`coarse_pass.py`) sees them: distances in bins, and openings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from lalaloc_core.conventions import OPENING_CLASSES, WALL_CODE
from lalaloc_core.localise.layouts import Layouts

# Azimuths that are looked at.
_AZIMUTHS = 16
# Width of the bins of log distance: 5 cm at a distance of 1 m.
_BIN = 0.05
# Walls are that far (m) from the poses of a grid, or count as nearer or farther ones.
_MIN_DISTANCE_M, _MAX_DISTANCE_M = 0.1, 500.0
# Classes of openings that have a row at every azimuth: all but walls.
OPENING_ROWS = len(OPENING_CLASSES) - 1


@dataclass(frozen=True, eq=False)
class BinnedLayouts:
    """What the first look sees of the poses of a grid.

    Attributes:
        rows: (n, a b + a k) a one for every azimuth at its bin, and at the opening that is met there.
        columns: (a,) the azimuth columns that are looked at.
        bins: (b,) log distances (m) at the centres of the bins.
    """

    rows: scipy.sparse.csr_array
    columns: Int[np.ndarray, "a"]
    bins: Float[np.ndarray, "b"]

    @classmethod
    def of(cls, layouts: Layouts) -> BinnedLayouts:
        """The layouts of some poses, binned."""
        width = layouts.log_profile.shape[1]
        count = min(_AZIMUTHS, width)
        columns = np.arange(count) * width // count
        log_m = layouts.log_profile[:, columns].astype(np.float32)
        log_m = np.clip(log_m, math.log(_MIN_DISTANCE_M), math.log(_MAX_DISTANCE_M))
        number = np.floor(log_m / _BIN).astype(np.int32)
        low, bins = int(number.min()), int(np.ptp(number)) + 1
        at = number - low + np.arange(count, dtype=np.int32) * bins
        present = np.ones(at.shape, bool)
        if layouts.kind is not None:
            kind = layouts.kind[:, columns].astype(np.int32)
            opening = count * bins + np.arange(count, dtype=np.int32) * OPENING_ROWS + kind - 1
            at, present = np.concatenate([at, opening], axis=1), np.concatenate([present, kind != WALL_CODE], axis=1)
        begin = np.concatenate([[0], np.cumsum(present.sum(axis=1))]).astype(np.int32)
        # Of the narrowest type, so that products are of the type of what they are taken with.
        ones = np.ones(int(begin[-1]), np.int8)
        rows = scipy.sparse.csr_array((ones, at[present], begin), shape=(len(layouts), count * (bins + OPENING_ROWS)))
        return cls(rows, columns, (_BIN * (low + 0.5 + np.arange(bins))).astype(np.float32))

    def __len__(self) -> int:
        return len(self.rows.indptr) - 1

    @property
    def nbytes(self) -> int:
        """Memory that the arrays take."""
        return self.rows.data.nbytes + self.rows.indices.nbytes + self.rows.indptr.nbytes
