"""Coarse quantiser of the inverted file: cells of prototypes with similar walls and openings.

The centroids are k-means of prototypes of generated homes, without alignment of their headings, and come with the
package (`scripts/make_prototype_cells.py`). An inverted file probes only the cells whose centroids fit the query (Sivic
and Zisserman, *Video Google*, 2003; Jégou et al., *Product quantization for nearest neighbor search*, 2011). Cells
determine which prototypes are compared, and so speed and recall; they do not change the cost of a prototype.

A plan claims the opening classes with a trust of about a half or more. Prototypes are assigned by the claimed classes
alone, so there is a *family* of cells for every set of claimed classes. All families share the centroids; cell numbers
are `family · centroids + centroid`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16

from lalaloc_core.conventions import OPENING_CLASSES, WALL_CODE
from lalaloc_core.localise.venue.prototype_costs import PrototypeCosts
from lalaloc_core.localise.venue.prototypes import AZIMUTHS, unpacked_openings

CELLS_FILE = Path(__file__).with_name("prototype_cells.npz")
# Scales of log distances and classes in the features, proportional to their cost at a typical precision.
_LOG_SCALE, _CLASS_SCALE = 0.95, 0.74
# Bins of log distances (0.25 to 33 m) with tabulated costs.
_LOWEST, _HIGHEST, _BIN = -1.4, 3.5, 0.35
_BINS = round((_HIGHEST - _LOWEST) / _BIN) + 1
_CHUNK = 2048
# Number of families: sets of opening classes that a plan can claim.
FAMILIES = 1 << (len(OPENING_CLASSES) - 1)


@dataclass(frozen=True, eq=False)
class Cells:
    """Centroids of the cells of each family.

    Attributes:
        log_profile: (v, a) mean log wall profiles (m).
        share: (v, a, c) shares of the opening classes by azimuth.
        version: identifier of the centroids, stored with the prototypes that were assigned by them.
    """

    log_profile: Float[np.ndarray, "v a"]
    share: Float[np.ndarray, "v a c"]
    version: int
    _centroids: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, init=False, repr=False)

    def __len__(self) -> int:
        """Return the number of cells of all families."""
        return FAMILIES * len(self.log_profile)

    def assign(self, rows: np.ndarray) -> UInt16[np.ndarray, "n"]:
        """Return the cell of each prototype: its family's, with the nearest centroid."""
        feature, family = features(rows), family_of(rows["claims"])
        cell = np.empty(len(rows), np.uint16)
        for number in np.unique(family).tolist():
            row, column = family == number, _claimed_features(number)
            own = nearest(feature[np.ix_(row, column)], *self._claimed_centroids(number))
            cell[row] = number * len(self.log_profile) + own
        return cell

    def _claimed_centroids(self, family: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the centroids in the features that a family is assigned by, and half their squared norms."""
        if family not in self._centroids:
            centroid = np.ascontiguousarray(_features(self.log_profile, self.share)[:, _claimed_features(family)])
            self._centroids[family] = centroid, half_norms(centroid)
        return self._centroids[family]

    def costs(self, query_costs: PrototypeCosts, families: Iterable[int]) -> dict[int, Float[np.ndarray, "v k j"]]:
        """Return the approximate mean cost of each cell's prototypes under every hypothesis, for some families.

        It has the terms of walls and openings and the penalty of the height; the ceiling and the room type are left
        out. The walls' term interpolates between tabulated bins, a product of matrices for all cells and hypotheses.
        """
        (k, j), v = query_costs.shape, len(self.log_profile)
        position = _LOWEST + _BIN * np.arange(_BINS)
        residual = (position - query_costs.shifted[..., None]) * query_costs.precision[:, None, :, None]
        by_bin = (np.log1p(np.square(residual)) / AZIMUTHS).astype(np.float32).reshape(k * j, -1)
        walls = (self._bins @ by_bin.T).reshape(v, k, j) + query_costs.penalty.astype(np.float32)
        if not query_costs.compares_openings:
            return dict.fromkeys(families, walls)
        share = self.share.reshape(v, -1)
        losses = {family: query_costs.opening_loss(claims_of(family)).reshape(k, -1) for family in families}
        return {family: walls + (share @ loss.T)[:, :, None] for family, loss in losses.items()}

    @cached_property
    def _bins(self) -> Float[np.ndarray, "v b"]:
        """Linear interpolation weights of log distances: two adjacent bins each, the others 0."""
        position = (np.clip(self.log_profile, _LOWEST, _HIGHEST - 1e-6) - _LOWEST) / _BIN
        lower = position.astype(np.intp)
        weight = np.zeros((*position.shape, _BINS), np.float32)
        np.put_along_axis(weight, lower[..., None], (1.0 - (position - lower))[..., None], axis=2)
        np.put_along_axis(weight, lower[..., None] + 1, (position - lower)[..., None], axis=2)
        return weight.reshape(len(position), -1)


@lru_cache(maxsize=1)
def shipped_cells() -> Cells:
    """Return the cells that come with the package."""
    with np.load(CELLS_FILE) as file:
        return Cells(
            file["log_profile"].astype(np.float32), file["share"].astype(np.float32) / 255.0, int(file["version"])
        )


def family_of(claims: UInt8[np.ndarray, "n"]) -> UInt8[np.ndarray, "n"]:
    """Return the families of prototypes: the bits of their claimed opening classes, without the walls' bit."""
    return claims >> (WALL_CODE + 1) & (FAMILIES - 1)


def claims_of(family: int) -> int:
    """Return the `claims` of the prototypes of a family, see `family_of`."""
    return family << (WALL_CODE + 1)


def _claimed_features(family: int) -> Int[np.ndarray, "f"]:
    """Return the columns of `features` that a family is assigned by: walls and claimed opening classes."""
    classes = np.arange(1, len(OPENING_CLASSES))
    claimed = np.tile(claims_of(family) >> classes & 1, AZIMUTHS).astype(bool)
    return np.concatenate([np.arange(AZIMUTHS), AZIMUTHS + np.flatnonzero(claimed)])


def features(rows: np.ndarray) -> Float[np.ndarray, "n f"]:
    """Return the features that prototypes are assigned by: scaled log distances and opening classes by azimuth."""
    kind = unpacked_openings(rows["openings"])
    return _features(rows["log_profile"], (kind[:, :, None] == np.arange(len(OPENING_CLASSES))))


def _features(log_profile: np.ndarray, share: np.ndarray) -> Float[np.ndarray, "n f"]:
    n, openings = len(log_profile), np.delete(share, WALL_CODE, axis=2).astype(np.float32)
    return np.concatenate([_LOG_SCALE * log_profile.astype(np.float32), _CLASS_SCALE * openings.reshape(n, -1)], axis=1)


def half_norms(centroid: Float[np.ndarray, "v f"]) -> Float[np.ndarray, "v"]:
    """Return half the squared norm of each centroid."""
    return 0.5 * np.square(centroid).sum(axis=1)


def nearest(
    feature: Float[np.ndarray, "n f"], centroid: Float[np.ndarray, "v f"], half_norm: Float[np.ndarray, "v"]
) -> Int[np.ndarray, "n"]:
    """Return the number of the nearest centroid of each row of features."""
    number = np.empty(len(feature), np.intp)
    for begin in range(0, len(feature), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        number[part] = (half_norm - feature[part] @ centroid.T).argmin(axis=1)
    return number
