"""Layouts of an album's ground with binned distances, for costs by lookup tables.

The cost of a wall at an azimuth depends on its log distance, the kind of opening there, and the error of the camera's
height alone. For each azimuth of a photograph a table has that cost for every bin of distance, kind and height error;
the cost of a pose under a heading is a sum of entries, as in `localise.match.coarse_pass`, at all azimuths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import OPENING_CLASSES, PASSAGE_CODE
from lalaloc_core.localise.match import Layouts, MatchingConfig

# Width of the bins of log distance, and range of distances (m).
BIN = 0.05
_MIN_M, _MAX_M = 0.1, 60.0
FIRST_BIN = math.floor(math.log(_MIN_M) / BIN)
BINS = math.ceil(math.log(_MAX_M) / BIN) - FIRST_BIN
KINDS = len(OPENING_CLASSES)
_CONFIG = MatchingConfig()


@dataclass(frozen=True, eq=False)
class BinnedGround:
    """Binned layouts of n poses.

    Attributes:
        index: (n, 2w) bin of the distance times the number of kinds, plus the kind, twice around the horizon.
        row, column: (e,) pose and azimuth column of the walls that are seen through openings.
        own, behind: (e,) bin of the own wall and its kind as in `index`, and bin of the wall behind.
        odds: (e,) odds that a prediction is of the wall behind.
    """

    index: Int[np.ndarray, "n v"]
    row: Int[np.ndarray, "e"]
    column: Int[np.ndarray, "e"]
    own: Int[np.ndarray, "e"]
    behind: Int[np.ndarray, "e"]
    odds: Float[np.ndarray, "e"]

    @classmethod
    def of(cls, layouts: Layouts) -> BinnedGround:
        """Bin layouts at heading 0."""
        index = _bins(layouts.log_profile.astype(np.float32)) * KINDS
        if layouts.kind is not None:
            index += layouts.kind
        seen = layouts.seen
        if seen is None:
            none = np.zeros(0, np.intp)
            return cls(np.concatenate([index, index], axis=1), none, none, none, none, np.zeros(0, np.float32))
        share = np.where(seen.kind == PASSAGE_CODE, _CONFIG.open_passage, _CONFIG.open_door).astype(np.float32)
        return cls(
            index=np.concatenate([index, index], axis=1),
            row=seen.row.astype(np.intp),
            column=seen.column.astype(np.intp),
            own=index[seen.row, seen.column],
            behind=_bins(seen.log_behind.astype(np.float32)),
            odds=share / (1.0 - share),
        )

    def __len__(self) -> int:
        return len(self.index)

    @property
    def columns(self) -> int:
        """Azimuth columns of the horizon."""
        return self.index.shape[1] // 2

    def part(self, rows: slice) -> BinnedGround:
        """Return successive poses."""
        begin, end = np.searchsorted(self.row, (rows.start, rows.stop))
        seen = (values[begin:end] for values in (self.row - rows.start, self.column, self.own, self.behind, self.odds))
        return BinnedGround(self.index[rows], *seen)

    def chosen(self, rows: Int[np.ndarray, "m"]) -> BinnedGround:
        """Return some poses, by their numbers in rising order."""
        place = np.full(len(self), -1)
        place[rows] = np.arange(len(rows))
        kept = place[self.row] >= 0
        seen = (values[kept] for values in (place[self.row], self.column, self.own, self.behind, self.odds))
        return BinnedGround(self.index[rows], *seen)


def _bins(log_m: Float[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    return np.clip(np.floor(log_m / BIN).astype(np.intp) - FIRST_BIN, 0, BINS - 1)


def bin_centres() -> Float[np.ndarray, "b"]:
    """Return the log distance (m) at the centre of each bin."""
    return BIN * (FIRST_BIN + 0.5 + np.arange(BINS))
