"""Layouts of grid poses as the coarse pass (`coarse_pass.py`) compares them: binned distances, and openings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import OPENING_CLASSES, WALL_CODE
from lalaloc_core.localise.match.layouts import Layouts

# Azimuths that are compared: with spheres, and with views, which show a part of them.
SPHERE_AZIMUTHS, VIEW_AZIMUTHS = 16, 64
# Width of the bins of log distance: 5 cm at a distance of 1 m.
_BIN = 0.05
# Distances (m) are clipped to this range.
_MIN_DISTANCE_M, _MAX_DISTANCE_M = 0.1, 500.0
# Azimuths of a sector of views; a view shows some sectors only, a sphere all.
_SECTOR_AZIMUTHS = 8
# Poses of a part: the sums of their costs stay in the processor's cache.
_PART = 512
# Opening classes with a row at every azimuth: all but walls.
OPENING_ROWS = len(OPENING_CLASSES) - 1


@dataclass(frozen=True, eq=False)
class BinnedLayouts:
    """Binned layouts of n poses.

    Attributes:
        walls: sectors of azimuths, each with (n, a b) ones, for every azimuth at its bin.
        openings: (n, a k) ones, for every azimuth at its opening class if it is not a wall.
        columns: (a,) the azimuth columns that are compared.
        bins: (b,) log distances (m) at the centres of the bins.
    """

    walls: tuple[scipy.sparse.csr_array, ...]
    openings: scipy.sparse.csr_array
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
        sectors = tuple(_ones((number - low)[:, part], bins) for part in _sectors(count))
        kind = np.zeros(number.shape, np.int32)
        if layouts.kind is not None:
            kind = layouts.kind[:, columns].astype(np.int32)
        openings = _ones(kind - 1, OPENING_ROWS, kind != WALL_CODE)
        return cls(sectors, openings, columns, (_BIN * (low + 0.5 + np.arange(bins))).astype(np.float32))

    def __len__(self) -> int:
        return len(self.openings.indptr) - 1

    @property
    def sectors_of_azimuths(self) -> list[slice]:
        """Numbers of the azimuths of each sector."""
        return _sectors(len(self.columns))

    def part(self, pose: Any) -> BinnedLayouts:
        """Return the layouts of some poses: a slice or numbers."""
        return BinnedLayouts(tuple(rows[pose] for rows in self.walls), self.openings[pose], self.columns, self.bins)

    @cached_property
    def parts(self) -> list[BinnedLayouts]:
        """The layouts, a few hundred poses at a time; kept, because slices of a sparse matrix are slow."""
        return [self.part(slice(first, first + _PART)) for first in range(0, len(self), _PART)]

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays, without `parts`."""
        return sum(m.data.nbytes + m.indices.nbytes + m.indptr.nbytes for m in (*self.walls, self.openings))


def _sectors(azimuths: int) -> list[slice]:
    """Return the sectors of a number of azimuths."""
    size = azimuths if azimuths <= SPHERE_AZIMUTHS else _SECTOR_AZIMUTHS
    return [slice(first, min(first + size, azimuths)) for first in range(0, azimuths, size)]


def _ones(
    number: Int[np.ndarray, "n a"], values: int, present: Bool[np.ndarray, "n a"] | None = None
) -> scipy.sparse.csr_array:
    """Return (n, a values) ones, for every azimuth at its number, where one is present."""
    count, azimuths = number.shape
    place = number + np.arange(azimuths, dtype=np.int32) * values
    begin = np.arange(count + 1, dtype=np.int32) * azimuths
    if present is not None:
        place = place[present]
        begin[1:] = np.cumsum(present.sum(axis=1))
    # The narrowest type, so that products keep the type of the dense factor.
    ones = np.ones(place.size, np.int8)
    return scipy.sparse.csr_array((ones, place.ravel(), begin), shape=(count, azimuths * values))
