"""Layouts of grid poses as the coarse pass (`coarse_pass.py`) compares them: binned distances, and openings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from lalaloc_core.conventions import OPENING_CLASSES, WALL_CODE
from lalaloc_core.localise.match.layouts import Layouts

# Azimuths that are compared: with spheres, and with views, which show a part of them.
SPHERE_AZIMUTHS, VIEW_AZIMUTHS = 16, 64
# Width of the bins of log distance: 5 cm at a distance of 1 m.
_BIN = 0.05
# Distances (m) are clipped to this range.
_MIN_DISTANCE_M, _MAX_DISTANCE_M = 0.1, 500.0
# Poses of a part: the sums of their costs stay in the processor's cache.
_PART = 512
# Opening classes with a row at every azimuth: all but walls.
OPENING_ROWS = len(OPENING_CLASSES) - 1


@dataclass(frozen=True, eq=False)
class BinnedLayouts:
    """Binned layouts of n poses.

    Attributes:
        rows: (n, a b + a k) ones, for every azimuth at its bin, and at its opening class if it is not a wall.
        columns: (a,) the azimuth columns that are compared.
        bins: (b,) log distances (m) at the centres of the bins.
    """

    rows: scipy.sparse.csr_array
    columns: Int[np.ndarray, "a"]
    bins: Float[np.ndarray, "b"]

    @classmethod
    def of(cls, layouts: Layouts, azimuths: int = SPHERE_AZIMUTHS) -> BinnedLayouts:
        """Bin layouts at a number of azimuths."""
        width = layouts.log_profile.shape[1]
        count = min(azimuths, width)
        columns = np.arange(count) * width // count
        log_m = layouts.log_profile[:, columns].astype(np.float32)
        log_m = np.clip(log_m, math.log(_MIN_DISTANCE_M), math.log(_MAX_DISTANCE_M))
        number = np.floor(log_m / _BIN).astype(np.int32)
        low, bins = int(number.min()), int(np.ptp(number)) + 1
        place = number - low + np.arange(count, dtype=np.int32) * bins
        present = np.ones(place.shape, bool)
        if layouts.kind is not None:
            kind = layouts.kind[:, columns].astype(np.int32)
            opening = count * bins + np.arange(count, dtype=np.int32) * OPENING_ROWS + kind - 1
            place = np.concatenate([place, opening], axis=1)
            present = np.concatenate([present, kind != WALL_CODE], axis=1)
        begin = np.concatenate([[0], np.cumsum(present.sum(axis=1))]).astype(np.int32)
        # The narrowest type, so that products keep the type of the dense factor.
        ones = np.ones(int(begin[-1]), np.int8)
        rows = scipy.sparse.csr_array(
            (ones, place[present], begin), shape=(len(layouts), count * (bins + OPENING_ROWS))
        )
        return cls(rows, columns, (_BIN * (low + 0.5 + np.arange(bins))).astype(np.float32))

    def __len__(self) -> int:
        return len(self.rows.indptr) - 1

    @cached_property
    def parts(self) -> list[scipy.sparse.csr_array]:
        """The rows, a few hundred poses at a time; kept, because slices of a sparse matrix are slow."""
        return [self.rows[first : first + _PART] for first in range(0, len(self), _PART)]

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays, without `parts`."""
        return self.rows.data.nbytes + self.rows.indices.nbytes + self.rows.indptr.nbytes
